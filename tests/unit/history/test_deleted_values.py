"""What a latched topic said is not known to hold where messages of it were deleted."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.history.context import Memory
from tests.support.bags import McapLayout, Msg, boolean, odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.housekeepers import NOW, T0, A, B, S, house_of, kept
from tests.support.memories import asked, each_way, memory_of

T0_S = T0 // S
DOCKED = "/docked"
LAYOUT = McapLayout(latched=frozenset({DOCKED, "/map_ready"}))


def docked(second: float, value: bool, topic: str = DOCKED) -> Msg:
    return boolean(T0 + round(second * S), value, topic)


def record(bag_dir: Path, name: str, start: int, splits: int, latched: Collection[Msg]) -> None:
    """Splits of ten seconds, in which the robot moves."""
    for number in range(splits):
        first = T0 + (start + 10 * number) * S
        own = [message for message in latched if first <= message.log_time < first + 10 * S]
        driven = [odom(first + n * S, 1.0, 2.0) for n in range(10)]
        messages = sorted([*driven, *own], key=lambda message: message.log_time)
        write_mcap(bag_dir / name / f"{name}_{number}.mcap", messages, LAYOUT)
    (bag_dir / name / "handover.json").write_text('{"format": 1}')


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """Of two minutes 10 to 30 s are a moment that was saved, 30 to 110 s were deleted."""
    said = [docked(5.5, True), docked(15.5, False), docked(40.5, True), docked(60.5, False)]
    said += [docked(80.5, True), docked(115.5, False), docked(2.5, True, "/map_ready")]
    record(tmp_path, A, 0, 6, said)
    record(tmp_path, B, 60, 6, said)
    kept(house_of(tmp_path), tmp_path, 12, 28)
    house_of(tmp_path, max_bytes=1).apply()
    left = sorted(path.stem for path in tmp_path.glob("rec*/*.mcap"))
    assert left == [f"{A}_1", f"{A}_2", f"{B}_5"]
    return tmp_path


def memory(bag_dir: Path, *, recalls: bool = False) -> Memory:
    return memory_of(bag_dir, clock=SettableClock(NOW), recalls=recalls)


def at(memory: Memory, bag_dir: Path, second: float, topic: str = DOCKED) -> Any:
    reply = asked(memory, bag_dir, "get_topic_at_time", topic=topic, timestamp=T0_S + second)
    return reply["value"]["value"] if "value" in reply else reply["reason"]


@each_way
def test_a_latched_value_is_not_held_into_a_time_that_was_deleted(
    bag_dir: Path, recalls: bool
) -> None:
    asking = memory(bag_dir, recalls=recalls)
    seconds = (12, 25, 45, 65, 75, 90, 112, 119)
    known = [at(asking, bag_dir, second) for second in seconds]
    # What it said newest before something is kept again was carried on.
    assert known == [True, False, "deleted", "deleted", "deleted", True, True, False]
    # A topic that said nothing there holds.
    assert {at(asking, bag_dir, second, "/map_ready") for second in seconds} == {True}
    refused = asked(asking, bag_dir, "get_topic_at_time", topic=DOCKED, timestamp=T0_S + 65)
    assert any("recorded, and deleted since" in note for note in refused["notes"])
    assert "to accept the older one, ask with tolerance_s of at least" in refused["detail"]


@each_way
def test_how_long_a_value_held_ends_where_a_time_was_deleted(bag_dir: Path, recalls: bool) -> None:
    asking = memory(bag_dir, recalls=recalls)
    window = {"topic": DOCKED, "start": T0_S + 10, "end": T0_S + 130}
    changes = asked(asking, bag_dir, "get_topic_in_range", changes=True, **window)["changes"]
    assert [spell_of(spell) for spell in changes] == [
        (True, 5.5, 10, True),
        (False, 15.5, 13.5, False),
        (True, 80.5, 35, True),
        (False, 115.5, 3.5, False),
    ]
    undocked = {"condition_type": "equals", "value": False}
    found = asked(asking, bag_dir, "find_matches", **window, **undocked)["sightings"]
    spans = [(row["first_seen"] - T0_S, row["duration_s"]) for row in found]
    assert spans == [(115.5, 3.5), (15.5, 13.5)]
    events = asked(asking, bag_dir, "recap", start=T0_S, end=T0_S + 130)["events"]
    flips = [event for event in events if event["text"] == "/docked became false"]
    assert [flip.get("duration_s") for flip in flips] == [13.5, None]


def spell_of(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["value"], row["start"] - T0_S, row["seconds"], row.get("ended", True)


def test_a_value_is_not_held_on_across_messages_that_were_deleted_by_request(
    tmp_path: Path,
) -> None:
    record(tmp_path, A, 0, 6, [docked(5.5, True), docked(55.5, False)])
    append_losses(tmp_path, [Loss(DOCKED, T0 + 20 * S, T0 + 30 * S, 2, "forgotten")])
    asking = memory(tmp_path)
    assert [at(asking, tmp_path, second) for second in (15, 25, 50, 57)] == [
        True,
        "deleted",
        "deleted",
        False,
    ]
    odometry = {"topic": "/odom", "condition_type": "above", "value": 0, "field": "position.x"}
    docked_then = {"topic": DOCKED, "condition_type": "equals", "value": True}
    for end, last in ((12, 12), (50, 20)):
        span = {"start": T0_S, "end": T0_S + end, "while": docked_then}
        answer = asked(asking, tmp_path, "find_matches", **odometry, **span)
        [found] = answer["sightings"]
        assert (found["first_seen"] - T0_S, found["last_seen"] - T0_S) == (6, last)
    assert answer["unknown_s"] == 30
