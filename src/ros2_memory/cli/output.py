"""Replies as people read them: tables for lists, lines for the rest.

What was recorded is foreign text: control characters in it never reach the terminal.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from ros2_memory.core.model import JsonValue

_FIRST_MOMENT: Final = 1e9
_LAST_MOMENT: Final = 4.2e9
"""Replies have times as floats of Unix seconds; hardly anything else lies between 2001 and 2103."""
_MINUTES_FROM_S: Final = 120.0
_HOURS_FROM_S: Final = 7200.0
_DAYS_FROM_S: Final = 172_800.0
_AT_ONCE_S: Final = 0.05
_NESTED: Final = 8
_MOST_COLUMNS: Final = 9
_NOTHING: Final = "-"
_NONE: Final = "none"
_BETWEEN: Final = 2
_TIME_OF_DAY: Final = 12
_UNBROKEN: Final = 16
"""Columns that text keeps for itself where a table is wider than the terminal."""
_VECTOR: Final = frozenset({"x", "y", "z", "w", "yaw_deg", "frame_id"})
_IN_WORDS: Final = re.compile(r"\b\d{10}\.\d{3,9}\b")


def show(console: Console, value: JsonValue, now: float | None = None) -> None:
    """Shows any reply; `now` (Unix seconds) is what the age of a moment counts from."""
    if isinstance(value, dict):
        stated = value.get("now")
        _show_object(console, value, stated if isinstance(stated, float) else now)
    elif isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        _show_rows(console, [each for each in value if isinstance(each, dict)])
    else:
        console.print(Text(cell(value) if value else _NONE))


def _show_object(console: Console, value: Mapping[str, JsonValue], now: float | None) -> None:
    lists: dict[str, list[dict[str, JsonValue]]] = {}
    lines = Table.grid(padding=(0, 2))
    lines.add_column(style="bold", no_wrap=True)
    lines.add_column(overflow="fold")
    for key, each in flat(value).items():
        rows = [row for row in each if isinstance(row, dict)] if isinstance(each, list) else []
        if isinstance(each, list) and rows and len(rows) == len(each):
            lists[key] = rows
        elif key == "notes" and isinstance(each, list):
            for note in each:
                lines.add_row("note", Text(_with_local_times(cell(note))))
        else:
            lines.add_row(Text(plain(key)), Text(_line(key, each, now)))
    if lines.row_count:
        console.print(lines)
    for key, rows in lists.items():
        console.print(Text(f"\n{plain(key)}", style="bold"))
        _show_rows(console, rows)


def _show_rows(console: Console, rows: Sequence[Mapping[str, JsonValue]]) -> None:
    """A table, or one after the other where it would be wider than the terminal."""
    shown = table(rows, console.width)
    if shown is not None:
        console.print(shown)
        return
    for row in rows:
        console.print()
        _show_object(console, row, None)


def _line(key: str, value: JsonValue, now: float | None) -> str:
    """What stands behind a key; of a moment how long ago it was, too."""
    if value is None or value == []:
        return _NONE
    if not isinstance(value, float) or not is_moment(value):
        return _under(key, value)
    ago = 0.0 if now is None else now - value
    if abs(ago) < _AT_ONCE_S:
        return moment(value)
    return f"{moment(value)} ({span(ago)} ago)" if ago > 0 else f"{moment(value)} (in {span(-ago)})"


def _under(key: str, value: JsonValue) -> str:
    """A value as its key means it: long times are in minutes, hours or days."""
    seconds = isinstance(value, int | float) and not isinstance(value, bool) and key.endswith("_s")
    if seconds and isinstance(value, int | float) and abs(value) >= _MINUTES_FROM_S:
        return cell(value) if is_moment(value) else span(value)
    return cell(value)


def _with_local_times(note: str) -> str:
    """A note whose Unix seconds are local times."""
    return _IN_WORDS.sub(lambda found: moment(float(found[0])), note)


def table(rows: Sequence[Mapping[str, JsonValue]], width: int) -> Table | None:
    """Objects as rows; their keys, in order of appearance, are the columns.

    None where it cannot be brought to a width of so many characters.
    """
    flattened = [flat(row) for row in rows]
    if len(_keys(flattened)) > _MOST_COLUMNS:
        flattened = [{**row} for row in rows]
    columns = [_Column.of(key, [row.get(key) for row in flattened]) for key in _keys(flattened)]
    if sum(each.least + _BETWEEN for each in columns) > width:
        return None
    narrow = sum(each.longest + _BETWEEN for each in columns) > width
    shown = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for each in columns:
        shown.add_column(
            Text(plain(each.key)),
            justify="right" if each.numeric else "left",
            overflow="fold",
            no_wrap=each.numeric,
            min_width=each.least,
            max_width=each.least if narrow and each.moments else None,
        )
    for row in flattened:
        shown.add_row(*(Text(_under(each.key, row.get(each.key))) for each in columns))
    return shown


@dataclass(frozen=True, slots=True)
class _Column:
    """What a column holds, and how many characters it takes: `longest`, or `least` if it must."""

    key: str
    numeric: bool
    moments: bool
    longest: int
    least: int

    @classmethod
    def of(cls, key: str, values: Sequence[JsonValue]) -> _Column:
        """The column of these values; a moment may be broken between its day and its time."""
        moments = any(is_moment(each) for each in values)
        numeric = all(
            isinstance(each, int | float) and not isinstance(each, bool) and not is_moment(each)
            for each in values
            if each is not None
        )
        longest = max(len(key), *(len(_under(key, each)) for each in values))
        if moments:
            return cls(key, numeric, moments, longest, _TIME_OF_DAY)
        return cls(key, numeric, moments, longest, longest if numeric else min(longest, _UNBROKEN))


def _keys(rows: Sequence[Mapping[str, JsonValue]]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))


def flat(value: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Small objects inside become keys with dots; what is larger, and a place, stays."""
    shown: dict[str, JsonValue] = {}
    for key, each in value.items():
        if isinstance(each, dict) and 0 < len(each) <= _NESTED and not _is_vector(each):
            if each.keys() == {"value"}:  # of a message that has this one field
                shown[key] = each["value"]
            else:
                shown.update((f"{key}.{inner}", item) for inner, item in flat(each).items())
        else:
            shown[key] = each
    return shown


def _is_vector(value: Mapping[str, JsonValue]) -> bool:
    """Whether an object is a place, a direction or a rotation."""
    return {"x", "y"} <= value.keys() <= _VECTOR


def cell(value: JsonValue) -> str:
    """One value as text."""
    if value is None:
        return _NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return moment(value) if is_moment(value) else f"{value:,.10g}".replace(",", "")
    if isinstance(value, str):
        return plain(value)
    if isinstance(value, int):
        return str(value)
    return (_list(value) if isinstance(value, list) else _object(value)) or _NOTHING


def _list(value: Sequence[JsonValue]) -> str:
    simple = all(isinstance(each, str | int | float) for each in value)
    return (", " if simple else " | ").join(cell(each) for each in value)


def _object(value: Mapping[str, JsonValue]) -> str:
    """An object in words: `x 1.5, y 2, yaw_deg 90 (map)`, `label: cup; score: 0.9`."""
    if _is_vector(value):
        flat_ground = "w" not in value and not value.get("z")
        told = ", ".join(
            f"{key} {cell(each)}"
            for key, each in value.items()
            if key != "frame_id" and not (key == "z" and flat_ground)
        )
        frame = value.get("frame_id")
        return told if frame is None else f"{told} ({cell(frame)})"
    if value.keys() == {"value"}:
        return cell(value["value"])
    return "; ".join(
        f"{plain(key)} ({cell(each)})" if isinstance(each, dict) else f"{plain(key)}: {cell(each)}"
        for key, each in value.items()
    )


def is_moment(value: JsonValue) -> bool:
    """Whether a number of a reply is a time."""
    return isinstance(value, float) and _FIRST_MOMENT < value < _LAST_MOMENT


def moment(unix_s: float) -> str:
    """A time in this machine's zone, to the millisecond."""
    local = datetime.fromtimestamp(unix_s, tz=UTC).astimezone()
    return f"{local:%Y-%m-%d %H:%M:%S}.{local.microsecond // 1000:03d}"


def span(seconds: float) -> str:
    """A duration in the unit that suits it: `4.2 s`, `12 min`, `5.1 h`, `23 days`."""
    amount = abs(seconds)
    if amount < _MINUTES_FROM_S:
        return f"{seconds:.1f} s"
    if amount < _HOURS_FROM_S:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if amount < _DAYS_FROM_S else f"{seconds / 86_400:.0f} days"


def plain(text: str) -> str:
    """The text without what a terminal would obey."""
    return "".join(each if each.isprintable() else _escaped(each) for each in text)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()
