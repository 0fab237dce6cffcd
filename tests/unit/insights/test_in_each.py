"""Several moments or hours of days in one question: each is answered as if it were asked alone."""

import time
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import NoDataReason, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.conditions import Sought
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.insights import fields
from ros2_memory.insights.at_each import hours_of_days, in_each
from ros2_memory.insights.sightings import find_matches
from ros2_memory.results import Sightings
from ros2_memory.tools.arguments import _as_hours
from ros2_memory.tools.replies import as_json
from tests.support.bags import along_x, boolean, detections, odom, text, tf_of, write_mcap
from tests.support.clocks import in_zone
from tests.support.memories import asked, memory_of, remembered
from tests.support.rooms import S, asked_of, draw, write

DAYS = 3
DAY_S = 86_400
MIDNIGHT = 1_783_987_200
BEGIN = MIDNIGHT + 86_400 - 120
"""Two minutes before midnight, UTC; so on each of the days."""
SPAN = {"start": MIDNIGHT, "end": MIDNIGHT + (DAYS + 2) * DAY_S}
HELLO = {"topic": "/chatter", "condition_type": "contains", "value": "hello"}


@pytest.fixture(autouse=True, scope="module")
def _in_utc() -> Iterator[None]:
    with in_zone("UTC"):
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bags = tmp_path_factory.mktemp("evenings")
    for day in range(DAYS):
        write(draw(day, 250), bags / f"day_{day}", begin=BEGIN + day * DAY_S)
    return bags


@pytest.fixture(scope="module")
def memory(folder: Path) -> Memory:
    return asked_of(folder, stored=True)


QUESTIONS: dict[str, dict[str, Any]] = {
    "find_matches": {**HELLO, "where": "hall", "limit": 100},
    "visits": {"where": "kitchen", "limit": 100, "while": HELLO},
    "trajectory_summary": {"farthest_from": {"x": 0, "y": 0}},
    "recap": {"where": "kitchen"},
    "get_topic_in_range": {"topic": "/odom", "fields": ["position.x"], "by": "hour"},
}


HOURS = ("23:59-00:02", -60, 120), ("23:00-23:59", -3600, -60)


@pytest.mark.parametrize(
    ("tool", "hours", "first", "last"),
    [(tool, *HOURS[nth % 2]) for nth, tool in enumerate(QUESTIONS)],
)
def test_each_window_has_the_answer_that_it_has_alone(
    memory: Memory, tool: str, hours: str, first: int, last: int
) -> None:
    given = QUESTIONS[tool]
    reply = asked(memory, tool, between=hours, **SPAN, **given)
    assert len(reply["windows"]) == DAYS
    shared = {key: each for key, each in reply.items() if key not in {"windows", "all", "notes"}}
    sums = dict.fromkeys(reply.get("all", ()), 0.0)
    for day, row in enumerate(reply["windows"]):
        midnight = MIDNIGHT + (day + 1) * DAY_S
        begin = midnight + first if day else max(midnight + first, BEGIN)
        assert row["start"] == pytest.approx(begin, abs=1e-3)
        assert row["end"] == pytest.approx(midnight + last, abs=1e-3)
        alone = asked(memory, tool, **given, start=row["start"], end=row["end"])
        beside = {"start", "end", "local", "notes", "now", "quoted"}
        expected = {key: each for key, each in alone.items() if key not in beside}
        found = {key: each for key, each in {**shared, **row}.items() if key not in beside}
        assert _without_ages(found) == _without_ages(expected)
        for key in sums:
            sums[key] += alone[key]
    assert reply.get("all", {}) == pytest.approx(sums, abs=0.01)


def test_a_month_of_dates_has_the_hours_of_its_own_days_and_more_are_refused(
    tmp_path: Path,
) -> None:
    ticks = [text((MIDNIGHT + 3600 * nth) * S, "tick") for nth in range(-24, 24 * 32)]
    hours = {"start": "2026-07-14", "end": "2026-08-13", "between": "20:00-24:00"}
    ask = partial(asked, remembered(tmp_path, ticks), "get_topic_in_range", topic="/chatter")
    reply = ask(**hours, max_samples=1)
    begins = [row["start"] - MIDNIGHT for row in reply["windows"]]
    assert begins == [day * DAY_S + 20 * 3600 for day in range(31)]
    refused = ask(**{**hours, "end": "2026-08-14"})
    assert "between takes at most 31 days: ask about a shorter window" in refused["detail"]


def _without_ages(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_ages(each) for each in value]
    if isinstance(value, dict):
        return {key: _without_ages(each) for key, each in value.items() if key != "ago_s"}
    return value


def test_what_none_of_the_hours_have_is_said_as_it_is_without_them(
    memory: Memory, folder: Path
) -> None:
    given = {**HELLO, "topic": "/chater", "between": "23:59-00:02"}
    reply = asked(memory, "find_matches", **given, **SPAN)
    assert reply["reason"] == "topic_not_recorded"
    assert "similar: /chatter" in reply["detail"]
    cups = {"topic": "/cups", "between": "23:59-00:02"}
    write_mcap(folder.parent / "more" / "rec" / "rec_0.mcap", [odom((BEGIN + 60) * S)])
    write_mcap(folder.parent / "more" / "b" / "b_0.mcap", [text((BEGIN + 600) * S, "x", "/cups")])
    more = memory_of(folder.parent / "more")
    reply = asked(more, "get_topic_in_range", **cups, **SPAN)
    assert reply["error"] == "no_data"
    assert "none between these hours on any day" in reply["detail"]
    assert "no message of /cups" in reply["detail"]


def test_days_that_were_not_asked_in_time_leave_no_total(memory: Memory, folder: Path) -> None:
    whole = asked(memory, "find_matches", **HELLO, between="23:59-00:02", **SPAN)
    asked_days: list[TimeRange] = []

    def ask(memory: Memory, span: TimeRange) -> Sightings:
        asked_days.append(span)
        if len(asked_days) > 1:
            raise QueryTimeoutError("out of time")
        topic, kind, value = HELLO.values()
        return find_matches(memory, Call(), Sought(topic, kind, value), span=span)

    span = TimeRange(SPAN["start"], SPAN["end"])
    hours = (datetime.min.time().replace(23, 59), datetime.min.time().replace(0, 2))
    reply = as_json(in_each(memory, Call(), span, hours, ask), folder)
    assert isinstance(reply, dict)
    assert reply["all"] == {"at_least": whole["windows"][0]["total"]}


AUTUMN = "Europe/Berlin 2026-10-25/2026-10-26"
SPRING = "Europe/Berlin 2026-03-29/2026-03-30"


@pytest.mark.parametrize(
    ("where", "hours", "expected"),
    [
        (AUTUMN, "02:15-02:45", "02:15-02:45 02:15-02:45"),
        (AUTUMN, "01:00-02:30", "01:00-02:30 02:00-02:30"),
        (AUTUMN, "02:15-04:00", "02:15-02:00 02:15-04:00"),
        (AUTUMN, "01:00-04:00", "01:00-04:00"),
        (AUTUMN, "03:00-02:30", "00:00-02:30 02:00-02:30 03:00-00:00"),
        (
            "Europe/Berlin 2026-03-28/2026-03-31",
            *("22:00-04:00", "00:00-04:00 22:00-04:00 22:00-04:00 22:00-00:00"),
        ),
        (SPRING, "02:30-03:30", "03:00-03:30"),
        (SPRING, "01:30-02:15", "01:30-03:00"),
        (SPRING, "02:10-02:50", ""),
        (SPRING, "03:00-02:30", "00:00-03:00 03:00-00:00"),
        (SPRING, "22:00-24:00", "22:00-00:00"),
        (SPRING, "00:00 - 24:00", "00:00-00:00"),
        # Days that begin in an hour that clocks repeat.
        (
            "Atlantic/Azores 2026-10-25/2026-10-26",
            *("00:30-00:30", "00:00-00:30 00:30-00:00 00:00-00:30 00:30-00:00"),
        ),
    ],
)
def test_hours_that_clocks_repeat_count_twice_and_those_that_they_skip_are_left_out(
    where: str, hours: str, expected: str
) -> None:
    zone, days = where.split()
    with in_zone(zone):
        begin, end = (int(datetime.fromisoformat(at).timestamp()) for at in days.split("/"))
        found = hours_of_days(TimeWindow(begin * S, end * S), *_as_hours(hours))  # type: ignore[misc]
        shown = [
            "-".join(
                time.strftime("%H:%M", time.localtime(at // S)) for at in (each.start, each.stop)
            )
            for each in found
        ]
    assert " ".join(shown) == expected


T0 = 1_700_000_000


@pytest.fixture(scope="module")
def holed(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    """Odometry along x at 1 m/s in two bags, with a hole of 10 s between them."""
    folder = tmp_path_factory.mktemp("bags")
    for number, begin in enumerate((0, 20)):
        messages = [
            each
            for at in range(begin, begin + 10)
            for each in (
                odom((T0 + at) * S, float(at)),
                tf_of((T0 + at) * S, "odom", "base_link", (at, 0.0, 0.0)),
                detections((T0 + at) * S, ["cup"]),
            )
        ]
        write_mcap(folder / "a" / f"a_{number}.mcap", messages)
    return memory_of(folder)


def test_an_error_takes_the_place_of_what_is_not_there(holed: Memory) -> None:
    times = [T0 + 5, T0 + 14.5, T0 + 15.5, T0 + 25, T0 + 5000]
    told = asked(holed, "get_position_at", timestamps=times)
    first, hole, again, last, beyond = told["results"]
    assert (first["x"], last["x"]) == (5.0, 25.0)
    assert (hole["at"], hole["error"], hole["reason"]) == (T0 + 14.5, "no_data", NoDataReason.GAP)
    assert "tolerance_s" in hole["detail"]
    # What one reason means is told once.
    assert again == {"at": T0 + 15.5, "error": "no_data", "reason": "gap"}
    assert (beyond["at"], beyond["reason"]) == (T0 + 5000, "outside_range")
    assert "detail" in beyond


def test_what_is_nowhere_is_an_error_as_for_one_moment(holed: Memory) -> None:
    for timestamps in ({"timestamps": [T0, T0 + 1]}, {"timestamp": T0}):
        told = asked(holed, "get_topic_at_time", topic="/nope", **timestamps)
        assert told["reason"] == "topic_not_recorded"
    refused = asked(holed, "get_position_at", timestamps=[T0], topic="/vision/*")
    assert "error" in refused


def test_a_note_on_several_of_them_is_told_once(tmp_path: Path) -> None:
    messages = [odom((T0 + at) * S, float("nan")) for at in range(3)]
    memory = remembered(tmp_path, [*messages, odom((T0 + 3) * S, 1.0)])
    told = asked(memory, "get_position_at", timestamps=[T0, T0 + 1, T0 + 3])
    assert told["notes"] == [
        "the recorded pose is no place: NaN, or all zeros, as where tracking is lost"
    ]
    assert all("notes" not in each for each in told["results"])
    alone = asked(memory, "get_position_at", timestamps=[T0, T0 + 3])
    assert [each.get("notes") for each in alone["results"]] == [told["notes"], None]
    assert "notes" not in alone


def test_a_window_with_too_many_messages_to_read_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = remembered(tmp_path, along_x(T0 * S, 9, mps=1))
    window = {"start": T0 * S / S, "end": T0 * S / S + 100, "fields": ["pose.covariance"]}
    whole = asked(memory, "get_topic_in_range", topic="/odom", **window)
    assert whole["extremes"]["pose.covariance"]["min"] == 0.0
    monkeypatch.setattr(fields, "MAX_MESSAGES", 3)
    answer = asked(memory, "get_topic_in_range", topic="/odom", **window)
    assert "extremes" not in answer
    assert fields.TOO_MANY in answer["notes"]


@pytest.mark.parametrize("apart", [True, False])
def test_a_type_that_a_topic_had_before_is_described(tmp_path: Path, apart: bool) -> None:
    """Also where the last message of it and one of the new type have the same log time."""
    said, flag = text(T0 * S, "a word", "/t"), boolean(T0 * S + apart * S, True, "/t")
    if apart:
        write_mcap(tmp_path / "a.mcap", [said])
        write_mcap(tmp_path / "b.mcap", [flag])
    else:
        write_mcap(tmp_path / "a.mcap", [said, flag])
    for message, kind in ((said, "text"), (flag, "boolean")):
        answer = fields.describe_type(memory_of(tmp_path), Call(), message.type)
        assert (answer.topics, answer.fields) == (("/t",), (("value", kind),))
