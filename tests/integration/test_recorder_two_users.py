"""A recorder under another user than the robot: what it receives in which discovery range.

The one test outside the discovery range LOCALHOST. It runs in a network namespace of its own in
which only the loopback interface is up, so that no other machine hears or is heard.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest
import yaml

from ros2_memory.recorder.process.installation import advice_on_silence
from tests.integration.another_user import as_nobody, needs_another_user, own_network
from tests.support.processes import PATIENCE_S
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import end, ros_environment, wait_for

UDP = "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
SUBNET = "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
PEERS = "ROS_STATIC_PEERS=127.0.0.1"
ASKED = {
    "local": ["ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST", UDP],
    "subnet": [SUBNET, PEERS, UDP],
    "shared": [SUBNET, PEERS],
}
"""The settings of each recorder, beside a robot in LOCALHOST."""


def messages(recording: Path) -> int:
    told = yaml.safe_load((recording / "metadata.yaml").read_text())
    return int(told["rosbag2_bagfile_information"]["message_count"])


@needs_another_user
def test_what_a_recorder_of_another_user_receives(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """What docs/how-to/systemd.md says of each discovery range; the robot is in LOCALHOST."""
    with (
        ros_environment(tmp_path, real=real_recorder) as env,
        tempfile.TemporaryDirectory() as made,  # a test's own folder is closed to other users
        own_network() as network,
        ExitStack() as ended,
    ):
        folder = Path(made)
        folder.chmod(0o777)
        publisher = [env["ROS2_LIVE_PYTHON"], "-P", "-m", "tests.integration.counting_publishers"]
        robot = subprocess.Popen(
            [*network, *publisher, "/odom:50:reliable"],
            env={**env, "PYTHONPATH": env["ROS2_LIVE_PYTHONPATH"]},
        )
        ended.callback(end, robot)
        ros2 = shutil.which("ros2", path=env["PATH"])
        assert ros2 is not None
        logs: dict[str, Path] = {}
        recorders: list[subprocess.Popen[bytes]] = []
        for name, settings in ASKED.items():
            argv = [*network, *as_nobody(), f"HOME={made}", *settings, ros2, "bag", "record"]
            argv += ["-s", "mcap", "-d", "1", "-o", str(folder / name), "-e", "^(/odom)$"]
            logs[name] = folder / f"{name}.log"
            with logs[name].open("wb") as log:
                recorders.append(subprocess.Popen(argv, env=env, stderr=log))
            ended.callback(end, recorders[-1])

        def is_done() -> bool:
            """Whether one has recorded for seconds, and all have subscribed."""
            said = all("Subscribed to topic" in log.read_text() for log in logs.values())
            return said and len([*(folder / "subnet").glob("*.mcap")]) >= 3

        wait_for(is_done, "messages in SUBNET", alive=robot)
        for recorder in recorders:
            recorder.send_signal(signal.SIGTERM)
        for recorder in recorders:
            recorder.wait(timeout=PATIENCE_S)
        found = {name: messages(folder / name) for name in ASKED}
    # They have subscribed, and yet they receive nothing.
    assert found["local"] == 0
    assert found["shared"] == 0
    assert found["subnet"] > 50


@pytest.mark.parametrize(
    ("env", "advice"),
    [
        ({}, "set FASTDDS_BUILTIN_TRANSPORTS=UDPv4"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "set FASTDDS_BUILTIN_TRANSPORTS=UDPv4"),
        ({"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, "firewall"),
        (
            {
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            },
            "docs/how-to/systemd.md",
        ),
        ({"ROS_LOCALHOST_ONLY": "1"}, "docs/how-to/systemd.md"),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "CYCLONEDDS_URI"),
        ({"RMW_IMPLEMENTATION": "rmw_connextdds"}, "RMW_IMPLEMENTATION"),
    ],
)
def test_the_advice_is_never_what_is_set_already(env: dict[str, str], advice: str) -> None:
    said = advice_on_silence(env)
    assert advice in said
    assert not ("set FASTDDS_BUILTIN" in said and "FASTDDS_BUILTIN_TRANSPORTS" in env)
