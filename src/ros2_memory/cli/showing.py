"""Replies as people read them: tables for lists, lines for the rest.

What was recorded is foreign text: control characters in it never reach the terminal.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from ros2_memory.model import JsonValue

_FIRST_MOMENT: Final = 1e9
_LAST_MOMENT: Final = 4.2e9
"""Replies have times as floats of Unix seconds; hardly anything else lies between 2001 and 2103."""
_MINUTES_FROM_S: Final = 120.0
_HOURS_FROM_S: Final = 7200.0
_DAYS_FROM_S: Final = 172_800.0
_NESTED: Final = 8
_MOST_COLUMNS: Final = 9
_NOTHING: Final = "-"


def show(console: Console, value: JsonValue) -> None:
    """Shows any reply."""
    if isinstance(value, dict):
        _show_object(console, value)
    elif isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        console.print(table([each for each in value if isinstance(each, dict)]))
    else:
        console.print(Text(cell(value)))


def _show_object(console: Console, value: Mapping[str, JsonValue]) -> None:
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
                lines.add_row("note", Text(cell(note)))
        else:
            lines.add_row(Text(plain(key)), Text(cell(each)))
    if lines.row_count:
        console.print(lines)
    for key, rows in lists.items():
        console.print(Text(f"\n{plain(key)}", style="bold"))
        console.print(table(rows))


def table(rows: Sequence[Mapping[str, JsonValue]]) -> Table:
    """Objects as rows; their keys, in order of appearance, are the columns."""
    flattened = [flat(row) for row in rows]
    if len(_keys(flattened)) > _MOST_COLUMNS:
        flattened = [{**row} for row in rows]
    columns = _keys(flattened)
    shown = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        values = [row.get(column) for row in flattened]
        numeric = all(
            isinstance(each, int | float) and not isinstance(each, bool) and not is_moment(each)
            for each in values
            if each is not None
        )
        shown.add_column(
            Text(plain(column)),
            justify="right" if numeric else "left",
            overflow="fold",
            no_wrap=numeric or any(is_moment(each) for each in values),
        )
    for row in flattened:
        shown.add_row(*(Text(cell(row.get(column))) for column in columns))
    return shown


def _keys(rows: Sequence[Mapping[str, JsonValue]]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))


def flat(value: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Small objects inside become keys with dots; what is larger stays."""
    shown: dict[str, JsonValue] = {}
    for key, each in value.items():
        if isinstance(each, dict) and 0 < len(each) <= _NESTED:
            shown.update((f"{key}.{inner}", item) for inner, item in flat(each).items())
        else:
            shown[key] = each
    return shown


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
    if isinstance(value, list) and all(isinstance(each, str | int | float) for each in value):
        return ", ".join(cell(each) for each in value) or _NOTHING
    return plain(json.dumps(value, ensure_ascii=False))


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
