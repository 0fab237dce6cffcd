"""docs/reference says what the code does. `UPDATE_DOCS=1` writes the parts that are made of it."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

from ros2_memory import results
from ros2_memory.core.errors import EpisodicError, NoDataReason
from ros2_memory.history.context import QuerySettings
from ros2_memory.serving.mcp_server import (
    MOMENT,
    RESOURCES,
    SCHEMA,
)
from ros2_memory.tools import extra_tools, spec_tools
from ros2_memory.tools.build import build_tools
from tests.project import reference_tables as reference
from tests.support.clocks import in_zone
from tests.support.documented_history import CALLS, MISTAKES, replies, shown_files, write_history
from tests.support.memories import ROOT

FOLDER = ROOT / "docs" / "reference"
TOOLS = build_tools(QuerySettings(), writing=True)
HOW = "write it anew with `UPDATE_DOCS=1 uv run pytest -n0 tests/project/test_reference.py`"


@cache
def page(name: str) -> str:
    return (FOLDER / f"{name}.md").read_text()


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mapping[str, str]]:
    """What the server says to every call of the page, where the time zone is UTC."""
    with in_zone("UTC"):
        yield replies(write_history(tmp_path_factory.mktemp("history") / "bags"))


def compare(name: str, part: str, expected: str) -> None:
    """Holds a part of a page to what it has to be, or writes it."""
    text = page(name)
    said = reference.section(text, part)
    if reference.without_sizes(said) == reference.without_sizes(expected):
        return
    if os.environ.get("UPDATE_DOCS"):
        (FOLDER / f"{name}.md").write_text(
            reference.with_section(text, part, expected), encoding="utf-8"
        )
        page.cache_clear()
        return
    assert reference.without_sizes(said) == reference.without_sizes(expected), HOW


def test_every_tool_stands_there_with_its_arguments_a_call_and_its_reply(
    answers: Mapping[str, str],
) -> None:
    assert list(CALLS) == [tool.name for tool in TOOLS]
    assert [name for name in CALLS if "error" in json.loads(answers[name])] == []
    compare("tools", "tools", reference.tool_sections(TOOLS, answers))


DECLARED = {
    declaration.names[0].name: declaration
    for declaration in (*spec_tools.DECLARATIONS, *extra_tools.DECLARATIONS)
    if "Reply: " in declaration.description
}


SPREAD = {"x", "y", "z", "yaw_deg", "in", "also_in", "at_least", "notes"}
"""Keys that a unit shows in the place of its own, and the one that every reply may have."""


def outer_keys(text: str) -> list[str]:
    """The keys of the object that a text begins with, without those of its rows."""
    outer, depth = "", 0
    for char in re.sub(r"\([^()]*\)|: the [a-z ]+|: a number|: \w+ or null", "", text).lstrip("`["):
        depth += (char in "{[") - (char in "}]")
        if depth == 0:
            break
        outer += char if depth == 1 else ""
    return re.findall(r"[a-z_]+", outer)


@pytest.mark.parametrize("name", DECLARED)
def test_the_keys_that_a_reply_is_said_to_have_are_declared(name: str) -> None:
    [returned, *_] = re.findall(r"[A-Z]\w+", DECLARED[name].query.__annotations__["return"])
    declared = SPREAD | {key.name for key in getattr(results, returned).reply.keys}
    [description] = [tool.description for tool in TOOLS if tool.name == name]
    said = outer_keys(description.partition("Reply: ")[2])
    assert said
    assert [key for key in said if key not in declared] == []


def test_every_key_stands_there_with_its_default_and_what_it_may_hold() -> None:
    documented = reference.documented_settings()
    named = set(re.findall(r"^- `([\w.]+)` \(", documented, re.MULTILINE))
    assert named == reference.configured_keys(), "each key in config/ has a comment on its line"
    compare("configuration", "keys", documented)


def test_the_keys_of_the_specification_are_marked_and_have_its_defaults() -> None:
    keys = reference.keys_of(ROOT / "config/config.yaml", "")
    assert {key: default for key, default, meaning in keys if meaning.startswith("* ")} == {
        "recording.bag_dir": "data/bags",
        "recording.split_duration_s": "10",
        "recording.clear_on_startup": "false",
        "recording.topics_file": "config/topics.yaml",
        "data.max_array_length": "50",
        "data.position_tolerance_m": "0.5",
        "data.time_tolerance_s": "0.1",
        "reader.index_refresh_s": "5",
        "reader.custom_msg_paths": "[]",
        "retention.max_total_gb": "5.0",
        "retention.max_age_h": "168",
    }


def test_every_preset_and_every_variable_stands_there() -> None:
    presets = {path.stem for path in (ROOT / "config" / "deployment").glob("*.yaml")}
    assert presets <= set(re.findall(r"^\| `(\w+)` \|", page("configuration"), re.MULTILINE))
    example = (ROOT / ".env.example").read_text()
    for variable in re.findall(r"^#([A-Z_]+)=", example, re.MULTILINE):
        assert f"`{variable}`" in page("configuration")


def test_every_resource_stands_there_with_the_tool_behind_it() -> None:
    documented = dict(
        re.findall(r"^\| `(episodic://\S+)` \| (.+) \|$", page("tools"), re.MULTILINE)
    )
    templates = {MOMENT.uri_template, SCHEMA.uri_template}
    assert set(documented) == {resource.uri for resource in RESOURCES.values()} | templates
    for tool, resource in RESOURCES.items():
        if tool != "list_moments":
            assert documented[resource.uri] == f"`{tool}`"


def test_every_command_and_every_column_of_a_lake_stands_there() -> None:
    compare("commands", "exits", reference.exit_list())
    compare("lake", "columns", reference.lake_tables())


def test_every_log_event_that_is_explained_exists() -> None:
    compare("log-events", "events", reference.event_list(page("log-events")))


def test_every_error_code_and_every_reason_stands_there() -> None:
    tables = set(re.findall(r"^\| `(\w+)` \|", page("errors"), re.MULTILINE))
    tables -= {"error", "reason"}  # their heads
    expected = reference.codes(EpisodicError) - {"no_data"} | {
        reason.value for reason in NoDataReason
    }
    assert tables == expected


@pytest.mark.parametrize("part", sorted(MISTAKES))
def test_every_error_that_is_shown_is_what_the_server_says(
    part: str, answers: Mapping[str, str]
) -> None:
    tool, given = MISTAKES[part]
    call = json.dumps({"name": tool, "arguments": given})
    compare("errors", part, f"```json\n{call}\n```\n\n{reference.shown(answers[part])}")


def test_every_file_that_is_shown_is_what_the_recorder_writes(tmp_path: Path) -> None:
    for part, text in shown_files(tmp_path).items():
        compare("files", part, reference.shown(text))
