"""Questions whose honest answer takes care."""

from pathlib import Path

from ros2_memory import queries
from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from tests.support.bags import (
    command,
    detections,
    odom,
    write_mcap,
)
from tests.support.memories import asked, memory_of

T0 = 1_700_000_000 * 10**9
S = 10**9


def span(start: float, end: float) -> TimeRange:
    return TimeRange(start_s=T0 / 1e9 + start, end_s=T0 / 1e9 + end)


def test_nothing_seen_in_the_newest_message_does_not_make_a_field_unknown(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [detections(T0, [])])
    answer = queries.find_last_match(
        memory_of(tmp_path),
        Call(),
        "/vision/scene/scene_objects",
        "equals",
        "cup",
        field="detections.label",
    )
    assert (answer.found, answer.notes) == (None, ())


def test_a_field_that_one_type_of_a_topic_has_is_shown_of_its_messages(tmp_path: Path) -> None:
    poses = [odom(T0 + n * S, n, 0.0) for n in range(3)]
    write_mcap(tmp_path / "a" / "a_0.mcap", poses)
    write_mcap(tmp_path / "b" / "b_0.mcap", [command(T0 + 9 * S, 0.5, topic="/odom")])
    window = {"topic": "/odom", "start": T0 / 1e9, "end": T0 / 1e9 + 9}
    memory = memory_of(tmp_path)
    told = asked(memory, tmp_path, "get_topic_in_range", **window, fields=["position.x"])
    assert [x for _, x in told["rows"]] == [0, 1, 2]
    assert any("1 samples left out: geometry_msgs/msg/Twist has no" in n for n in told["notes"])
    told = asked(memory, tmp_path, "get_topic_in_range", **window, fields=["nothing"])
    assert told["error"] == "invalid_arguments"


def test_a_window_that_reaches_past_the_memory_at_either_end_says_so(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [odom(T0 + n * S, n, 0.0) for n in range(3)])
    memory = memory_of(tmp_path)
    inside = queries.topic_range(memory, Call(), "/odom", span(0, 2))
    assert inside.notes == ()
    wider = queries.topic_range(memory, Call(), "/odom", span(-5, 900))
    assert [note.partition(" at ")[0] for note in wider.notes] == [
        f"recorded only 2 of 905 s between {T0 // S - 5}.000000 and {T0 // S + 900}.000000",
        "the memory begins",
        "the memory ends",
    ]
