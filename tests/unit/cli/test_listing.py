"""The commands that only look, on bags of any origin: what they print, and how they end."""

import csv
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import AbstractContextManager, closing
from datetime import datetime
from functools import partial
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path
from unittest.mock import patch

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from ros2_memory import bootstrap, cli
from ros2_memory.bag_dir.layout import LIST_FILE, OWN_FOLDER
from ros2_memory.cli import output
from ros2_memory.cli.app import COMMANDS, epilog
from ros2_memory.cli.options import parse_time
from ros2_memory.cli.output import format_time
from ros2_memory.columns import database
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import McapLayout, Msg, header, make, odom, text, write_mcap
from tests.support.forked_commands import write_command
from tests.support.housekeepers import later, own_all, recording_now
from tests.support.program import Program
from tests.unit.cli.conftest import Using

T0 = 1_700_000_000 * NS_PER_S


def seconds(first: int, count: int, x: float = 0.0) -> list[Msg]:
    return [odom(T0 + (first + n) * NS_PER_S, x, float(n)) for n in range(count)]


@pytest.fixture(autouse=True)
def wide_terminal(no_deployment: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings in folders of their own, and two files that lie loose together."""
    folder = tmp_path_factory.mktemp("bags")
    write_mcap(folder / "a" / "a_0.mcap", [*seconds(0, 5), text(T0, "one")])
    write_mcap(folder / "a" / "a_1.mcap", seconds(5, 5))
    write_mcap(folder / "b" / "b_0.mcap", seconds(100, 4, 7.0))
    write_mcap(folder / "loose" / "red.mcap", seconds(200, 2))
    write_mcap(folder / "loose" / "blue.mcap", seconds(200, 3))
    (folder / "notes.txt").write_text("not a bag")
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of them, in which commands are given."""
    folder = shutil.copytree(made, tmp_path / "bags")
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("fly", "fly"),
        ("ask where_am_i --help", "the tools are: list_recorded_topics, data_time_range"),
        ("ask nowhere visits x=1", "'nowhere' is not an argument, and there is no such file or"),
        ("ask visits x=1 nowhere", "'nowhere' is not an argument, and there is no such file or"),
        ("info gone", "no such file or folder"),
        ("info ./gone=5", "no such file or folder"),
        ("info notes.txt", "is not a bag"),
        ("info a b", "one file or fol"),
        ("info . --recording loosy", "similar: loose"),
        ("info . --recording ../a", "data.recording"),
        # It once said of a topic with messages that there were none.
        ("cat /odom . --limit=-1", "--limit and --tail must be more than 0"),
        ("cat /odom . --limit=0", "--limit and --tail must be more than 0"),
        ("cat /odom . --tail=-1", "--limit and --tail must be more than 0"),
        ("cat /odom . --tail=0", "--limit and --tail must be more than 0"),
        ("watch . --every 0", "--every must be more than 0 and at most"),
        ("watch . --every inf --count 2", "--every must be more than 0 and at most"),
        ("watch . --every nan", "--every must be more than 0 and at most"),
        ("watch . --count 0", "--count must be more than 0"),
        ("cat /odom gone", "gone: there is no such file or folder"),
        ("cat a /odom", "/odom: there is no such file or folder"),
        ("cat /odom empty", "contains no bag with messages"),
        ("cat /nothing a", "no topic /nothing is recorded"),
        ("cat '/\x1b[31m' .", "/\\x1b[31m"),
        ("export .", "give one of --mcap FILE and --parquet DIR"),
        ("export . --mcap x --parquet b", "give one of --mcap FILE and --parquet DIR"),
        ("export . --mcap x --robot r1", "--robot is for --parquet"),
        ("export . --mcap x --last 5 --start 1", "give --last, or --start and --end, not both"),
        ("export . --mcap x --last 0", "--last is 0; it must be more than 0 seconds"),
        ("export . --mcap x --last noon", "--last is noon; it must be more than 0 seconds"),
        ("export . --mcap x --start noon", "'noon' is not a time"),
        ("export . --mcap x --start 2 --end 1", "end"),
        ("export . --mcap x --topic /nothing", "no recorded topic matches /nothing"),
        ("export . --mcap gone/out.mcap", "there is no folder gone; make it first"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_reason(
    made: Path, exits: Program, monkeypatch: pytest.MonkeyPatch, line: str, why: str
) -> None:
    monkeypatch.chdir(made)
    refused = exits(2, line).err
    assert why in refused
    assert "\x1b" not in refused


@pytest.mark.parametrize(
    ("line", "extra"),
    [
        ("export a --parquet rows", "parquet"),
        ("plot path a --out a.svg", "plot"),
        ("ship --once deployment=lake 'fleet.robots={a: a}' lake.warehouse=lake", "lake"),
    ],
)
def test_a_command_whose_extra_is_not_installed_names_it(
    folder: Path, exits: Program, monkeypatch: pytest.MonkeyPatch, line: str, extra: str
) -> None:
    monkeypatch.delitem(sys.modules, "ros2_memory.cli.parquet", raising=False)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setattr(bootstrap, "find_spec", lambda _name: None)
    assert f"pip install '.[{extra}]'" in exits(2, line).err


def test_what_is_wrong_with_a_bag_is_noted_once_and_not_for_each_topic(
    folder: Path, exits: Program
) -> None:
    bag = folder / "a" / "a_0.mcap"
    whole = bag.read_bytes()
    bag.write_bytes(whole[:-20])
    os.utime(bag, (1.7e9, 1.7e9))
    assert "missing" not in exits(0, "topics .").err, "its messages are all there"
    bag.write_bytes(whole[: len(whole) * 7 // 10])
    os.utime(bag, (1.7e9, 1.7e9))
    shown = exits(0, "topics .").err
    assert shown.count("may be missing, as a crash left 1 bag open") == 1
    assert shown.startswith("note: /chatter, /odom: messages after")
    assert [len(row["notes"]) for row in exits(0, "topics . --json").json] == [1, 1]


def test_info_has_the_notes_on_robots_and_those_on_files(folder: Path, exits: Program) -> None:
    bag = folder / "b" / "b_0.mcap"
    content = bytearray(bag.read_bytes())
    last = (T0 + 103 * NS_PER_S).to_bytes(8, "little")
    content[content.rindex(last)] ^= 1  # in its statistics
    bag.write_bytes(content)
    for robot, x in (("red", 0.0), ("blue", 9.0)):
        write_mcap(folder / robot / f"{robot}_0.mcap", seconds(1000, 60, x))
    notes = exits(0, "info .").err
    assert "b/b_0.mcap: its summary section does not match its checksum" in notes
    assert "robots are mixed: blue, red overlap" in notes


def test_a_deployment_that_records_there_is_looked_at_as_it_is(
    folder: Path, exits: Program, using: Using
) -> None:
    def budget(line: str) -> float | None:
        most: float | None = exits(0, line).json["memory_status"]["budget"]["max_gb"]
        return most

    own_all(folder)
    using(folder)
    assert budget("info --json") == 5.0
    using(folder, "robot")
    assert (budget("info . --json"), budget("info a --json")) == (5.0, None)


def test_topics_without_messages_are_named_and_all_faults_of_clocks(
    tmp_path: Path, exits: Program
) -> None:
    declared = [("/idle", "std_msgs/msg/Bool"), ("/lost", "std_msgs/msg/Bool")]
    write_mcap(tmp_path / "a" / "a_0.mcap", seconds(0, 3), declared=declared)
    odometry = ("/odom", "nav_msgs/msg/Odometry")  # of which another bag has messages
    write_mcap(tmp_path / "b" / "b_0.mcap", [text(T0, "x")], declared=[odometry])
    for nth in range(12):
        boot = [odom(nth * 100 * NS_PER_S, 0.0, 0.0)]  # before the clock was set
        write_mcap(tmp_path / f"r{nth}" / f"r{nth}_0.mcap", boot)
    words = " ".join(exits(0, f"info {tmp_path}").out.split())
    assert "topics_without_messages /idle, /lost" in words
    assert words.count("the clock was not set") == 12
    reply = exits(0, f"info {tmp_path} --json").json
    assert reply["held"]["topics_without_messages"] == ["/idle", "/lost"]
    assert len(reply["data_time_range"]["clock_faults"]) == 12


def rows(exits: Program, *words: str) -> dict[str, dict[str, JsonValue]]:
    found = exits(0, "recordings . --json", *words).json
    return {row["recording"]: row for row in found if "recording" in row}


def test_recordings_says_whose_they_are_and_names_what_is_not_read(
    folder: Path, exits: Program
) -> None:
    own_all(folder)
    write_mcap(folder / "c" / "c_0.mcap", seconds(300, 2))
    assert "not_read" not in exits(0, "recordings .").out
    (folder / "c" / "c_1.mcap").write_bytes(b"no bag at all")
    killed = McapLayout(chunk_size=1_000, finish=False)
    unfinished = write_mcap(folder / "c" / "c_2.mcap", seconds(310, 9), killed)
    for path in (folder / "c" / "c_1.mcap", unfinished):
        os.utime(path, (1_700_000_000,) * 2)
    write_mcap(folder / "c" / "c_3.mcap", [text(time.time_ns(), "now")], killed)
    reasons = {row["file"]: row["reason"] for row in exits(0, "recordings . --json").json[5:]}
    assert [*reasons] == ["c/c_1.mcap", "c/c_2.mcap", "c/c_3.mcap"]
    assert reasons["c/c_2.mcap"].startswith("the file ends early")
    assert reasons["c/c_3.mcap"] == "still being written"
    found = rows(exits)
    assert (found["a"]["whose"], found["c"]["whose"]) == ("this recorder", "another recorder")
    assert "c/c_1.mcap" in exits(0, "recordings .").out
    assert "1 damaged bag file" in " ".join(exits(0, "info .").out.split())
    (folder / LIST_FILE).unlink()
    (folder / LIST_FILE).mkdir()  # a list that cannot be read
    assert {row["whose"] for row in rows(exits).values()} == {None}


def test_when_another_program_closes_its_bag_is_not_known(tmp_path: Path, exits: Program) -> None:
    now = [text(time.time_ns(), "now")]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", now, McapLayout(finish=False))
    why = "ask again when its program has closed it (reader.include_active=true reads MCAP before"
    for line in ("cat /chatter", "export --mcap x.mcap"):
        assert why in exits(2, line, tmp_path).err
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [text(time.time_ns() - 60 * NS_PER_S, "before")])
    line = "ask get_topic_seconds_ago topic=/chatter seconds_ago=0 data.now=wall"
    assert f"or {why[4:]}" in " ".join(exits(1, line, tmp_path).out.split())


def test_a_recording_without_a_message_is_named_too(folder: Path, exits: Program) -> None:
    names = ["b/b_1.mcap", "caught_nothing/caught_nothing_0.mcap", "lies_loose.mcap"]
    for name in names:
        write_mcap(folder / name, [])
    files = [row["file"] for row in exits(0, "recordings . --json").json if "file" in row]
    assert files == names
    assert "no message was recorded" in exits(0, "recordings .").out
    assert exits(0, "info . --json").json["held"]["empty_bags"] == 3
    # Where there is nothing else, one line says so.
    for line in ("recordings caught_nothing", "recordings empty", "topics empty", "info empty"):
        [told] = exits(1, line).out.splitlines()
        assert str(folder / line.split()[1]) in told


@pytest.mark.parametrize(("name", "count"), [("a", 10), ("b", 4), ("loose/blue", 3)])
def test_each_recording_can_be_looked_at_alone(
    folder: Path, exits: Program, name: str, count: int
) -> None:
    lines = exits(0, f"cat /odom . --recording {name} --json").out.splitlines()
    assert len(lines) == count
    assert [*rows(exits, "--recording", name)] == [name]


def test_what_is_forgotten_is_forgotten_of_one_recording_too(
    folder: Path, tmp_path: Path, exits: Program, using: Using
) -> None:
    own_all(folder)
    for bag in folder.rglob("*.mcap"):  # one that changed just now is not stored yet
        os.utime(bag, (1_700_000_000,) * 2)
    using(folder)
    counts = {"bags": 2, "stored": 2, "refused": 0}
    assert exits(0, "index data.recording=a data.now=latest --json").json == counts
    (store,) = tmp_path.rglob("columns.sqlite")
    with closing(sqlite3.connect(store)) as base:
        assert base.execute("SELECT count(*) FROM bag").fetchone() == (2,)
    forgetting = "forget --last 9000 --topic /chatter --yes --json data.now=latest"
    assert exits(0, forgetting).json["stays"] == []
    # Without the bag that had some of it, and what has a part in common with that.
    with closing(sqlite3.connect(store)) as base:
        assert base.execute("SELECT count(*) FROM bag").fetchone() == (0,)


def test_where_no_store_can_be_written_index_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exits: Program
) -> None:
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    (tmp_path / OWN_FOLDER).write_text("a file where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / OWN_FOLDER))
    assert "XDG_CACHE_HOME" in exits(2, "index").err


def test_index_fails_if_the_store_cannot_be_written(
    folder: Path, exits: Program, using: Using
) -> None:
    for bag in folder.rglob("*.mcap"):
        os.utime(bag, (1_700_000_000,) * 2)
    using(folder)
    transaction = database._transaction

    def fill_the_disk(connection: sqlite3.Connection, begin: str) -> AbstractContextManager[None]:
        if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            return transaction(connection, begin)  # an empty file is made first
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise error

    with patch.object(database, "_transaction", fill_the_disk):
        failed = exits(2, "index --json")
    assert failed.json["stored"] == 0
    assert "the store of columns cannot be used: database or disk is full" in failed.err
    assert exits(0, "index --json").json["stored"] > 0


def test_no_text_commands_a_terminal_nor_a_reply_and_letters_that_it_has_not_are_spelled_out(
    tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mcap(tmp_path / "rec_0.mcap", [text(T0, "\x1b[2J\x9b31m k\u00fcche", "/speech")])
    with monkeypatch.context() as terminal:
        terminal.setattr(sys.stdout, "isatty", lambda: True)
        for option in ("--csv", "--json"):
            assert not {"\x1b", "\x9b"} & {*exits(0, "cat /speech", option, tmp_path).out}
    shown = exits(0, f"ask {tmp_path} get_topic_in_last topic=/speech seconds=4000").out
    assert "\x1b" not in shown
    assert "\\x1b[2J" in shown
    written = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(written, encoding="ascii"))
    assert cli.main(["cat", "/speech", str(tmp_path)]) == 0
    assert written.getvalue().endswith(b" k\\xfcche\n")


def test_brackets_of_a_path_and_of_a_question_are_shown_as_they_stand(
    tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag_dir = tmp_path / "[robot a]" / "[bold]"
    write_mcap(bag_dir / "rec_0.mcap", [text(T0, "hello")])
    terminal = StringIO()
    console = partial(Console, file=terminal, force_terminal=True, width=1000)
    monkeypatch.setattr(output, "Console", console)
    exits(0, "topics", bag_dir)
    assert f"looking through {bag_dir}" in terminal.getvalue()
    exits(1, "ask", bag_dir, "[/x]")
    assert "asking [/x]" in terminal.getvalue()


def test_a_topic_whose_type_changes_is_printed_to_its_end(folder: Path, exits: Program) -> None:
    write_mcap(folder / "c" / "c_0.mcap", [text(T0 + 300 * NS_PER_S, "parked", "/odom")])
    write_mcap(folder / "d" / "d_0.mcap", seconds(400, 2, 9.0))
    for field, tail, kept, left in (("position.x", "-n 99", 21, 1), ("data", "--tail 1", 1, 2)):
        for form in ("", "--csv", "--json"):
            printed = exits(0, f"cat /odom . --field {field} {tail} {form}")
            assert len(printed.out.splitlines()) == kept + (form == "--csv")
            assert f"{left} message" in printed.err
            assert f"left out: {'std' if field != 'data' else 'nav'}_msgs/msg/" in printed.err
    assert "has no field 'none'" in exits(2, "cat /odom . --field none --csv").err


def test_cat_calls_no_message_absent_that_cannot_be_decoded(tmp_path: Path, exits: Program) -> None:
    torn = Msg("/torn", "std_msgs/msg/String", T0, b"\0\1\0\0\xff\xff\xff\xff")
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [torn])
    err = exits(1, "cat /torn", tmp_path).err
    assert "1 message left out that cannot be decoded" in err
    assert "no message" not in err


def test_a_recorded_number_is_no_time_however_large(tmp_path: Path, exits: Program) -> None:
    free = make("std_msgs/msg/Float64", data=2_147_483_648.5)
    write_mcap(tmp_path / "a" / "a_0.mcap", [Msg("/free", "std_msgs/msg/Float64", T0, free)])
    assert "  value: 2147483648.5\n" in exits(0, "cat /free", tmp_path).out
    for line in (
        f"get_topic_at_time topic=/free timestamp={T0 // NS_PER_S}",
        "get_topic_in_last topic=/free seconds=9",
        "get_topic_in_last topic=/free seconds=9 fields=data",
        "get_topic_in_last topic=/free seconds=9 fields=data by=hour",
    ):
        printed = exits(0, "ask", *line.split(), tmp_path).out
        assert "2147483648.5" in printed
        assert "2038" not in printed
        assert format_time(T0 / NS_PER_S) in printed
    stamped = Msg("/head", "std_msgs/msg/Header", T0, header(T0 + 1000, "arm"))
    write_mcap(tmp_path / "b" / "b_0.mcap", [stamped])
    assert f"stamp: {format_time(T0 / NS_PER_S + 1e-6)}" in exits(0, "cat /head", tmp_path).out


def test_csv_has_a_column_for_each_field(folder: Path, exits: Program) -> None:
    words = ("--csv", "--field", "position.y", "--field", "header.frame_id")
    rows = [*csv.reader(exits(0, "cat /odom b", *words).out.splitlines())]
    assert rows[0] == ["time", "position.y", "header.frame_id"]
    assert rows[1:] == [[f"1700000{100 + n}.000000000", f"{n}.0", "odom"] for n in range(4)]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--limit 2", [0, 1]),
        ("--tail 2", [8, 9]),
        ("--limit 99999999999999999999 --last 1.5", [8, 9]),
        ("--tail 99999999999999999999 --last 1.5", [8, 9]),
        ("--last 1.5", [8, 9]),
        ("--last 1.5s", [8, 9]),
        ("--start 3s --end 2s", [6, 7]),
    ],
)
def test_some_messages_can_be_chosen(
    folder: Path, exits: Program, words: str, expected: list[int]
) -> None:
    lines = exits(0, f"cat /odom a --json {words}").out.splitlines()
    times = [json.loads(line)["time_ns"] for line in lines]
    assert times == [T0 + n * NS_PER_S for n in expected]


def test_a_reader_that_ends_early_is_no_error(folder: Path, tmp_path: Path) -> None:
    write_command(tmp_path)
    program = [str(tmp_path / "ros2-memory"), "cat", "/odom", str(folder / "a")]
    reading, writing = os.pipe()
    os.close(reading)  # as `head` does once it has its lines
    done = subprocess.run(program, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")


@given(st.integers(946_684_800_000_000, 4_102_444_800_000_000))
def test_a_time_that_is_printed_is_read_back_to_the_microsecond(us: int) -> None:
    assert round(parse_time(format_time(us / 1e6), 0.0) * 1e6) == us


@pytest.mark.usefixtures("folder")
def test_tools_take_a_path_before_them_and_times_in_words(exits: Program) -> None:
    told = exits(0, "ask get_position_at b --json", 'timestamps=["1s","3 seconds ago"]').json
    times = [row["timestamp"] for row in told["results"]]
    assert times == [1_700_000_102.0, 1_700_000_100.0]
    assert exits(0, "ask b get_position_seconds_ago --json seconds_ago=2s").json["y"] == 1.0
    assert "'soon' is not a time" in exits(2, "ask recap b start=soon").err


@pytest.mark.usefixtures("folder")
def test_a_path_is_read_alike_with_recorder_none_as_nothing_records_there_anyway(
    exits: Program,
) -> None:
    """Else "ago" counted from the wall clock, and no .db3 was read."""
    ago = "ask b get_position_seconds_ago --json seconds_ago=2"
    assert exits(0, f"{ago} recorder=none").json == exits(0, ago).json


def test_a_folder_whose_name_has_an_equals_sign_is_no_argument(
    folder: Path, exits: Program
) -> None:
    shutil.copytree(folder / "b", folder / "robot=7" / "b")
    asked = "ask get_position_seconds_ago seconds_ago=0 --json"
    for path in (folder / "robot=7", "./robot=7"):
        assert exits(0, asked, path).json["y"] == 3.0


@pytest.mark.usefixtures("folder")
def test_a_window_of_a_day_or_a_minute_in_words_is_all_of_it(exits: Program) -> None:
    minute = datetime.fromtimestamp(T0 / NS_PER_S + 100).astimezone().strftime("%H:%M")
    for words in ("today", minute, f"'today {minute}'"):
        told = exits(0, f"ask get_topic_in_range b --json topic=/odom start={words} end={words}")
        assert told.json["total"] == 4
        assert len(exits(0, f"cat /odom b --json --start {words} --end {words}").out.split()) >= 4


@pytest.mark.parametrize(
    "line",
    [
        "info",
        "topics",
        "recordings",
        "ask",
        "watch --count 1",
        "config show",
        "export --mcap copy.mcap",
        "index",
        "recover a",
        "forget --last 100 --dry-run data.now=latest",
        "adopt b",
    ],
)
def test_every_command_prints_json(folder: Path, exits: Program, using: Using, line: str) -> None:
    own_all(folder)
    using(folder)
    code = 1 if line.startswith("forget") else 0  # bags of others stay
    assert exits(code, line, "--json").json


def test_a_date_without_dashes_is_no_second_of_1970() -> None:
    with pytest.raises(InvalidArgumentsError, match="the date is 2026-11-21"):
        parse_time("20261121", 0)
    assert parse_time("20269999", 0) == 20269999


def test_where_something_is_recorded_info_says_for_how_long_the_budget_lasts(
    folder: Path, exits: Program, using: Using
) -> None:
    using(folder)
    recording_now(folder, "b", clock=later(0))
    shown = exits(0, "info deployment=robot retention.max_total_gb=2.0").out
    assert re.search(r"budget\.max_gb +2\n", shown)
    assert "budget.full_in_days" in shown


def test_config_is_shown_as_yaml_that_a_program_would_take_but_no_token_is(
    exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEMORY_BAG_DIR", "/bags")
    monkeypatch.setenv("MEMORY_API_TOKEN", "a-secret-that-is-long-enough")
    text = exits(0, "config show server.port=9300").out
    shown = yaml.safe_load(text)
    assert shown["server"]["port"] == 9300
    assert shown["recording"]["bag_dir"] == "/bags"
    assert shown["storage"]["_target_"].startswith("ros2_memory.")
    assert "MEMORY_API_TOKEN is set" in text
    assert "/config.yaml\n" in text
    assert "a-secret" not in text


def test_config_shows_that_systemd_gives_the_token(
    tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    (tmp_path / "memory_api_token").write_text("a-secret-that-is-long-enough")
    text = exits(0, "config show").out
    assert "# the credential memory_api_token is set: " in text
    assert "a-secret" not in text


def test_without_v_no_warning_is_logged_and_with_it_the_events(
    folder: Path, exits: Program
) -> None:
    for name in "ab":
        (folder / "a" / f"{name}.mcap").write_bytes(b"")
        os.utime(folder / "a" / f"{name}.mcap", (1_700_000_000,) * 2)
    assert exits(0, "topics .").err == ""
    lines = exits(0, "topics . -v logging.level=warning").err.splitlines()
    assert [json.loads(line)["event"] for line in lines] == ["bag_damaged", "bag_damaged"]


def test_the_help_of_every_command_says_what_its_exit_codes_mean(exits: Program) -> None:
    for each in COMMANDS:
        assert " ".join(exits(0, f"{each} --help").out.split()).endswith(epilog(each)), each


def test_help_has_a_short_option_and_without_a_name_the_tools_are_listed_with_their_arguments(
    exits: Program,
) -> None:
    for words in ("-h", "info -h", "config show -h"):
        assert "Usage: ros2-memory" in exits(0, words).out
    assert "seconds_ago, topic?, tolerance_s?" in exits(0, "ask").out
