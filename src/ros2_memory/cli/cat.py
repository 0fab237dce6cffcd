"""`ros2-memory cat`: the messages of one topic, as lines for people, CSV, or JSON lines."""

import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, TypeAlias

import typer

from ros2_memory.cli.csv_line import csv_line
from ros2_memory.cli.options import Bags, Times
from ros2_memory.cli.output import (
    filled_leaves,
    format_time,
    format_value,
    print_exactly,
    print_notes,
    with_plain_numbers,
)
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns
from ros2_memory.extract import SchemaExtractor
from ros2_memory.history.bag_access import StoredMessage
from ros2_memory.history.context import Call
from ros2_memory.history.coverage import note_unread
from ros2_memory.history.no_data import resolve_topic
from ros2_memory.history.robots import note_times_twice
from ros2_memory.history.view import View
from ros2_memory.tools.reply_size import to_json_text

Row: TypeAlias = tuple[Ns, JsonValue]
"""The log time of a message, and its extracted value."""


def cat(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="The name of the topic, such as /odom.")
    ],
    *,
    field: Annotated[
        list[str] | None, "PATH", "Print only this field, such as pose.covariance; repeatable."
    ] = None,
    times: Times,
    limit: Annotated[int | None, "--limit", "-n", "N", "Print only the first N messages."] = None,
    tail: Annotated[int | None, "N", "Print only the newest N messages."] = None,
    as_csv: Annotated[
        bool, "--csv", "Print CSV: time in Unix seconds, a column for each field."
    ] = False,
    as_json: Annotated[bool, "--json", "Print JSON lines: time (Unix s), time_ns, value."] = False,
    bags: Bags,
) -> bool:
    """Print the messages of a topic in a time window, each once, by log time.

    By default it prints the fields that the tools' replies show; --field selects others, and a
    wrong one lists all. CSV and JSON have the exact numbers; text rounds them and shortens arrays.
    """
    if as_csv and as_json:
        raise InvalidArgumentsError("give --csv or --json, not both")
    if limit is not None and tail is not None:
        raise InvalidArgumentsError("give --limit or --tail, not both")
    most = limit if tail is None else tail
    if most is not None and most < 1:
        raise InvalidArgumentsError("--limit and --tail must be more than 0")
    memory = bags.memory()
    view = View(memory, Call())
    name = resolve_topic(view, topic)
    window = times.window(memory)
    found = view.stream.messages([name], window, newest_first=tail is not None)
    exact = as_csv or as_json
    rows: Iterable[Row] = extract_values(view, found, field or (), exact=exact, most=most)
    if tail is not None:
        rows = reversed([*rows])
    if as_csv:
        lines = _csv_lines(rows)
    elif as_json:
        lines = (
            to_json_text({"time": unix_from_ns(time), "time_ns": time, "value": value})
            for time, value in rows
        )
    else:
        lines = (
            f"{format_time(unix_from_ns(time))}  {format_value(with_plain_numbers(value))}"
            for time, value in rows
        )
    count = print_exactly(lines)
    note_unread(view, window)
    note_times_twice(view, window)
    print_notes(view.notes.sentences())
    if not count and view.notes.complete:
        advice = "`ros2-memory topics` says when there are some"
        print(f"no message of {name} in this time; {advice}", file=sys.stderr)
    return not count or not view.notes.complete


def extract_values(
    view: View,
    messages: Iterable[StoredMessage],
    fields: Sequence[str],
    *,
    exact: bool,
    most: int | None = None,
) -> Iterator[Row]:
    """Yields the values of messages: the fields at these dot-paths, or those that replies show.

    `exact`: numbers are not rounded, and arrays are whole. At most `most` rows; None for all.
    Messages that cannot be decoded, or lack a field, are counted in notes.

    Raises:
        InvalidArgumentsError: no message has such fields.
    """
    count, undecodable, refusals = 0, 0, Counter[str]()
    for stored in messages:
        message = view.bags.decode(stored)
        if message is None:
            undecodable += 1
            continue
        try:
            value = _value_of(view.extractor, message, stored.type, fields, exact=exact)
        except InvalidArgumentsError as refusal:
            refusals[str(refusal)] += 1
            if not count and len(view.timeline.types_of(stored.topic)) == 1:
                break  # the others have no other type
            continue
        yield stored.time, value
        count += 1
        if count == most:
            break
    if refusals and not count:
        raise InvalidArgumentsError(next(iter(refusals)))
    for reason, number in refusals.items():
        view.notes.add(f"{counted(number, 'message')} left out: {reason}")
    if undecodable:
        view.notes.complete = False
        what = counted(undecodable, "message")
        view.notes.add(f"{what} left out that cannot be decoded: `ros2-memory info` shows why")


def _value_of(
    extractor: SchemaExtractor,
    message: object,
    type_name: str,
    fields: Sequence[str],
    *,
    exact: bool,
) -> JsonValue:
    """Returns the value of a message as `extract_values` yields it.

    Raises:
        InvalidArgumentsError: the message lacks a field.
    """
    if not exact:
        return extractor.shown(message, type_name, fields).value
    if not fields:
        return extractor.exact(message, type_name)
    values = {path: extractor.exact_at(message, type_name, path) for path in fields}
    if None in values.values():
        extractor.shown(message, type_name, fields)  # refuses a field that is absent
    return values


def _csv_lines(rows: Iterable[Row]) -> Iterator[str]:
    """Yields a header and a line for each row, with the fields of the first row as columns.

    Fields of nested messages have dot-paths; a cell with a list has JSON. Fields that only later
    rows have are named in a note at the end.
    """
    columns: list[str] | None = None
    without_column: set[str] = set()
    for time, value in rows:
        cells = {path or "value": inner for path, inner in filled_leaves(value).items()}
        if columns is None:
            columns = [*cells]
            yield csv_line(["time", *columns])
        without_column.update(cells.keys() - columns)
        seconds, nanoseconds = divmod(time, NS_PER_S)
        yield csv_line([f"{seconds}.{nanoseconds:09d}", *map(cells.get, columns)])
    if without_column:
        names = listed(sorted(without_column))
        print_notes([f"no column, as the first message has no such field: {names}"])
