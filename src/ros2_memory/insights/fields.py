"""Fields of messages, as the dot-paths that tools take: which a type has, and their extremes."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import NoDataError, NoDataReason, UndecodableError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import dotted, listed
from ros2_memory.counts.numbers import GREATEST, LEAST, PieceNumbers, TooManyError
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.view import View, open_view
from ros2_memory.results import Extremes, TypeFields

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.history.context import Call, Memory

MAX_FIELDS: Final = 100
MAX_MESSAGES: Final = 4_000
"""How many one question reads where columns do not hold a field: minutes of odometry, an hour of a
slow topic."""

TOO_MANY: Final = "the window has too many messages to compute extremes: ask for a shorter one"


def describe_type(memory: Memory, call: Call, type_name: str) -> TypeFields:
    """Returns the fields of a recorded message type, from the newest message of it.

    Raises:
        NoDataError: no topic was recorded under the type, or none of its messages can be decoded.
    """
    view = open_view(memory, call, memory.clock.now())
    timeline = view.timeline
    topics = [topic for topic, types in timeline.types.items() if type_name in types]
    if not topics:
        recorded = sorted(set(chain.from_iterable(timeline.types.values())))
        raise NoDataError(
            NoDataReason.TOPIC_NOT_RECORDED,
            "no topic was recorded under this type; there are "
            f"{listed(recorded, at_most=MAX_FIELDS)}",
        )
    failure = ""
    for topic in topics:
        # A topic may have changed its type since.
        last = timeline.totals(topic)[type_name].last
        messages = view.stream.messages([topic], TimeWindow.until(last), newest_first=True)
        newest = next((stored for stored in messages if stored.type == type_name), None)
        if newest is None:
            continue
        try:
            message = memory.reader.decode(newest.record)
        except UndecodableError as error:
            failure = error.reason
            continue
        value = memory.extractor.exact(message, type_name)
        fields = dict(fields_of(value))
        if len(fields) > MAX_FIELDS:
            view.notes.add(f"{MAX_FIELDS} of {len(fields)} fields")
        shown = tuple(fields.items())[:MAX_FIELDS]
        return TypeFields(type_name, tuple(topics), shown, notes=view.notes.sentences())
    raise NoDataError(
        NoDataReason.UNDECODABLE,
        f"no newest message of this type can be read: {failure or 'none is left'}",
    )


def fields_of(value: JsonValue, path: str = "") -> Iterator[tuple[str, str]]:
    """Yields dot-paths and the kinds of their values; a list is described by its first element."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from fields_of(inner, dotted(path, name))
    elif isinstance(value, list):
        if value and isinstance(value[0], dict | list):
            yield from fields_of(value[0], path)
        else:
            yield path, f"list of {_kind(value[0])}s" if value else "list"
    else:
        yield path, _kind(value)


def _kind(value: JsonValue) -> str:
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, str):
        return "text"
    return "number"


def extremes_of(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str]
) -> tuple[Extremes, ...]:
    """Returns the extremes of each of the fields (dot-paths) that holds numbers.

    None, with a note, where more than `MAX_MESSAGES` would have to be read from bags. Messages that
    cannot be decoded do not count, nor do NaN and infinities.

    Args:
        view: the call's.
        topic: its name.
        window: of log time.
        fields: dot-paths.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    names = tuple(dict.fromkeys(fields))
    whole = np.empty(0, np.int64)
    piece_numbers = PieceNumbers(view, topic, names, whole, most_read=MAX_MESSAGES)
    try:
        piece_numbers.collect(window)
    except TooManyError:
        view.notes.add(TOO_MANY)
        return ()
    if piece_numbers.since is not None:
        view.notes.add_lack(
            f"out of time: extremes are of what is after {unix_text(piece_numbers.since)}"
        )
    extremes = []
    for nth, field in enumerate(names):
        least, most = (piece_numbers.extreme(nth, [0], sign) for sign in (LEAST, GREATEST))
        if least is not None and most is not None:
            extremes.append(Extremes(field, *least, *most))
    return tuple(extremes)
