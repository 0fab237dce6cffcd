"""What documents name exists, and AGENTS.md and the package's map leave no room out."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

import ros2_memory
from ros2_memory.config import Settings
from tests.project.reference_tables import configured_keys
from tests.support.memories import ROOT

README = (ROOT / "README.md").read_text()
SOURCE = ROOT / "src" / "ros2_memory"
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "AGENTS.md", *(ROOT / "docs").rglob("*.md")])
MAPS = [
    ROOT / "AGENTS.md",
    *(ROOT / "docs" / name for name in ("architecture.md", "reference/specification.md")),
]
EACH = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)


def test_every_key_that_readme_names_exists() -> None:
    sections = {each.name for each in fields(Settings)}
    documented = set(re.findall(r"`(\w+\.\w+)(?:=[^`]*)?`", README))
    known = configured_keys() | {"recorder.json"}  # a file
    assert {key for key in documented if key.split(".")[0] in sections} <= known


def anchors(path: Path) -> set[str]:
    """What the headings of a page are linked to as."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings}


@EACH
def test_every_file_section_and_test_that_a_document_names_exists(document: Path) -> None:
    text, folder = document.read_text(), document.parent
    linked = re.findall(r"\]\((?!https?://|#)([^)#\s]+)", text)
    named = re.findall(r"`((?:docs|deploy|tests|benchmarks|config)/[\w./-]+\.\w+)", text)
    assert [each for each in linked if not (folder / each).exists()] == []
    assert [each for each in named if not (ROOT / each).exists()] == []
    led = re.findall(r"\]\((?!https?://)([^)#\s]*)#([^)\s]+)\)", text)
    assert [
        (path, anchor)
        for path, anchor in led
        if anchor not in anchors(folder / path if path else document)
    ] == []
    for file, name in re.findall(r"(tests/[\w/]+\.py)::(?:\w+::)?(\w+)", text):
        assert re.search(rf"(def|class) {name}\b", (ROOT / file).read_text()), name


@pytest.mark.parametrize("document", MAPS, ids=lambda document: document.name)
def test_every_module_that_a_map_names_exists(document: Path) -> None:
    text = document.read_text()
    named = re.findall(r"`([a-z_0-9/.-]+(?:/|\.py|\.toml|\.yaml))(?:::[\w:]+)?`", text)
    elsewhere = ("moments/", "build/", "tools/mcp.yaml", "topics.yaml", "metadata.yaml")
    paths = [each for each in named if not each.startswith((*elsewhere, "."))]
    assert len(paths) > 15
    assert [
        each for each in paths if not ((SOURCE / each).exists() or (ROOT / each).exists())
    ] == []


def test_agents_and_the_map_of_the_package_name_every_room() -> None:
    rooms = {each.parent.name for each in SOURCE.glob("*/__init__.py")}
    agents = (ROOT / "AGENTS.md").read_text()
    assert [room for room in rooms if f"`{room}/`" not in agents] == []
    mapped = re.findall(r"^    ([a-z_]+) ", ros2_memory.__doc__ or "", re.MULTILINE)
    assert rooms <= {*mapped}
