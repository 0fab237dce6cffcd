"""Replies as people read them, in a terminal of 80 columns and in a wide one."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ros2_memory.cli.output import atomic_file, format_time, format_value, print_reply
from ros2_memory.core.model import JsonValue
from tests.support.program import Printed

Shown = Callable[..., Printed]
T0 = 1_700_000_000.25


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shown:
    """What is printed of a reply in so many columns."""

    def run(value: JsonValue, width: int = 80) -> Printed:
        monkeypatch.setenv("COLUMNS", str(width))
        print_reply(value)
        return Printed(*capsys.readouterr())

    return run


@pytest.mark.parametrize(
    ("value", "output"),
    [
        (T0, format_time(T0)),
        (True, "true"),
        (0.1 + 0.2, "0.3"),
        (["a", 2], "a, 2"),
        ({"label": "cup", "at": {"x": 1, "y": 2}}, "label: cup; at.x: 1; at.y: 2"),
        ([{"label": "cup"}, {"label": "\x1b[0m"}], "label: cup | label: \\x1b[0m"),
        (None, "-"),
        ([], "-"),
        ({}, "-"),
    ],
)
def test_a_value_in_a_cell_is_one_line(value: JsonValue, output: str) -> None:
    assert format_value(value) == output


def test_a_reply_is_a_line_for_each_value_and_its_notes_are_on_stderr(shown: Shown) -> None:
    printed = shown({"at": T0, "value": {"x": 1}, "gaps": [], "notes": ["one", "two"]})
    lines = [line.split() for line in printed.out.splitlines()]
    assert lines == [["at", format_time(T0)], ["value.x", "1"], ["gaps", "-"]]
    assert printed.err == "note: one\nnote: two\n"
    assert shown([]).out == "none\n"


def test_rows_with_named_columns_are_a_table(shown: Shown) -> None:
    reply: JsonValue = {
        "topic": "/bumper",
        "columns": ["day", "count"],
        "rows": [["2026-11-16", 2], ["2026-11-17", None]],
    }
    lines = [line.split() for line in shown(reply).out.splitlines()]
    assert lines[0] == ["topic", "/bumper"]
    for row in (["rows"], ["day", "count"], ["2026-11-16", "2"], ["2026-11-17", "-"]):
        assert row in lines


def test_in_a_narrow_terminal_wide_rows_stand_one_below_the_other(shown: Shown) -> None:
    row: JsonValue = {f"a_key_with_a_long_name_{n}": n for n in range(10)}
    assert shown([row, row]).out.count("a_key_with_a_long_name_5  5\n") == 2
    assert shown([row, row], width=300).out.count("a_key_with_a_long_name_5") == 1


@pytest.mark.parametrize("width", [0, 40])
def test_however_narrow_a_terminal_is_nothing_of_a_table_is_cut(shown: Shown, width: int) -> None:
    """The width is 0 on some serial lines."""
    output = "".join(shown([{"topic": "/a_long_name" * 5, "count": 12345}], width).out.split())
    assert "12345" in output
    assert "/a_long_name" * 5 in output.replace("12345", "")


def test_of_two_programs_that_write_a_file_at_once_each_writes_a_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "window.mcap"
    with atomic_file(path) as first:
        first.write_text("all of the first")
        with atomic_file(path) as second:
            second.write_text("all of the second")
        assert path.read_text() == "all of the second"
    assert path.read_text() == "all of the first"
    assert [*tmp_path.iterdir()] == [path]


def test_what_a_killed_program_had_not_written_whole_is_deleted_by_the_next_one(
    tmp_path: Path,
) -> None:
    program = (
        "import os, pathlib, signal, sys\n"
        "from ros2_memory.cli.output import atomic_file\n"
        "with atomic_file(pathlib.Path(sys.argv[1])) as half:\n"
        "    half.write_bytes(b'half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = tmp_path / "window.mcap"
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    [abandoned] = tmp_path.iterdir()
    with atomic_file(path) as first:
        for folder in (abandoned, first.parent):
            os.utime(folder, (0, 0))
        first.write_text("first")
        with atomic_file(path) as second:
            second.write_text("second")
    assert path.read_text() == "first"
    assert [*tmp_path.iterdir()] == [path]
