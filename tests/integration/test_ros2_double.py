"""What `ros2 bag record` writes: the real one and the double, and files that the real one wrote."""

from __future__ import annotations

import re
import signal
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from ros2_memory.recorder.process.command import storage_config
from tests.integration.ros_recordings import (
    Recording,
    in_file,
    is_closed,
    messages,
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
    storage.write_text(storage_config(16384))
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


def test_chunks_have_a_crc_only_where_the_configuration_asks_for_it(session: Session) -> None:
    for recording, has_crc in ((session.small, True), (session.default, False)):
        for split in recording.splits():
            with split.open("rb") as stream:
                records = [*StreamReader(stream, emit_chunks=True).records]
            crcs = [record.uncompressed_crc for record in records if isinstance(record, Chunk)]
            assert {crc != 0 for crc in crcs} == {has_crc}


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


def spoken(log: str) -> list[str]:
    """The log lines, without times."""
    return re.findall(r"\[[A-Z]+\] \[[0-9.]+\] (\[\w+\]: .*)", log)
