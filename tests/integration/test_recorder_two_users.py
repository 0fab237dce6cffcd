"""A recorder under another user than the robot: what it receives in which discovery range.

The one test outside the discovery range LOCALHOST. It runs in a network namespace of its own in
which only the loopback interface is up, so that no other machine hears or is heard.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
import yaml

from ros2_memory.recorder.process.environment import advice_on_silence
from tests.support.processes import PATIENCE_S
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import ros_environment, wait_for

OTHER_UID = 65534  # nobody's
SCRIPT = """\
set -u
folder=$1; shift
ip link set lo up
ip link set lo multicast on
"$ROS2_LIVE_PYTHON" -P -m tests.support.counting_publishers /odom:50:reliable &
robot=$!
as() {
  name=$1; shift
  # Only to read programs below a private home: what lies in /dev/shm is opened for writing, too.
  exec setpriv --reuid=$OTHER --regid=$OTHER --clear-groups \
    --inh-caps=+dac_read_search --ambient-caps=+dac_read_search \
    env "$@" HOME="$folder" ROS_LOG_DIR="$folder/log" PYTHONPATH="$OWN_PYTHONPATH" \
    ros2 bag record -s mcap -d 1 -o "$folder/$name" -e '^(/odom)$' \
    > "$folder/$name.log" 2>&1
}
udp=FASTDDS_BUILTIN_TRANSPORTS=UDPv4
as local ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $udp & first=$!
as subnet ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET ROS_STATIC_PEERS=127.0.0.1 $udp & second=$!
as shared ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET ROS_STATIC_PEERS=127.0.0.1 & third=$!
until [ -e "$folder/stop" ]; do sleep 0.1; done
kill -TERM $first $second $third
wait $first $second $third
kill -KILL $robot
"""


def _cannot() -> str | None:
    if os.geteuid() != 0:
        return "only root may start a process of another user"
    if missing := [each for each in ("unshare", "setpriv", "ip") if shutil.which(each) is None]:
        return f"there is no {', '.join(missing)}"
    tried = subprocess.run(["unshare", "--net", "true"], capture_output=True, check=False)
    return None if tried.returncode == 0 else "no network namespace may be made here"


def _done(folder: Path) -> bool:
    """Whether one has recorded for seconds, and all have subscribed."""
    logs = [folder / f"{name}.log" for name in ("local", "subnet", "shared")]
    said = all(log.is_file() and "Subscribed" in log.read_text() for log in logs)
    return said and len([*(folder / "subnet").glob("*.mcap")]) >= 3


def messages(recording: Path) -> int:
    told = yaml.safe_load((recording / "metadata.yaml").read_text())
    return int(told["rosbag2_bagfile_information"]["message_count"])


def test_what_a_recorder_of_another_user_receives(
    real_recorder: RealRecorder, tmp_path: Path
) -> None:
    """What docs/how-to/systemd.md says of each discovery range; the robot is in LOCALHOST."""
    if reason := _cannot():
        pytest.skip(reason)
    with (
        ros_environment(tmp_path, real=real_recorder) as env,
        tempfile.TemporaryDirectory() as made,  # a test's own folder is closed to other users
    ):
        folder = Path(made)
        folder.chmod(0o777)
        known = {
            **env,
            "OTHER": str(OTHER_UID),
            "OWN_PYTHONPATH": env["PYTHONPATH"],
            "PYTHONPATH": env["ROS2_LIVE_PYTHONPATH"],
        }
        argv = ["unshare", "--net", "bash", "-c", SCRIPT, "two-users", made]
        script = subprocess.Popen(argv, env=known, stdin=subprocess.DEVNULL)
        wait_for(lambda: _done(folder), "messages in SUBNET", alive=script)
        (folder / "stop").touch()
        script.wait(timeout=PATIENCE_S)
        found = {name: messages(folder / name) for name in ("local", "subnet", "shared")}
        subscribed = (folder / "local.log").read_text()
    # Subscribed, and yet it receives nothing.
    assert "Subscribed to topic '/odom'" in subscribed
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
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "RMW_IMPLEMENTATION"),
    ],
)
def test_the_advice_is_never_what_is_set_already(env: dict[str, str], advice: str) -> None:
    said = advice_on_silence(env)
    assert advice in said
    assert not ("set FASTDDS_BUILTIN" in said and "FASTDDS_BUILTIN_TRANSPORTS" in env)
