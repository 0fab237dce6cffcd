"""What commands print and write: replies as tables and lines, notes, a spinner, whole files.

Recorded text may contain control characters, which must never reach a terminal: `escape`.
"""

from __future__ import annotations

import json
import math
import sys
from contextlib import contextmanager
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ros2_memory.core.errors import BagError
from ros2_memory.core.temporary import hidden_folder
from ros2_memory.core.text import leaves
from ros2_memory.core.timebase import NS_PER_US, local_time

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

_NO_TERMINAL: Final = 160, 24
"""Columns and lines where no terminal says how many there are."""
_LEAST_WIDTH: Final = 12
"""Columns of the terminal for each one of a table, on average."""
_EARLIEST_TIME: Final = 1e9
_LATEST_TIME: Final = 4.2e9
"""Replies have times as floats of Unix seconds; hardly anything else lies between 2001 and 2103."""
_RECORDED: Final = ("value", "min", "max")
"""Keys of replies with fields of messages: a number there need not be a time."""


def print_line(line: str) -> None:
    """Prints a line on stdout, and flushes it."""
    print(line, flush=True)


def print_json(value: object) -> None:
    """Prints a value for programs, as a line on stdout."""
    print_line(json.dumps(value))


def print_exactly(lines: Iterable[str]) -> int:
    """Prints lines for programs; returns their number. On a terminal escapes control characters."""
    count, is_terminal = 0, sys.stdout.isatty()
    for line in lines:
        count += 1
        print(escape(line) if is_terminal else line)
    sys.stdout.flush()
    return count


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path, which is renamed to `path` after the block, or removed if it fails.

    Raises:
        BagError: the block raised one; an error of the temporary file names `path` instead.
        OSError: the block raised one, or the file cannot be renamed; the error names `path`.
    """
    try:
        with hidden_folder(path.parent) as folder:
            temporary = folder / "written"
            try:
                yield temporary
            except BagError as error:
                if error.path != str(temporary):
                    raise
                raise BagError(str(path), error.reason) from error
            temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def print_notes(notes: Iterable[str]) -> None:
    """Prints notes on stderr."""
    for note in notes:
        print(f"note: {escape(note)}", file=sys.stderr, flush=True)


@contextmanager
def spinner(activity: str) -> Iterator[Callable[[str], None]]:
    """Shows on a terminal what the block is doing; yields a function that changes the text."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    # A `Text`: in a string, brackets of a question or a path would be Rich's markup.
    with console.status(Text(escape(activity))) as status:
        yield lambda text: status.update(Text(escape(text)))


def print_reply(reply: JsonValue) -> None:
    """Prints a reply for people: a line for each value, a table for each list of objects."""
    if isinstance(reply, dict):
        _print_object(reply)
    elif rows := _objects(reply):
        _print_rows(rows)
    else:
        print_line(format_value(reply) if reply else "none")


def _print_object(reply: Mapping[str, JsonValue]) -> None:
    lines: dict[str, str] = {}
    tables: dict[str, list[JsonObject]] = {}
    notes: list[str] = []
    for path, value in filled_leaves(_with_rows_as_objects(reply)).items():
        if rows := _objects(value):
            tables[path] = rows
        elif path == "notes" and isinstance(value, list):
            notes += map(str, value)
        else:
            lines[escape(path)] = format_value(value)
    width = max(map(len, lines), default=0)
    for name, text in lines.items():
        print_line(f"{name:<{width}}  {text}")
    for path, rows in tables.items():
        print_line(f"\n{escape(path)}")
        _print_rows(rows)
    print_notes(notes)


def _with_rows_as_objects(reply: Mapping[str, JsonValue]) -> JsonObject:
    """Returns a reply whose table (names of columns, rows of cells) is a list of objects."""
    rest = {**reply}
    columns = rest.pop("columns" if "columns" in rest else "fields", None)
    rows = rest.pop("rows", None)
    if not isinstance(columns, list) or not isinstance(rows, list):
        return {**reply}
    names = [*map(str, columns)]
    is_recorded = [not (name == "timestamp" or name.endswith("_unix")) for name in names]
    if isinstance(total := rest.get("all"), list):  # without the cell of the bin
        rest["all"] = [*map(with_plain_numbers, total, is_recorded[1:])]
    cells_by_row = (
        map(with_plain_numbers, row, is_recorded) for row in rows if isinstance(row, list)
    )
    return rest | {"rows": [dict(zip(names, cells, strict=False)) for cells in cells_by_row]}


def _objects(value: JsonValue) -> list[JsonObject]:
    """Returns the items of a list of objects; of any other value an empty list."""
    items = value if isinstance(value, list) else []
    rows = [item for item in items if isinstance(item, dict)]
    return rows if len(rows) == len(items) else []


def _print_rows(rows: Sequence[JsonObject]) -> None:
    """Prints a table, or one object after the other where its columns would be too narrow."""
    flat = [*map(filled_leaves, rows)]
    columns = dict.fromkeys(path for row in flat for path in row)
    width = get_terminal_size(_NO_TERMINAL).columns
    if len(columns) * _LEAST_WIDTH > width:
        for row in rows:
            print_line("")
            _print_object(row)
        return
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for path in columns:
        table.add_column(Text(escape(path)), overflow="fold")
    for row in flat:
        table.add_row(*[Text(format_value(row.get(path))) for path in columns])
    Console(width=width).print(table)


def filled_leaves(value: JsonValue) -> dict[str, JsonValue]:
    """Returns the values inside nested objects by dot-path, without empty objects."""
    return {path: inner for path, inner in leaves(value) if inner != {}}


def with_plain_numbers(value: JsonValue, is_recorded: bool = True) -> JsonValue:
    """Returns a value whose recorded floats are texts, since one may seem a time; a stamp is one.

    All of a value that `is_recorded`; of a reply those below the keys `_RECORDED`.
    """
    if isinstance(value, float):
        return repr(value).removesuffix(".0") if is_recorded else value
    if isinstance(value, list):
        return [with_plain_numbers(inner, is_recorded) for inner in value]
    if isinstance(value, dict):
        return {
            key: inner
            if key.endswith("stamp")
            else with_plain_numbers(inner, is_recorded or key in _RECORDED)
            for key, inner in value.items()
        }
    return value


def format_value(value: JsonValue) -> str:
    """Formats a value in one line: a time as local time; null and what is empty as `-`."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value).lower()  # a boolean as in JSON
    if isinstance(value, float):
        is_time = _EARLIEST_TIME < value < _LATEST_TIME
        return format_time(value) if is_time else f"{value:.10g}"
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, list):
        separator = " | " if _objects(value) else ", "
        return separator.join(map(format_value, value)) or "-"
    parts = [f"{escape(path)}: {format_value(part)}" for path, part in filled_leaves(value).items()]
    return "; ".join(parts) or "-"


def format_time(unix_s: float) -> str:
    """Formats a time in this machine's zone, to the microsecond: `2026-11-20T08:30:00.000000`.

    Every option that takes a time reads this form; it is one word for a shell. A local time that
    occurs twice, because clocks were set back, has its offset.
    """
    fraction, whole = math.modf(unix_s)  # `unix_s * 1e6` would round twice
    microseconds = int(whole) * 1_000_000 + round(fraction * 1e6)
    return local_time(microseconds * NS_PER_US).isoformat(timespec="microseconds")


def format_size(size_bytes: float) -> str:
    """Formats a size: `0.61 MB`, `23.4 GB`."""
    unit, name = (1e9, "GB") if size_bytes >= 1e9 else (1e6, "MB")
    return f"{format_value(float(f'{size_bytes / unit:.3g}'))} {name}"


def escape(text: str) -> str:
    """Returns the text with control characters spelled out, so that a terminal ignores them."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )
