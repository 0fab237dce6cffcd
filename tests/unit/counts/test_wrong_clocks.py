"""Bins leave bags out that a wrong clock dated, unless the window has nothing else."""

from pathlib import Path

import pytest

from ros2_memory.history.context import Memory, QuerySettings
from tests.support.bags import boolean, detections, odom, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.memories import asked, memory_of
from tests.support.tables import table

S = 10**9
TRUE = 1_784_030_400
UNSET = 86_400
AHEAD = 2_082_758_400
CUPS = "/vision/scene/scene_objects"


@pytest.fixture
def memory(tmp_path: Path) -> Memory:
    """Six messages of today, two of 1970 and one of 2036, of each topic."""
    for name, begin, count in (("unset", UNSET, 2), ("today", TRUE, 6), ("ahead", AHEAD, 1)):
        messages = [odom((begin + n) * S, n, 0.0) for n in range(count)]
        messages += [boolean((begin + n) * S + 1, data=n % 2 == 0) for n in range(count)]
        messages += [detections((begin + n) * S + 2, ["cup"]) for n in range(count)]
        messages += [text((begin + n) * S + 3, "idle" if n < 3 else "busy") for n in range(count)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages)
    return memory_of(tmp_path, clock=FixedClock((TRUE + 600) * S), limits=QuerySettings())


def whole(by: str = "hour") -> dict[str, object]:
    return {"start": 0, "end": AHEAD + 10, "by": by}


def test_labels_of_a_wrong_clock_do_not_count(memory: Memory, tmp_path: Path) -> None:
    seen = {"topic": CUPS, "condition_type": "contains", "value": "cup", "by": "label"}
    for window in ({}, {"start": 0, "end": AHEAD + 10}):
        reply = asked(memory, tmp_path, "find_matches", **seen, **window)
        found = table(reply)["all"]
        assert (found["count"], found["seconds"]) == (1, 5.0)
        assert found["first_unix"] == pytest.approx(TRUE, abs=0.001)
        assert found["last_unix"] == pytest.approx(TRUE + 5, abs=0.001)
        assert not any("recorded only" in note for note in reply["notes"])
    reply = asked(memory, tmp_path, "find_matches", **seen, start=UNSET - 5, end=UNSET + 60)
    assert table(reply)["all"]["last_unix"] == pytest.approx(UNSET + 1, abs=0.001)
    assert not any("recorded only" in note for note in reply["notes"])


def test_no_value_holds_from_one_clock_to_the_next(memory: Memory, tmp_path: Path) -> None:
    """The robot was idle at the end of 1970, and at the beginning of today."""
    reply = asked(memory, tmp_path, "get_topic_in_range", topic="/chatter", **whole("value"))
    rows = table(reply)
    assert {value: row["count"] for value, row in rows.items()} == {"idle": 1, "busy": 1, "all": 2}
    assert rows["idle"]["first_unix"] == pytest.approx(TRUE, abs=0.001)
    assert rows["busy"]["last_unix"] == pytest.approx(TRUE + 5, abs=0.001)
    of_1970 = {"start": UNSET - 5, "end": UNSET + 60, "by": "value"}
    reply = asked(memory, tmp_path, "get_topic_in_range", topic="/chatter", **of_1970)
    assert table(reply)["all"]["last_unix"] == pytest.approx(UNSET + 1, abs=0.001)


@pytest.mark.parametrize(("begin", "count"), [(UNSET, 2), (AHEAD, 1)])
def test_a_window_inside_of_a_bag_of_a_wrong_clock_counts_what_is_there(
    memory: Memory, tmp_path: Path, begin: int, count: int
) -> None:
    window = {"start": begin - 5, "end": begin + 60}
    reply = asked(memory, tmp_path, "get_topic_in_range", topic="/odom", by="hour", **window)
    assert table(reply)["all"]["count"] == count
    condition = {"topic": "/odom", "condition_type": "above", "field": "position.x", "value": -1}
    reply = asked(memory, tmp_path, "find_matches", **condition, **window)
    assert reply["searched_from"] == begin
