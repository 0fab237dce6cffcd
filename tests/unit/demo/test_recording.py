"""The demo's bags: the layout of `ros2 bag record`, and what the closed forms say, in each."""

from __future__ import annotations

from collections import Counter
from itertools import takewhile
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S
from ros2_memory.demo.messages import STREAMS, MessageSchedule, Stream, definition
from ros2_memory.demo.recording import DemoRecorder
from tests.support.clocks import FixedClock

T0 = 1_800_000_000 * NS_PER_S + 123 * NS_PER_MS
START = T0 + 22 * NS_PER_S + 7 * NS_PER_MS
TIMELINE = MessageSchedule(T0, START)
BY_TOPIC = {stream.topic: stream for stream in STREAMS}
SECONDS = 13


def record(folder: Path, *, until: int) -> None:
    with DemoRecorder(folder / "demo", TIMELINE, clock=FixedClock(until)) as recorder:
        pass
    assert recorder.failure is None


def count(stream: Stream, at: int) -> int:
    return sum(1 for _ in takewhile(lambda each: each.log_time <= at, TIMELINE.messages(stream)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    record(folder, until=START + SECONDS * NS_PER_S)
    return folder / "demo"


def test_every_topic_holds_exactly_the_messages_that_were_due(recording: Path) -> None:
    with Reader(recording) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        times = Counter(connection.topic for connection, _, _ in reader.messages())
    due = {stream.topic: count(stream, START + SECONDS * NS_PER_S) for stream in STREAMS}
    assert counts == due == times
    assert due["/odom"] == 20 * SECONDS
    assert due["/tf_static"] == 1


def test_every_channel_has_its_definition_and_its_qos(recording: Path) -> None:
    topics = set()
    for path in recording.glob("*.mcap"):
        with path.open("rb") as stream:
            reader = make_reader(stream)
            assert reader.get_header().profile == "ros2"
            summary = reader.get_summary()
            assert summary is not None
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (schema.name, schema.encoding) == (BY_TOPIC[channel.topic].type, "ros2msg")
            assert schema.data.decode() == definition(schema.name)
            latched = "durability: transient_local" in channel.metadata["offered_qos_profiles"]
            assert latched == (channel.topic == "/tf_static")
            topics.add(channel.topic)
    assert topics == set(BY_TOPIC)
