"""The environment that `ros2` gets: setup files sourced by a real bash, and nothing of ours."""

import os
import sys
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process import installation
from ros2_memory.recorder.process.installation import (
    advice_on_silence,
    find_ros2,
    robot_environment,
    without_ours,
)

BASE = {"PATH": os.defpath, "ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
LOGS = Path("/somewhere/logs")


def setup_file(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("texts", "found"),
    [
        (
            ["export WAY=distro PYTHONPATH=/ros\n", 'export WAY="$WAY:ws"\n'],
            {"WAY": "distro:ws", "PYTHONPATH": "/ros"},
        ),
        (
            ["export ODD=$'a\\nB=b \\xff end'\n"],
            {"ODD": os.fsdecode(b"a\nB=b \xff end"), "B": None},
        ),
        (["export COUNT=$#\n"] * 3, {"COUNT": "0"}),
        (["file=x files=y; export A=1\n", "export B=2\n"], {"A": "1", "B": "2"}),
        (['export SEEN="${PYTHONPATH-none}"\n'], {"SEEN": "none"}),
    ],
    ids=[
        "in order",
        "newlines and bytes of any kind",
        "no arguments",
        "variables named as the helpers",
        "nothing of ours",
    ],
)
def test_what_setup_files_set_is_there(
    tmp_path: Path, texts: list[str], found: dict[str, str | None]
) -> None:
    files = [setup_file(tmp_path, f"{nth}.bash", text) for nth, text in enumerate(texts)]
    uninvited = setup_file(tmp_path, "env.bash", "export UNINVITED=1\n")
    base = {**BASE, "PYTHONPATH": "/of/ours", "BASH_ENV": str(uninvited)}
    env = robot_environment(files, LOGS, base)
    assert {name: env.get(name) for name in (*found, "UNINVITED")} == {**found, "UNINVITED": None}


def test_a_path_is_never_read_as_shell_text(tmp_path: Path) -> None:
    folder = tmp_path / "a b; touch 'x' $(touch y) `touch z`"
    folder.mkdir()
    file = setup_file(folder, "-e.bash", "export WAY=odd\n")
    assert robot_environment([file], LOGS, BASE)["WAY"] == "odd"
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_what_setup_files_print_is_told_and_harms_nothing(tmp_path: Path) -> None:
    file = setup_file(tmp_path, "a.bash", "echo WAY=wrong; echo oh >&2; export WAY=right\n")
    with capture_logs() as logs:
        assert robot_environment([file], LOGS, BASE)["WAY"] == "right"
    assert [each["text"] for each in logs] == ["WAY=wrong", "oh"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "{bad} is not there; correct recorder.setup_files"),
        ("echo 'no such way' >&2\nexit 3\n", "{bad} failed with status 3 (no such way)"),
        ("return 3\n", "{bad} failed with status 3"),
        ("( exit 3 )\n", "{bad} failed with status 3"),
        ("exit 0\n", "{bad} failed"),
        ("sleep 600\n", "did not come to an end"),
    ],
)
def test_a_setup_file_that_is_missing_or_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, said: str
) -> None:
    monkeypatch.setattr(installation, "SETUP_TIMEOUT_S", 0.3 if "sleep" in str(text) else 60)
    good = setup_file(tmp_path, "good.bash", "export A=1\n")
    bad = tmp_path / "bad.bash"
    if text is not None:
        bad.write_text(text)
    with pytest.raises(RecorderError) as caught:
        robot_environment([good, bad, good], LOGS, BASE)
    assert said.format(bad=bad) in str(caught.value)


@pytest.mark.parametrize(
    ("given", "left"),
    [
        (
            {
                "VIRTUAL_ENV": "/venv",
                "VIRTUAL_ENV_PROMPT": "x",
                "PYTHONHOME": "/venv",
                "PATH": f"{sys.prefix}/bin:/venv/bin:/usr/bin:/venvs/bin",
            },
            {"PATH": "/usr/bin:/venvs/bin"},
        ),
        (
            {"VIRTUAL_ENV": "/venv", "PYTHONPATH": "/venv/lib:/opt/ros/lib"},
            {"PYTHONPATH": "/opt/ros/lib"},
        ),
        ({"VIRTUAL_ENV": "/venv", "PYTHONPATH": "/venv/lib"}, {}),
        (
            {"NOTIFY_SOCKET": "/run/x", "WATCHDOG_USEC": "1", "WATCHDOG_PID": "2", "HOME": "/h"},
            {"HOME": "/h"},
        ),
    ],
    ids=["virtual environment", "PYTHONPATH", "nothing else in PYTHONPATH", "service manager"],
)
def test_what_is_ours_stays_here(given: dict[str, str], left: dict[str, str]) -> None:
    assert without_ours({"PATH": "/usr/bin", **given}) == {"PATH": "/usr/bin", **left}


def test_the_form_of_its_output_is_ours_whatever_the_robot_is_set_to() -> None:
    ours = {
        "RCUTILS_COLORIZED_OUTPUT": "0",
        "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] [{time}] [{name}]: {message}",
        "RCUTILS_LOGGING_USE_STDOUT": "0",
        "ROS_LOG_DIR": str(LOGS),
    }
    assert robot_environment([], LOGS, BASE).items() >= ours.items()
    theirs = dict.fromkeys(ours, "1")
    kept = {"ROS_LOG_DIR": "1"}  # the robot names a place
    assert robot_environment([], LOGS, BASE | theirs).items() >= (ours | kept).items()


def test_ros2_is_found_on_the_path_of_the_environment_or_setup_files_are_asked_for(
    tmp_path: Path,
) -> None:
    program = setup_file(tmp_path, "ros2", "")
    program.chmod(0o755)
    assert find_ros2({"PATH": f"/nowhere:{tmp_path}"}) == str(program)
    with pytest.raises(RecorderError, match=r"recorder\.setup_files"):
        find_ros2({"PATH": "/nowhere"})


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
def test_the_advice_on_silence_is_never_what_is_set_already(
    env: dict[str, str], advice: str
) -> None:
    said = advice_on_silence(env)
    assert advice in said
    assert not ("set FASTDDS_BUILTIN" in said and "FASTDDS_BUILTIN_TRANSPORTS" in env)
