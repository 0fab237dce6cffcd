"""Answers against the closed form, over bags that the real `ros2 bag record` wrote, and one more.

That one the tests write: without the shared bags there is no other of its length.
"""

import math
import random
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from ros2_memory import queries
from ros2_memory.core.timebase import unix_from_ns, unix_rounded_up
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import AtTime, TimeRange
from tests.support.closed_form import (
    CAMERA,
    LASER,
    SESSIONS,
    SMALL,
    SPEED,
    Session,
    degrees_apart,
    mounted,
    position,
    written_session,
    yaw_deg,
)
from tests.support.memories import memory_of
from tests.support.shared_bags import needs_recorded

WRITTEN = "written"
"""In place of a session: the one that the test writes."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return written_session(tmp_path_factory.mktemp("session") / "written")


@pytest.fixture(
    params=[
        pytest.param(SMALL, id="small"),
        pytest.param(WRITTEN, id=WRITTEN),
        *(pytest.param(each, id=name, marks=needs_recorded) for name, each in SESSIONS.items()),
    ]
)
def session(request: pytest.FixtureRequest) -> Session:
    found: Session = (
        request.getfixturevalue("written") if request.param == WRITTEN else request.param
    )
    return found


@cache
def remembered(folder: Path, storage: str) -> Memory:
    return memory_of(folder, storage=storage)


@pytest.fixture
def memory(session: Session) -> Memory:
    return remembered(session.folder, session.storage)


def spanned(memory: Memory, session: Session) -> tuple[float, float]:
    """First and last moment of the odometry, in seconds after T0."""
    rows = {row.topic: row for row in queries.list_recorded_topics(memory, Call())}
    first, last = rows["/odom"].first, rows["/odom"].last
    return session.since(unix_from_ns(first)), session.since(unix_from_ns(last))


@cache
def log_times(folder: Path) -> dict[str, list[int]]:
    """Those of each topic by plain rosbags, over all files of a session."""
    times: defaultdict[str, list[int]] = defaultdict(list)
    with Reader(folder) as reader:
        for connection, stamp, _ in reader.messages():
            times[connection.topic].append(stamp)
    return {topic: sorted(each) for topic, each in times.items()}


def test_the_position_is_the_closed_form_at_the_replys_own_timestamp(
    memory: Memory, session: Session
) -> None:
    begin, end = spanned(memory, session)
    known = log_times(session.folder)["/odom"]
    rng = random.Random(50)
    for _ in range(50):
        asked = session.at(rng.uniform(begin + 0.2, end))
        answer = queries.position(memory, Call(), AtTime(at_s=asked))
        t = session.since(unix_from_ns(answer.time))
        x, y = position(t)
        assert math.dist(answer.pose.position[:2], (x, y)) < 0.005
        assert answer.time == max(each for each in known if each <= asked * 1e9 + 1000)


@pytest.mark.parametrize(("sensor", "mount"), [("laser", LASER), ("camera", CAMERA)])
def test_a_transform_is_interpolated_to_the_asked_moment(
    memory: Memory, session: Session, sensor: str, mount: tuple[float, float, float]
) -> None:
    begin, end = spanned(memory, session)
    rng = random.Random(7)
    for _ in range(25):
        t = rng.uniform(begin + 0.1, end - 0.1)
        answer = queries.transform(memory, Call(), "odom", sensor, AtTime(at_s=session.at(t)))
        assert math.dist(answer.transform.translation, mounted(t, mount)) < 0.005
        x, y, z, w = answer.transform.rotation
        yaw = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        assert degrees_apart(yaw, yaw_deg(t)) < 0.2
        assert answer.clock == "stamp"


def test_the_path_length_is_speed_times_time(memory: Memory, session: Session) -> None:
    begin, end = spanned(memory, session)
    span = TimeRange(start_s=session.at(begin - 1), end_s=session.at(end + 1))
    answer = queries.trajectory_summary(memory, Call(), span)
    steps = round((end - begin) * 20)
    assert answer.trajectory.totals.distance_m == pytest.approx(SPEED * steps / 20, rel=1e-3)
    assert answer.trajectory.max_speed == pytest.approx(SPEED, abs=1e-6)
    assert answer.trajectory.avg_speed == pytest.approx(SPEED, rel=0.01)
    for waypoint in answer.trajectory.waypoints:
        x, y = position(session.since(unix_from_ns(waypoint.time)))
        assert math.dist(waypoint.position[:2], (x, y)) < 0.005


def test_a_timestamp_fed_back_finds_its_own_message(memory: Memory, session: Session) -> None:
    begin, end = spanned(memory, session)
    span = TimeRange(start_s=session.at(begin), end_s=session.at(end))
    for sample in queries.topic_range(memory, Call(), "/odom", span, max_samples=60).samples:
        again = queries.topic_value(
            memory, Call(), "/odom", AtTime(at_s=unix_rounded_up(sample.time)), tolerance_s=0.0
        )
        assert again.sample.time == sample.time
