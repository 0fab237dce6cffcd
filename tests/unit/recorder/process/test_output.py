"""What the recorder says, from the logs of the real one and from the texts of its sources."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.recorder.process.output import LineKind, parse_line
from tests.support.shared_bags import RECORDED, needs_recorded

ROBOTS_TOPICS = {
    "/battery_state",
    "/bumper",
    "/cmd_vel",
    "/odom",
    "/scan",
    "/tf",
    "/tf_static",
    "/vision/scene/scene_description",
    "/vision/scene/scene_objects",
}


@needs_recorded
@pytest.mark.parametrize(
    ("name", "ended"),
    [
        ("session_mcap", True),
        ("session_sqlite3", True),
        ("session_zstd", True),
        ("session_zstd_file", True),
        ("session_killed", False),
        ("session_killed_chunk64k", False),
    ],
)
def test_the_logs_of_real_recorders_are_understood(name: str, ended: bool) -> None:
    lines = [parse_line(raw) for raw in (RECORDED / f"logs/{name}.log").read_text().splitlines()]
    said = [line.kind for line in lines]
    subscribed = {line.topic for line in lines if line.kind is LineKind.SUBSCRIBED}
    assert subscribed == ROBOTS_TOPICS
    assert said.count(LineKind.STOPPED) == ended
    assert said.index(LineKind.READY) < said.index(LineKind.SUBSCRIBED)
    assert {
        LineKind.WARNING,
        LineKind.ERROR,
        LineKind.QOS_REFUSED,
        LineKind.UNKNOWN_TYPE,
    }.isdisjoint(said)


@pytest.mark.parametrize(
    ("raw", "said", "topic"),
    [
        ("[INFO] [1.5] [rosbag2_recorder]: Recording...", LineKind.READY, None),
        ("[INFO] [1.5] [rosbag2_recorder]: Listening for topics...", LineKind.READY, None),
        (
            (
                "stdin is not a terminal device. Keyboard handling disabled.[INFO] [1.5] [n]: "
                "Subscribed to topic '/odom'"
            ),
            LineKind.SUBSCRIBED,
            "/odom",
        ),
        (
            "[INFO] [1.5] [n]: Subscribed to topic '/tf_static' (repeat-transient-local, depth=3)",
            LineKind.SUBSCRIBED,
            "/tf_static",
        ),
        ("\x1b[32m[INFO] [1.5] [n]: Recording...\x1b[0m", LineKind.READY, None),
        (
            "[ERROR] [ros2bag]: Output folder '/bags/rec_1' already exists.",
            LineKind.ERROR,
            None,
        ),
        (
            (
                "[WARN] [1.5] [rosbag2_recorder]: A new publisher for subscribed topic /scan was "
                "found offering RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, but rosbag already "
                "subscribed requesting RMW_QOS_POLICY_RELIABILITY_RELIABLE. Messages from this "
                "new publisher will not be recorded."
            ),
            LineKind.QOS_REFUSED,
            "/scan",
        ),
        (
            (
                "[WARN] [1.5] [rosbag2_recorder]: New publisher discovered on topic '/tf_static', "
                "offering incompatible QoS. No messages will be received from it. "
                "Last incompatible policy: DURABILITY_QOS_POLICY"
            ),
            LineKind.QOS_REFUSED,
            "/tf_static",
        ),
        (
            (
                "[WARN] [1.5] [ROSBAG2_TRANSPORT]: Topic '/x' has unknown type 'my_msgs/msg/X' . "
                "Only topics with known type are supported. Reason: 'package 'my_msgs' not found"
            ),
            LineKind.UNKNOWN_TYPE,
            "/x",
        ),
        (
            (
                "[ERROR] [1.5] [ROSBAG2_TRANSPORT]: Topic '/cmd_vel' has more than one type "
                "associated. Only topics with one type are supported"
            ),
            LineKind.SEVERAL_TYPES,
            "/cmd_vel",
        ),
        (
            "[WARN] [1.5] [rosbag2_cpp]: Cache buffers lost messages per topic: ",
            LineKind.MESSAGES_LOST,
            None,
        ),
        ("Total lost: 12", LineKind.MESSAGES_LOST, None),
        ("Total lost: 0", LineKind.OTHER, None),
        ("[WARN] [1.5] [n]: something else", LineKind.WARNING, None),
        ("[FATAL] [1.5] [n]: it is over", LineKind.ERROR, None),
        ("[DEBUG] [1.5] [n]: detail", LineKind.OTHER, None),
        ("ros2 bag record: error: unrecognized arguments: --x", LineKind.OTHER, None),
        ("", LineKind.OTHER, None),
    ],
)
def test_a_line_is_classified(raw: str, said: LineKind, topic: str | None) -> None:
    line = parse_line(raw)
    assert (line.kind, line.topic) == (said, topic)


@given(st.text())
def test_no_line_is_too_odd(raw: str) -> None:
    assert parse_line(raw).kind in LineKind
