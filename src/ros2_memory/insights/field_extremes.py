"""The least and the greatest number that fields of a topic held in a window, and when.

All messages of the window count, not only those that a reply shows.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import leaves
from ros2_memory.results import Extremes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

MAX_MESSAGES: Final = 4_000
MAX_NUMBERS: Final = 400_000
"""How much one question reads: minutes of odometry, an hour of a slow topic."""

TOO_MANY: Final = "the window has too many messages to compute extremes: ask for a shorter one"

_LARGEST: Final = sys.float_info.max
_SUMMARY: Final = frozenset({"bytes", "numbers"})
"""The keys of a summary in place of numbers that are too many to show."""


def extremes_of(
    view: View, topic: str, window: TimeWindow, fields: Sequence[str]
) -> tuple[Extremes, ...]:
    """Returns the extremes of each of the fields (dot-paths) that holds numbers.

    None, with a note, where the window holds more than `MAX_NUMBERS`. Messages that cannot be
    decoded do not count, nor do NaN and infinities.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
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
    return tuple(found[field] for field in dict.fromkeys(fields) if field in found)


def numbers_in(value: JsonValue) -> Iterator[float]:
    """Yields the numbers of a field; not those of a summary in place of an array."""
    if isinstance(value, dict) and value.keys() <= _SUMMARY:
        return  # its numbers are counts, not the field's values
    for leaf in leaves(value):
        if isinstance(leaf, bool) or not isinstance(leaf, int | float):
            continue
        if -_LARGEST <= leaf <= _LARGEST:
            yield leaf


def _update(found: dict[str, Extremes], field: str, time: Ns, numbers: Sequence[float]) -> None:
    """Updates a field's extremes with the numbers of the next message; of equal ones the first."""
    before = found.get(field, Extremes(field, math.inf, time, -math.inf, time))
    least, most = min(numbers), max(numbers)
    low = (least, time) if least < before.least else (before.least, before.least_at)
    high = (most, time) if most > before.most else (before.most, before.most_at)
    found[field] = Extremes(field, *low, *high)
