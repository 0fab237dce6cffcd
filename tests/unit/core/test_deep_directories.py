"""Directories nested deeper than a program's stack, its open files or a path can be."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from ros2_memory.bootstrap import build_memory, reading_of
from ros2_memory.cli.maintenance.recover import recover_files
from ros2_memory.config import load_settings
from ros2_memory.core import directories
from ros2_memory.retention.clear import clear_bags
from tests.support.bags import odom, write_mcap
from tests.support.housekeepers import keeper_of

DEEP = 1100


@contextmanager
def within(root: Path, depth: int, name: str) -> Iterator[int]:
    """The innermost of so many nested directories, made where they are not."""
    current = os.open(root, os.O_RDONLY)
    for _ in range(depth):
        with suppress(FileExistsError):
            os.mkdir(name, dir_fd=current)
        inner = os.open(name, os.O_RDONLY, dir_fd=current)
        os.close(current)
        current = inner
    try:
        yield current
    finally:
        os.close(current)


def put(root: Path, bag: Path, depth: int = DEEP, name: str = "d") -> None:
    with within(root, depth, name) as inner:
        os.link(bag, "deep.mcap", dst_dir_fd=inner)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "bag.mcap", [odom(1_790_000_000 * 10**9, 1.0, 2.0)])


@pytest.fixture
def bags(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "bags"
    folder.mkdir()
    yield folder
    # pytest would recurse.
    subprocess.run(["rm", "-rf", str(folder)], check=True)


def test_they_are_scanned_repaired_read_for_definitions_cleared_and_removed(
    bags: Path, bag: Path, tmp_path: Path
) -> None:
    put(bags, bag)
    with within(bags, DEEP, "d") as inner:
        os.mkdir("msg", dir_fd=inner)
        os.close(os.open("msg/Deep.msg", os.O_CREAT | os.O_WRONLY, dir_fd=inner))
    settings = load_settings(
        [f"recording.bag_dir={bags}", f"reader.custom_msg_paths=[{bags}]"], {"XDG_CACHE_HOME": ""}
    )
    assert reading_of(settings, {})
    assert len(build_memory(settings).index.snapshot().bags) == 1
    keeper_of(bags).apply()
    assert recover_files(bags).whole == 1
    assert clear_bags(bags).files == 1
    put(bags, bag, 3, "shallow")
    (bags / "link").symlink_to(tmp_path)
    directories.remove(bags)
    assert not bags.exists()
    assert bag.exists()
