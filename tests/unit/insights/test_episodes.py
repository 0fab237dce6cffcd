"""Texts and states that hold until the next: intervals, what is beside them, how often, changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.history import held_values
from ros2_memory.history.held_values import HeldValues
from ros2_memory.insights import sightings
from tests.support.bags import (
    McapLayout,
    battery,
    boolean,
    octets,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, each_way, memory_of, with_store

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.history.context import Memory

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
    beats = [odom((BEGIN + at) * S, at / 100, 0.0) for at in range(0, 321, 2)]
    beats += [boolean((BEGIN + at) * S, data=at >= 100, topic="/docked") for at in range(0, 320, 2)]
    later = [odom((BEGIN + at) * S, 0.0, 0.0) for at in range(900, 940, 2)]
    later.insert(5, text((BEGIN + 909) * S, "rest", "/task"))
    write_splits(folder, [*said, *beats], 100, "a")
    write_mcap(folder / "c" / "c_0.mcap", later)
    memory = memory_of(folder)
    return with_store(memory, folder) if stored else memory


@pytest.fixture(scope="module", params=[False, True], ids=["bags", "store"])
def memory(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    return written(tmp_path_factory.mktemp("bags"), stored=request.param)


def test_what_is_damaged_outside_of_the_window_is_no_note(tmp_path: Path) -> None:
    """Whether a topic has episodes is seen in its newest messages, of which one is damaged."""
    for nth in range(2):
        begin = (BEGIN + 40 * nth) * S
        said = [text(begin + n * S, f"step {n}") for n in range(10)]
        path = write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", said, McapLayout(chunk_size=200))
    spoil_chunk(path, 2)
    memory = memory_of(tmp_path)
    found = {"topic": "/chatter", "condition_type": "contains", "value": "step"}
    early = ask(memory, "find_matches", **found, start=BEGIN + 2, end=BEGIN + 4)
    assert len(early["sightings"]) == 1
    assert "notes" not in early
    late = ask(memory, "find_matches", **found, start=BEGIN + 40, end=BEGIN + 50)
    assert any("could not be read whole" in note for note in late["notes"])


def ask(memory: Memory, tool: str, **given: object) -> Any:
    return asked(memory, memory.index.bag_dir, tool, **given)


def matches(memory: Memory, kind: str, value: str, **given: object) -> list[Any]:
    reply = ask(memory, "find_matches", topic="/task", condition_type=kind, value=value, **given)
    rows: list[Any] = reply["episodes"]
    return rows


def spans(rows: list[Any]) -> list[tuple[float, float, str]]:
    return [(row["start"] - BEGIN, row["end"] - BEGIN, row["value"]) for row in rows]


def test_a_text_holds_until_the_next_and_has_what_came_before_and_after(memory: Memory) -> None:
    rows = matches(memory, "contains", "wash", oldest_first=True)
    assert spans(rows) == [
        (10, 70, "wash the pot"),
        (80, 120, "wash the potato"),
        (300, 320, "wash the pot"),
    ]
    assert "previous" not in rows[0]
    assert (rows[0]["next"]["value"], rows[0]["next"]["start"]) == ("wash the potato", BEGIN + 80)
    assert rows[1]["previous"]["value"] == "wash the pot"
    assert rows[1]["next"]["value"] == "use a knife"
    assert rows[1]["robot"]["x"] == 0.8
    assert [row["seconds"] for row in rows] == [60, 40, 20]


def test_a_text_that_nothing_was_recorded_after_is_not_said_to_have_ended(memory: Memory) -> None:
    cut, open_end = (
        matches(memory, "contains", "pot", start=BEGIN + 290)[0],
        ask(memory, "find_matches", topic="/task", condition_type="equals", value="rest")[
            "episodes"
        ][0],
    )
    assert (cut["end"], cut["ended"], cut["next"]["value"]) == (BEGIN + 320, False, "rest")
    assert (open_end["end"], open_end["ended"]) == (BEGIN + 938, False)


@pytest.mark.parametrize(
    ("kind", "value", "found"),
    [
        ("contains", "pot", {"wash the pot", "wash the potato"}),
        ("contains_word", "pot", {"wash the pot"}),
        ("contains_word", "Knife", {"use a knife", "use a butter knife"}),
        ("contains_word", "knife -butter", {"use a knife"}),
        ("contains_word", "butter knife", {"use a butter knife"}),
    ],
)
def test_whole_words_are_told_from_parts_of_words(
    memory: Memory, kind: str, value: str, found: set[str]
) -> None:
    assert {row["value"] for row in matches(memory, kind, value)} == found


def test_values_are_counted_with_how_long_they_held(memory: Memory) -> None:
    window = {"start": BEGIN, "end": BEGIN + 319}
    reply = ask(memory, "get_topic_in_range", topic="/task", by="value", **window)
    counts = {row[0]: row[1:3] for row in reply["rows"]}
    assert counts["wash the pot"] == [2, 79.0]
    assert counts["wash the potato"] == [1, 40.0]
    assert reply["all"][:2] == [5, 259.0]
    docked = ask(memory, "get_topic_in_range", topic="/docked", by="value", **window)
    assert {row[0]: row[1:3] for row in docked["rows"]} == {
        "true": [1, 218.0],
        "false": [1, 100.0],
    }
    one = {"topic": "/task", "condition_type": "contains_word", "value": "pot", "by": "value"}
    assert [row[:2] for row in ask(memory, "find_matches", **one)["rows"]] == [["wash the pot", 2]]


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


def test_numbers_are_written_as_everywhere_else(tmp_path: Path) -> None:
    """A float32 holds 0.10000000149011612 where 0.1 was meant."""
    write_mcap(
        tmp_path / "a" / "a_0.mcap", [battery((BEGIN + n) * S, n // 5 / 10) for n in range(15)]
    )
    given = {"topic": "/battery_state", "start": BEGIN, "end": BEGIN + 14, "fields": ["percentage"]}
    for stored in (False, True):
        memory = memory_of(tmp_path)
        memory = with_store(memory, tmp_path) if stored else memory
        reply = ask(memory, "get_topic_in_range", changes=True, **given)
        assert [row["value"] for row in reply["changes"]] == [0, 0.1, 0.2]
        reply = ask(memory, "get_topic_in_range", by="value", **given)
        assert {row[0] for row in reply["rows"]} == {"0", "0.1", "0.2"}


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("get_topic_in_range", {"topic": "/odom", "changes": True}),
        ("get_topic_in_range", {"topic": "/odom", "by": "value"}),
        (
            "find_matches",
            {"topic": "/task", "condition_type": "contains", "value": "pot", "with": "/odom"},
        ),
    ],
)
def test_a_topic_without_a_single_value_is_refused_by_name(
    memory: Memory, tool: str, given: dict[str, object]
) -> None:
    reply = ask(memory, tool, **given, start=BEGIN, end=BEGIN + 300)
    assert reply["error"] == "invalid_arguments"
    assert "/odom (nav_msgs/msg/Odometry) is no text, number or boolean" in reply["detail"]


@each_way
def test_the_size_of_a_long_array_is_no_value_of_it(tmp_path: Path, *, recalls: bool) -> None:
    said = [octets((BEGIN + n) * S, [n] * 60) for n in range(10)]
    write_mcap(tmp_path / "a" / "a_0.mcap", said)
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/octets", "start": BEGIN, "end": BEGIN + 9}
    for how in ({"changes": True}, {"by": "value"}):
        reply = ask(memory, "get_topic_in_range", **given, **how, fields=["data"])
        assert "field data of /octets" in reply["detail"]
        reply = ask(memory, "get_topic_in_range", **given, **how, fields=["data.7"])
        assert len(reply["changes"] if "changes" in how else reply["rows"]) == 10


def test_an_unknown_topic_beside_is_named(memory: Memory) -> None:
    reply = ask(
        memory, "find_matches", topic="/task", condition_type="contains", value="pot",
        **{"with": "/actions"},
    )  # fmt: skip
    assert (reply["error"], reply["reason"]) == ("no_data", "topic_not_recorded")
    assert "/action" in reply["detail"]


def test_texts_that_no_empty_one_ends_are_sightings_as_before(tmp_path: Path) -> None:
    words = ["hello", "stop", "stop", "hello"]
    said = [text((BEGIN + 60 * nth) * S, each, "/speech") for nth, each in enumerate(words)]
    write_mcap(tmp_path / "bag.mcap", said)
    given = {"topic": "/speech", "condition_type": "contains", "value": "stop"}
    assert ask(memory_of(tmp_path), "find_matches", **given)["total"] == 2


def test_a_minute_or_a_day_that_is_start_and_end_is_meant_as_a_whole(memory: Memory) -> None:
    minute = "2026-07-14T03:34Z"  # 40 s to 100 s after BEGIN
    given = {"topic": "/action", "start": minute, "end": minute}
    reply = ask(memory, "get_topic_in_range", **given)
    assert [sample["timestamp"] - BEGIN for sample in reply["samples"]] == [60, 85]
    exact = ask(memory, "get_topic_in_range", **{**given, "end": "2026-07-14T03:34:00Z"})
    assert exact["error"] == "no_data"


@pytest.mark.parametrize("late_ns", [0, 1, 1000])
def test_a_text_does_not_reach_into_the_second_or_the_minute_after_it(
    tmp_path: Path, late_ns: int
) -> None:
    ticks = [text((BEGIN + at) * S + late_ns, f"{at}") for at in range(0, 200, 20)]
    write_mcap(tmp_path / "bag.mcap", ticks)
    memory = memory_of(tmp_path)
    for second in ("2026-07-14T03:33:39Z", "2026-07-14T03:33:39.9Z"):  # 19 s after BEGIN
        asked = {"topic": "/chatter", "timestamp": second, "tolerance_s": 60}
        assert ask(memory, "get_topic_at_time", **asked)["value"] == {"value": "0"}
    minute = dict.fromkeys(("start", "end"), "2026-07-14T03:34Z")
    reply = ask(memory, "get_topic_in_range", topic="/chatter", **minute)
    assert [sample["value"]["value"] for sample in reply["samples"]] == ["40", "60", "80"]


def only(memory: Memory, tables: int, monkeypatch: pytest.MonkeyPatch) -> Memory:
    """The memory, whose time for reading is over after so many tables of each question."""
    left = [tables]

    def check(_: HeldValues, at: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise QueryTimeoutError(f"out of time at {at}")

    monkeypatch.setattr(sightings, "says_episodes", lambda *_: True)
    monkeypatch.setattr(HeldValues, "_check", check)
    return memory


@pytest.mark.parametrize(
    ("given", "rows"), [({"changes": True}, "changes"), ({"by": "value"}, "rows")]
)
def test_what_a_call_has_no_time_for_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: dict[str, object], rows: str
) -> None:
    memory = only(written(tmp_path), 4, monkeypatch)
    window = {"start": BEGIN, "end": BEGIN + 935}
    reply = ask(memory, "get_topic_in_range", topic="/task", **given, **window)
    assert len(reply[rows]) == 2
    [note] = [each for each in reply["notes"] if "out of time" in each]
    assert f"only what is after {BEGIN + 260}" in note


def test_a_search_that_runs_out_of_time_says_from_where_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = only(written(tmp_path), 4, monkeypatch)
    given = {"topic": "/task", "condition_type": "equals"}
    some = ask(memory, "find_matches", **given, value="rest")
    assert (some["at_least"], some["more"]) == (1, True)
    assert f"ran out of time at {BEGIN + 260}" in some["notes"][0]
    memory = only(written(tmp_path / "again"), 4, monkeypatch)
    none = ask(memory, "find_matches", **given, value="wash the potato")
    assert (none["error"], none["searched_back_to"]) == ("timeout", BEGIN + 260)


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("get_topic_in_range", {"topic": "/task", "changes": True}),
        ("get_topic_in_range", {"topic": "/docked", "by": "value"}),
        (
            "find_matches",
            {"topic": "/task", "condition_type": "contains", "value": "pot", "with": "/action"},
        ),
    ],
)
def test_messages_that_have_no_columns_give_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tool: str, given: dict[str, object]
) -> None:
    given = {"start": BEGIN, "end": BEGIN + 935, **given}
    by_columns = ask(written(tmp_path / "columns"), tool, **given)
    monkeypatch.setattr(held_values, "words_of", lambda *_: None)
    assert ask(written(tmp_path / "messages"), tool, **given) == by_columns


def test_texts_that_are_too_long_for_a_state_are_sightings(tmp_path: Path) -> None:
    said = ["", *["wash the pot " + "x" * 20_000] * 3]
    rows = [text((BEGIN + n) * S, each, "/task") for n, each in enumerate(said)]
    write_mcap(tmp_path / "a" / "a_0.mcap", rows)
    memory = memory_of(tmp_path)
    given = {"topic": "/task", "condition_type": "contains", "value": "pot"}
    assert "episodes" not in ask(memory, "find_matches", **given)


def test_values_that_are_too_long_to_be_held_are_named(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held_values, "_MOST_CHARS", 40)
    window = {"start": BEGIN, "end": BEGIN + 319}
    reply = ask(memory, "get_topic_in_range", topic="/task", by="value", **window)
    assert [row[0] for row in reply["rows"]] == ["use a butter knife", "wash the pot"]
    [note] = [each for each in reply["notes"] if "more than 40 characters" in each]
    assert f"only what is after {BEGIN + 200}.000000 is counted" in note
