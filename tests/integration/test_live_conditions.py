"""The recorder under conditions that a robot meets: no room, another user, publishers amiss."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.heartbeat import RecorderState
from tests.faults.small_disk import filled, needs_mounts, small_disk
from tests.support.live_recorder import (
    NS_PER_S,
    Machine,
    answering,
    bag_files,
    machine,
    moment_of,
    ticks,
)
from tests.support.processes import until
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import Robot, publishing_robot
from tests.timing import each_in_time

NOBODY = "65534"
needs_another_user = pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("setpriv", "nsenter", "unshare", "ip"))),
    reason="root alone may run the recorder as another user (with util-linux and iproute2)",
)


@contextmanager
def own_network() -> Iterator[list[str]]:
    """A machine's network without a way out; what to start programs through to be on it."""
    hold = "ip link set lo up && echo up && exec sleep infinity"
    holder = subprocess.Popen(["unshare", "--net", "sh", "-c", hold], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        if holder.stdout.readline() != b"up\n":
            pytest.skip("this user may not make a network of its own")
        yield ["nsenter", f"--net=/proc/{holder.pid}/ns/net"]
    finally:
        holder.kill()
        holder.communicate()


def as_nobody() -> list[str]:
    """What becomes another user's program.

    Interpreter and checkout may lie where only their owner may look, so it may look everywhere, and
    write nowhere; without that bit access(2) denies what open(2) allows.
    """
    become = ["setpriv", "--reuid", NOBODY, "--regid", NOBODY, "--clear-groups"]
    become += [f"--{which}-caps=+dac_read_search" for which in ("inh", "ambient")]
    # The folder for logs is not its own, nor is the one for what was covered.
    ours = ["ROS_LOG_DIR", *(name for name in os.environ if name.startswith("COVERAGE_"))]
    return [*become, "--securebits=+no_setuid_fixup", "env", *(f"--unset={n}" for n in ours)]


HZ = 20.0
DISK_SIZE = "8m"
TOLD_WITHIN_S = 10.0
HEARD = {"/odom", "/bumper", "/clock"}


@pytest.fixture(scope="module")
def site(
    real_recorder: RealRecorder, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Machine]:
    folder = tmp_path_factory.mktemp("conditions")
    with machine(folder, real_recorder) as site:
        yield site


@pytest.fixture(scope="module")
def robot(site: Machine) -> Iterator[Robot]:
    """It drives all the time, recorded or not."""
    with publishing_robot(site.env, site.folder / "truth.json", "--hz", f"{HZ:g}") as robot:
        yield robot


@needs_mounts
@pytest.mark.parametrize("least", ["0.001", "0"])
@each_in_time
def test_a_full_disk_is_told_within_10_s_and_recording_resumes_when_there_is_room(
    site: Machine, robot: Robot, tmp_path: Path, least: str
) -> None:
    guarded = least != "0"
    with small_disk(tmp_path / "disk", DISK_SIZE) as disk:
        recorder = site.record(
            f"full{least}{tmp_path.name}",
            "recording.split_duration_s=1",
            f"retention.min_free_gb={least}",
            bag_dir=disk / "bags",
        )
        try:
            recorder.wait_for("split_closed")
            full_at = time.time_ns()
            with filled(disk):

                def errors() -> list[dict[str, Any]]:
                    return [event for event in recorder.all_events() if event["level"] == "error"]

                until(lambda: errors() or None, "an error event", alive=recorder.process)
                assert moment_of(errors()[0]) - full_at <= TOLD_WITHIN_S * NS_PER_S
                if guarded:
                    recorder.wait_for("recording_paused")
            room_at = time.time_ns()
            if guarded:
                recorder.wait_for("recording_resumed")

            def are_there() -> bool:
                found = ticks(bag_files(recorder.bag_dir), robot.t0, HZ)
                return any(tick.publish_time > room_at for tick in found)

            until(are_there, "messages after there was room", alive=recorder.process)
            recorder.wait_for_state(RecorderState.RECORDING)
            recorder.stop()
        finally:
            recorder.discard()


@needs_another_user
def test_a_recorder_under_another_user_than_the_publishers_records(
    site: Machine, tmp_path: Path
) -> None:
    """In the default discovery range, where the transports are those of the environment."""
    bags = tmp_path / "bags"
    bags.mkdir()
    os.chown(bags, int(NOBODY), int(NOBODY))
    reach = "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
    with (
        own_network() as network,
        publishing_robot(
            site.env, tmp_path / "truth.json", through=[*network, "env", reach]
        ) as robot,
    ):
        transports = "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
        recorder = site.record(
            "others",
            "recording.split_duration_s=1",
            bag_dir=bags,
            through=[*network, *as_nobody(), reach, transports],
        )
        recorder.wait_for("split_closed", 2)
        recorder.stop()
        t0 = robot.t0
    files = bag_files(bags)
    assert {file.stat().st_uid for file in files} == {int(NOBODY)}
    found = [tick.number for tick in ticks(files, t0, HZ)]
    assert found == list(range(found[0], found[-1] + 1))
    assert len(found) > HZ


def test_what_is_amiss_with_publishers_shows_in_the_heartbeat_and_in_health(
    site: Machine, robot: Robot, tmp_path: Path
) -> None:
    """A topic without messages, one that does not fit, one of an unknown type, one of nobody."""
    listed = ["/odom", "/bumper", "/clock", "/*/position", "/nobody"]
    quiet = ("--topics", "/clock", "/px4/position", "--subscribers", "99")
    with (
        publishing_robot(site.env, tmp_path / "quiet.json", *quiet),
        answering(site.folder / "amiss" / "bags", tmp_path / "server.log") as served,
    ):
        recorder = site.record(
            "amiss",
            "recording.split_duration_s=1",
            # Asks of the bumper, whose messages are not latched, what it does not offer.
            "data.tf_static_topics=[/bumper]",
            topics=listed,
        )
        # Each is found out when it is: topics one after the other, and silence by closed splits.
        for topic in HEARD:
            recorder.wait_for("subscribed", topic=topic)
        for event, topic in (("qos_refused", "/bumper"), ("unknown_type", "/px4/position")):
            assert recorder.wait_for(event)[0]["reason"].startswith(f"{topic}:")
        recorder.wait_for("split_closed")

        status = recorder.wait_for_beat(
            lambda beat: {*beat.silent} == {"/bumper", "/clock"} and beat.last_error is not None,
            "it in the heartbeat",
        )
        health = json.loads(served.get("/health")[1])["recorder"]
        recorder.stop()
    assert set(status.subscribed) == HEARD
    assert health["silent_topics"] == ["/bumper", "/clock"]
    assert health["last_error"]
