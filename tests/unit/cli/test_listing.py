"""`info`, `topics`, `recordings` and `cat` on bags of any origin, and `--recording`."""

from __future__ import annotations

import csv
import json
import math
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from io import BytesIO, TextIOWrapper
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory import cli
from ros2_memory.cli.ask import with_times
from ros2_memory.cli.options import LOOKING, parse_end, parse_time, settings_to_look
from ros2_memory.cli.output import format_time
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, log_entry, odom, text, write_mcap
from tests.support.housekeepers import own_all

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.reply import JsonObject
    from tests.support.program import Program

T0 = 1_700_000_000 * NS_PER_S
Capture = pytest.CaptureFixture[str]


def seconds(first: int, count: int, x: float = 0.0) -> list[Msg]:
    return [odom(T0 + (first + n) * NS_PER_S, x, float(n)) for n in range(count)]


@pytest.fixture(autouse=True)
def no_deployment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MEMORY_DEPLOYMENT", "MEMORY_BAG_DIR", "MEMORY_CONFIG_OVERRIDES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings in folders of their own, and two files that lie loose together."""
    write_mcap(tmp_path / "a" / "a_0.mcap", [*seconds(0, 5), text(T0, "one")])
    write_mcap(tmp_path / "a" / "a_1.mcap", seconds(5, 5))
    write_mcap(tmp_path / "b" / "b_0.mcap", seconds(100, 4, 7.0))
    write_mcap(tmp_path / "loose" / "red.mcap", seconds(200, 2))
    write_mcap(tmp_path / "loose" / "blue.mcap", seconds(200, 3))
    return tmp_path


@pytest.mark.parametrize("option", ["--limit=-1", "--tail=-1", "--limit=0", "--tail=0"])
def test_cat_refuses_to_print_less_than_one_message(
    folder: Path, exits: Program, option: str
) -> None:
    """It once said of a topic with messages that there were none."""
    refused = exits(2, f"cat /odom {folder}", option).err
    assert "--limit and --tail must be more than 0" in refused


def test_cat_takes_no_pattern_and_names_what_it_matches(folder: Path, exits: Program) -> None:
    assert "/od* is a pattern; matching: /odom" in exits(2, f"cat /od* {folder}").err


def test_where_another_program_made_all_recordings_it_is_said_once(
    folder: Path, exits: Program
) -> None:
    assert exits(0, f"recordings {folder}").out.count("another recorder") == 1


class TestPaths:
    @pytest.mark.parametrize("path", [".", "a", "a/a_0.mcap", "loose/red.mcap"])
    def test_info_and_topics_take_a_folder_or_a_bag(
        self, folder: Path, exits: Program, path: str
    ) -> None:
        counts = {".": (5, 19), "a": (2, 10), "a/a_0.mcap": (1, 5), "loose/red.mcap": (1, 2)}
        bags, poses = counts[path]
        shown = exits(0, f"info {folder}/{path} --json").json
        assert shown["data_time_range"]["bags"] == bags
        assert shown["memory_status"]["recorder"] is None
        counted = {
            row["topic"]: row["count"] for row in exits(0, f"topics {folder}/{path} --json").json
        }
        # The two loose files hold the same messages, and lie in one folder.
        assert counted["/odom"] == poses

    @pytest.mark.parametrize(
        ("name", "words"),
        [
            ("gone", "no such file or folder"),
            ("gone=5", "no such file or folder"),
            ("notes.txt", "is not a bag"),
            ("a b", "one file or fol"),
        ],
    )
    def test_what_is_no_bag_is_refused_by_name(
        self, folder: Path, exits: Program, name: str, words: str
    ) -> None:
        (folder / "notes.txt").write_text("not a bag")
        assert words in exits(2, "info", *(folder / each for each in name.split())).err

    @pytest.mark.parametrize("words", [("/odom", "gone"), ("gone", "/odom")])
    def test_beside_a_topic_a_folder_that_is_not_there_is_named(
        self, exits: Program, words: tuple[str, ...]
    ) -> None:
        assert f"neither {' nor '.join(words)} is a file or folder" in exits(2, "cat", *words).err

    def test_of_an_empty_folder_one_line_says_so(self, tmp_path: Path, exits: Program) -> None:
        (tmp_path / "empty").mkdir()
        for command in ("info", "topics", "recordings"):
            shown = exits(1, f"{command} {tmp_path}/empty").out
            assert len(shown.splitlines()) == 1
            assert str(tmp_path / "empty") in shown

    def test_where_an_error_names_a_tool_people_read_the_command(
        self, folder: Path, tmp_path: Path, exits: Program
    ) -> None:
        (tmp_path / "empty").mkdir()
        for topic, path, command in (("/odom", "empty", "info"), ("/nothing", "a", "topics")):
            shown = exits(2, f"cat {topic} {folder}/{path}").err
            assert f"; `ros2-memory {command}` lists" in shown
            assert "data_time_range" not in shown
            assert "list_recorded_topics" not in shown

    def test_what_is_wrong_with_a_bag_is_noted_once_and_not_for_each_topic(
        self, folder: Path, exits: Program
    ) -> None:
        bag = folder / "a" / "a_0.mcap"
        bag.write_bytes(bag.read_bytes()[:-20])
        os.utime(bag, (1.7e9, 1.7e9))
        shown = exits(0, f"topics {folder}").out
        assert shown.count("readable part is used") == 1
        assert "2 topics: 1 unfinished bag" in shown
        assert [len(row["notes"]) for row in exits(0, f"topics {folder} --json").json] == [1, 1]

    def test_errors_have_no_control_characters(self, folder: Path, exits: Program) -> None:
        assert "\x1b" not in exits(2, "cat", "/\x1b[31m", folder).err

    def test_bags_of_others_need_no_recorder_and_no_preset(
        self, folder: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        findings = {
            each["about"]: each for each in exits(0, f"doctor {folder}/a --json").json["findings"]
        }
        assert "recorder=none" in findings["recorder"]["seen"]
        assert "ros" not in findings
        monkeypatch.setenv("MEMORY_BAG_DIR", str(folder))
        assert exits(0, "ask get_position_seconds_ago seconds_ago=0 --json").json["age_s"] == 0

    def test_a_deployment_that_records_there_is_looked_at_as_it_is(
        self, folder: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        own_all(folder)
        monkeypatch.setenv("MEMORY_BAG_DIR", str(folder))
        assert exits(0, "info --json").json["memory_status"]["budget"]["max_gb"] == 5.0
        monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
        assert exits(0, f"info {folder} --json").json["memory_status"]["budget"]["max_gb"] == 5.0
        assert exits(0, f"info {folder}/a --json").json["memory_status"]["budget"]["max_gb"] is None

    def test_topics_without_messages_are_named_and_the_first_of_many_faults_of_clocks(
        self, tmp_path: Path, exits: Program
    ) -> None:
        declared = [("/idle", "std_msgs/msg/Bool"), ("/lost", "std_msgs/msg/Bool")]
        write_mcap(tmp_path / "a" / "a_0.mcap", seconds(0, 3), declared=declared)
        for nth in range(12):
            boot = [odom(nth * 100 * NS_PER_S, 0.0, 0.0)]  # before the clock was set
            write_mcap(tmp_path / f"r{nth}" / f"r{nth}_0.mcap", boot)
        words = " ".join(exits(0, f"info {tmp_path}").out.split())
        assert "topics_without_messages /idle, /lost" in words
        assert "silent_topics" not in words
        assert words.count("the clock was not set") == 10
        assert "2 more clock_faults: --json lists them" in words
        reply = exits(0, f"info {tmp_path} --json").json
        assert reply["held"]["topics_without_messages"] == ["/idle", "/lost"]
        assert len(reply["data_time_range"]["clock_faults"]) == 12


class TestRecordings:
    def test_folders_are_recordings_and_so_are_files_that_lie_loose(
        self, folder: Path, exits: Program
    ) -> None:
        rows = {row["recording"]: row for row in exits(0, f"recordings {folder} --json").json}
        assert {name: row["bags"] for name, row in rows.items()} == {
            "a": 2,
            "b": 1,
            "loose/red": 1,
            "loose/blue": 1,
        }
        assert (rows["a"]["start"], rows["a"]["length_s"]) == (1_700_000_000.0, 9.0)
        assert (rows["a"]["messages"], rows["a"]["topics"], rows["a"]["storage"]) == (11, 2, "mcap")

    def test_it_says_whose_they_are_and_names_what_is_not_read(
        self, folder: Path, exits: Program
    ) -> None:
        own_all(folder)
        write_mcap(folder / "c" / "c_0.mcap", seconds(300, 2))
        (folder / "c" / "c_1.mcap").write_bytes(b"no bag at all")
        os.utime(folder / "c" / "c_1.mcap", (1_700_000_000,) * 2)
        rows = {row["recording"]: row for row in exits(0, f"recordings {folder} --json").json}
        assert (rows["a"]["whose"], rows["c"]["whose"]) == ("this recorder", "another recorder")
        assert rows["c"]["not_read"] == 1
        assert "1 damaged bag file; see below" in " ".join(exits(0, f"info {folder}").out.split())

    def test_one_without_a_message_is_named_too(self, folder: Path, exits: Program) -> None:
        write_mcap(folder / "caught_nothing" / "caught_nothing_0.mcap", [])
        write_mcap(folder / "b" / "b_1.mcap", [])  # the end of a recording that has messages
        write_mcap(folder / "lies_loose.mcap", [])
        silent = [
            row["recording"]
            for row in exits(0, f"recordings {folder} --json").json
            if row["messages"] == 0
        ]
        assert silent == ["caught_nothing", "lies_loose.mcap"]
        assert "no message was recorded" in exits(0, f"recordings {folder}").out
        assert exits(0, f"info {folder} --json").json["held"]["empty_bags"] == 3
        assert len(exits(1, f"recordings {folder}/caught_nothing").out.splitlines()) == 1

    @pytest.mark.parametrize(("name", "count"), [("a", 10), ("b", 4), ("loose/blue", 3)])
    def test_each_can_be_looked_at_alone(
        self, folder: Path, exits: Program, name: str, count: int
    ) -> None:
        assert (
            len(exits(0, f"cat /odom {folder} --recording {name} --json").out.splitlines()) == count
        )
        assert [
            row["recording"]
            for row in exits(0, f"recordings {folder} --recording {name} --json").json
        ] == [name]

    def test_a_name_that_there_is_not_is_refused_with_one_like_it(
        self, folder: Path, exits: Program
    ) -> None:
        write_mcap(folder / "kitchen_run" / "kitchen_run_0.mcap", seconds(400, 1))
        assert "similar: kitchen_run" in exits(2, f"info {folder} --recording kitchen_rum").err
        assert "data.recording" in exits(2, f"info {folder} --recording ../a").err

    def test_what_is_forgotten_is_forgotten_of_one_recording_too(
        self, folder: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        own_all(folder)
        for bag in folder.rglob("*.mcap"):  # one that changed just now is not stored yet
            os.utime(bag, (1_700_000_000,) * 2)
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder / ".cache"))
        monkeypatch.setenv("MEMORY_BAG_DIR", str(folder))
        monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", "data.now=latest")
        assert exits(0, "index data.recording=a --json").json == {
            "bags": 2,
            "stored": 2,
            "refused": 0,
        }
        (store,) = folder.rglob("columns.sqlite")
        with closing(sqlite3.connect(store)) as base:
            assert base.execute("SELECT count(*) FROM bag").fetchone() == (2,)
        forgetting = ["forget", "--last", "9000", "--topic", "/chatter", "--yes", "--json"]
        assert exits(0, *forgetting).json["stays"] == []
        # Without the bag that had some of it, and what has a part in common with that.
        with closing(sqlite3.connect(store)) as base:
            assert base.execute("SELECT count(*) FROM bag").fetchone() == (0,)


def test_a_path_elsewhere_is_looked_at_whatever_the_environment_deploys(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
    monkeypatch.setenv("MEMORY_BAG_DIR", str(folder / "a"))
    assert settings_to_look(None, [str(folder)]) == (folder, [*LOOKING])
    assert settings_to_look(None, [str(folder / "a")]) == (folder / "a", [])


def test_of_a_folder_without_a_recording_nobody_is_said_to_have_made_all(
    tmp_path: Path, exits: Program
) -> None:
    (tmp_path / "letter.mcap").write_bytes(b"a letter")
    assert "whose" not in exits(0, f"recordings {tmp_path}").out


class TestCat:
    @pytest.mark.parametrize("option", ["--csv", "--json"])
    def test_no_text_commands_a_terminal(
        self, tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch, option: str
    ) -> None:
        write_mcap(tmp_path / "rec_0.mcap", [text(T0, "\x1b[2J\x9b31m", "/speech")])
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        shown = exits(0, "cat /speech", option, tmp_path).out
        assert not {"\x1b", "\x9b"} & {*shown}

    def test_letters_that_the_encoding_has_not_are_spelled_out(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write_mcap(tmp_path / "rec_0.mcap", [text(T0, "k\u00fcche", "/speech")])
        written = BytesIO()
        monkeypatch.setattr(sys, "stdout", TextIOWrapper(written, encoding="ascii"))
        assert cli.main(["cat", "/speech", str(tmp_path)]) == 0
        assert written.getvalue().endswith(b"  k\\xfcche\n")

    def test_json_lines_are_whole_and_strict(self, tmp_path: Path, exits: Program) -> None:
        messages = [odom(T0 + 1, math.nan, 0.123456789), odom(T0 + 2, 1.0, 2.0)]
        write_mcap(tmp_path / "r" / "r_0.mcap", messages)
        first, second = (
            json.loads(line, parse_constant=pytest.fail)
            for line in exits(0, f"cat /odom {tmp_path} --json").out.splitlines()
        )
        assert (first["time_ns"], second["time_ns"]) == (T0 + 1, T0 + 2)
        assert first["value"]["position"] == {"x": None, "y": 0.123456789, "z": 0.0}

    def test_csv_has_a_column_for_each_field(self, folder: Path, exits: Program) -> None:
        words = ("--csv", "--field", "position.y", "--field", "header.frame_id")
        rows = [*csv.reader(exits(0, f"cat /odom {folder}/b", *words).out.splitlines())]
        assert rows[0] == ["time", "position.y", "header.frame_id"]
        assert rows[1:] == [[f"1700000{100 + n}.000000000", f"{n}.0", "odom"] for n in range(4)]

    def test_levels_of_a_log_have_their_names(self, tmp_path: Path, exits: Program) -> None:
        lines = [log_entry(T0 + level, level, "nav", "said") for level in (30, 35)]
        write_mcap(tmp_path / "rec" / "rec_0.mcap", lines)
        assert [
            line.split("level: ")[1].split(";")[0]
            for line in exits(0, f"cat /rosout {tmp_path}").out.splitlines()
        ] == [
            "WARN (30)",
            "35",
        ]
        assert (
            exits(0, f"cat /rosout {tmp_path} --field level --limit 1").out.split("level: ")[1]
            == "WARN (30)\n"
        )

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            (["--limit", "2"], [0, 1]),
            (["--tail", "2"], [8, 9]),
            (["--last", "1.5"], [8, 9]),
            (["--last", "1.5s"], [8, 9]),
            (["--start", "3s", "--end", "2s"], [6, 7]),
        ],
    )
    def test_some_can_be_chosen(
        self, folder: Path, exits: Program, words: list[str], expected: list[int]
    ) -> None:
        times = [
            json.loads(line)["time_ns"]
            for line in exits(0, f"cat /odom {folder}/a --json", *words).out.splitlines()
        ]
        assert times == [T0 + n * NS_PER_S for n in expected]

    def test_a_reader_that_ends_early_is_no_error(self, folder: Path) -> None:
        program = [sys.executable, "-m", "ros2_memory.cli", "cat", "/odom", str(folder / "a")]
        reading, writing = os.pipe()
        os.close(reading)  # as `head` does once it has its lines
        done = subprocess.run(program, stdout=writing, stderr=subprocess.PIPE, check=False)
        os.close(writing)
        assert (done.returncode, done.stderr) == (1, b"")


@given(st.integers(946_684_800_000_000, 4_102_444_800_000_000))
def test_a_time_that_is_printed_is_read_back_to_the_microsecond(us: int) -> None:
    assert round(parse_time(format_time(us / 1e6), 0.0) * 1e6) == us


def test_times_and_durations_of_tools_may_be_words() -> None:
    known: dict[str, JsonObject] = {
        "start": {"type": ["number", "string"]},
        "timestamps": {"type": "array", "items": {"type": ["number", "string"]}},
        "seconds": {"type": "number"},
        "topic": {"type": "string"},
    }
    given_words = {
        "start": "10m",
        "timestamps": ["1s", "1 hour ago"],
        "seconds": "2h",
        "topic": "3d",
    }
    assert with_times(given_words, known, 1_700_000_000.0) == {
        "start": 1_700_000_000.0 - 600,
        "timestamps": [1_699_999_999.0, 1_700_000_000.0 - 3600],
        "seconds": 7200.0,
        "topic": "3d",
    }
    assert with_times({"seconds": "0s", "start": 5}, known, 0.0) == {"seconds": 0.0, "start": 5}
    with pytest.raises(InvalidArgumentsError, match="'soon' is not a time"):
        with_times({"start": "soon"}, known, 1_700_000_000.0)


@pytest.mark.parametrize("words", [["cat"], ["plot", "signal", "-o", "x.svg"]])
def test_where_the_topic_is_forgotten_the_command_is_named(
    folder: Path, exits: Program, words: list[str]
) -> None:
    expected = f"write `ros2-memory {' '.join(words[:2])} {folder / 'a'} TOPIC`"
    assert f"is a folder, not a topic; {expected}" in exits(2, *words, folder / "a").err


def test_a_path_may_come_first(folder: Path, exits: Program, tmp_path: Path) -> None:
    bags = folder / "a"
    for first, last in (
        (["cat", bags, "/odom"], ["cat", "/odom", bags]),
        (["ask", bags, "data_time_range"], ["ask", "data_time_range", bags]),
    ):
        shown = exits(0, *first).out
        assert shown == exits(0, *last).out
    for words in ([bags], [bags, "timeline"], [bags, "signal", "/odom"]):
        picture = tmp_path / "picture.svg"
        exits(0, "plot", *words, "-o", picture)
        picture.unlink()


def test_a_recap_without_a_time_is_of_the_newest_day(folder: Path, exits: Program) -> None:
    reply = exits(0, f"ask recap {folder}/b --json").json
    assert reply["start"] <= T0 / NS_PER_S + 100 < reply["end"]
    assert reply["end"] - reply["start"] >= 23 * 3600


@pytest.mark.parametrize(
    "words",
    [
        ["info"],
        ["topics"],
        ["recordings"],
        ["ask"],
        ["watch", "--count", "1"],
        ["config", "show"],
        ["export", "--mcap", "copy.mcap"],
        ["index"],
        ["recover", "a"],
        ["forget", "--last", "100", "--dry-run"],
        ["adopt", "b"],
    ],
    ids=" ".join,
)
def test_every_command_prints_json(
    folder: Path, exits: Program, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    own_all(folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(folder))
    monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", "data.now=latest")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    code = 1 if words[0] == "forget" else 0  # bags of others stay
    assert exits(code, *words, "--json").json


def test_a_window_that_ends_with_a_date_has_all_of_that_day() -> None:
    start = parse_time("2026-11-20", 0)
    assert parse_end("2026-11-20", 0, start) == pytest.approx(parse_time("2026-11-21", 0))
    assert parse_end("2026-11-20T09:00", 0, start) == parse_time("2026-11-20T09:00", 0)
    assert parse_end("1784023260", 0, start) == 1784023260


def test_a_date_without_dashes_is_no_second_of_1970() -> None:
    with pytest.raises(InvalidArgumentsError, match="the date is 2026-11-21"):
        parse_time("20261121", 0)
    assert parse_time("20269999", 0) == 20269999
