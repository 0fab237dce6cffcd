"""Finds the robot's ROS 2: setup file, environment, and what its `ros2 bag record` can do."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.child import run_bounded
from ros2_memory.recorder.process.command import HELP_ARGV, options_in_help
from ros2_memory.recorder.process.environment import find_ros2, rmw_of, robot_environment

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

HELP_TIMEOUT_S: Final = 60.0
DISTRIBUTIONS: Final = Path("/opt/ros")


class Installation(NamedTuple):
    """A ROS 2 that can record.

    Attributes:
        ros2: the path of the program.
        env: the whole environment that it runs in.
        options: the long options of its `ros2 bag record`.
    """

    ros2: str
    env: dict[str, str]
    options: frozenset[str]


def find_installation(setup_files: Sequence[Path], log_dir: Path) -> Installation:
    """Makes the environment of `ros2`, and reads its options from its help.

    Args:
        setup_files: as for `robot_environment`.
        log_dir: as for `robot_environment`.

    Raises:
        RecorderError: a setup file fails, there is no `ros2`, or it cannot record MCAP.
    """
    env = robot_environment(setup_files, log_dir)
    ros2 = find_ros2(env, sourced=bool(setup_files))
    # Nothing is recorded yet, or never (`ros2-memory doctor`): no log goes beside the bags.
    with TemporaryDirectory() as elsewhere:
        finished = run_bounded(
            [ros2, *HELP_ARGV], {**env, "ROS_LOG_DIR": elsewhere}, HELP_TIMEOUT_S
        )
    if finished.returncode != 0:
        printed = " ".join(finished.stderr.decode(errors="replace").split())[-300:]
        rmw = rmw_of(env)
        do = (
            f"install the package ros-$ROS_DISTRO-{rmw.replace('_', '-')}, or set "
            "RMW_IMPLEMENTATION to what the robot's nodes use"
            if rmw in printed
            else "install the packages ros-$ROS_DISTRO-ros2bag and -rosbag2-storage-mcap, and "
            "correct recorder.setup_files"
        )
        raise RecorderError(
            f"{ros2} bag record --help fails with status {finished.returncode} ({printed}); {do}"
        )
    return Installation(ros2, env, options_in_help(finished.stdout.decode(errors="replace")))


def setup_files_here(
    configured: Sequence[Path], env: Mapping[str, str], distributions: Path = DISTRIBUTIONS
) -> tuple[Path, ...]:
    """Returns the configured setup files; none where `ros2` is on PATH; else the newest one's.

    Distributions are named in the order of the alphabet. One of ROS 1 has no `ros2`.

    Raises:
        RecorderError: there is no ROS 2.
    """
    if configured or shutil.which("ros2", path=env.get("PATH", os.defpath)):
        return tuple(configured)
    found = [
        file
        for file in sorted(distributions.glob("*/setup.bash"))
        if file.with_name("bin").joinpath("ros2").is_file()
    ]
    if not found:
        raise RecorderError(
            f"there is no ROS 2: `ros2` is not on PATH, and {distributions} has no distribution; "
            "source the robot's setup.bash first, or name it: recorder.setup_files=[FILE]"
        )
    return (found[-1],)
