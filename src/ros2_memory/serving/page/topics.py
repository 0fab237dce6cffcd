"""The topics for the page: how often each speaks, when it did in a span, and what can be plotted.

And the topics that can place the robot: those with poses, and satellite receivers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject, rounded
from ros2_memory.core.timebase import Ns, unix_from_ns
from ros2_memory.history.no_data import topics_of_robot, topics_that_show_poses, topics_with
from ros2_memory.history.scan import scan
from ros2_memory.history.view import Census, View
from ros2_memory.insights.fields import fields_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.history.context import Call, Memory

MOST_TOPICS: Final = 200
MOST_NUMBERS: Final = 60
BINS: Final = 60
_MOST_TIMES: Final = 20_000
"""Messages of a topic of which each is counted where it is; more are spread over their bags."""
_LARGEST_BYTES: Final = 1_000_000
"""A message that is decoded to see what numbers it has: images have none that are worth a plot."""
_PLOTTED: Final = frozenset({"number", "list of numbers"})
_QUICK_S: Final = 2.0


def topics_shown(memory: Memory, call: Call, window: TimeWindow) -> JsonObject:
    """Returns the topics with counts and rates, their messages in each bin of a window, and more.

    `numbers` are the fields that can be plotted, by the newest message; `places_robot` lists the
    topics that can place the robot, and whether they are poses or fixes. Where time runs out,
    messages are taken to be spread evenly over their bags.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    view = View(memory, replace(call, deadline=call.deadline.within(_QUICK_S)), window.stop)
    topics = view.timeline.topics()
    rows: list[JsonValue] = [
        {
            "topic": topic,
            "type": type_name,
            "count": census.count,
            "rate_hz": _rate(view, topic),
            "spoke": _spoke(view, topic, window).tolist(),
            "numbers": [*_numbers(view, topic)],
        }
        for topic in topics[:MOST_TOPICS]
        for type_name, census in [_newest_type(view, topic)]
    ]
    return {
        "topics": rows,
        "topics_total": len(topics),
        "places_robot": _places_robot(view),
    }


def _newest_type(view: View, topic: str) -> tuple[str, Census]:
    """Returns the type under which a topic was recorded last, and what is recorded under it."""
    return max(view.census(topic).items(), key=lambda each: each[1].last)


def _rate(view: View, topic: str) -> float | None:
    """Returns how often (Hz) a topic speaks while it is recorded; None for a single message."""
    timeline = view.timeline
    spans = timeline.recordings(topic)
    length = sum(last - first for first, last in spans.values())
    count = sum(total.messages for total in timeline.totals(topic).values())
    if count <= len(spans) or not length:
        return None
    return rounded((count - len(spans)) / unix_from_ns(length), 3)


def _spoke(view: View, topic: str, window: TimeWindow) -> NDArray[np.int64]:
    """Returns how many messages each bin of a window has."""
    extents = [*view.timeline.extents(topic, window)]
    held = sum(known.count for each in extents for known in each.bag.summary.of(topic))
    width = max((window.stop - window.start) // BINS, 1)
    longest = max((each.last - each.first for each in extents), default=0)
    if longest > width and held <= _MOST_TIMES:
        try:
            parts = [rows.times for rows in scan(view, topic, window, columns=False)]
        except QueryTimeoutError:
            pass
        else:
            return _binned(np.concatenate([np.zeros(0, np.int64), *parts]), window)
    spread = [
        np.linspace(each.first, each.last, min(known.count, BINS), dtype=np.int64)
        for each in extents
        for known in each.bag.summary.of(topic)
    ]
    return _binned(np.concatenate([np.zeros(0, np.int64), *spread]), window)


def _binned(times: NDArray[np.int64], window: TimeWindow) -> NDArray[np.int64]:
    length: Ns = window.stop - window.start
    inside = times[(times >= window.start) & (times < window.stop)] - window.start
    return np.bincount((inside / length * BINS).astype(np.int64).clip(0, BINS - 1), minlength=BINS)


def _numbers(view: View, topic: str) -> list[str]:
    """Returns the fields of a topic's newest message that are numbers, as dot-paths."""
    found = view.stream.newest(topic, TimeWindow.everything())
    if found is None or len(found.record.payload) > _LARGEST_BYTES:
        return []
    message = view.bags.decode(found)
    if message is None:
        return []
    value = view.extractor.exact(message, found.type)
    numbers = [path or "data" for path, kind in fields_of(value) if kind in _PLOTTED]
    return numbers[:MOST_NUMBERS]


def _places_robot(view: View) -> list[JsonValue]:
    """Returns the topics that can place the robot; those that are its own come first."""
    posed = [each.partition(" ")[0] for each in topics_with(view, "position")]
    posed = posed or [each.partition(" ")[0] for each in topics_that_show_poses(view)]
    own = {*topics_of_robot(view, "position")}
    posed.sort(key=lambda each: (each not in own, each))
    fixes = [each.partition(" ")[0] for each in topics_with(view, "geodetic")]
    kinds = {**dict.fromkeys(fixes, "fixes"), **dict.fromkeys(posed, "poses")}
    return [{"topic": each, "kind": kinds[each]} for each in dict.fromkeys([*posed, *fixes])]
