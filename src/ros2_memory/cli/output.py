"""What commands print and write: replies as tables and lines, notes, a spinner, whole files.

Recorded text may contain control characters, which must never reach a terminal: `escape`.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
import sys
from contextlib import contextmanager, suppress
from io import StringIO
from itertools import chain
from typing import TYPE_CHECKING, Final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from ros2_memory.core.errors import BagError
from ros2_memory.core.text import dotted
from ros2_memory.core.timebase import NS_PER_US, local_time
from ros2_memory.messages.levels import with_level_names

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

_PIPE_WIDTH: Final = 160
"""Columns where no terminal says how many there are, so that lines in a pipe are not cut."""
_EARLIEST_TIME: Final = 1e9
_LATEST_TIME: Final = 4.2e9
"""Replies have times as floats of Unix seconds; hardly anything else lies between 2001 and 2103."""
_MINUTES_FROM_S: Final = 120.0
_RATES: Final = ("_m_s", "_deg_s", "_rad_s", "_per_s")
"""How keys of speeds and rates end: their values are no durations."""
_HOURS_FROM_S: Final = 7200.0
_DAYS_FROM_S: Final = 172_800.0
_NO_AGE_BELOW_S: Final = 0.05
_MAX_FLATTENED_KEYS: Final = 8
_MAX_COLUMNS: Final = 9
_MOST_ROWS: Final = 10
"""Rows of a list that people are shown; --json prints all."""
_LEAST_WIDTH: Final = 20
"""With fewer columns (COLUMNS is 0 on some serial lines) tables would be empty."""
_ENDLESS: Final = 10_000
"""Characters of a terminal that is wide enough for any table."""
_TIME_OF_DAY_WIDTH: Final = 15
_MIN_TEXT_WIDTH: Final = 16
"""Columns that a text keeps where a table is wider than the terminal."""
_ALL: Final = "all"
"""The key of a table's last row, and the text of its first column."""
_KEYS_OF_TIMES: Final = frozenset({"start", "end", "earliest", "latest", "first_ts", "last_ts"})
_VECTOR_KEYS: Final = frozenset({"x", "y", "z", "w", "yaw_deg", "frame_id"})
_TIME_IN_NOTE: Final = re.compile(r"\b\d{10}\.\d{3,9}\b")
_COMMANDS: Final = {
    "data_time_range": "`ros2-memory info`",
    "list_recorded_topics": "`ros2-memory topics`",
}
"""What a person runs in place of a tool that a sentence names."""
_LISTS_TOOLS: Final = "the tools are: "
"""In a sentence that lists the tools, each by its name."""
_WITH_TOOLS: Final = frozenset({"problems", "doubts"})
"""Keys of sentences that may name tools."""
_TOOL_IN_NOTE: Final = re.compile(rf"(?<![\w/])(?:{'|'.join(_COMMANDS)})\b")


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


def csv_line(cells: Iterable[object]) -> str:
    """Returns a row of CSV, without the line's end."""
    line = StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path, which is renamed to `path` after the block, or removed if it fails.

    Raises:
        BagError: the block raised one; an error of the temporary file names `path` instead.
        OSError: the block raised one, or the file cannot be renamed; the error names `path`.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        yield temporary
        temporary.replace(path)
    except BagError as error:
        if error.path != str(temporary):
            raise
        raise BagError(str(path), error.reason) from error
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def print_notes(notes: Iterable[str]) -> None:
    """Prints notes on stderr, with times in this machine's zone."""
    for note in notes:
        print(f"note: {with_local_times(note)}", file=sys.stderr, flush=True)


def stdout_console() -> Console:
    """Returns the console for answers; in a pipe its lines are 160 characters wide."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _PIPE_WIDTH
    console.width = max(console.width, _LEAST_WIDTH)
    return console


@contextmanager
def spinner(activity: str) -> Iterator[Callable[[str], None]]:
    """Shows on a terminal what the block is doing; yields a function that changes the text."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    with console.status(escape(activity)) as status:
        yield lambda text: status.update(escape(text))


def print_reply(value: JsonValue, now: float | None = None) -> None:
    """Prints a reply for people.

    Ages count from the reply's own `now`, else from the argument (Unix s); without both no age is
    shown.
    """
    value, console = with_level_names(value), stdout_console()
    if isinstance(value, dict):
        reply_now = value.get("now")
        _print_object(console, value, reply_now if isinstance(reply_now, float) else now)
    elif isinstance(value, list) and (rows := _objects(value)):
        _print_rows(console, rows)
    else:
        console.print(Text(format_value(value) if value else "none"))


def cut_lists(reply: JsonObject, names: Iterable[str]) -> JsonObject:
    """Returns a reply with the first ten rows of the named lists, and a note for each list cut."""
    shorter: JsonObject = {}
    notes: list[JsonValue] = []
    for name in names:
        rows = reply.get(name)
        if isinstance(rows, list) and len(rows) > _MOST_ROWS:
            shorter[name] = rows[:_MOST_ROWS]
            notes.append(f"{len(rows) - _MOST_ROWS} more {name}: --json prints them")
    if not shorter:
        return reply
    own_notes = reply.get("notes")
    return (
        reply | shorter | {"notes": [*(own_notes if isinstance(own_notes, list) else ()), *notes]}
    )


def _print_object(console: Console, value: Mapping[str, JsonValue], now: float | None) -> None:
    """Prints a line for each key, and then a table for each list of objects."""
    lists: dict[str, list[JsonObject]] = {}
    lines = Table.grid(padding=(0, 2))
    lines.add_column(style="bold", no_wrap=True)
    lines.add_column(overflow="fold")
    for key, inner in _flattened(_rows_as_objects(value)).items():
        if isinstance(inner, list) and (rows := _objects(inner)):
            lists[key] = rows
        elif key == "notes" and isinstance(inner, list):
            for note in inner:
                lines.add_row("note", Text(with_local_times(str(note))))
        elif key == "detail" and isinstance(inner, str):  # why there is no answer
            lines.add_row(key, Text(with_local_times(inner)))
        else:
            line = _format_line(key, inner, now)
            if key in _WITH_TOOLS:
                line = with_commands(line)
            lines.add_row(Text(escape(key)), Text(line))
    if lines.row_count:
        console.print(lines)
    for key, rows in lists.items():
        console.print(Text(f"\n{escape(key)}", style="bold"))
        _print_rows(console, rows)


def _objects(values: Sequence[JsonValue]) -> list[JsonObject]:
    """Returns the values if all of them are objects; else an empty list."""
    rows = [row for row in values if isinstance(row, dict)]
    return rows if len(rows) == len(values) else []


def with_local_times(sentence: str) -> str:
    """Prepares a sentence for a terminal: local times, commands instead of tools, escapes."""
    local = _TIME_IN_NOTE.sub(lambda match: format_time(float(match[0])), sentence)
    return escape(with_commands(local))


def with_commands(sentence: str) -> str:
    """Replaces the names of tools by commands that show the same, except in a list of all tools."""
    if _LISTS_TOOLS in sentence:
        return sentence
    return _TOOL_IN_NOTE.sub(lambda match: _COMMANDS[match[0]], sentence)


def _rows_as_objects(reply: Mapping[str, JsonValue]) -> Mapping[str, JsonValue]:
    """Returns a reply whose table (names of columns, rows of cells) is a list of objects.

    A time with a column `x_unix` beside `x` is shown once, by its exact value.
    """
    rest = {**reply}
    columns = rest.pop("columns" if "columns" in rest else "fields", None)
    rows = rest.pop("rows", None)
    if not isinstance(columns, list) or not isinstance(rows, list):
        return reply
    totals = rest.get(_ALL)
    if isinstance(totals, list):
        del rest[_ALL]
        rows = [*rows, [_ALL, *totals]]
    objects: list[JsonValue] = []
    for row in rows:
        if not isinstance(row, list):
            continue
        cells: JsonObject = dict(zip(map(str, columns), row, strict=False))
        for name in [name for name in cells if name.endswith("_unix")]:
            cells[name.removesuffix("_unix")] = cells.pop(name)
        objects.append(cells)
    return rest | {"rows": objects}


def _print_rows(console: Console, rows: Sequence[Mapping[str, JsonValue]]) -> None:
    """Prints the widest table that fits the terminal; else one object after the other."""
    flattened = [_flattened(row) for row in rows]
    if len(_all_keys(flattened)) > _MAX_COLUMNS:
        flattened = [{**row} for row in rows]
    endless = console.options.update_width(_ENDLESS)
    wide, narrow = (_table(flattened, breaks_times=breaks) for breaks in (False, True))
    if Measurement.get(console, endless, wide).maximum <= console.width:
        console.print(wide)
        return
    if Measurement.get(console, endless, narrow).minimum <= console.width:
        console.print(narrow)
        return
    for row in rows:
        console.print()
        _print_object(console, row, None)


def _format_line(key: str, value: JsonValue, now: float | None) -> str:
    """Formats the value of a key; behind a time stands its age (`12 min ago`, `in 4.2 s`)."""
    if value is None or value == []:
        return "none"
    text = _format_for_key(key, value)
    if now is None or not isinstance(value, float) or not _is_time(value):
        return text
    age_s = now - value
    if abs(age_s) < _NO_AGE_BELOW_S:
        return text
    age = f"{format_duration(age_s)} ago" if age_s > 0 else f"in {format_duration(-age_s)}"
    return f"{text} ({age})"


def _format_for_key(key: str, value: JsonValue) -> str:
    """Formats a value; long durations (keys in `_s`) in minutes, hours or days.

    A time near 1970 is of a clock that was never set, and is shown in seconds.
    """
    if isinstance(value, int | float) and not _is_time(value):
        if key in _KEYS_OF_TIMES:
            return f"{format_value(round(value, 3))} s after 1970"
        is_duration = key.endswith("_s") and not key.endswith(_RATES)
        if is_duration and abs(value) >= _MINUTES_FROM_S:
            return format_duration(value)
    return format_value(value)


def _table(rows: Sequence[Mapping[str, JsonValue]], *, breaks_times: bool) -> Table:
    """Returns a table with a row for each object, and a column for each key.

    Columns are in the order in which their keys first appear. With `breaks_times` a time takes two
    lines: its date, and its time of day.
    """
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    columns = []
    for key in _all_keys(rows):
        values = [row.get(key) for row in rows]
        has_times = any(map(_is_time, values))
        is_numeric = not has_times and all(map(_is_number_or_none, values))
        cells = [_format_for_key(key, value) for value in values]
        if has_times and breaks_times:
            cells = [cell.replace("T", "\n") for cell in cells]
        longest_word = max(map(len, (key, *chain(*map(str.split, cells)))))
        table.add_column(
            Text(escape(key)),
            justify="right" if is_numeric else "left",
            overflow="fold",
            no_wrap=is_numeric,
            min_width=_TIME_OF_DAY_WIDTH if has_times else min(longest_word, _MIN_TEXT_WIDTH),
        )
        columns.append(map(Text, cells))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    return table


def _is_number_or_none(value: JsonValue) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _all_keys(rows: Sequence[Mapping[str, JsonValue]]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))


def _flattened(value: Mapping[str, JsonValue]) -> JsonObject:
    """Returns an object with the keys of its small objects as dot-paths; positions stay objects."""
    flat: JsonObject = {}
    for key, inner in value.items():
        is_small = isinstance(inner, dict) and 0 < len(inner) <= _MAX_FLATTENED_KEYS
        if not isinstance(inner, dict) or not is_small or _is_vector(inner):
            flat[key] = inner
        elif inner.keys() == {"value"}:  # a message with this one field
            flat[key] = inner["value"]
        else:
            flat.update((f"{key}.{name}", item) for name, item in _flattened(inner).items())
    return flat


def leaves(value: JsonValue, path: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Yields the values inside nested objects, each with its dot-path; a list is one value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, dotted(path, key))
    else:
        yield path, value


def _is_vector(value: Mapping[str, JsonValue]) -> bool:
    """Returns whether an object is a position, a direction or a rotation."""
    return {"x", "y"} <= value.keys() <= _VECTOR_KEYS


def format_value(value: JsonValue) -> str:
    """Formats a value in one line: a time as local time; null and empty lists as `-`."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value).lower()  # a boolean as in JSON
    if isinstance(value, float):
        return format_time(value) if _is_time(value) else f"{value:,.10g}".replace(",", "")
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, dict):
        return _format_object(value) or "-"
    is_simple = all(isinstance(item, str | int | float) for item in value)
    return (", " if is_simple else " | ").join(map(format_value, value)) or "-"


def _format_object(value: Mapping[str, JsonValue]) -> str:
    """Formats an object: `x 1.5, y 2, yaw_deg 90 (map)`, `label: cup; score: 0.9`."""
    if value.keys() == {"value"}:
        return format_value(value["value"])
    if _is_vector(value):
        axes = [f"{key} {format_value(value[key])}" for key in value if key != "frame_id"]
        frame = value.get("frame_id")
        return ", ".join(axes) + ("" if frame is None else f" ({format_value(frame)})")
    parts = []
    for key, inner in value.items():
        text = format_value(inner)
        parts.append(
            f"{escape(key)} ({text})" if isinstance(inner, dict) else f"{escape(key)}: {text}"
        )
    return "; ".join(parts)


def _is_time(value: JsonValue) -> bool:
    return isinstance(value, float) and _EARLIEST_TIME < value < _LATEST_TIME


def format_time(unix_s: float) -> str:
    """Formats a time in this machine's zone, to the microsecond: `2026-11-20T08:30:00.000000`.

    Every option that takes a time reads this form; it is one word for a shell. A local time that
    occurs twice, because clocks were set back, has its offset.
    """
    fraction, whole = math.modf(unix_s)  # `unix_s * 1e6` would round twice
    microseconds = int(whole) * 1_000_000 + round(fraction * 1e6)
    return local_time(microseconds * NS_PER_US).isoformat(timespec="microseconds")


def format_duration(seconds: float) -> str:
    """Formats a duration in the unit that suits it: `4.2 s`, `12 min`, `5.1 h`, `23 days`."""
    amount = abs(seconds)
    if amount < _MINUTES_FROM_S:
        return f"{seconds:.1f} s"
    if amount < _HOURS_FROM_S:
        return f"{seconds / 60:.0f} min"
    if amount < _DAYS_FROM_S:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86_400:.0f} days"


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
