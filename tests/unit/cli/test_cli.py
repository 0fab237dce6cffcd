"""`ros2-memory`: what its commands that only look print, and how they end."""

import json
import os
from pathlib import Path

import pytest
import yaml

from ros2_memory.cli.app import COMMANDS, epilog
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import odom, text, write_mcap
from tests.support.housekeepers import later, recording_now
from tests.support.program import Program

T0 = 1_700_000_000 * NS_PER_S


@pytest.fixture(autouse=True)
def bag_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two bags, ten seconds of odometry at 10 Hz in each, an hour apart; and two words."""
    for number in range(2):
        start = T0 + number * 3600 * NS_PER_S
        messages = [odom(start + n * NS_PER_S // 10, float(number), n / 10) for n in range(100)]
        messages.append(text(start + NS_PER_S, "scissors \x1b[31mred"))
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "replay")
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


class TestAsk:
    def test_what_was_recorded_cannot_command_the_terminal(self, exits: Program) -> None:
        shown = exits(0, "ask get_topic_in_last topic=/chatter seconds=4000").out
        assert "\x1b" not in shown
        assert "\\x1b[31mred" in shown

    def test_without_a_name_the_tools_are_listed_with_their_arguments(self, exits: Program) -> None:
        assert "seconds_ago, topic?, tolerance_s?" in exits(0, "ask").out


class TestInfo:
    def test_where_something_is_it_says_for_how_long_the_budget_lasts(
        self, bag_dir: Path, exits: Program
    ) -> None:
        recording_now(bag_dir, "rec", clock=later(0))
        shown = exits(0, "info deployment=robot retention.max_total_gb=2.0").out
        assert "of 2 GB: bags 0" in shown
        assert "what is stored beside them 0" in shown
        assert "full in" in shown


class TestConfig:
    def test_it_is_shown_as_yaml_that_a_program_would_take_but_no_token_is(
        self, bag_dir: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MEMORY_API_TOKEN", "a-secret-that-is-long-enough")
        text = exits(0, "config show server.port=9300").out
        shown = yaml.safe_load(text)
        assert shown["server"]["port"] == 9300
        assert shown["recording"]["bag_dir"] == str(bag_dir)
        assert shown["storage"]["_target_"].startswith("ros2_memory.")
        assert "MEMORY_API_TOKEN is set" in text
        assert "a-secret" not in text

    def test_sources_say_in_a_line_which_file_or_variable_set_a_key(
        self, monkeypatch: pytest.MonkeyPatch, exits: Program, bag_dir: Path
    ) -> None:
        monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot_live")
        monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", "recorder=none")
        monkeypatch.setenv("ROS_VISION_INTERFACES_PATH", str(bag_dir))
        head, *rows = exits(0, "config show --sources server.port=9300").out.splitlines()
        assert head.startswith("# files are those of ")
        told = {
            key: f"{rest} "
            for key, _, rest in (" ".join(row.split()).partition(" ") for row in rows)
        }
        for key, who in (
            ("deployment", "by MEMORY_DEPLOYMENT "),
            ("storage", "deployment/robot.yaml "),
            ("recorder", "by MEMORY_CONFIG_OVERRIDES "),
            ("server.port", "on the command line "),
            ("server.name", "config.yaml "),
            ("server.transport", "deployment/robot.yaml "),
            ("reader.include_active", "deployment/robot_live.yaml "),
            ("reader.custom_msg_paths", "config.yaml, and by ROS_VISION_INTERFACES_PATH "),
            ("recording.bag_dir", "by MEMORY_BAG_DIR "),
            ("recorder._target_", "recorder/none.yaml "),
        ):
            assert told[key].startswith(who), key


class TestTheProgram:
    def test_warnings_are_one_sentence_and_with_v_the_events(
        self, bag_dir: Path, exits: Program
    ) -> None:
        for name in "ab":
            (bag_dir / "rec" / f"{name}.mcap").write_bytes(b"")
            os.utime(bag_dir / "rec" / f"{name}.mcap", (1_700_000_000,) * 2)
        (line,) = exits(0, "topics").err.splitlines()
        assert "2 warnings logged (2 x bag_damaged); -v shows" in line
        output = [
            json.loads(line)
            for line in exits(0, "topics -v logging.level=warning").err.splitlines()
        ]
        assert [each["event"] for each in output] == ["bag_damaged", "bag_damaged"]

    @pytest.mark.parametrize("command", COMMANDS)
    def test_the_help_of_every_command_says_what_its_exit_codes_mean(
        self, exits: Program, command: str
    ) -> None:
        assert " ".join(exits(0, f"{command} --help").out.split()).endswith(epilog(command))


@pytest.mark.parametrize("words", ["-h", "info -h", "config show -h"])
def test_help_has_a_short_option(words: str, exits: Program) -> None:
    assert "Usage: ros2-memory" in exits(0, words).out
