"""What became of the goals of actions, in recaps."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.insights.sightings import find_matches
from ros2_memory.results import Event
from tests.support.bags import McapLayout, Msg, goals, odom, write_mcap, write_splits
from tests.support.memories import asked, memory_of
from tests.support.tables import table

S = 10**9
BEGIN = 1_784_000_000 * S
TOPIC = "/drive/_action/status"

Told = tuple[str, str, float, float | None, bool]


def told(
    bag_dir: Path, messages: list[Msg], begin: float, end: float, cut: int = 10**9, *, recalls: bool
) -> list[Told]:
    for number, at in enumerate(range(0, len(messages), cut)):
        write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages[at : at + cut])
    memory = memory_of(bag_dir, recalls=recalls)
    found = recap(memory, Call(), TimeRange(start_s=BEGIN / S + begin, end_s=BEGIN / S + end))
    return [row(each) for each in found.events if "goal" in each.kind]


def row(event: Event) -> Told:
    until = None if event.end is None else (event.end - BEGIN) / S
    return event.kind, event.text, (event.start - BEGIN) / S, until, event.goes_on


def history(*statuses: tuple[int, Mapping[int, int]]) -> list[Msg]:
    return [goals(BEGIN + at * S, listed) for at, listed in statuses]


DAY = history(
    (10, {1: 1}),
    (11, {1: 2}),
    (20, {1: 4}),
    (30, {1: 4, 2: 2}),
    (42, {1: 4, 2: 6}),
    (50, {2: 6, 3: 2}),
    (55, {2: 6, 3: 3}),
    (56, {2: 6, 3: 5}),
    (60, {3: 5, 4: 2}),
)


def test_what_ended_before_a_window_is_not_told_and_what_began_before_is(tmp_path: Path) -> None:
    assert told(tmp_path, DAY, 35, 52, recalls=False) == [
        ("failed goal", "/drive goal aborted, accepted before", 42, None, False),
        ("goal", "/drive goal accepted", 50, None, True),
    ]


TORN = Msg(TOPIC, DAY[0].type, BEGIN + 20 * S, b"\x00\x01\x00\x00\xff\xff\xff\x7f")


@pytest.mark.parametrize(
    ("before", "pause", "is_told"),
    [
        ([], range(0), False),
        (history((20, {1: 4})), range(0), True),
        (history((20, {1: 4})), range(24, 39), False),
        ([*history((20, {1: 4})), TORN], range(0), False),
    ],
)
def test_what_a_window_first_lists_as_ended_just_did_if_the_message_before_it_is_known(
    tmp_path: Path, before: list[Msg], pause: range, is_told: bool
) -> None:
    beats = [odom(BEGIN + at * S + 1, 0.0, 0.0) for at in range(60) if at not in pause]
    messages = [*beats, *before, *history((42, {1: 4, 2: 6}))]
    messages.sort(key=lambda message: message.log_time)
    found = told(tmp_path, messages, 35, 52, 5, recalls=False)
    assert [text for _, text, *_ in found] == ["/drive goal aborted after 0 s"] * is_told
    [*searched] = found_in(memory_of(tmp_path), "equals", "failed", begin=35, end=52)
    assert [(goal, last) for goal, _, _, last, _ in searched] == [(2, 42)] * is_told


Found = tuple[int, str, float, float, bool]


def found_in(
    memory: Memory,
    condition: str,
    value: JsonValue,
    field: str | None = None,
    *,
    begin: float = 0,
    end: float = 10**6,
) -> list[Found]:
    """The goals that a search finds: number, status, first and last second, whether it began."""
    found = find_matches(
        memory,
        Call(),
        TOPIC,
        condition,
        value,
        field=field,
        start_s=BEGIN / S + begin,
        end_s=BEGIN / S + end,
        limit=50,
    )
    assert found.total == len(found.sightings)
    return [
        (
            int(str(each.value["goal"]), 16),
            str(each.value["status"]),
            (each.first - BEGIN) / S,
            (each.last - BEGIN) / S,
            each.begun,
        )
        for each in found.sightings
        if isinstance(each.value, dict)
    ]


def test_a_search_of_a_window_finds_what_ended_in_it_by_a_status_that_there_is(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, DAY)
    found = found_in(memory_of(tmp_path), "equals", "failed", begin=35, end=55)
    assert found == [(2, "aborted", 42, 42, False)]
    with pytest.raises(InvalidArgumentsError, match=r"aborted \(0 to 6\), or failed"):
        found_in(memory_of(tmp_path), "equals", "lost")


def test_a_goal_is_active_from_its_acceptance_to_its_end_in_windows_without_a_status(
    tmp_path: Path,
) -> None:
    """Active from 10 to 40 s (34:00), another from 60 s on, which a restart at 99 s cuts short."""
    beats = [odom(BEGIN + at * S, at / 10, 0.0) for at in range(100)]
    told = history((10, {1: 2}), (40, {1: 4}), (60, {1: 4, 2: 2}))
    layout = McapLayout(latched=frozenset({TOPIC}))
    write_splits(tmp_path, sorted([*beats, *told], key=lambda one: one.log_time), layout=layout)
    beats = [odom(BEGIN + at * S, 0.0, 0.0) for at in range(900, 950)]
    write_splits(tmp_path, beats, name="next")
    memory = memory_of(tmp_path)

    def held(word: str, begin: int, end: int) -> object:
        given = {"topic": TOPIC, "condition_type": "equals", "value": word}
        window = {"start": BEGIN / S + begin, "end": BEGIN / S + end}
        rows = asked(memory, "find_matches", **given, **window)["sightings"]
        by_hour = asked(memory, "find_matches", **given, **window, by="hour")
        whole = table(by_hour)["all"]
        shown = [(row["duration_s"], row["began_earlier"], row["robot"]["x"]) for row in rows]
        return shown, whole["count"], whole["seconds"], str(whole["first"])[-5:]

    assert held("executing", 20, 30) == ([(10, True, 2.0)], 0, 10, "None")
    assert held("succeeded", 20, 50) == ([(20, True, 4.0)], 1, 20, "34:00")
    assert held("succeeded", 45, 55) == ([], 0, 0, "None")
    assert held("executing", 900, 940) == ([], 0, 0, "None")


def test_a_goal_has_the_fields_that_are_asked_of_its_last_message(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", DAY)
    memory = memory_of(tmp_path)
    aborted = {"topic": TOPIC, "condition_type": "equals", "value": "aborted"}
    status = "status_list.1.status"
    goal = asked(memory, "find_matches", **aborted, fields=[status])["sightings"][0]["value"]
    assert (goal["goal"][-1], goal["status"], goal[status]) == ("2", "aborted", 6)
    refused = asked(memory, "find_matches", **aborted, fields=["nope"])
    assert (refused["error"], "nope" in refused["detail"]) == ("invalid_arguments", True)
