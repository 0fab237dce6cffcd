"""`ros2-memory up` with the real `ros2 bag record`: publishers, a client, and how it ends."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from tests.support.live_recorder import Machine, answer
from tests.support.processes import PATIENCE_S, until
from tests.support.ros_processes import end, publishing_robot
from tests.support.served import Served

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("server.port=0", "recording.split_duration_s=1", "retention.min_free_gb=0")
RADIUS = 2.0  # m, of the circle that `tests/support/robot_publishers.py` drives on
LEFT = ["/camera/image_raw", "/speech", "/clock"]
PROPOSED = [
    "/battery_state",
    "/bumper",
    "/cmd_vel",
    "/odom",
    "/tf",
    "/tf_static",
    "/vision/scene/scene_objects",
]


@dataclass
class Up:
    """A running `ros2-memory up`, and what it printed so far."""

    process: subprocess.Popen[bytes]
    out: Path
    err: Path

    def wait_for_line(self, pattern: str) -> re.Match[str]:
        def come() -> re.Match[str] | None:
            found = re.search(pattern, self.out.read_text())
            is_over = self.process.poll() is not None
            assert found or not is_over, self.out.read_text() + self.err.read_text()
            return found

        return until(come)

    def served(self) -> Served:
        """Its server, as soon as that listens."""
        found = self.wait_for_line(r"the page of this memory: http://127\.0\.0\.1:(\d+)/")
        return Served(self.process, int(found[1]), self.err)

    def code(self) -> int:
        return self.process.wait(timeout=PATIENCE_S)


@contextmanager
def started(folder: Path, env: Mapping[str, str], *words: str) -> Iterator[Up]:
    """`ros2-memory up --yes` of this checkout, with the bags in `folder`/bags."""
    path = os.pathsep.join(filter(None, (str(ROOT / "src"), env.get("PYTHONPATH"))))
    out, err = folder / "up.out", folder / "up.err"
    # As a shell has it that starts a program in the background.
    argv = ["env", "--ignore-signal=INT", sys.executable, "-m", "ros2_memory.cli", "up", "--yes"]
    with out.open("wb") as stdout, err.open("wb") as stderr:
        process = subprocess.Popen(
            [*argv, "--bag-dir", str(folder / "bags"), *QUICK, *words],
            env={**env, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            cwd=folder,
        )
    try:
        yield Up(process, out, err)
    finally:
        end(process)
        sys.stdout.write(out.read_text() + err.read_text())


def words_of(pid: int) -> list[str]:
    """The command line of a process; nothing once it has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    return [""]


def descendants(pid: int) -> dict[int, list[str]]:
    """The command lines of all processes below a process, by their ids."""
    found: dict[int, list[str]] = {}
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, listed.read_text().split()):
            found |= {child: words_of(child), **descendants(child)}
    return found


def assert_have_ended(below: dict[int, list[str]]) -> None:
    assert not [words for pid, words in below.items() if words_of(pid) == words != [""]]


def test_it_records_what_it_proposes_answers_over_sse_and_leaves_no_process(
    site: Machine, tmp_path: Path
) -> None:
    drive = ("--hz", "20", "--topics", *PROPOSED, *LEFT)
    with (
        publishing_robot(site.env, tmp_path / "truth.json", *drive),
        started(tmp_path, site.env) as up,
    ):
        served = up.served()
        written = (tmp_path / "bags" / "topics.yaml").read_text()
        assert yaml.safe_load(written) == {"topics": PROPOSED}
        assert "  # - /speech  # std_msgs/msg/String: what people said\n" in written
        assert "/camera" not in written
        shown = up.out.read_text()
        assert re.search(r"leave +/camera/image_raw +sensor_msgs/msg/Image: images", shown)
        assert re.search(r"record +/odom +\S+ Hz +724 B +\S+ MB a day", shown)
        assert re.search(r"about \S+ GB a day, .* the budget of 5 GB .* holds \d\S* days;", shown)

        def seen() -> dict[str, float] | None:
            reply = answer(served, "get_topic_seconds_ago", topic="/odom", seconds_ago=2)
            found: dict[str, float] | None = reply.get("value", {}).get("position")
            return found

        at = until(seen)
        # It drives on a circle that touches the origin.
        assert at["x"] ** 2 + (at["y"] - RADIUS) ** 2 == pytest.approx(RADIUS**2, abs=0.01)
        names = {each["topic"] for each in answer(served, "list_recorded_topics")}
        assert names.isdisjoint(LEFT)
        up.wait_for_line(r"recorder: recording since .*, 7 topics")
        below = descendants(up.process.pid)
        modules = {word for words in below.values() for word in words}
        assert {"ros2_memory.recorder", "ros2_memory.server", "record"} <= modules
        up.process.send_signal(signal.SIGINT)
        assert up.code() == 0
        assert_have_ended(below)
    assert "recorder and server have ended" in up.out.read_text()
    assert up.err.read_text() == ""


def test_a_list_that_is_there_is_used_and_a_program_that_dies_ends_it_with_code_1(
    site: Machine, tmp_path: Path
) -> None:
    (tmp_path / "bags").mkdir()
    listed = tmp_path / "bags" / "topics.yaml"
    listed.write_text("topics: [/odom, /joy]\n")
    setup = f"recorder.setup_files=[{site.env['ROS2_LIVE_SETUP']}]"
    with (
        publishing_robot(site.env, tmp_path / "truth.json", "--topics", "/odom", "/bumper"),
        started(tmp_path, site.plain_env, setup) as up,
    ):
        up.wait_for_line("recorder: recording since")
        shown = up.out.read_text()
        assert f"{listed} is used as it is\n" in shown
        assert "it lacks, of what would be proposed: /bumper\n" in shown
        up.served()
        below = descendants(up.process.pid)
        server = next(each for each, words in below.items() if "ros2_memory.server" in words)
        os.kill(server, signal.SIGKILL)
        assert up.code() == 1
        assert_have_ended(below)
    assert "ros2-memory up: the server ended with status -9\n" in up.err.read_text()
    assert listed.read_text() == "topics: [/odom, /joy]\n"


def test_where_no_topic_is_offered_it_names_the_domain_and_what_to_do(
    site: Machine, tmp_path: Path
) -> None:
    with started(tmp_path, site.env) as up:
        assert up.code() == 2
        said = up.err.read_text()
    domain = site.env["ROS_DOMAIN_ID"]
    assert f"no topic is offered in ROS_DOMAIN_ID={domain} over rmw_fastrtps_cpp" in said
    assert "start the robot's nodes, and give this command their ROS_DOMAIN_ID" in said
    assert not (tmp_path / "bags" / "topics.yaml").exists()
