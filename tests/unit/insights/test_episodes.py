"""Texts and states that hold until the next: intervals, what is beside them, how often, changes."""

from itertools import count
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.history import held_values
from ros2_memory.history.context import Memory
from ros2_memory.history.held_values import HeldValues
from ros2_memory.insights import sightings
from tests.support.bags import (
    Msg,
    boolean,
    make,
    octets,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.memories import asked, each_way, memory_of
from tests.support.tables import table

S = 10**9
BEGIN = 1_784_000_000
TASKS = [
    (10, "wash the pot"), (40, "wash the pot"), (70, ""), (80, "wash the potato"),
    (120, "use a knife"), (200, "use a butter knife"), (260, ""), (300, "wash the pot"),
]  # fmt: skip
ACTIONS = [(12, "scrub"), (30, "rinse"), (60, ""), (85, "peel"), (110, ""), (130, "cut"), (210, "")]


def written(folder: Path, *, stored: bool = False) -> Memory:
    """Bags with a beat every two seconds, and nothing between 320 and 900 s."""
    said = [text((BEGIN + at) * S, words, "/task") for at, words in TASKS]
    said += [text((BEGIN + at) * S, words, "/action") for at, words in ACTIONS]
    beats = [odom((BEGIN + at) * S, at / 100) for at in range(0, 321, 2)]
    beats += [boolean((BEGIN + at) * S, data=at >= 100, topic="/docked") for at in range(0, 320, 2)]
    later = [odom((BEGIN + at) * S) for at in range(900, 940, 2)]
    later.insert(5, text((BEGIN + 909) * S, "rest", "/task"))
    write_splits(folder, [*said, *beats], 100, "a")
    write_mcap(folder / "c" / "c_0.mcap", later)
    return memory_of(folder, recalls=stored)


@pytest.fixture(scope="module", params=[False, True], ids=["bags", "store"])
def memory(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    return written(tmp_path_factory.mktemp("bags"), stored=request.param)


def ask(memory: Memory, tool: str, **given: object) -> Any:
    return asked(memory, tool, **given)


def test_changes_are_one_row_for_each_value_with_what_held_at_the_start(memory: Memory) -> None:
    window = {"start": BEGIN + 50, "end": BEGIN + 130}
    reply = ask(memory, "get_topic_in_range", topic="/task", changes=True, **window)
    assert [(row["start"] - BEGIN, row["value"]) for row in reply["changes"]] == [
        (10, "wash the pot"),
        (80, "wash the potato"),
        (120, "use a knife"),
    ]
    assert "notes" not in reply
    few = ask(memory, "get_topic_in_range", topic="/task", changes=True, max_samples=2, **window)
    assert (few["total"], len(few["changes"])) == (3, 2)
    assert few["notes"][0].startswith("the first 2 of 3 changes: to continue")
    docked = ask(memory, "get_topic_in_range", topic="/docked", changes=True, **window)
    assert [row["value"] for row in docked["changes"]] == [False, True]


@each_way
@pytest.mark.parametrize(
    ("kind", "number"),
    [("Float32", 0.1), ("Float32", float(2**128 - 2**104)), ("Float64", 1e300)],
)
def test_a_number_is_written_as_everywhere_else(
    tmp_path: Path, kind: str, number: float, *, recalls: bool
) -> None:
    """A float32 holds 0.10000000149011612 where 0.1 was meant."""
    type_name = f"std_msgs/msg/{kind}"
    said = [make(type_name, data=value) for value in (number, 2.5, number)]
    messages = [Msg("/number", type_name, (BEGIN + n) * S, body) for n, body in enumerate(said)]
    write_splits(tmp_path, messages)
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/number", "start": BEGIN, "end": BEGIN + 9}
    samples = ask(memory, "get_topic_in_range", **given)["samples"]
    changes = ask(memory, "get_topic_in_range", **given, changes=True)["changes"]
    rows = ask(memory, "get_topic_in_range", **given, by="value")["rows"]
    shown = [str(row["value"]) for row in changes]
    assert shown == [str(number), "2.5", str(number)]
    assert shown == [str(each["value"]["value"]) for each in samples]
    assert {row[0] for row in rows} == {*shown}


@each_way
def test_the_size_of_a_long_array_is_no_value_of_it(tmp_path: Path, *, recalls: bool) -> None:
    said = [octets((BEGIN + n) * S, [n] * 60) for n in range(10)]
    write_splits(tmp_path, said)
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/octets", "start": BEGIN, "end": BEGIN + 9}
    for how in ({"changes": True}, {"by": "value"}):
        reply = ask(memory, "get_topic_in_range", **given, **how, fields=["data"])
        assert "field data of /octets" in reply["detail"]
        reply = ask(memory, "get_topic_in_range", **given, **how, fields=["data.7"])
        assert len(reply["changes"] if "changes" in how else reply["rows"]) == 10


def test_a_search_that_runs_out_of_time_says_from_where_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After four tables of each question."""
    looks = count(1)

    def check(_: HeldValues, at: int) -> None:
        if next(looks) % 5 == 0:
            raise QueryTimeoutError(f"out of time at {at}")

    monkeypatch.setattr(sightings, "says_episodes", lambda *_: True)
    monkeypatch.setattr(HeldValues, "_check", check)
    given = {"topic": "/task", "condition_type": "equals"}
    some = ask(written(tmp_path), "find_matches", **given, value="rest")
    assert (some["at_least"], some["more"]) == (1, True)
    assert f"ran out of time at {BEGIN + 260}" in some["notes"][0]
    none = ask(written(tmp_path / "again"), "find_matches", **given, value="wash the potato")
    assert (none["error"], none["searched_back_to"]) == ("timeout", BEGIN + 260)


def test_values_that_are_too_long_to_be_held_are_named(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held_values, "_MOST_CHARS", 40)
    window = {"start": BEGIN, "end": BEGIN + 319}
    reply = ask(memory, "get_topic_in_range", topic="/task", by="value", **window)
    assert [row[0] for row in reply["rows"]] == ["use a butter knife", "wash the pot"]
    [note] = [each for each in reply["notes"] if "more than 40 characters" in each]
    assert f"only what is after {BEGIN + 200}.000000 is counted" in note


def test_of_more_episodes_than_are_counted_the_newest_are(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sightings, "MOST_COUNTED", 2)
    given = {"topic": "/task", "condition_type": "contains", "value": "wash", "by": "day"}
    reply = ask(memory, "find_matches", **given)
    assert (reply["start"], table(reply)["all"]["count"]) == (BEGIN + 80, 2)
    [note] = [each for each in reply["notes"] if "is counted" in each]
    assert note.endswith("is counted: more than 2 episodes; ask about a shorter window")
