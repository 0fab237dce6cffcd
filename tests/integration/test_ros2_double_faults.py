"""What `ros2 bag record` does when it is signalled, starved or robbed: the real one and the double.

One suite holds both, so that it fails where the double differs.
"""

from __future__ import annotations

import signal
import subprocess
import time
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.integration.ros_recordings import (
    Recording,
    in_file,
    is_closed,
    messages,
)
from tests.support.processes import PATIENCE_S
from tests.support.ros_processes import (
    RECORDERS,
    installation,
    publishing_robot,
    ros_environment,
    wait_for,
)
from tests.timing import each_in_time

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.real_recorder import RealRecorder

SECOND = 10**9


# Name: options. They all begin at once, since each takes its time to begin.
STARTED = {
    "sigint": ("-e", "/odom|/bumper"),
    "sigterm": ("-e", "/odom|/bumper"),
    "stalled": ("-e", "/odom", "-d", "1"),
}
# Overrides of a profile, and what they are refused with; None: they are taken.
OVERRIDES = {
    "{reliability: reliable, durability: transient_local}": (
        "('Invalid QoSProfile', 'History and/or depth settings are required.')"
    ),
    "{history: keep_all, colour: red}": "Unexpected key `colour` for QoS profile.",
    "{depth: 5}": None,
}


@pytest.fixture(scope="module", params=RECORDERS)
def real(request: pytest.FixtureRequest) -> RealRecorder | None:
    """Whose `ros2` it is; None: the double's."""
    return installation(request)


@pytest.fixture(scope="module")
def env(
    real: RealRecorder | None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, str]]:
    """An environment in which a robot drives all the time."""
    folder = tmp_path_factory.mktemp("driving")
    topics = ("--topics", "/odom", "/tf_static", "/bumper")
    with (
        ros_environment(folder, real=real) as env,
        publishing_robot(env, folder / "truth.json", *topics),
    ):
        yield env


@pytest.fixture(scope="module")
def started(
    env: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Recording]]:
    """Recordings under way, each for one test."""
    folder = tmp_path_factory.mktemp("started")
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(Recording(env, folder / name, *options))
            for name, options in STARTED.items()
        }


@pytest.fixture
def quiet(real: RealRecorder | None, tmp_path: Path) -> Iterator[dict[str, str]]:
    """An environment in which nothing is published."""
    with ros_environment(tmp_path, real=real) as env:
        yield env


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_recording_cleanly(
    started: dict[str, Recording], number: signal.Signals
) -> None:
    recording = started[number.name.lower()]
    recording.await_subscribed("/odom", "/bumper")
    assert recording.stop(number) == 0
    assert is_closed(recording.splits()[0])
    assert (recording.directory / "metadata.yaml").is_file()
    assert f"signal_handler(signum={number.value})" in recording.said


@pytest.mark.parametrize("text", ["/od", "^(/odom)$"])
@each_in_time
def test_a_topic_is_recorded_whose_name_contains_a_match(
    env: dict[str, str], tmp_path: Path, text: str
) -> None:
    with Recording(env, tmp_path / "a", "-e", text) as recording:
        recording.await_subscribed("/odom")
        assert recording.stop() == 0
    assert "/bumper" not in recording.said


def test_of_what_comes_while_it_is_stopped_only_the_newest_messages_are_kept(
    started: dict[str, Recording],
) -> None:
    """Ten, and those that publishers send again; fewer where others come before it takes them.

    On a busy machine it may take each before the next one comes, so it is stopped three times.
    """
    recording = started["stalled"]
    recording.await_splits(2)
    stalls = []
    for _ in range(3):
        stopped = time.time_ns()
        recording.process.send_signal(signal.SIGSTOP)
        wait_for(partial(_is_past, stopped + 2 * SECOND), "40 messages")
        stalls.append((stopped, time.time_ns()))
        recording.process.send_signal(signal.SIGCONT)
        recording.await_splits(len(recording.splits()) + 2)
    assert recording.stop() == 0
    published = sorted(published for _, _, published, _ in messages(recording))
    kept = [sum(start < each < end for each in published) for start, end in stalls]
    assert min(kept) <= 30, kept
    # What is sent again on a busy machine lies among what is lost.
    assert max(after - before for before, after in pairwise(published)) > SECOND // 5


def _is_past(moment: int) -> bool:
    return time.time_ns() > moment


@each_in_time
def test_a_silent_robot_leaves_its_last_split_open_until_it_speaks_again(
    quiet: dict[str, str], tmp_path: Path
) -> None:
    bumper = ("--topics", "/bumper", "--subscribers", "1")
    with Recording(quiet, tmp_path / "a", "-e", "/bumper", "-d", "1") as recording:
        with publishing_robot(quiet, tmp_path / "1.json", *bumper, duration_s=0.2) as robot:
            silent_since = robot.t0
            robot.finish()
        wait_for(lambda: time.time_ns() > silent_since + 2 * SECOND, "silence")
        assert [split.stat().st_size for split in recording.splits()] == [0]
        with publishing_robot(quiet, tmp_path / "2.json", *bumper, duration_s=0.2) as robot:
            robot.finish()
        assert recording.stop() == 0
    assert [len(in_file(split)) for split in recording.splits()] == [1, 1]


@each_in_time
def test_an_override_is_a_whole_profile_or_is_refused(
    quiet: dict[str, str], tmp_path: Path
) -> None:
    with ExitStack() as stack:
        recordings: dict[str, Recording] = {}
        for number, text in enumerate(OVERRIDES):
            override = tmp_path / f"{number}.yaml"
            override.write_text(f"/bumper: {text}\n")
            options = ("-e", "/bumper", "--qos-profile-overrides-path", str(override))
            recording = Recording(quiet, tmp_path / f"of{number}", *options)
            recordings[text] = stack.enter_context(recording)
        stack.enter_context(publishing_robot(quiet, tmp_path / "1.json", "--topics", "/bumper"))
        for text, refusal in OVERRIDES.items():
            recording = recordings[text]
            if refusal is None:
                recording.await_said("Overriding subscription profile for /bumper")
                recording.await_subscribed("/bumper")
                assert recording.stop() == 0
            else:
                assert recording.process.wait(timeout=PATIENCE_S) == 1
                assert recording.said == f"[ERROR] [ros2bag]: {refusal}\n"
                assert not recording.directory.exists()


@each_in_time
def test_publishers_that_cannot_meet_what_was_asked_are_not_recorded_and_warned_of(
    quiet: dict[str, str], tmp_path: Path
) -> None:
    topics = ("--topics", "/bumper", "/px4/position")
    override = tmp_path / "qos.yaml"
    override.write_text("/bumper: {history: keep_all, durability: transient_local}\n")
    both = ("-e", "^(/bumper|/px4/.*)$", "-d", "1")
    with ExitStack() as stack:
        plain = stack.enter_context(Recording(quiet, tmp_path / "plain", *both))
        asking = stack.enter_context(
            Recording(
                quiet, tmp_path / "asking", *both, "--qos-profile-overrides-path", str(override)
            )
        )
        reliable = stack.enter_context(publishing_robot(quiet, tmp_path / "1.json", *topics))
        plain.await_subscribed("/bumper")
        late = stack.enter_context(
            publishing_robot(quiet, tmp_path / "2.json", *topics, "--best-effort")
        )
        plain.await_said(
            "A new publisher for subscribed topic /bumper was found offering "
            "RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, but rosbag already subscribed requesting "
            "RMW_QOS_POLICY_RELIABILITY_RELIABLE. "
            "Messages from this new publisher will not be recorded.",
            "Topic '/px4/position' has unknown type 'px4_msgs/msg/VehicleLocalPosition' .",
        )
        asking.await_said(
            "New publisher discovered on topic '/bumper', offering incompatible QoS. "
            "No messages will be sent to it. Last incompatible policy: DURABILITY_QOS_POLICY"
        )
        # A split begins with a message, so it has recorded something.
        plain.await_splits(2)
        late.stop()
        published = reliable.stop()
        assert [recording.stop() for recording in (plain, asking)] == [0, 0]
    heard = [topic for topic, *_ in messages(plain)]
    assert set(heard) == {"/bumper"}
    assert 0 < heard.count("/bumper") <= published["/bumper"]
    assert messages(asking) == []
    assert plain.said.count("has unknown type") == 1


@each_in_time
def test_a_full_disk_is_no_error_and_it_goes_on_once_there_is_room(
    env: dict[str, str], tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("this user may not mount a small disk")
    try:
        ballast = disk / "ballast"
        ballast.write_bytes(bytes(60 * 1024))
        # What it says lies beside the disk, which has no room for it; the last -o counts.
        options = (*STARTED["stalled"], "-o", str(disk / "a"))
        with Recording(env, tmp_path / "a", *options) as recording:
            recording.directory = disk / "a"
            recording.await_splits(3)
            sizes = [split.stat().st_size for split in recording.splits()]
            ballast.unlink()
            full = len(recording.splits())
            recording.await_splits(full + 2)
            assert recording.stop() == 0
        assert sizes[0] % 4096 == 0
        assert set(sizes[1:]) == {0}
        assert not is_closed(recording.splits()[1])
        assert is_closed(recording.splits()[full])
        assert "ERROR" not in recording.said
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@each_in_time
def test_with_sim_time_nothing_is_recorded_before_the_clock_and_its_time_is_the_log_time(
    quiet: dict[str, str], tmp_path: Path
) -> None:
    options = ("-e", "/odom", "-d", "1", "--use-sim-time")
    with (
        Recording(quiet, tmp_path / "a", *options) as recording,
        publishing_robot(quiet, tmp_path / "1.json", "--topics", "/odom"),
    ):
        recording.await_said("use_sim_time set, waiting for /clock")
        assert "Subscribed" not in recording.said
        with publishing_robot(quiet, tmp_path / "2.json", "--topics", "/clock"):
            recording.await_said("Sim time /clock found, starting recording.")
            recording.await_subscribed("/odom")
            recording.await_splits(2)
            assert recording.stop() == 0
    found = messages(recording)
    assert found
    assert all(0 < log < 60 * SECOND < published for _, log, published, _ in found)
