"""When each label was in view in a span, for the rows of the timeline; also without a place."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.intervals import united
from ros2_memory.core.reply import JsonObject, rounded
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.view import View
from ros2_memory.insights.recap import found_events

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.core.model import JsonValue, TimeWindow
    from ros2_memory.history.context import Call, Memory

MOST_LABELS: Final = 60
_BARS: Final = 400
"""At most so many bars of a label: what lies nearer than a pixel or two is drawn as one."""
_PATIENT_S: Final = 8.0


def labels_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the labels that were in view longest, with how often, how long (s) and when.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    view = View(memory, replace(call, deadline=call.deadline.within(_PATIENT_S)), window.stop)
    least = memory.limits.min_score
    found = [each.visible for each in found_events(view, window).values() if each is not None]
    seen = united([each.scoring(least) if least else each for each in found])
    rows = [_row(label, *spans, window) for label, spans in seen.spans().items() if len(spans[0])]
    rows.sort(key=lambda row: (-float(str(row["seconds"])), str(row["label"])))
    shown: list[JsonValue] = [*rows[:MOST_LABELS]]
    return {
        "end": unix_from_ns(window.stop),
        "labels": shown,
        "labels_total": len(rows),
    }


def _row(
    label: str, first: NDArray[np.int64], last: NDArray[np.int64], window: TimeWindow
) -> JsonObject:
    """Returns a row of a label, whose intervals are in order and do not overlap."""
    start, stop = first.clip(window.start), last.clip(None, window.stop)
    is_apart = start[1:] - stop[:-1] > (window.stop - window.start) // _BARS
    begins, ends = start[np.append(True, is_apart)], stop[np.append(is_apart, True)]
    pairs = zip(begins.tolist(), ends.tolist(), strict=True)
    return {
        "label": label,
        "sightings": len(first),
        "seconds": rounded(unix_from_ns(int((stop - start).sum())), 1),
        "bars": [[round(unix_from_ns(each), 3) for each in pair] for pair in pairs],
    }
