"""Which messages of some topics meet a condition, one by one, the newest first."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.history.matched import MET, UNKNOWN, Matching

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View


class Tested(NamedTuple):
    """A message of a search.

    Attributes:
        time: log time.
        topic: its topic.
        met: whether it meets the condition; None where it cannot be decoded.
    """

    time: Ns
    topic: str
    met: bool | None


def tested(
    view: View, search: ReverseSearch, topics: Sequence[str], window: TimeWindow
) -> Iterator[Tested]:
    """Yields the messages of topics in a window, newest first, and whether they meet a condition.

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    matching = Matching(view, search)
    sources = (_of_topic(matching, topic, window) for topic in topics)
    yield from heapq.merge(*sources, key=lambda each: -each.time)


def _of_topic(matching: Matching, topic: str, window: TimeWindow) -> Iterator[Tested]:
    for block in matching.newest_first(topic, window):
        times, met = block.tested()
        for time, found in zip(times[::-1].tolist(), met[::-1].tolist(), strict=True):
            yield Tested(time, topic, None if found == UNKNOWN else found == MET)
