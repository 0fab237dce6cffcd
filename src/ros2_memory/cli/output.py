"""Prints replies for people: tables for lists, lines for the rest; and what it does meanwhile.

And makes the files that a command writes. Recorded text comes from elsewhere: control characters in
it never reach the terminal.
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
"""Of a list that is cut."""
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
    """Prints lines for programs, on a terminal without control characters; returns how many."""
    count, is_screen = 0, sys.stdout.isatty()
    for line in lines:
        count += 1
        print(escape(line) if is_screen else line)
    sys.stdout.flush()
    return count


def csv_line(cells: Iterable[object]) -> str:
    """Returns a row of CSV, without the line's end."""
    line = StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


@contextmanager
def made_whole(path: Path) -> Iterator[Path]:
    """Yields where to write a file, which takes its place at the end, or is gone where that fails.

    Raises:
        BagError: it cannot be written, under its own name.
        OSError: likewise.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        yield temporary
        temporary.replace(path)
    except BagError as error:
        own = error.path == str(temporary)
        raise BagError(str(path) if own else error.path, error.reason) from error
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
    """Returns the console for answers; where it is no terminal, lines are not cut."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _PIPE_WIDTH
    return console


@contextmanager
def spinner(activity: str) -> Iterator[Callable[[str], None]]:
    """Shows on a terminal, and nowhere else, what the block is doing; yields what changes that."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    with console.status(escape(activity)) as status:
        yield lambda text: status.update(escape(text))


def print_reply(value: JsonValue, now: float | None = None) -> None:
    """Prints any reply. The ages of times count from `now` (Unix s), or from the reply's own."""
    value, console = with_level_names(value), stdout_console()
    if isinstance(value, dict):
        stated = value.get("now")
        _print_object(console, value, stated if isinstance(stated, float) else now)
    elif isinstance(value, list) and (rows := _objects(value)):
        _print_rows(console, rows)
    else:
        console.print(Text(format_value(value) if value else "none"))


def with_shorter_lists(reply: JsonObject, names: Iterable[str]) -> JsonObject:
    """Returns a reply whose lists of these names have the first rows alone; notes say so."""
    long = {
        name: rows
        for name in names
        if isinstance(rows := reply.get(name), list) and len(rows) > _MOST_ROWS
    }
    if not long:
        return reply
    notes = reply.get("notes")
    more = [f"{len(long[name]) - _MOST_ROWS} more {name}: --json prints them" for name in long]
    shorter: JsonObject = {name: rows[:_MOST_ROWS] for name, rows in long.items()}
    return reply | shorter | {"notes": [*(notes if isinstance(notes, list) else ()), *more]}


def _print_object(console: Console, value: Mapping[str, JsonValue], now: float | None) -> None:
    lists: dict[str, list[JsonObject]] = {}
    lines = Table.grid(padding=(0, 2))
    lines.add_column(style="bold", no_wrap=True)
    lines.add_column(overflow="fold")
    for key, inner in _flattened(_with_named_cells(value)).items():
        if isinstance(inner, list) and (rows := _objects(inner)):
            lists[key] = rows
        elif key == "notes" and isinstance(inner, list):
            for note in inner:
                lines.add_row("note", Text(with_local_times(str(note))))
        elif key == "detail" and isinstance(inner, str):  # why there is no answer
            lines.add_row(key, Text(with_local_times(inner)))
        else:
            line = _format_line(key, inner, now)
            lines.add_row(
                Text(escape(key)), Text(with_commands(line) if key in _WITH_TOOLS else line)
            )
    if lines.row_count:
        console.print(lines)
    for key, rows in lists.items():
        console.print(Text(f"\n{escape(key)}", style="bold"))
        _print_rows(console, rows)


def _objects(values: Sequence[JsonValue]) -> list[JsonObject]:
    """Returns the values where all are objects; else none."""
    rows = [row for row in values if isinstance(row, dict)]
    return rows if len(rows) == len(values) else []


def with_local_times(sentence: str) -> str:
    """Returns a sentence for a terminal, with times in this machine's zone, and commands."""
    local = _TIME_IN_NOTE.sub(lambda time: format_time(float(time[0])), sentence)
    return escape(with_commands(local))


def with_commands(sentence: str) -> str:
    """Returns a sentence with commands for the tools that it names, where there is one."""
    if _LISTS_TOOLS in sentence:
        return sentence
    return _TOOL_IN_NOTE.sub(lambda tool: _COMMANDS[tool[0]], sentence)


def _with_named_cells(value: Mapping[str, JsonValue]) -> Mapping[str, JsonValue]:
    """Returns a reply with an object for each row of its table, if it has one.

    Where a row has a time in two columns, only the exact one is shown.
    """
    shown = {**value}
    names = "columns" if "columns" in shown else "fields"
    fields, rows = shown.pop(names, None), shown.pop("rows", None)
    if not isinstance(fields, list) or not isinstance(rows, list):
        return value
    if isinstance(totals := shown.get(_ALL), list):  # a row of its own, without its name
        del shown[_ALL]
        rows = [*rows, [_ALL, *totals]]
    named = [
        dict(zip(map(str, fields), row, strict=False)) for row in rows if isinstance(row, list)
    ]
    for row in named:
        for name in [name for name in row if name.endswith("_unix")]:
            row[name.removesuffix("_unix")] = row.pop(name)
    return shown | {"rows": [*named]}


def _print_rows(console: Console, rows: Sequence[Mapping[str, JsonValue]]) -> None:
    """Prints a table, or one object after the other where it is wider than the terminal."""
    flattened = [_flattened(row) for row in rows]
    if len(_all_keys(flattened)) > _MAX_COLUMNS:
        flattened = [{**row} for row in rows]
    endless = console.options.update_width(_ENDLESS)
    for breaks_times in (False, True):
        table = _table(flattened, breaks_times=breaks_times)
        needed = Measurement.get(console, endless, table)
        if (needed.minimum if breaks_times else needed.maximum) <= console.width:
            console.print(table)
            return
    for row in rows:
        console.print()
        _print_object(console, row, None)


def _format_line(key: str, value: JsonValue, now: float | None) -> str:
    """Formats the value of a key; a time with its age."""
    if value is None or value == []:
        return "none"
    text = _format_for_key(key, value)
    if now is None or not isinstance(value, float) or not _is_time(value):
        return text
    age = now - value
    if abs(age) < _NO_AGE_BELOW_S:
        return text
    return f"{text} ({f'{format_duration(age)} ago' if age > 0 else f'in {format_duration(-age)}'})"


def _format_for_key(key: str, value: JsonValue) -> str:
    """Formats a value; of seconds, as under `duration_s`, long ones in minutes, hours or days.

    A time of a clock that was never set gets its unit.
    """
    if key in _KEYS_OF_TIMES and isinstance(value, int | float) and not _is_time(value):
        return f"{format_value(round(value, 3))} s after 1970"
    if (
        isinstance(value, int | float)
        and key.endswith("_s")
        and not key.endswith(_RATES)
        and abs(value) >= _MINUTES_FROM_S
        and not _is_time(value)
    ):
        return format_duration(value)
    return format_value(value)


def _table(rows: Sequence[Mapping[str, JsonValue]], *, breaks_times: bool) -> Table:
    """Returns objects as rows; their keys, in order of appearance, are the columns.

    A time may break between its date and its time of day.
    """
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    columns = []
    for key in _all_keys(rows):
        values = [row.get(key) for row in rows]
        has_times = any(map(_is_time, values))
        is_numeric = not has_times and all(
            isinstance(value, int | float) and not isinstance(value, bool)
            for value in values
            if value is not None
        )
        cells = [_format_for_key(key, value) for value in values]
        if has_times and breaks_times:
            cells = [cell.replace("T", "\n") for cell in cells]
        width = max(map(len, (key, *chain(*map(str.split, cells)))))
        table.add_column(
            Text(escape(key)),
            justify="right" if is_numeric else "left",
            overflow="fold",
            no_wrap=is_numeric,
            min_width=_TIME_OF_DAY_WIDTH if has_times else min(width, _MIN_TEXT_WIDTH),
        )
        columns.append(map(Text, cells))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    return table


def _all_keys(rows: Sequence[Mapping[str, JsonValue]]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))


def _flattened(value: Mapping[str, JsonValue]) -> JsonObject:
    """Returns an object whose small objects are keys with dots; positions stay objects."""
    flat: JsonObject = {}
    for key, inner in value.items():
        if (
            not isinstance(inner, dict)
            or not 0 < len(inner) <= _MAX_FLATTENED_KEYS
            or _is_vector(inner)
        ):
            flat[key] = inner
        elif inner.keys() == {"value"}:  # a message that has this one field
            flat[key] = inner["value"]
        else:
            flat.update((f"{key}.{name}", item) for name, item in _flattened(inner).items())
    return flat


def leaves(value: JsonValue, name: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Yields what an object holds, however deep, by dot-paths; of any other value itself."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}" if name else key)
    else:
        yield name, value


def _is_vector(value: Mapping[str, JsonValue]) -> bool:
    """Returns whether an object is a position, a direction or a rotation."""
    return {"x", "y"} <= value.keys() <= _VECTOR_KEYS


def format_value(value: JsonValue) -> str:
    """Formats one value as text; a time as local time, an absent or empty one as `-`."""
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
    if _is_vector(value):
        text = ", ".join(
            f"{key} {format_value(inner)}" for key, inner in value.items() if key != "frame_id"
        )
        frame = value.get("frame_id")
        return text if frame is None else f"{text} ({format_value(frame)})"
    if value.keys() == {"value"}:
        return format_value(value["value"])
    return "; ".join(
        f"{escape(key)} ({format_value(inner)})"
        if isinstance(inner, dict)
        else f"{escape(key)}: {format_value(inner)}"
        for key, inner in value.items()
    )


def _is_time(value: JsonValue) -> bool:
    """Returns whether a number of a reply is a time (Unix s)."""
    return isinstance(value, float) and _EARLIEST_TIME < value < _LATEST_TIME


def format_time(unix_s: float) -> str:
    """Formats a time in this machine's zone, to the microsecond.

    Every option that takes a time reads it, and it is one word for a shell. Where clocks were set
    back, and the time occurs twice, it has its offset.
    """
    fraction, whole = math.modf(unix_s)  # the product of the whole would be rounded twice
    microseconds = int(whole) * 1_000_000 + round(fraction * 1e6)
    return local_time(microseconds * NS_PER_US).isoformat(timespec="microseconds")


def format_duration(seconds: float) -> str:
    """Formats a duration in the unit that suits it: `4.2 s`, `12 min`, `5.1 h`, `23 days`."""
    amount = abs(seconds)
    if amount < _MINUTES_FROM_S:
        return f"{seconds:.1f} s"
    if amount < _HOURS_FROM_S:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if amount < _DAYS_FROM_S else f"{seconds / 86_400:.0f} days"


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
