"""The environment that `ros2` gets: setup files sourced by a real bash, and nothing of ours."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process import installation
from ros2_memory.recorder.process.installation import (
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


def refusal(*files: Path) -> str:
    with pytest.raises(RecorderError) as caught:
        robot_environment(files, LOGS, BASE)
    return str(caught.value)


class TestSetupFiles:
    def test_are_sourced_in_order(self, tmp_path: Path) -> None:
        distro = setup_file(tmp_path, "distro.bash", "export WAY=distro PYTHONPATH=/ros\n")
        workspace = setup_file(tmp_path, "ws.bash", 'export WAY="$WAY:ws" AMENT_PREFIX_PATH=/ws\n')
        env = robot_environment([distro, workspace], LOGS, BASE)
        assert (env["WAY"], env["AMENT_PREFIX_PATH"], env["PYTHONPATH"]) == (
            "distro:ws",
            "/ws",
            "/ros",
        )

    def test_values_with_newlines_and_bytes_of_any_kind_survive(self, tmp_path: Path) -> None:
        file = setup_file(tmp_path, "a.bash", "export ODD=$'a\\nB=b \\xff end'\n")
        env = robot_environment([file], LOGS, BASE)
        assert os.fsencode(env["ODD"]) == b"a\nB=b \xff end"
        assert "B" not in env

    def test_a_path_is_never_read_as_shell_text(self, tmp_path: Path) -> None:
        folder = tmp_path / "a b; touch 'x' $(touch y) `touch z`"
        folder.mkdir()
        file = setup_file(folder, "-e.bash", "export WAY=odd\n")
        assert robot_environment([file], LOGS, BASE)["WAY"] == "odd"
        assert [path.name for path in tmp_path.iterdir()] == [folder.name]

    def test_do_not_see_the_names_of_the_others_as_arguments(self, tmp_path: Path) -> None:
        files = [setup_file(tmp_path, f"{n}.bash", "export COUNT=$#\n") for n in range(3)]
        assert robot_environment(files, LOGS, BASE)["COUNT"] == "0"

    def test_may_use_variables_named_as_the_helpers(self, tmp_path: Path) -> None:
        first = setup_file(tmp_path, "1.bash", "file=x files=y; export A=1\n")
        second = setup_file(tmp_path, "2.bash", "export B=2\n")
        env = robot_environment([first, second], LOGS, BASE)
        assert (env["A"], env["B"]) == ("1", "2")

    def test_what_they_print_is_told_and_harms_nothing(self, tmp_path: Path) -> None:
        file = setup_file(tmp_path, "a.bash", "echo WAY=wrong; echo oh >&2; export WAY=right\n")
        with capture_logs() as logs:
            assert robot_environment([file], LOGS, BASE)["WAY"] == "right"
        assert [each["text"] for each in logs] == ["WAY=wrong", "oh"]

    def test_one_that_is_missing_is_named(self, tmp_path: Path) -> None:
        message = refusal(setup_file(tmp_path, "a.bash", ""), tmp_path / "gone.bash")
        assert str(tmp_path / "gone.bash") in message
        assert "recorder.setup_files" in message

    @pytest.mark.parametrize("end", ["exit 3", "return 3", "( exit 3 )"])
    def test_one_that_fails_is_named_with_what_it_said(self, tmp_path: Path, end: str) -> None:
        good = setup_file(tmp_path, "good.bash", "export A=1\n")
        bad = setup_file(tmp_path, "bad.bash", f"echo 'no such distribution' >&2\n{end}\n")
        message = refusal(good, bad, good)
        assert message.startswith(f"{bad} failed with status 3")
        assert "no such distribution" in message

    def test_one_that_exits_as_if_all_were_well_is_named(self, tmp_path: Path) -> None:
        bad = setup_file(tmp_path, "bad.bash", "exit 0\n")
        assert refusal(bad).startswith(f"{bad} failed")

    def test_one_that_never_ends_is_given_up(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(installation, "SETUP_TIMEOUT_S", 0.3)
        assert "did not come to an end" in refusal(setup_file(tmp_path, "a.bash", "sleep 600\n"))

    def test_bash_reads_nothing_that_it_was_not_given(self, tmp_path: Path) -> None:
        uninvited = setup_file(tmp_path, "env.bash", "export UNINVITED=1\n")
        file = setup_file(tmp_path, "a.bash", "export A=1\n")
        env = robot_environment([file], LOGS, {**BASE, "BASH_ENV": str(uninvited)})
        assert "UNINVITED" not in env


class TestOurs:
    def test_the_virtual_environment_stays_here(self) -> None:
        mine = f"{sys.prefix}/bin"
        env = without_ours(
            {
                "VIRTUAL_ENV": "/venv",
                "VIRTUAL_ENV_PROMPT": "x",
                "PYTHONHOME": "/venv",
                "PATH": f"{mine}:/venv/bin:/usr/bin:/venvs/bin",
            }
        )
        assert env == {"PATH": "/usr/bin:/venvs/bin"}

    def test_a_python_path_of_the_robot_stays_where_no_file_sets_it(self) -> None:
        given = {"PATH": "/usr/bin", "VIRTUAL_ENV": "/venv", "PYTHONPATH": "/venv/lib:/opt/ros/lib"}
        assert without_ours(given)["PYTHONPATH"] == "/opt/ros/lib"
        assert "PYTHONPATH" not in without_ours(given | {"PYTHONPATH": "/venv/lib"})

    def test_a_python_path_from_before_does_not_reach_the_setup_files(self, tmp_path: Path) -> None:
        file = setup_file(tmp_path, "a.bash", 'export SEEN="${PYTHONPATH-none}"\n')
        env = robot_environment([file], LOGS, {**BASE, "PYTHONPATH": "/of/ours"})
        assert env["SEEN"] == "none"

    def test_the_service_managers_channels_stay_here(self) -> None:
        given = {"NOTIFY_SOCKET": "/run/x", "WATCHDOG_USEC": "1", "WATCHDOG_PID": "2", "HOME": "/h"}
        assert without_ours(given) == {"HOME": "/h"}


class TestOutputOfRos:
    def test_its_form_is_ours_whatever_the_robot_is_set_to(self) -> None:
        given = {
            **BASE,
            "RCUTILS_COLORIZED_OUTPUT": "1",
            "RCUTILS_CONSOLE_OUTPUT_FORMAT": "{message}",
            "RCUTILS_LOGGING_USE_STDOUT": "1",
        }
        env = robot_environment([], LOGS, given)
        assert env["RCUTILS_COLORIZED_OUTPUT"] == "0"
        assert env["RCUTILS_CONSOLE_OUTPUT_FORMAT"] == "[{severity}] [{time}] [{name}]: {message}"
        assert env["RCUTILS_LOGGING_USE_STDOUT"] == "0"

    def test_its_logs_go_where_they_are_told_unless_the_robot_names_a_place(self) -> None:
        assert robot_environment([], LOGS, BASE)["ROS_LOG_DIR"] == str(LOGS)
        named = {**BASE, "ROS_LOG_DIR": "/var/log/ros"}
        assert robot_environment([], LOGS, named)["ROS_LOG_DIR"] == "/var/log/ros"


class TestRos2:
    def test_it_is_found_on_the_path_of_the_environment(self, tmp_path: Path) -> None:
        program = setup_file(tmp_path, "ros2", "")
        program.chmod(0o755)
        assert find_ros2({"PATH": f"/nowhere:{tmp_path}"}) == str(program)

    def test_where_it_is_not_the_setup_files_are_asked_for(self) -> None:
        with pytest.raises(RecorderError, match=r"recorder\.setup_files"):
            find_ros2({"PATH": "/nowhere"})
