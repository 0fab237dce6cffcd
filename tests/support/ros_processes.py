"""ROS 2 for a test: an environment of its own on this machine, and programs that run in it.

`ros_environment` is a context manager; what it yields is the whole environment for subprocesses,
that of the real recorder (`tests/support/real_recorder.py`): a `ROS_DOMAIN_ID` that no other test
on this machine has, and discovery on this machine alone.
"""

import json
import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import PATIENCE_S, until
from tests.support.real_recorder import (
    RealRecorder,
)

ROOT = Path(__file__).resolve().parents[2]
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108
_DOMAINS = range(1, 102)  # those whose ports lie below the ephemeral ones (ROS_DOMAIN_ID)


@contextmanager
def ros_environment(folder: Path, *, real: RealRecorder) -> Iterator[dict[str, str]]:
    """An environment for subprocesses, see above; `folder` gets the logs.

    At the end, files that Fast DDS left in shared memory since the start are removed, where no
    process has them open.
    """
    before = _shared_memory()
    with _domain() as domain:
        try:
            yield {
                **real.env,
                # That of the type support in `tests/support/robot_publishers.py`.
                "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
                "ROS2_LIVE_SETUP": str(real.setup),
                "ROS2_LIVE_PYTHON": real.python,
                "ROS2_LIVE_PYTHONPATH": f"{ROOT}{os.pathsep}{real.python_path}",
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "ROS_LOG_DIR": str(folder / "ros_log"),
            }
        finally:
            _remove_unused(_shared_memory() - before)


@dataclass(frozen=True)
class Robot:
    """Publishers that run in a process of their own."""

    process: subprocess.Popen[bytes]
    truth_file: Path

    @property
    def t0(self) -> int:
        """T0 in ns; waits until the robot drives."""
        until(self.truth_file.is_file, "the robot's start", alive=self.process)
        return int(self._truth()["t0_ns"])

    @property
    def late_s(self) -> float:
        """How late it published at worst, in seconds."""
        return float(self._truth()["late_s"])

    def reached(self) -> list[int]:
        """When it first reached each further subscriber of its first topic (ns)."""
        matched = [(int(at), int(count)) for at, count in self._truth()["matched"]]
        return [at for (_, before), (at, count) in pairwise(matched) if count > before]

    def stop(self) -> dict[str, int]:
        """Ends the drive, once it has begun; returns how many messages were published by topic."""
        until(self.truth_file.is_file, "the robot's start", alive=self.process)
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(timeout=PATIENCE_S)
        assert code == 0, f"the robot's publishers ended with {code}"
        return {str(topic): int(count) for topic, count in self._truth()["published"].items()}

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
    through: Sequence[str] = (),
) -> Iterator[Robot]:
    """A robot that publishes (`tests/support/robot_publishers.py`, whose options these are).

    Args:
        env: what `ros_environment` yielded.
        truth: file that is to hold T0 and the counts; it must not exist.
        options: such as `--hz 1`, `--topics /odom`, `--subscribers 1`.
        through: a program that becomes the robot, given as the end of its arguments.
    """
    assert not truth.exists(), f"{truth} is the truth of another drive"
    given = ("--truth", str(truth), *options)
    with running(env, "tests.support.robot_publishers", *given, through=through) as process:
        yield Robot(process, truth)


@contextmanager
def running(
    env: Mapping[str, str], module: str, *arguments: str, through: Sequence[str] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """A module that publishes, as a program under the Python of ROS."""
    argv = [*through, env["ROS2_LIVE_PYTHON"], "-P", "-m", module, *arguments]
    known = {**env, "PYTHONPATH": env["ROS2_LIVE_PYTHONPATH"]}
    process = subprocess.Popen(argv, env=known, stdin=subprocess.DEVNULL)
    try:
        yield process
    finally:
        end(process)


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
