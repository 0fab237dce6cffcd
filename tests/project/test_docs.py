"""What documents name exists, and AGENTS.md and the package's map leave no room out."""

from __future__ import annotations

import ast
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_type_hints

import pytest

import ros2_memory
from ros2_memory.config import Ros2BagNode, Settings
from ros2_memory.history.context import QuerySettings
from ros2_memory.tools.spec_tools import build_tools
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator

README = (ROOT / "README.md").read_text(encoding="utf-8")
REFERENCE = (ROOT / "docs/reference/tools.md").read_text(encoding="utf-8")
TOOLS = build_tools(QuerySettings(), writing=True)


def keys(cls: type, prefix: str = "") -> Iterator[str]:
    hints = get_type_hints(cls)
    for each in fields(cls):
        name = f"{prefix}{each.name}"
        kind = hints[each.name]
        if is_dataclass(kind) and isinstance(kind, type):
            yield from keys(kind, f"{name}.")
        else:
            section = name.partition(".")[0]
            is_chosen = section in {"storage", "recorder"} or name == "lake.engine"
            yield section if is_chosen else name


def test_the_overview_lists_the_tools_in_their_order() -> None:
    section = REFERENCE.partition("| tool |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert rows == [tool.name for tool in TOOLS]


def test_readme_counts_the_tools() -> None:
    assert f"has {len(TOOLS)} tools" in README


def test_every_key_that_readme_tells_of_exists() -> None:
    sections = {each.name for each in fields(Settings)}
    documented = set(re.findall(r"`(\w+\.\w+)(?:=[^`]*)?`", README))
    known = set(keys(Settings)) | {f"recorder.{each.name}" for each in fields(Ros2BagNode)}
    known.add("recorder.json")  # a file
    assert {key for key in documented if key.split(".")[0] in sections} <= known


DOCUMENTS = sorted([ROOT / "README.md", ROOT / "AGENTS.md", *(ROOT / "docs").rglob("*.md")])
NAMED = sorted(
    {
        (document.name, reference)
        for document in DOCUMENTS
        for reference in re.findall(
            r"tests/[\w/]+\.py(?:::\w+)*", document.read_text(encoding="utf-8")
        )
    }
)


def held_by(path: Path) -> set[str]:
    """What a file of tests holds: `test_x`, `TestY`, `TestY::test_x`."""
    held = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            held.add(node.name)
        if isinstance(node, ast.ClassDef):
            held |= {
                f"{node.name}::{inner.name}"
                for inner in node.body
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef)
            }
    return held


@pytest.mark.parametrize(("document", "reference"), NAMED)
def test_every_test_that_a_document_names_exists(document: str, reference: str) -> None:
    file, _, name = reference.partition("::")
    assert (ROOT / file).is_file(), f"{document} names {file}"
    if name:
        assert name.rpartition("::")[2].startswith("test_"), f"{document} names {reference}"
        assert name in held_by(ROOT / file), f"{document} names {reference}"


def anchors(path: Path) -> set[str]:
    """What the headings of a page are linked to as."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)
def test_every_file_that_a_document_links_to_or_names_exists(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    linked = re.findall(r"\]\((?!https?://|#)([^)#\s]+)", text)
    named = re.findall(r"`((?:docs|deploy|tests|benchmarks|config)/[\w./-]+\.\w+)`", text)
    folder = document.parent
    assert [each for each in linked if not (folder / each).exists()] == []
    led = re.findall(r"\]\((?!https?://)([^)#\s]*)#([^)\s]+)\)", text)
    lost = [
        (path, anchor)
        for path, anchor in led
        if anchor not in anchors(folder / path if path else document)
    ]
    assert lost == []
    assert [each for each in named if not (ROOT / each).exists()] == []


SOURCE = ROOT / "src" / "ros2_memory"
MAPS = [
    ROOT / "AGENTS.md",
    *(ROOT / "docs" / name for name in ("architecture.md", "reference/specification.md")),
]


@pytest.mark.parametrize("document", MAPS, ids=lambda document: document.name)
def test_every_module_that_a_map_names_exists(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    named = re.findall(r"`([a-z_0-9/.-]+(?:/|\.py|\.toml|\.yaml))(?:::[\w:]+)?`", text)
    elsewhere = ("moments/", "build/", "tools/mcp.yaml", "topics.yaml", "metadata.yaml")
    paths = [each for each in named if not each.startswith((*elsewhere, "."))]
    assert len(paths) > 15
    assert [
        each for each in paths if not ((SOURCE / each).exists() or (ROOT / each).exists())
    ] == []


def test_agents_and_the_map_of_the_package_name_every_room() -> None:
    rooms = sorted(each.parent.name for each in SOURCE.glob("*/__init__.py"))
    agents = (ROOT / "AGENTS.md").read_text(encoding="utf-8")
    assert [room for room in rooms if f"`{room}/`" not in agents] == []
    mapped = re.findall(r"^    ([a-z_]+) ", ros2_memory.__doc__ or "", re.MULTILINE)
    assert sorted({*rooms} - {*mapped}) == []
