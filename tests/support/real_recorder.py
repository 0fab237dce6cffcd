"""The real `ros2 bag record` for tests, where this machine has one or can be given one.

`.ci/real-recorder` finds it, or sets it up, which takes half a minute once. Where there is none,
tests that need it skip and say why; with EPISODIC_REQUIRE_REAL=1 they fail instead.

    def test_of_the_real_one(real_recorder: RealRecorder, tmp_path: Path) -> None:
        with ros_environment(tmp_path, real=real_recorder) as env:
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROS_NAMES = ("ROS", "RMW", "RCUTILS", "FASTDDS", "FASTRTPS", "AMENT", "COLCON", "CMAKE")
"""How the names of environment variables begin that are a ROS installation's, or the robot's."""
FINDING_S = 600.0
_PYTHONS = ("python3", "/usr/bin/python3")
_PROBE = "import rclpy, sys; print(sys.executable, *sys.version_info[:2])"


@dataclass(frozen=True)
class RealRecorder:
    """A ROS installation with `ros2 bag record`.

    Attributes:
        setup: its setup file.
        env: what its setup file makes of an environment that knows no ROS.
        python: the interpreter that has its rclpy, for publishers.
        python_path: PYTHONPATH for publishers, without the root of this checkout: after what its
            packages need, the packages of the environment that runs the tests.
    """

    setup: Path
    env: Mapping[str, str]
    python: str
    python_path: str


def env_without_ros() -> dict[str, str]:
    """This process's environment without anything of ROS."""
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(ROS_NAMES) and name not in {"PYTHONPATH", "LD_LIBRARY_PATH"}
    }


@pytest.fixture(scope="session")
def real_recorder() -> RealRecorder:
    """The real recorder of this machine; the first call may set it up.

    Where there is none the test skips, or fails with EPISODIC_REQUIRE_REAL=1.
    """
    found = _found()
    if isinstance(found, str):
        say = pytest.fail if os.environ.get("EPISODIC_REQUIRE_REAL") == "1" else pytest.skip
        say(f"no real recorder: {found}")
    return found


@cache
def _found() -> RealRecorder | str:
    ran = subprocess.run(
        [ROOT / ".ci" / "real-recorder"],
        env={**env_without_ros(), "PATH": _path()},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        check=False,
        text=True,
        timeout=FINDING_S,
    )
    said = ran.stdout.strip()
    if ran.returncode:
        return said
    setup = Path(said)
    env = _sourced(setup)
    for python in _PYTHONS:
        asked = subprocess.run(
            [python, "-c", _PROBE], env=env, capture_output=True, check=False, text=True
        )
        if asked.returncode == 0:
            break
    else:
        return f"no Python of {setup} has rclpy: {asked.stderr.strip().splitlines()[-1]}"
    executable, *version = asked.stdout.split()
    if [int(part) for part in version] != list(sys.version_info[:2]):
        own = "{}.{}".format(*sys.version_info)
        return f"rclpy of {setup} is for Python {'.'.join(version)}, the tests run in {own}"
    packages = next(path for path in sys.path if path.endswith("site-packages"))
    return RealRecorder(
        setup=setup,
        env=env,
        python=executable,
        python_path=os.pathsep.join(filter(None, (env.get("PYTHONPATH"), packages))),
    )


def _path() -> str:
    """PATH without the environment that runs the tests, whose `python3` is not a distribution's."""
    own = str(Path(sys.prefix) / "bin")
    return os.pathsep.join(
        folder for folder in os.environ["PATH"].split(os.pathsep) if folder != own
    )


def _sourced(setup: Path) -> dict[str, str]:
    """The environment that a setup file makes."""
    ran = subprocess.run(
        ["bash", "-c", '. "$1" >&2 && env -0', "-", str(setup)],
        env={**env_without_ros(), "PATH": _path()},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        check=True,
    )
    pairs = (entry.partition("=") for entry in os.fsdecode(ran.stdout).split("\0") if entry)
    aside = {"_", "SHLVL", "PWD", "OLDPWD", "VIRTUAL_ENV"}
    return {name: value for name, _, value in pairs if name not in aside}
