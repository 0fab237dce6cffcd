"""What `ros2 bag record` writes: the real one and the double, and files that the real one wrote."""

from __future__ import annotations

import re
import signal
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Any, Final

import pytest
from mcap.records import Channel, Chunk, Header, Message, Metadata, Schema, SummaryOffset
from mcap.stream_reader import breakup_chunk

from tests.integration.ros_recordings import (
    Recording,
    embedded,
    in_file,
    is_closed,
    messages,
    metadata,
    records,
    summary_of,
)
from tests.support.ros_processes import (
    RECORDERS,
    installation,
    publishing_robot,
    ros_environment,
    wait_for,
)
from tests.support.shared_bags import RECORDED, needs_recorded
from tests.timing import in_time

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mcap.summary import Summary

    from tests.support.real_recorder import RealRecorder

TOPICS: Final = (
    "/odom",
    "/tf",
    "/tf_static",
    "/cmd_vel",
    "/bumper",
    "/battery_state",
    "/vision/scene/scene_objects",
)
SPLIT_S: Final = 3
DRIVE_S: Final = 8.0
SPLITS: Final = 3
REGEX: Final = f"^({'|'.join(TOPICS)})$"


@dataclass(frozen=True)
class Session:
    """One drive, recorded by three at once; `late` began when the drive was under way."""

    t0: int
    published: dict[str, int]
    small: Recording  # 16 KiB chunks, zstd
    default: Recording
    late: Recording
    active_bytes: int  # of the default one's first split while 16 KiB chunks had reached the disk
    closed_early: Summary  # of a split, read while the recording went on
    codes: list[int]


@pytest.fixture(scope="module", params=RECORDERS)
def session(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session as the tests take it to be, which asks of programs to run in time."""
    real = installation(request)
    found: list[Session] = []

    def once() -> None:
        session = drive_once(tmp_path_factory.mktemp("session"), real)
        assert session.active_bytes == 0
        assert len(session.small.splits()) == SPLITS
        assert {topic for topic, *_ in messages(session.late)} == set(TOPICS)
        # That it had subscribed when the drive began; the late one counts as a subscriber, too.
        recorded = [topic for topic, *_ in messages(session.default)]
        assert recorded.count("/odom") == session.published["/odom"]
        found.append(session)

    in_time(once)
    return found[-1]


def drive_once(folder: Path, real: RealRecorder | None) -> Session:
    storage, qos = folder / "storage.yaml", folder / "qos.yaml"
    storage.write_text("chunkSize: 16384\ncompression: Zstd\n")
    qos.write_text(
        "/tf_static: {history: keep_all, reliability: reliable, durability: transient_local}\n"
    )
    small = ["-e", REGEX, "--storage-config-file", str(storage)]
    small += ["--qos-profile-overrides-path", str(qos), "--custom-data", "robot=r1", "site=hall"]
    default = ["-e", REGEX]
    every = ["-d", str(SPLIT_S)]
    with (
        ros_environment(folder, real=real) as env,
        Recording(env, folder / "bags" / "small", *every, *small) as first,
        Recording(env, folder / "bags" / "default", *every, *default) as second,
        Recording(env, folder / "bags" / "late", *every, *default) as third,
        halted(third),
        publishing_robot(
            env, folder / "truth.json", "--subscribers", "2", duration_s=DRIVE_S
        ) as robot,
    ):
        t0 = robot.t0
        beginning = first.splits()[0]
        wait_for(lambda: beginning.stat().st_size > 0, "a chunk of 16 KiB")
        active_bytes = second.splits()[0].stat().st_size
        third.process.send_signal(signal.SIGCONT)
        first.await_splits(2)
        wait_for(lambda: is_closed(beginning), "the footer of the first split")
        closed_early = summary_of(beginning)
        published = robot.finish()
        codes = [recording.stop() for recording in (first, second, third)]
        return Session(t0, published, first, second, third, active_bytes, closed_early, codes)


@contextmanager
def halted(recording: Recording) -> Iterator[None]:
    """It has begun, which takes it seconds, and does not get to see who publishes what."""
    recording.await_said("Recording...")
    recording.process.send_signal(signal.SIGSTOP)
    yield


def test_a_clean_end_exits_with_0(session: Session) -> None:
    assert session.codes == [0, 0, 0]


def test_every_published_message_is_recorded_once(session: Session) -> None:
    assert session.published["/odom"] == int(DRIVE_S * 20)
    for recording in (session.small, session.default):
        found = Counter(topic for topic, *_ in messages(recording))
        assert dict(found) == session.published


def test_overlapping_recordings_agree_on_publish_time_and_payload_and_not_on_log_time(
    session: Session,
) -> None:
    first, second = (
        {(topic, published): (log, data) for topic, log, published, data in messages(recording)}
        for recording in (session.small, session.default)
    )
    assert first.keys() == second.keys()
    assert all(first[key][1] == second[key][1] for key in first)
    assert sum(first[key][0] == second[key][0] for key in first) < len(first) / 10


def test_a_latched_message_is_in_the_split_in_which_it_was_received_and_in_no_other(
    session: Session,
) -> None:
    (first,), (late,) = (
        [m for m in messages(recording) if m[0] == "/tf_static"]
        for recording in (session.small, session.late)
    )
    assert first[2:] == late[2:]
    assert late[1] > first[1]
    with_it = [
        "/tf_static" in {topic for topic, *_ in in_file(split)} for split in session.small.splits()
    ]
    assert with_it == [True, False, False]


def test_a_late_recording_misses_nothing_after_the_first_message_of_a_topic(
    session: Session,
) -> None:
    everything, late = messages(session.small), messages(session.late)
    for topic in TOPICS:
        all_of_it, since = ([m[2:] for m in found if m[0] == topic] for found in (everything, late))
        assert since
        assert since == all_of_it[-len(since) :]
    assert len(late) < len(everything)


def test_a_split_begins_with_the_message_that_comes_too_late_for_the_one_before(
    session: Session,
) -> None:
    splits = [[log for _, log, *_ in in_file(split)] for split in session.small.splits()]
    assert len(splits) == 3
    for before, after in pairwise(splits):
        assert after[0] - min(before) > SPLIT_S * 10**9
    for split in splits:
        for place, log in enumerate(split):
            assert log - min(split[: place + 1]) <= SPLIT_S * 10**9


def test_a_split_is_closed_while_the_recording_goes_on(session: Session) -> None:
    assert session.closed_early.statistics is not None
    assert session.closed_early.statistics.message_count == len(in_file(session.small.splits()[0]))


def test_each_split_lists_those_before_it_and_the_last_one_the_topics(session: Session) -> None:
    names = [split.name for split in session.small.splits()]
    assert names == [f"small_{number}.mcap" for number in range(3)]
    for number, split in enumerate(session.small.splits()):
        begin, end = embedded(split)
        assert begin["relative_file_paths"] == names[: max(1, number)]
        assert end["relative_file_paths"] == names[: number + 1]
        assert bool(end["topics_with_message_count"]) == (number == 2)
        assert begin["custom_data"] == {"robot": "r1", "site": "hall"}


def test_metadata_yaml_states_what_the_files_hold(session: Session) -> None:
    stated = metadata(session.small.directory)
    logs = [[log for _, log, *_ in in_file(split)] for split in session.small.splits()]
    assert [file["message_count"] for file in stated["files"]] == [len(split) for split in logs]
    assert stated["message_count"] == sum(session.published.values())
    assert stated["starting_time"]["nanoseconds_since_epoch"] == min(map(min, logs))
    topics = stated["topics_with_message_count"]
    counts = {topic["topic_metadata"]["name"]: topic["message_count"] for topic in topics}
    assert counts == session.published


@needs_recorded
def test_a_file_is_built_as_the_real_ones_are(session: Session) -> None:
    for number, real in ((0, "session_mcap/session_mcap_0"), (1, "session_mcap/session_mcap_1")):
        own_file, real_file = session.default.splits()[number], RECORDED / f"{real}.mcap"
        assert skeleton(own_file) == skeleton(real_file)
        assert declares_once(real_file)
        assert declares_once(own_file)
    # The second one's summary has the latched topic, of which it holds no message.
    own = summary_of(session.default.splits()[1])
    assert own.statistics is not None
    assert own.statistics.channel_count == len(own.channels) - 1


@needs_recorded
def test_chunks_are_compressed_as_in_the_real_ones(session: Session) -> None:
    for split in session.small.splits():
        chunks = summary_of(split).chunk_indexes
        assert all(
            chunk.compression == ("zstd" if chunk.uncompressed_size >= 1024 else "")
            for chunk in chunks
        )
        assert len(chunks) > 2
    assert skeleton(session.small.splits()[0]) == skeleton(
        RECORDED / "session_killed_chunk64k" / "session_killed_chunk64k_0.mcap"
    )


@needs_recorded
def test_channels_and_schemas_are_those_of_the_real_ones(session: Session) -> None:
    own = summary_of(session.default.splits()[0])
    real = summary_of(RECORDED / "session_mcap" / "session_mcap_0.mcap")
    real_channels = {channel.topic: channel for channel in real.channels.values()}
    for channel in own.channels.values():
        same = real_channels[channel.topic]
        assert channel.message_encoding == same.message_encoding
        assert channel.metadata == same.metadata
        schema, real_schema = own.schemas[channel.schema_id], real.schemas[same.schema_id]
        assert (schema.name, schema.encoding) == (real_schema.name, real_schema.encoding)
        # Distributions differ in their comments.
        assert fields(schema) == fields(real_schema)
        if schema.name in {"std_msgs/msg/Bool", "geometry_msgs/msg/Twist"}:
            assert schema.data == real_schema.data


@needs_recorded
def test_metadata_has_the_shape_of_the_real_one(session: Session) -> None:
    real = metadata(RECORDED / "session_mcap")
    assert shape(metadata(session.default.directory)) == shape(real)
    for number in (0, 1):
        real_file = RECORDED / "session_mcap" / f"session_mcap_{number}.mcap"
        pairs = zip(embedded(session.default.splits()[number]), embedded(real_file), strict=True)
        assert all(shape(own) == shape(real) for own, real in pairs)


@needs_recorded
def test_it_says_what_the_real_one_says(session: Session) -> None:
    real = spoken((RECORDED / "logs" / "session_mcap.log").read_text())
    own = spoken(session.default.said)
    # Two lines of the beginning come from two threads; robots differ in topics, drives in length,
    # and who names topics is told that all of them were found.
    others = ("/scan", "description", "All requested topics")
    assert set(own) == {line for line in real if not any(other in line for other in others)}
    assert own[-5:] == real[-5:]
    assert own[0] == real[0]
    assert session.default.said.startswith("stdin is not a terminal device.")
    assert own.count(real[-4]) == len(session.default.splits())


def test_channel_ids_differ_between_the_splits_of_one_recording(session: Session) -> None:
    first, second = (summary_of(split) for split in session.small.splits()[:2])
    ids = [{c.topic: c.id for c in summary.channels.values()} for summary in (first, second)]
    assert ids[0].keys() == ids[1].keys()
    assert ids[0] != ids[1]


def skeleton(file: Path) -> list[object]:
    """The kinds of records in their order, runs taken together, and what is fixed in them."""
    found: list[object] = []
    for record in records(file, emit_chunks=True):
        match record:
            case Header():
                assert record.library
                found.append(("Header", record.profile))
            case Chunk():
                found.append(("Chunk", record.uncompressed_crc))
            case Metadata():
                found.append(("Metadata", record.name, *record.metadata))
            case SummaryOffset():
                found.append(("SummaryOffset", record.group_opcode))
            case _:
                found.append(type(record).__name__)
    once = [kind for kind, _ in groupby(found)]
    chunk = [("Chunk", 0), "MessageIndex"]
    while any(once[at : at + 4] == chunk * 2 for at in range(len(once))):
        at = next(at for at in range(len(once)) if once[at : at + 4] == chunk * 2)
        del once[at : at + 2]
    return once


def declares_once(file: Path) -> bool:
    """Whether each schema and channel comes right before its first message, and only there."""
    kinds = {Schema: "S", Channel: "C", Message: "M"}
    chunks = [record for record in records(file, emit_chunks=True) if isinstance(record, Chunk)]
    inside = [record for chunk in chunks for record in breakup_chunk(chunk)]
    in_order = re.fullmatch(r"((S?C)?M)+", "".join(kinds[type(record)] for record in inside))
    declared = [(type(r), r.id) for r in inside if isinstance(r, Schema | Channel)]
    return in_order is not None and len(declared) == len(set(declared))


def shape(value: Any) -> Any:
    """Keys and types of what YAML holds; of a list, that of its elements."""
    if isinstance(value, dict):
        return {key: shape(inner) for key, inner in value.items()}
    if isinstance(value, list):
        shapes = [shape(inner) for inner in value]
        assert all(other == shapes[0] for other in shapes)
        return shapes[:1]
    return type(value)


def fields(schema: Schema) -> list[str]:
    """The definition's lines without comments."""
    lines = (line.split("#")[0].strip() for line in schema.data.decode().splitlines())
    return [line for line in lines if line]


def spoken(log: str) -> list[str]:
    """The log lines, without times."""
    return re.findall(r"\[[A-Z]+\] \[[0-9.]+\] (\[\w+\]: .*)", log)
