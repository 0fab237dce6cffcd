"""The least and the greatest number that fields of a topic held in a window, and when.

All messages of the window count, not only those that a reply shows.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.counts.column_numbers import GREATEST, LEAST, PieceNumbers, TooManyError
from ros2_memory.counts.field_numbers import numbers_in
from ros2_memory.history.coverage import unix_text
from ros2_memory.results import Extremes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

MAX_MESSAGES: Final = 4_000
MAX_NUMBERS: Final = 400_000
"""How much one question reads where columns do not hold a field: minutes of odometry, an hour of a
slow topic."""

TOO_MANY: Final = "the window has too many messages to compute extremes: ask for a shorter one"


def extremes_of(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str], total: int
) -> tuple[Extremes, ...]:
    """Returns the extremes of each of the fields (dot-paths) that holds numbers.

    None, with a note, where more than `MAX_MESSAGES` would have to be read from bags. Messages that
    cannot be decoded do not count, nor do NaN and infinities.

    Args:
        view: the call's.
        topic: its name.
        window: of log time.
        fields: dot-paths.
        total: how many messages the window holds.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    names = tuple(dict.fromkeys(fields))
    if view.memory.columns is None:
        if total > MAX_MESSAGES:
            view.notes.add(TOO_MANY)
            return ()
        return _read_extremes(view, topic, window, names)
    whole = np.empty(0, np.int64)
    found = PieceNumbers(view, topic, names, whole, most_read=MAX_MESSAGES, only_extremes=True)
    try:
        found.collect(window)
    except TooManyError:
        view.notes.add(TOO_MANY)
        return ()
    if found.since is not None:
        view.notes.complete = False
        view.notes.add(f"out of time: extremes are of what is after {unix_text(found.since)}")
    extremes = []
    for nth, field in enumerate(names):
        least, most = (found.extreme(nth, [0], sign) for sign in (LEAST, GREATEST))
        if least is not None and most is not None:
            extremes.append(Extremes(field, *least, *most))
    return tuple(extremes)


def _read_extremes(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str]
) -> tuple[Extremes, ...]:
    """Does as `extremes_of` where there are no columns: in a lake."""
    found: dict[str, Extremes] = {}
    count = 0
    for each in view.stream.messages([topic], window):
        channel = each.record.channel
        message = view.bags.decode(each)
        if message is None:
            continue
        for field in fields:
            value = view.memory.extractor.exact_at(message, channel.type, field)
            numbers = [*numbers_in(value)]
            count += len(numbers)
            if numbers:
                _update(found, field, each.time, numbers)
        if count > MAX_NUMBERS:
            view.notes.add(TOO_MANY)
            return ()
    return tuple(found[field] for field in fields if field in found)


def _update(found: dict[str, Extremes], field: str, time: Ns, numbers: Sequence[float]) -> None:
    """Updates a field's extremes with the numbers of the next message; of equal ones the first."""
    before = found.get(field, Extremes(field, math.inf, time, -math.inf, time))
    least, most = min(numbers), max(numbers)
    low = (least, time) if least < before.least else (before.least, before.least_at)
    high = (most, time) if most > before.most else (before.most, before.most_at)
    found[field] = Extremes(field, *low, *high)
