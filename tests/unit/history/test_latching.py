"""Latched is what holds until the next message, and not all that is transient local."""

import json
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory, QuerySettings
from ros2_memory.history.view import AtTime
from ros2_memory.queries import position, topic_value, value_when
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.tools.replies import Replies
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    log_entry,
    odom,
    text,
    write_splits,
)
from tests.support.housekeepers import keeper_of
from tests.support.memories import memory_of

S = 10**9
T0 = 1_790_000_000 * S
MAP, TELEMETRY, ROSOUT = "/map_name", "/fmu/out/vehicle_status", "/rosout"
TRANSIENT = McapLayout(latched=frozenset({MAP, TELEMETRY, ROSOUT, "/tf_static"}))


def drive(start: int, stop: int) -> list[Msg]:
    return [odom(at, 0.0, 0.0) for at in range(start, stop, S)]


def every(period_s: float, seconds: float, topic: str, begin: int = T0) -> list[Msg]:
    count = int(seconds / period_s)
    return [text(begin + round(n * period_s * S), str(n), topic) for n in range(count)]


def record(bag_dir: Path, messages: list[Msg]) -> None:
    write_splits(bag_dir, messages, layout=TRANSIENT)


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
    ("latched_s", "drive_s", "holds"),
    [
        ([0], 3, True),  # a map, published once, in a recording however short
        ([n * 4.9 for n in range(24)], 130, False),
        ([n * 5.1 for n in range(23)], 130, True),
        ([0, 60], 130, True),
        ([0, 4.9, 9.8], 14, False),
        ([0, 0.4], 130, True),  # twice when its node started
        ([0, 0.4], 3, False),
    ],
    ids=count(),
)
def test_what_is_published_every_five_seconds_or_less_often_holds(
    tmp_path: Path, latched_s: list[float], drive_s: int, holds: bool
) -> None:
    latched = [text(T0 + round(at * S), "office", MAP) for at in latched_s]
    record(tmp_path, [*latched, *drive(T0, T0 + drive_s * S)])
    for recalls in (False, True):
        found = reply(remembered(tmp_path, recalls=recalls), MAP, latched[-1].log_time + 3 * S)
        assert ("error" not in found) is holds
        if holds:
            assert (found["latched"], found["age_s"]) == (True, 3.0)


def test_the_configuration_says_what_is_latched_and_what_is_not(tmp_path: Path) -> None:
    telemetry = every(0.1, 7, TELEMETRY)
    record(tmp_path, [text(T0, "x", MAP), *telemetry, *drive(T0, T0 + 60 * S)])
    latching = Latching(include=("/fmu/*",), exclude=(MAP,))
    memory = remembered(tmp_path, latching=latching)
    assert reply(memory, TELEMETRY, T0 + 59 * S)["latched"] is True
    assert set(reply(memory, MAP, T0 + 59 * S)) == {"error"}
    both = remembered(tmp_path, latching=Latching(include=("/odom",), exclude=("/odom",)))
    assert set(reply(both, "/odom", T0 + 99 * S)) == {"error"}


def test_a_value_of_another_time_says_that_it_is_latched(tmp_path: Path) -> None:
    bump = boolean(T0 + 20 * S, True)
    record(tmp_path, [text(T0, "office", MAP), bump, *drive(T0, T0 + 60 * S)])
    memory = remembered(tmp_path)
    found = value_when(memory, Call(), MAP, "/bumper", condition_type="equals", value=True)
    shown = json.loads(Replies(tmp_path, 24_000).answer(found).text)
    assert (shown["value_latched"], shown["value_age_s"]) == (True, 20.0)


def test_a_pose_that_is_latched_says_so(tmp_path: Path) -> None:
    record(tmp_path, [odom(T0, 1.0, 2.0), text(T0 + 60 * S, "later", "/words")])
    memory = remembered(tmp_path, latching=Latching(include=("/odom",)))
    found = position(memory, Call(), AtTime(unix_from_ns(T0 + 30 * S)))
    assert [note for note in found.notes if "/odom is latched" in note and "30" in note]


def test_retention_carries_the_newest_of_what_is_transient_local_and_no_log(
    tmp_path: Path,
) -> None:
    """However often it is published; and then it is no more latched than before."""
    telemetry = every(0.01, 7, TELEMETRY)
    messages = [
        text(T0, "office", MAP),
        log_entry(T0 + S, 20, "nav", "hello"),
        *telemetry,
        *drive(T0, T0 + 30 * S),
    ]
    record(tmp_path, messages)
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
