"""Takes values out of replies: what the script reads, and nothing that it reckons.

Where a name has more than one spelling among tools, all are tried.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from tests.home.judging import unix_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue

Row: TypeAlias = "dict[str, JsonValue]"

IN: tuple[str, ...] = ("in", "room", "place_name")
SINCE: tuple[str, ...] = ("since", "from", "first_seen", "start", "arrived", "timestamp")


class UnreadableError(Exception):
    """A reply has no such value: the tool does not report it."""


def row(value: JsonValue) -> Row:
    """Returns an object.

    Raises:
        UnreadableError: it is none.
    """
    if not isinstance(value, dict):
        raise UnreadableError(f"{value!r} is no object")
    return value


def get(found: Row, *names: str) -> JsonValue:
    """Returns the value under the first of the names that is there.

    Raises:
        UnreadableError: none is.
    """
    for name in names:
        if name in found:
            return found[name]
    raise UnreadableError(f"none of {', '.join(names)} in {', '.join(found)}")


def rows(found: Row, *names: str) -> list[Row]:
    """Returns a list of objects under the first of the names that is there.

    Raises:
        UnreadableError: none is, or it is no list of objects.
    """
    listed = get(found, *names)
    if not isinstance(listed, list):
        raise UnreadableError(f"{names[0]} is no list")
    return [row(each) for each in listed]


def first(listed: Sequence[Row]) -> Row:
    """Returns the first object of a list.

    Raises:
        LookupError: it is empty.
    """
    if not listed:
        raise LookupError("nothing was found")
    return listed[0]


def number(found: Row, *names: str) -> float:
    """Returns a number.

    Raises:
        UnreadableError: it is none.
    """
    value = get(found, *names)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UnreadableError(f"{names[0]} is {value!r}")
    return float(value)


def text(found: Row, *names: str) -> str:
    """Returns a text; that of an object is its `name`.

    Raises:
        UnreadableError: it is none.
    """
    value = get(found, *names)
    if isinstance(value, dict):
        value = value.get("name")
    if isinstance(value, list) and value:
        value = value[0]
    if not isinstance(value, str):
        raise UnreadableError(f"{names[0]} is {value!r}")
    return value


def places(found: Row) -> str:
    """Returns the names of the place that something is in, and of those around it.

    Raises:
        UnreadableError: the reply names no place.
    """
    around = found.get("also_in")
    return ", ".join([place(found), *map(str, around if isinstance(around, list) else ())])


def place(found: Row) -> str:
    """Returns the name of the place that something is in, wherever the reply has it.

    Raises:
        UnreadableError: the reply names no place.
    """
    for holder in ("", "place", "robot", "position", "pose"):
        inner = found if not holder else found.get(holder)
        if isinstance(inner, dict) and any(name in inner for name in IN):
            return text(inner, *IN)
    raise UnreadableError(f"no place in {', '.join(found)}")


def time(found: Row, *names: str) -> float:
    """Returns a time in Unix seconds.

    Raises:
        UnreadableError: it is none.
    """
    at = unix_of(get(found, *names))
    if at is None:
        raise UnreadableError(f"{names[0]} is no time")
    return at


def things(reply: Row) -> list[Row]:
    """Returns the things of `find_things`."""
    return rows(reply, "things", "instances")


def stays(thing: Row) -> list[Row]:
    """Returns the places of a thing, oldest first; a thing that was not moved has one."""
    listed = rows(thing, "moved") if "moved" in thing else [thing]
    return sorted(listed, key=lambda each: time(each, *SINCE))


def bins(reply: Row, *names: str) -> dict[str, JsonValue]:
    """Returns the value of each bin of a reply that was asked `by` something, by its name.

    The column is the first with one of the names, also as what is said of a field (`charge.min`).

    Raises:
        UnreadableError: it has no such column, or rows of another length.
    """
    columns, listed = get(reply, "columns"), get(reply, "rows")
    if not isinstance(columns, list) or not isinstance(listed, list):
        raise UnreadableError("columns or rows is no list")
    wanted = (each for each in columns if str(each).rpartition(".")[2] in names)
    column = next(wanted, None)
    if column is None:
        raise UnreadableError(f"no column {names[0]} in {', '.join(map(str, columns))}")
    at = columns.index(column)
    return {str(each[0]): each[at] for each in listed if isinstance(each, list)}
