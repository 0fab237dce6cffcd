"""Finds the robot's ROS 2: its setup file, environment and options of `ros2 bag record`."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.errors import RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.recorder.process.child import run_bounded
from ros2_memory.recorder.process.command import HELP_ARGV, options_in_help

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SETUP_TIMEOUT_S: Final = 60.0

_log = get_logger(__name__)

# The script prints each file's name before it sources the file, so that a file that fails or exits
# can be named. What files print goes to stderr. They do not see the arguments, which some would
# take for their own. An empty entry ends the names and begins the environment.
_SOURCE_ALL: Final = (
    'files=("$@"); set --; '
    'for file in "${files[@]}"; do printf "%s\\0" "$file"; . "$file" >&2 || exit; done; '
    'printf "\\0"; exec env -0'
)
_OURS: Final = frozenset(
    {
        "VIRTUAL_ENV",
        "VIRTUAL_ENV_PROMPT",
        "PYTHONHOME",
        "PYTHONEXECUTABLE",
        "BASH_ENV",  # bash would source it
        # The service manager's channels belong to the daemon.
        "NOTIFY_SOCKET",
        "WATCHDOG_PID",
        "WATCHDOG_USEC",
        "LISTEN_FDS",
        "LISTEN_PID",
        "JOURNAL_STREAM",
        "CREDENTIALS_DIRECTORY",
        # The server's, from an environment file that both programs have.
        "MEMORY_API_TOKEN",
    }
)
_SHELLS_OWN: Final = ("_", "SHLVL", "PWD", "OLDPWD")
# The recorder's lines are read by a program: whole lines, on stderr, without colours, in rcutils'
# default form. A robot may well be set to another one.
_READABLE_OUTPUT: Final = {
    "RCUTILS_COLORIZED_OUTPUT": "0",
    "RCUTILS_LOGGING_BUFFERED_STREAM": "1",
    "RCUTILS_LOGGING_USE_STDOUT": "0",
    "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] [{time}] [{name}]: {message}",
    "PYTHONUNBUFFERED": "1",
}


def robot_environment(
    setup_files: Sequence[Path],
    log_dir: Path,
    inherited: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Returns the environment for `ros2`.

    It is the inherited one without our own variables, after the setup files. `ROS_DOMAIN_ID`, the
    RMW's settings and all other variables of the robot pass through.

    Args:
        setup_files: bash scripts, sourced in this order; none if `ros2` is on PATH already.
        log_dir: the directory for ROS's logs, unless the environment has ROS_LOG_DIR.
        inherited: the environment to begin with; None for the process's own.

    Raises:
        RecorderError: a setup file is missing or fails; the message names it.
    """
    base = without_ours(os.environ if inherited is None else inherited)
    if setup_files:
        # Setup files set PYTHONPATH; an earlier value is not the robot's.
        base.pop("PYTHONPATH", None)
        base = _sourced(setup_files, base)
    return {"ROS_LOG_DIR": str(log_dir), **base, **_READABLE_OUTPUT}


def without_ours(inherited: Mapping[str, str]) -> dict[str, str]:
    """Returns an environment without our virtual environment and service manager's variables."""
    prefixes = [inherited["VIRTUAL_ENV"]] if inherited.get("VIRTUAL_ENV") else []
    if sys.prefix != sys.base_prefix:
        prefixes.append(sys.prefix)
    env = {name: value for name, value in inherited.items() if name not in _OURS}
    for name in ("PATH", "PYTHONPATH"):
        if name in env:
            env[name] = os.pathsep.join(
                part
                for part in env[name].split(os.pathsep)
                if not any(Path(part).is_relative_to(prefix) for prefix in prefixes)
            )
    if not env.get("PYTHONPATH"):
        env.pop("PYTHONPATH", None)
    return env


def rmw_of(env: Mapping[str, str]) -> str:
    """Returns the RMW of nodes in an environment; `rmw_fastrtps_cpp` by default."""
    return env.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp"


def advice_on_rmw(env: Mapping[str, str]) -> str | None:
    """Returns advice on what a recorder needs with Zenoh or Cyclone DDS; None with others."""
    rmw = rmw_of(env)
    if "zenoh" in rmw:
        return (
            "over Zenoh nodes find each other through a router (`ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`): does it run, and has the recorder the nodes' ROS_DOMAIN_ID, "
            "ZENOH_SESSION_CONFIG_URI and ZENOH_CONFIG_OVERRIDE? see docs/how-to/robot.md"
        )
    if "cyclonedds" in rmw:
        return (
            "has the recorder the nodes' ROS_DOMAIN_ID and CYCLONEDDS_URI, which names the "
            "network interfaces? see docs/how-to/robot.md"
        )
    return None


def advice_on_silence(env: Mapping[str, str]) -> str:
    """Returns advice for subscriptions that receive nothing.

    In the discovery range LOCALHOST, rmw_fastrtps ignores FASTDDS_BUILTIN_TRANSPORTS and uses
    shared memory, which another user cannot read.
    """
    advice = advice_on_rmw(env)
    if advice:
        return advice
    if "fastrtps" not in rmw_of(env):
        return "is the robot's RMW_IMPLEMENTATION the recorder's, and does a firewall block DDS?"
    local = env.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    if local or env.get("ROS_LOCALHOST_ONLY") == "1":
        return (
            "if the publishers run under another user: in the discovery range LOCALHOST Fast DDS "
            "uses shared memory, which users do not share, and FASTDDS_BUILTIN_TRANSPORTS changes "
            "nothing; run the recorder as the robot's user, or see docs/how-to/systemd.md for what "
            "a wider range takes and exposes"
        )
    if env.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4":
        return (
            "if the publishers run under another user, set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 "
            "for the recorder: Fast DDS does not share memory between users"
        )
    return "do the publishers publish, and does a firewall block DDS?"


def find_ros2(env: Mapping[str, str]) -> str:
    """Returns the path of the `ros2` program.

    Raises:
        RecorderError: `ros2` is not on the environment's PATH.
    """
    program = shutil.which("ros2", path=env.get("PATH", os.defpath))
    if program is None:
        raise RecorderError(
            "`ros2` was not found on PATH, nor by recorder.setup_files; name there the setup.bash "
            "of the ROS 2 distribution, and of the workspace with the robot's own messages"
        )
    return str(Path(program).absolute())


def _sourced(setup_files: Sequence[Path], base: Mapping[str, str]) -> dict[str, str]:
    for file in setup_files:
        if not file.is_file():
            raise RecorderError(f"{file} is not there; correct recorder.setup_files")
    bash = shutil.which("bash", path=base.get("PATH", os.defpath))
    if bash is None:
        raise RecorderError("there is no bash on PATH, which recorder.setup_files need")
    # Absolute: bash looks a bare name up on PATH.
    names = [str(file.absolute()) for file in setup_files]
    argv = [bash, "--noprofile", "--norc", "-c", _SOURCE_ALL, "ros2-memory-setup", *names]
    finished = run_bounded(argv, base, SETUP_TIMEOUT_S)
    begun, ended, entries = os.fsdecode(finished.stdout).partition("\0\0")
    printed = finished.stderr.decode("utf-8", errors="replace")
    if finished.returncode != 0 or not ended:
        name = begun.rstrip("\0").rpartition("\0")[2] or "the shell"
        said = " ".join(printed.split())[-300:]
        raise RecorderError(
            f"{name} failed with status {finished.returncode}{f' ({said})' if said else ''}; "
            "correct it, or recorder.setup_files"
        )
    for line in printed.splitlines():
        _log.warning("setup_file_said", text=line)
    pairs = (entry.partition("=") for entry in entries.split("\0") if entry)
    return {name: value for name, _, value in pairs if name not in _SHELLS_OWN}


HELP_TIMEOUT_S: Final = 60.0
DISTRIBUTIONS: Final = Path("/opt/ros")


class Installation(NamedTuple):
    """A ROS 2 that can record.

    Attributes:
        ros2: the path of the program.
        env: its whole environment.
        options: the long options of its `ros2 bag record`.
    """

    ros2: str
    env: dict[str, str]
    options: frozenset[str]


def find_installation(setup_files: Sequence[Path], log_dir: Path) -> Installation:
    """Returns the robot's `ros2`, with its environment and its options.

    Raises:
        RecorderError: a setup file fails, there is no `ros2`, or it cannot record MCAP.
    """
    env = robot_environment(setup_files, log_dir)
    ros2 = find_ros2(env)
    try:
        # `ros2-memory doctor` calls this as well: no log goes beside the bags.
        with TemporaryDirectory() as elsewhere:
            finished = run_bounded(
                [ros2, *HELP_ARGV], {**env, "ROS_LOG_DIR": elsewhere}, HELP_TIMEOUT_S
            )
    except OSError as error:
        raise RecorderError(
            f"no temporary folder can be made: {error.strerror or error}; free its disk, or name "
            "another folder in TMPDIR"
        ) from error
    if finished.returncode != 0:
        printed = " ".join(finished.stderr.decode(errors="replace").split())[-300:]
        rmw = rmw_of(env)
        advice = (
            "install the packages ros-$ROS_DISTRO-ros2bag and -rosbag2-storage-mcap, and "
            "correct recorder.setup_files"
        )
        if rmw in printed:
            advice = (
                f"install the package ros-$ROS_DISTRO-{rmw.replace('_', '-')}, or set "
                "RMW_IMPLEMENTATION to what the robot's nodes use"
            )
        status = finished.returncode
        raise RecorderError(
            f"{ros2} bag record --help fails with status {status} ({printed}); {advice}"
        )
    return Installation(ros2, env, options_in_help(finished.stdout.decode(errors="replace")))


def setup_files_here(
    configured: Sequence[Path], env: Mapping[str, str], distributions: Path = DISTRIBUTIONS
) -> tuple[Path, ...]:
    """Returns the configured setup files, or that of the newest distribution.

    None is needed if `ros2` is on PATH. Names of distributions are in the order of the alphabet.

    Raises:
        RecorderError: there is no ROS 2.
    """
    if configured or shutil.which("ros2", path=env.get("PATH", os.defpath)):
        return tuple(configured)
    setups = [
        file
        for file in sorted(distributions.glob("*/setup.bash"))
        if file.with_name("bin").joinpath("ros2").is_file()  # not in ROS 1
    ]
    if not setups:
        raise RecorderError(
            f"there is no ROS 2: `ros2` is not on PATH, and {distributions} has no distribution; "
            "source the robot's setup.bash first, or name it: recorder.setup_files=[FILE]"
        )
    return (setups[-1],)
