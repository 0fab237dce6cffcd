"""Fields of messages, as the dot-paths that tools take: which a type has, and their extremes."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import NoDataError, NoDataReason, UndecodableError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import leaves, listed
from ros2_memory.counts.numbers import (
    GREATEST,
    LEAST,
    PieceNumbers,
    TooManyError,
    number_paths,
)
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.view import View, days_back, open_view
from ros2_memory.results import Extremes, TypeFields

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Call, Memory

MAX_FIELDS: Final = 100
MAX_MESSAGES: Final = 4_000
"""How many messages a question reads if columns lack a field: minutes of odometry, an hour of a
slow topic."""

TOO_MANY: Final = "the window has too many messages to compute extremes: ask for a shorter one"


def describe_type(memory: Memory, call: Call, type_name: str) -> TypeFields:
    """Returns the fields of a recorded message type, from the newest message of it.

    Raises:
        NoDataError: no topic was recorded under the type, or none of its messages can be decoded.
    """
    view, topics = _view_with(open_view(memory, call, memory.clock.now()), type_name)
    if not topics:
        recorded = sorted(set(chain.from_iterable(view.timeline.types.values())))
        raise NoDataError(
            NoDataReason.TOPIC_NOT_RECORDED,
            "no topic was recorded under this type; there are "
            f"{listed(recorded, at_most=MAX_FIELDS)}",
        )
    failure = "none is left"
    for topic in topics:
        newest = _newest_of_type(view, topic, type_name)
        if newest is None:
            continue
        try:
            memory.reader.decode(newest.record)
        except UndecodableError as error:
            failure = error.reason
            continue
        fields = dict(fields_of(view.example(newest)))
        if len(fields) > MAX_FIELDS:
            view.notes.add(f"{MAX_FIELDS} of {len(fields)} fields")
        shown = tuple(fields.items())[:MAX_FIELDS]
        return TypeFields(type_name, tuple(topics), shown, notes=view.notes.sentences())
    raise NoDataError(
        NoDataReason.UNDECODABLE, f"no newest message of this type can be read: {failure}"
    )


def _view_with(view: View, type_name: str) -> tuple[View, list[str]]:
    """Returns a view of the newest days that have topics of a type, and these topics.

    Where there are none: the view that was given.
    """
    for days in days_back(view):
        topics = [topic for topic, types in days.timeline.types.items() if type_name in types]
        if topics:
            return days, topics
    return view, []


def _newest_of_type(view: View, topic: str, type_name: str) -> StoredMessage | None:
    """Returns a topic's newest message of a type: the topic may have changed its type since."""
    last = view.timeline.totals(topic)[type_name].last
    messages = view.stream.messages([topic], TimeWindow.until(last), newest_first=True)
    return next((stored for stored in messages if stored.type == type_name), None)


def fields_of(value: JsonValue, path: str = "") -> Iterator[tuple[str, str]]:
    """Yields dot-paths and the kinds of their values; a list has its first element's fields."""
    for field, inner in leaves(value, path):
        if not isinstance(inner, list):
            if inner != {}:
                yield field, _kind(inner)
        elif inner and isinstance(inner[0], dict | list):
            yield from fields_of(inner[0], field)
        else:
            yield field, f"list of {_kind(inner[0])}s" if inner else "list"


def _kind(value: JsonValue) -> str:
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, str):
        return "text"
    return "number"


def extremes_of(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str]
) -> tuple[Extremes, ...]:
    """Returns the extremes of each field (dot-path) of a topic that holds numbers.

    Of an object each number has its own. Messages that cannot be decoded do not count, nor do NaN
    and infinities. If more than `MAX_MESSAGES` would have to be read from bags, there are no
    extremes, and a note says so.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    names = number_paths(view, topic, fields, window.stop)
    whole = np.empty(0, np.int64)  # no bounds between bins
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
