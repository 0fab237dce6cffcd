"""ROS 2 for a test: an environment of its own on this machine, and programs that run in it.

`ros_environment` is a context manager; what it yields is the whole environment for subprocesses:

- `ros2` on PATH is the test double (`tests/ros2_double`), or the real one
  (`tests/support/real_recorder.py`).
- A `ROS_DOMAIN_ID` that no other test on this machine has, and discovery on this machine alone.
- `ROS2_LIVE_SETUP` names a `setup.bash` that makes the same of an environment that knows no ROS,
  as a distribution's does.

ROS's Python packages are in an environment of their own, as a distribution's are: the double and
the publishers run in it, the tests do not. Beside the real recorder the publishers run in the
environment of that one.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from tests.support.bags import VISION_DEFINITIONS
from tests.support.examples import LONG
from tests.support.processes import PATIENCE_S, until
from tests.support.real_recorder import (
    RealRecorder,
    env_without_ros,
    find_real_recorder,
    require_real_recorder,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

ROOT: Final = Path(__file__).resolve().parents[2]
SHARED_MEMORY: Final = Path("/dev/shm")  # noqa: S108
ROS: Final = ROOT / "build" / os.environ.get("EPISODIC_ROS_WHEELS", "ros")
"""The environment of the double: Jazzy's wheels, or the newest ones (ros-newest)."""
RECORDERS: Final = ("real", "double") if LONG else ("recorder",)
"""What a test of recording is run with, by the names of parameters.

The real recorder where there is one, else the double; a long run takes both.
"""

_HAS_ROS: Final = any(ROS.glob("lib/*/site-packages/rclpy"))
_NO_ROS: Final = (
    f"build/{ROS.name} has no rclpy (wheels: Linux, Python 3.11); to make it: "
    f"UV_PROJECT_ENVIRONMENT=build/{ROS.name} "
    f"uv sync --locked --inexact --no-default-groups --group {ROS.name}"
)

_DOMAINS: Final = range(1, 102)  # those whose ports lie below the ephemeral ones (ROS_DOMAIN_ID)
_DEFINITIONS: Final = {
    **VISION_DEFINITIONS,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
_WRAPPER: Final = """\
#!/bin/sh
# Test double of ROS 2's command line, made by a test.
export PYTHONPATH='{root}'
exec '{python}' -P -m tests.ros2_double "$@"
"""
_SETUP: Final = """\
export PATH='{folder}/bin':"$PATH"
export AMENT_PREFIX_PATH='{folder}'
export ROS_DISTRO=jazzy ROS_VERSION=2
"""


def installation(request: pytest.FixtureRequest) -> RealRecorder | None:
    """What a fixture with `params=RECORDERS` is run with, for `ros_environment`; None: the double.

    Skips where that one is not there; `require_real_recorder` says when it fails instead.
    """
    if request.param == "recorder":
        return real_or_double()
    if request.param == "real":
        return require_real_recorder()
    _require_double()
    return None


def real_or_double() -> RealRecorder | None:
    """The real recorder where there is one, else None, the double: for tests that take long."""
    found = find_real_recorder()
    if isinstance(found, RealRecorder):
        return found
    _require_double()
    return None


def _require_double() -> None:
    if not _HAS_ROS:
        pytest.skip(_NO_ROS)


def write_workspace(folder: Path) -> Path:
    """What an installed ROS has, as far as a recorder looks: the way to its `setup.bash`.

    `bin/ros2`, and the definitions of the message types that the wheels lack.
    """
    values = {
        "folder": folder,
        "root": ROOT,
        "python": ROS / "bin" / "python",
    }
    program, setup = folder / "bin" / "ros2", folder / "setup.bash"
    program.parent.mkdir(parents=True)
    program.write_text(_WRAPPER.format(**values))
    program.chmod(0o755)
    setup.write_text(_SETUP.format(**values))
    for name, text in _DEFINITIONS.items():
        package, _, message = name.split("/")
        file = folder / "share" / package / "msg" / f"{message}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        marker = folder / "share/ament_index/resource_index/packages" / package
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
    return setup


@contextmanager
def ros_environment(folder: Path, *, real: RealRecorder | None = None) -> Iterator[dict[str, str]]:
    """An environment for subprocesses, see above; `folder` gets the workspace and the logs.

    At the end, files that Fast DDS left in shared memory since the start are removed, where no
    process has them open.

    Args:
        folder: a folder of the test's own.
        real: the installation whose `ros2` it is; None: the double.
    """
    before = _shared_memory()
    known = _of_double(folder / "ros") if real is None else _of_real(real)
    with _domain() as domain:
        try:
            yield {
                **known,
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "ROS_LOG_DIR": str(folder / "ros_log"),
            }
        finally:
            _remove_unused(_shared_memory() - before)


def _of_double(workspace: Path) -> dict[str, str]:
    setup = write_workspace(workspace)
    kept = env_without_ros()
    return {
        **kept,
        "PATH": f"{workspace / 'bin'}{os.pathsep}{kept['PATH']}",
        "AMENT_PREFIX_PATH": str(workspace),
        "ROS_DISTRO": "jazzy",
        "ROS_VERSION": "2",
        "ROS2_LIVE_SETUP": str(setup),
        "ROS2_LIVE_PYTHON": str(ROS / "bin" / "python"),
        "ROS2_LIVE_PYTHONPATH": str(ROOT),
    }


def _of_real(real: RealRecorder) -> dict[str, str]:
    return {
        **real.env,
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",  # that of `tests/support/ros_types.py`
        "ROS2_LIVE_SETUP": str(real.setup),
        "ROS2_LIVE_PYTHON": real.python,
        "ROS2_LIVE_PYTHONPATH": f"{ROOT}{os.pathsep}{real.python_path}",
    }


@dataclass(frozen=True)
class Robot:
    """Publishers that run in a process of their own."""

    process: subprocess.Popen[bytes]
    truth_file: Path

    @property
    def t0(self) -> int:
        """T0 in ns; waits until the robot drives."""
        wait_for(self.truth_file.is_file, "the robot's start", alive=self.process)
        return int(self._truth()["t0_ns"])

    @property
    def late_s(self) -> float:
        """How late it published at worst, in seconds."""
        return float(self._truth()["late_s"])

    def reached(self) -> list[int]:
        """When it first reached each further subscriber of its first topic (ns)."""
        matched = [(int(at), int(count)) for at, count in self._truth()["matched"]]
        return [at for (_, before), (at, count) in pairwise(matched) if count > before]

    def finish(self) -> dict[str, int]:
        """How many messages were published on each topic; waits for the end of the drive."""
        code = self.process.wait(timeout=PATIENCE_S)
        assert code == 0, f"the robot's publishers ended with {code}"
        return {str(topic): int(count) for topic, count in self._truth()["published"].items()}

    def stop(self) -> dict[str, int]:
        """Ends the drive, once it has begun, and tells as `finish` does."""
        wait_for(self.truth_file.is_file, "the robot's start", alive=self.process)
        self.process.send_signal(signal.SIGINT)
        return self.finish()

    def bump(self) -> None:
        """It bumps into something, now instead of at its own time."""
        self.process.send_signal(signal.SIGUSR1)

    def _truth(self) -> dict[str, Any]:
        truth: dict[str, Any] = json.loads(self.truth_file.read_text())
        return truth


@contextmanager
def publishing_robot(
    env: Mapping[str, str],
    truth: Path,
    *options: str,
    duration_s: float | None = None,
    through: Sequence[str] = (),
) -> Iterator[Robot]:
    """A robot that publishes (`tests/support/robot_publishers.py`, whose options these are).

    Args:
        env: what `ros_environment` yielded.
        truth: file that is to hold T0 and the counts; it must not exist.
        options: such as `--hz 1`, `--topics /odom`, `--subscribers 1`.
        duration_s: seconds after which it stops by itself; None: never.
        through: a program that becomes the robot, given as the end of its arguments.
    """
    assert not truth.exists(), f"{truth} is the truth of another drive"
    argv = [*through, env["ROS2_LIVE_PYTHON"], "-P", "-m", "tests.support.robot_publishers"]
    argv += ["--truth", str(truth), *options]
    if duration_s is not None:
        argv += ["--duration", str(duration_s)]
    known = {**env, "PYTHONPATH": env["ROS2_LIVE_PYTHONPATH"]}
    process = subprocess.Popen(argv, env=known, stdin=subprocess.DEVNULL)
    try:
        yield Robot(process, truth)
    finally:
        end(process)


def wait_for(
    condition: Callable[[], object],
    what: str,
    *,
    timeout_s: float = PATIENCE_S,
    alive: subprocess.Popen[bytes] | None = None,
) -> None:
    """Returns once the condition holds; fails where it does not in time, or `alive` died."""

    def holds() -> bool:
        if condition():
            return True
        assert alive is None or alive.poll() is None, f"it ended before {what}"
        return False

    until(holds, what, timeout_s=timeout_s)


def end(process: subprocess.Popen[bytes]) -> None:
    """Whatever is left of a process that a test started."""
    if process.poll() is None:
        process.kill()
    process.wait(timeout=PATIENCE_S)


@contextmanager
def _domain() -> Iterator[int]:
    """A domain that is this process's until the end: held by the name of a socket."""
    first = os.getpid() % len(_DOMAINS)
    for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
        with socket.socket(socket.AF_UNIX) as lock:
            try:
                lock.bind(f"\0ros2-memory-test-domain-{domain}")
            except OSError:
                continue
            yield domain
            return
    pytest.fail("every ROS domain of this machine is taken by a test")


def _shared_memory() -> set[Path]:
    """What Fast DDS has there: 2 calls it fastrtps, 3 fastdds."""
    return {*SHARED_MEMORY.glob("*fastrtps_*"), *SHARED_MEMORY.glob("*fastdds_*")}


def _remove_unused(files: set[Path]) -> None:
    used = _open_files() if files else ""
    for file in files:
        if file.name not in used:
            file.unlink(missing_ok=True)


def _open_files() -> str:
    """The names of the files that processes have mapped or open."""
    names: list[str] = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it may end meanwhile, or be another user's
            names.append((process / "maps").read_text(errors="replace"))
            names += [str(link.readlink()) for link in (process / "fd").iterdir()]
    return "\n".join(names)
