"""Architecture, AGENTS.md and the package's map name what is there, and leave no room out."""

from __future__ import annotations

import re
from typing import Final

import ros2_memory
from tests.support.memories import ROOT

SOURCE: Final = ROOT / "src" / "ros2_memory"
PAGE: Final = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
AGENTS: Final = (ROOT / "AGENTS.md").read_text(encoding="utf-8")
ROOMS: Final = sorted(each.parent.name for each in SOURCE.glob("*/__init__.py"))


def test_every_module_that_is_named_exists() -> None:
    named = re.findall(r"`((?:[a-z_0-9]+/)+[a-z_0-9]*(?:\.py)?|[a-z_]+\.py)`", PAGE + AGENTS)
    folders = ("config/", "docs/", "tests/", "benchmarks/", "moments/", "build/")
    modules = [each for each in named if not each.startswith(folders)]
    assert len(modules) > 30
    assert [each for each in modules if not (SOURCE / each).exists()] == []


def test_the_table_and_the_map_name_every_room() -> None:
    described = ros2_memory.__doc__ or ""
    assert [room for room in ROOMS if f"`{room}/`" not in AGENTS] == []
    mapped = re.findall(r"^    ([a-z_]+) ", described, re.MULTILINE)
    assert sorted({*ROOMS} - {*mapped}) == []
