"""The least and the greatest number that fields of a topic held in a window, and when.

All messages of the window count, not only those that a reply shows.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import leaves
from ros2_memory.core.errors import UndecodableError
from ros2_memory.results import Extremes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

MOST_MESSAGES: Final = 4_000
MOST_NUMBERS: Final = 400_000
"""What is gone through for one question: minutes of odometry, an hour of a slow topic."""

TOO_MANY: Final = "there is too much in the window to tell extremes: ask for a shorter one"

_LARGEST: Final = sys.float_info.max
_SUMMARY: Final = frozenset({"bytes", "numbers"})
"""The keys of what stands for numbers that are too many to show."""


def extremes_of(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str]
) -> tuple[Extremes, ...]:
    """The extremes of each of the fields (dot-paths) that holds numbers.

    None of any, with a note, where the window holds more than `MOST_NUMBERS`. Messages that cannot
    be decoded are passed over; so are NaN and infinities.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    found: dict[str, Extremes] = {}
    looked_at = 0
    for each in view.stream.messages([topic], window):
        channel = each.record.channel
        try:
            message = view.memory.reader.decode(each.record)
        except UndecodableError:
            continue
        for field in fields:
            value = view.memory.extractor.exact_at(message, channel.type, field)
            numbers = [*_numbers(value)]
            looked_at += len(numbers)
            if numbers:
                _take(found, field, each.time, numbers)
        if looked_at > MOST_NUMBERS:
            view.notes.add(TOO_MANY)
            return ()
    return tuple(found[field] for field in dict.fromkeys(fields) if field in found)


def _numbers(value: JsonValue) -> Iterator[float]:
    if isinstance(value, dict) and value.keys() <= _SUMMARY:
        return  # it tells how much there is, and that is none of the field's numbers
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _take(found: dict[str, Extremes], field: str, time: Ns, numbers: Sequence[float]) -> None:
    """Takes the numbers of the next message; of equal ones the first counts."""
    least, most = min(numbers), max(numbers)
    before = found.get(field)
    if before is None:
        found[field] = Extremes(field, least, time, most, time)
        return
    low = (least, time) if least < before.least else (before.least, before.least_at)
    high = (most, time) if most > before.most else (before.most, before.most_at)
    found[field] = Extremes(field, *low, *high)
