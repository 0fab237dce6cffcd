"""Replies as people read them, in a terminal of 80 columns and in a wide one."""

from collections.abc import Callable

import pytest

from ros2_memory.cli.output import format_time, format_value, print_reply, with_commands
from ros2_memory.core.model import JsonValue

Shown = Callable[..., str]
T0 = 1_700_000_000.25


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shown:
    """What is printed of a reply in so many columns."""

    def run(value: JsonValue, width: int = 80, now: float | None = None) -> str:
        monkeypatch.setenv("COLUMNS", str(width))
        print_reply(value, now)
        lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
        assert all(len(line) <= width for line in lines)
        return "\n".join(lines)

    return run


@pytest.mark.parametrize(
    ("value", "output"),
    [
        ({"x": 1.5, "y": 2, "z": 0.0}, "x 1.5, y 2, z 0"),
        ({"x": 1.5, "y": 2, "z": 0.4, "yaw_deg": 90.0}, "x 1.5, y 2, z 0.4, yaw_deg 90"),
        ({"x": 1.5, "y": 2, "frame_id": "map"}, "x 1.5, y 2 (map)"),
        ({"x": 0, "y": 0, "z": 0, "w": 1}, "x 0, y 0, z 0, w 1"),
        ({"value": "cup"}, "cup"),
        ({"label": "cup", "score": 0.9}, "label: cup; score: 0.9"),
        ({"label": "cup", "at": {"x": 1, "y": 2}}, "label: cup; at (x 1, y 2)"),
        ([{"label": "cup"}, {"label": "\x1b[0m"}], "label: cup | label: \\x1b[0m"),
        ([], "-"),
        ({}, "-"),
    ],
)
def test_objects_in_a_cell_are_words(value: JsonValue, output: str) -> None:
    assert format_value(value) == output


def test_a_moment_has_its_local_time_and_its_age_and_what_there_is_not_is_in_words(
    shown: Shown,
) -> None:
    output = shown({"timestamp": T0, "first": T0 - 7200.0, "next": T0 + 60.0}, now=T0)
    assert output.splitlines()[0].split(maxsplit=1) == ["timestamp", format_time(T0)]
    assert f"{format_time(T0 - 7200)} (2.0 h ago)" in output
    assert f"{format_time(T0 + 60)} (in 60.0 s)" in output
    # That of a clock that was never set has its unit.
    assert shown({"earliest": 0.0}).split() == ["earliest", "0", "s", "after", "1970"]
    assert "0 s after 1970" in shown([{"recording": "a", "start": 2e-9}])
    assert shown({"recorder": None, "gaps": []}).split() == ["recorder", "none", "gaps", "none"]
    assert shown([]) == "none"


def test_a_list_of_tools_stays_one_and_a_tool_to_ask_becomes_a_command() -> None:
    assert with_commands("the tools are: list_recorded_topics, visits").endswith(
        "list_recorded_topics, visits"
    )
    assert with_commands("list_recorded_topics lists all") == "`ros2-memory topics` lists all"


def test_counts_by_day_are_a_table_whose_last_row_is_of_all(shown: Shown) -> None:
    """Of a time that stands there twice, as text and exactly, people get the exact one."""
    reply: JsonValue = {
        "topic": "/bumper",
        "columns": ["day", "count", "first", "first_unix"],
        "rows": [["2026-11-16", 2, "09:00:00", T0], ["2026-11-17", 0, None, None]],
        "all": [2, "09:00:00", T0],
    }
    lines = [line.split() for line in shown(reply).splitlines() if line]
    assert lines[:3] == [["topic", "/bumper"], ["rows"], ["day", "count", "first"]]
    assert lines[-3:] == [
        ["2026-11-16", "2", format_time(T0)],
        ["2026-11-17", "0", "-"],
        ["all", "2", format_time(T0)],
    ]


def test_in_a_narrow_terminal_moments_are_broken_and_wide_rows_stand_one_below_the_other(
    shown: Shown,
) -> None:
    rows: JsonValue = [{"topic": "/a_long_name" * 3, "first": T0, "last": T0, "count": 12345}]
    output = shown(rows)
    for part in format_time(T0).split("T"):
        assert [line.count(part) for line in output.splitlines() if part in line] == [2]
    assert "12345" in output
    row: JsonValue = {f"a_key_with_a_long_name_{n}": n for n in range(6)}
    assert shown([row, row]).count("a_key_with_a_long_name_5  5") == 2
    assert shown([row, row], width=200).count("a_key_with_a_long_name_5") == 1


def test_a_serial_line_of_no_columns_shows_tables_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    print_reply([{"topic": "/odom", "count": 5}])
    assert "/odom" in capsys.readouterr().out
