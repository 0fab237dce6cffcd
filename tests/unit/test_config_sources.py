"""Which file of a configuration directory set a key."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest

from ros2_memory.config_sources import Sources
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return shutil.copytree(ROOT / "config", tmp_path / "config")


def test_a_preset_that_builds_on_itself_ends(folder: Path) -> None:
    (folder / "config.yaml").write_text("defaults:\n  - deployment: loop\n")
    (folder / "deployment" / "loop.yaml").write_text("defaults: [loop]\ndata: {now: latest}\n")
    assert Sources(folder, (), {})("data.now") == f"in {folder}"


def test_a_file_of_the_operators_stands_for_the_keys_that_it_sets(folder: Path) -> None:
    text = (folder / "config.yaml").read_text().replace("deployment: null", "deployment: mine")
    (folder / "config.yaml").write_text(text)
    (folder / "deployment" / "mine.yaml").write_text(
        "# @package _global_\nserver:\n  name: robin\n"
    )
    source = Sources(folder, (), {})
    assert source("server.name") == f"in {folder / 'deployment' / 'mine.yaml'}"
    assert source("server.port") == f"in {folder / 'config.yaml'}"
    assert source.choice("deployment") == ("mine", f"in {folder / 'config.yaml'}")


@pytest.mark.parametrize("content", ["[", "- 1", "", "data: 7", "defaults: 7", "\x00"])
def test_of_files_that_make_no_sense_the_folder_is_named(folder: Path, content: str) -> None:
    (folder / "config.yaml").write_text(content)
    assert Sources(folder, (), {})("data.now") == f"in {folder}"
    assert Sources(folder, (), {}).choice("storage") == (None, f"in {folder / 'config.yaml'}")
