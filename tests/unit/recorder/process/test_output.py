"""What the recorder says, from the logs of the real one and from the texts of its sources."""

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


# What a line reports, the topic if it names one, and the line.
LINES = """
recording - [INFO] [1.5] [rosbag2_recorder]: Recording...
recording - [INFO] [1.5] [rosbag2_recorder]: Listening for topics...
recording - \x1b[32m[INFO] [1.5] [n]: Recording...\x1b[0m
subscribed /odom stdin is not a terminal device.[INFO] [1.5] [n]: Subscribed to topic '/odom'
subscribed /tf [INFO] [1.5] [n]: Subscribed to topic '/tf' (repeat-transient-local, depth=3)
error - [ERROR] [ros2bag]: Output folder '/bags/rec_1' already exists.
qos_refused /scan [WARN] [1] [n]: A new publisher for subscribed topic /scan was found offering RMW
qos_refused /a [WARN] [1.5] [n]: New publisher discovered on topic '/a', offering incompatible QoS.
unknown_type /x [WARN] [1.5] [T]: Topic '/x' has unknown type 'my_msgs/msg/X' . Only topics with
several_types /y [ERROR] [1.5] [T]: Topic '/y' has more than one type associated. Only topics with
messages_lost - [WARN] [1.5] [rosbag2_cpp]: Cache buffers lost messages per topic:
messages_lost - Total lost: 12
other - Total lost: 0
warning - [WARN] [1.5] [n]: something else
error - [FATAL] [1.5] [n]: it is over
other - [DEBUG] [1.5] [n]: detail
other - ros2 bag record: error: unrecognized arguments: --x
"""


@pytest.mark.parametrize("line", LINES.strip().split("\n"))
def test_a_line_is_classified(line: str) -> None:
    kind, topic, raw = line.split(" ", 2)
    parsed = parse_line(raw)
    assert (parsed.kind, parsed.topic or "-") == (kind, topic)


@given(st.text())
def test_no_line_is_too_odd(raw: str) -> None:
    assert parse_line(raw).kind in LineKind
