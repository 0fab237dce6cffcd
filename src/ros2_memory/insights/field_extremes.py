"""The least and the greatest number that fields of a topic held in a window, and when.

All messages of the window count, not only those that a reply shows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.counts.column_numbers import GREATEST, LEAST, PieceNumbers, TooManyError
from ros2_memory.history.coverage import unix_text
from ros2_memory.results import Extremes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.view import View

MAX_MESSAGES: Final = 4_000
"""How many one question reads where columns do not hold a field: minutes of odometry, an hour of a
slow topic."""

TOO_MANY: Final = "the window has too many messages to compute extremes: ask for a shorter one"


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
    found = PieceNumbers(view, topic, names, whole, most_read=MAX_MESSAGES)
    try:
        found.collect(window)
    except TooManyError:
        view.notes.add(TOO_MANY)
        return ()
    if found.since is not None:
        view.notes.add_lack(f"out of time: extremes are of what is after {unix_text(found.since)}")
    extremes = []
    for nth, field in enumerate(names):
        least, most = (found.extreme(nth, [0], sign) for sign in (LEAST, GREATEST))
        if least is not None and most is not None:
            extremes.append(Extremes(field, *least, *most))
    return tuple(extremes)
