"""Latched is what holds until the next message, and not all that is transient local."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory, QuerySettings
from ros2_memory.history.view import AtTime
from ros2_memory.index.segment import Pace, TopicTotals
from ros2_memory.queries import position, topic_value, value_when
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.tools.replies import Replies
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    make,
    odom,
    stamp,
    text,
    write_mcap,
)
from tests.support.housekeepers import keeper_of
from tests.support.memories import each_way, memory_of

if TYPE_CHECKING:
    from pathlib import Path


S = 10**9
T0 = 1_790_000_000 * S
MAP, TELEMETRY, ROSOUT = "/map_name", "/fmu/out/vehicle_status", "/rosout"
TRANSIENT = McapLayout(latched=frozenset({MAP, TELEMETRY, ROSOUT, "/tf_static"}))


def log_line(at: int) -> Msg:
    body = make(
        "rcl_interfaces/msg/Log",
        stamp=stamp(at),
        level=20,
        name="nav",
        msg="hello",
        file="",
        function="",
        line=1,
    )
    return Msg(ROSOUT, "rcl_interfaces/msg/Log", at, body)


def drive(start: int, stop: int) -> list[Msg]:
    return [odom(at, 0.0, 0.0) for at in range(start, stop, S)]


def every(period_s: float, seconds: float, topic: str, begin: int = T0) -> list[Msg]:
    count = int(seconds / period_s)
    return [text(begin + round(n * period_s * S), str(n), topic) for n in range(count)]


def record(folder: Path, messages: list[Msg], layout: McapLayout = TRANSIENT) -> None:
    """In splits of ten seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    by_split: dict[int, list[Msg]] = {}
    for each in sorted(messages, key=lambda message: message.log_time):
        by_split.setdefault((each.log_time - T0) // (10 * S), []).append(each)
    for nth, some in by_split.items():
        write_mcap(folder / f"{folder.name}_{nth}.mcap", some, layout)


def remembered(root: Path, *, recalls: bool = False, **limits: Any) -> Memory:
    return memory_of(root, limits=QuerySettings(**limits), recalls=recalls)


def reply(memory: Memory, topic: str, at: int) -> dict[str, Any]:
    """The reply to a question for a moment, or the reason why there is none."""
    try:
        answer = topic_value(memory, Call(), topic, AtTime(unix_from_ns(at)))
    except NoDataError as error:
        return {"error": error.reason}
    shown: dict[str, Any] = json.loads(Replies(memory.index.bag_dir, 24_000).answer(answer).text)
    return shown


@pytest.mark.parametrize(
    ("messages", "span_s", "length_s", "rare"),
    [
        (1, 0.0, 3.0, True),  # a map, published once, in a recording however short
        (12, 11 * 4.9, 60.0, False),
        (12, 11 * 5.0, 60.0, True),
        (12, 11 * 5.1, 60.0, True),
        (3, 2 * 4.9, 14.6, False),
        (3, 2 * 5.1, 15.2, True),
        (2, 0.4, 600.0, True),  # twice when its node started
        (2, 0.4, 3.0, False),
        (2300, 23.0, 30.0, False),
        (2300, 23.0, 1e7, False),  # telemetry that fell silent is no map
    ],
)
def test_a_topic_is_rare_by_its_pace_over_its_recording(
    messages: int, span_s: float, length_s: float, rare: bool
) -> None:
    latched = TopicTotals(T0, T0 + round(span_s * S), messages)
    assert Pace(latched, T0, T0 + round(length_s * S)).is_rare is rare


@each_way
def test_telemetry_that_is_transient_local_does_not_hold(tmp_path: Path, recalls: bool) -> None:
    telemetry = every(0.01, 7, TELEMETRY)
    record(tmp_path / "rec", [*telemetry, *drive(T0, T0 + 60 * S)])
    memory = remembered(tmp_path, recalls=recalls)
    assert reply(memory, TELEMETRY, T0 + 3 * S)["timestamp"] == unix_from_ns(T0 + 3 * S)
    assert "latched" not in reply(memory, TELEMETRY, T0 + 3 * S)
    assert set(reply(memory, TELEMETRY, T0 + 30 * S)) == {"error"}
    assert set(reply(memory, TELEMETRY, T0 + 365 * 86_400 * S)) == {"error"}


@pytest.mark.parametrize(("period_s", "holds"), [(4.9, False), (5.1, True), (60.0, True)])
def test_what_is_published_every_five_seconds_or_less_often_holds(
    tmp_path: Path, period_s: float, holds: bool
) -> None:
    latched = every(period_s, 120, MAP)
    record(tmp_path / "rec", [*latched, *drive(T0, T0 + 130 * S)])
    memory = remembered(tmp_path)
    at = latched[-1].log_time + 3 * S
    found = reply(memory, MAP, at)
    assert ("error" not in found) is holds
    if holds:
        assert (found["latched"], found["age_s"]) == (True, 3.0)


def test_the_configuration_says_what_is_latched_and_what_is_not(tmp_path: Path) -> None:
    telemetry = every(0.1, 7, TELEMETRY)
    record(tmp_path / "rec", [text(T0, "x", MAP), *telemetry, *drive(T0, T0 + 60 * S)])
    latching = Latching(include=("/fmu/*",), exclude=(MAP,))
    memory = remembered(tmp_path, latching=latching)
    assert reply(memory, TELEMETRY, T0 + 59 * S)["latched"] is True
    assert set(reply(memory, MAP, T0 + 59 * S)) == {"error"}
    both = remembered(tmp_path, latching=Latching(include=("/odom",), exclude=("/odom",)))
    assert set(reply(both, "/odom", T0 + 99 * S)) == {"error"}


def test_a_value_of_another_time_says_that_it_is_latched(tmp_path: Path) -> None:
    bump = boolean(T0 + 20 * S, True)
    record(tmp_path / "rec", [text(T0, "office", MAP), bump, *drive(T0, T0 + 60 * S)])
    memory = remembered(tmp_path)
    found = value_when(memory, Call(), MAP, "/bumper", condition_type="equals", value=True)
    shown = json.loads(Replies(tmp_path, 24_000).answer(found).text)
    assert (shown["value_latched"], shown["value_age_s"]) == (True, 20.0)


def test_a_pose_that_is_latched_says_so(tmp_path: Path) -> None:
    record(tmp_path / "rec", [odom(T0, 1.0, 2.0), text(T0 + 60 * S, "later", "/words")])
    memory = remembered(tmp_path, latching=Latching(include=("/odom",)))
    found = position(memory, Call(), AtTime(unix_from_ns(T0 + 30 * S)))
    assert [note for note in found.notes if "/odom is latched" in note and "30" in note]


def test_retention_carries_the_newest_of_what_is_transient_local_and_no_log(
    tmp_path: Path,
) -> None:
    """However often it is published; and then it is no more latched than before."""
    telemetry = every(0.01, 7, TELEMETRY)
    messages = [text(T0, "office", MAP), log_line(T0 + S), *telemetry, *drive(T0, T0 + 30 * S)]
    record(tmp_path / "rec", messages)
    keeper_of(tmp_path, max_bytes=1).apply()
    carried = tmp_path / "latched/carried.mcap"
    topics = [TELEMETRY, MAP, ROSOUT]
    found = {
        each.channel.topic: each.log_time
        for each in McapReader().records(carried, topics, TimeWindow.everything())
    }
    assert found == {TELEMETRY: telemetry[-1].log_time, MAP: T0}
    memory = remembered(tmp_path)
    assert set(reply(memory, TELEMETRY, T0 + 29 * S)) == {"error"}
    assert reply(memory, TELEMETRY, telemetry[-1].log_time)["value"] == {"value": "699"}
    assert reply(memory, MAP, T0 + 29 * S)["age_s"] == 29.0
