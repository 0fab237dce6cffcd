"""Questions whose honest answer takes care, and a recorded circle in its closed form.

Its header stamps are T0 + t exactly; log times lie some milliseconds later.
"""

import json
import math
from functools import partial
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from ros2_memory import queries
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange
from tests.support.bags import along_x, command, detections, odom, text
from tests.support.closed_form import TURN_RATE, position
from tests.support.memories import ROOT, Remember, asked, memory_of, remembered
from tests.support.shared_bags import RECORDED, needs_recorded

T0 = 1_700_000_000 * 10**9
S = 10**9


def span(start: float, end: float) -> TimeRange:
    return TimeRange(start_s=T0 / 1e9 + start, end_s=T0 / 1e9 + end)


def test_nothing_seen_in_the_newest_message_does_not_make_a_field_unknown(tmp_path: Path) -> None:
    cup = {"condition_type": "equals", "value": "cup", "field": "detections.label"}
    memory = remembered(tmp_path, [detections(T0, [])])
    assert asked(memory, "find_last_match", topic="/vision/*/*", **cup) is None


def test_a_field_that_one_type_of_a_topic_has_is_shown_of_its_messages(tmp_path: Path) -> None:
    messages = [*(odom(T0 + n * S, n, 0.0) for n in range(3)), command(T0 + 9 * S, 0.5, 0, "/odom")]
    window = {"topic": "/odom", "start": T0 / 1e9, "end": T0 / 1e9 + 9}
    ask = partial(asked, remembered(tmp_path, messages), "get_topic_in_range", **window)
    told = ask(fields=["position.x"])
    assert [x for _, x in told["rows"]] == [0, 1, 2]
    [note] = told["notes"]
    assert note.startswith("1 sample left out: geometry_msgs/msg/Twist has no")
    assert ask(fields=["nothing"])["error"] == "invalid_arguments"


def test_a_window_that_reaches_past_the_memory_at_either_end_says_so(tmp_path: Path) -> None:
    memory = remembered(tmp_path, along_x(T0, 3, mps=1.0))
    inside = queries.topic_range(memory, Call(), "/odom", span(0, 2))
    assert inside.notes == ()
    wider = queries.topic_range(memory, Call(), "/odom", span(-5, 900))
    assert [note.partition(" at ")[0] for note in wider.notes] == [
        "recorded only 2 of 905 s",
        "the memory begins",
        "the memory ends",
    ]


SPEED = 0.5  # m/s
LASER, CAMERA = (0.10, 0.20), (0.15, 0.30)  # x and z in base_link, m
COMMITTED = ROOT / "tests" / "data" / "session_zstd", 1795144023.536, "mcap"
SESSIONS = (
    (RECORDED / "session_mcap", 1795144003.095, "mcap"),
    (RECORDED / "session_sqlite3", 1795144003.086, "rosbag2"),
    (RECORDED / "session_zstd_file", 1795144044.072, "rosbag2"),
)


@pytest.mark.parametrize(
    ("folder", "t0", "storage"),
    [COMMITTED, *(pytest.param(*session, marks=needs_recorded) for session in SESSIONS)],
    ids=lambda value: value.name if isinstance(value, Path) else "",
)
def test_a_recorded_circle_is_answered_in_its_closed_form(
    folder: Path, t0: float, storage: str
) -> None:
    with Reader(folder) as reader:
        connections = [each for each in reader.connections if each.topic == "/odom"]
        times = sorted(time for _, time, _ in reader.messages(connections))
    memory, begin, end = memory_of(folder, storage=storage), times[0] / 1e9, times[-1] / 1e9
    for nth in range(1, 40, 4):
        asked = begin + 0.2 + (end - begin - 0.4) * nth / 40
        t = asked - t0
        answer = queries.position(memory, Call(), AtTime(at_s=asked))
        assert answer.time == max(time for time in times if time <= asked * 1e9)
        there = position(unix_from_ns(answer.time) - t0)
        assert math.dist(answer.pose.position[:2], there) < 0.005
        for sensor, (ahead, height) in {"laser": LASER, "camera": CAMERA}.items():
            placed = queries.transform(memory, Call(), "odom", sensor, AtTime(at_s=asked))
            (x, y), angle = position(t), TURN_RATE * t
            there = x + ahead * math.cos(angle), y + ahead * math.sin(angle)
            assert math.dist(placed.transform.translation, (*there, height)) < 0.005
            *_, z, w = placed.transform.rotation
            off = math.remainder(2 * math.atan2(z, w) - angle, math.tau)
            assert abs(off) < math.radians(0.2)
    driven = queries.trajectory_summary(memory, Call(), TimeRange(begin - 1, end + 1)).trajectory
    steps = round((end - begin) * 20)
    assert driven.totals.distance_m == pytest.approx(SPEED * steps / 20, rel=1e-3)
    assert driven.max_speed == pytest.approx(SPEED, abs=1e-6)


def test_a_robot_that_is_faster_than_is_taken_for_plausible_is_told_the_setting(
    tmp_path: Path,
) -> None:
    """As on a road: each of its steps would be a jump, and its path have no metres."""
    driven = [odom(T0 + nth * S // 5, x=nth * 2.8, vx=14.0) for nth in range(100)]
    memory = remembered(tmp_path, driven)
    reply = asked(memory, "trajectory_summary", start=T0 // S, end=T0 // S + 20)
    advice = (
        "the messages state up to 14.0 m/s, and steps faster than 10 m/s "
        "(data.max_plausible_speed_mps) are taken for jumps: set it higher"
    )
    assert advice in reply["notes"]
    limits = QuerySettings(max_plausible_speed_mps=20.0)
    memory = memory_of(tmp_path, limits=limits)
    reply = asked(memory, "trajectory_summary", start=T0 // S, end=T0 // S + 20)
    assert reply["distance_m"] == pytest.approx(99 * 2.8, rel=0.01)
    assert "plausible" not in str(reply.get("notes"))


def test_fields_go_on_into_a_text_of_json(tmp_path: Path) -> None:
    """A key that one of the messages lacks is null there, with a note."""
    said = ('{"step": {"name": "heat", "pans": [{"id": 7}, {"id": 9}]}}', '{"done": true}', "idle")
    memory = remembered(tmp_path, [text(T0 + n * S, one, "/task") for n, one in enumerate(said)])
    window = {"topic": "/task", "start": T0 // S, "end": T0 // S + 1}
    fields = ["data.step.name", "value.step.pans.1.id", "data.step.pans.id"]
    reply = asked(memory, "get_topic_in_range", **window, fields=fields)
    assert [row[1:] for row in reply["rows"]] == [["heat", 9, [7, 9]], [None] * 3]
    assert "data.step.name: this message has no such field" in str(reply)
    refused = asked(memory, "get_topic_at_time", topic="/task", timestamp=T0 // S, fields=["step"])
    assert refused["detail"].endswith("in data, a text of JSON, data.KEY is one of: step")
    plain = {"topic": "/task", "timestamp": T0 // S + 2, "fields": ["data.step"]}
    assert asked(memory, "get_topic_at_time", **plain)["error"] == "invalid_arguments"


def test_numbers_in_texts_of_json_are_summarised_by_hour(remember: Remember) -> None:
    said = ('{"note": "a"}', *(json.dumps({"kg": kg}) for kg in (2.5, 9, 4)))
    stored = remember([text(T0 + n * S, one, "/task") for n, one in enumerate(said)])
    window = {"topic": "/task", "start": T0 // S, "end": T0 // S + 9, "fields": ["data.kg"]}
    reply = asked(stored, "get_topic_in_range", by="hour", **window)
    row = dict(zip(reply["columns"], reply["rows"][0], strict=True))
    summary = [row[f"data.kg.{what}"] for what in ("first", "last", "min", "max", "mean")]
    assert summary == [2.5, 4, 2.5, 9, pytest.approx(5.166667)]
