"""Notes on recordings that hold a topic at the same time, as of several robots.

They are of one robot where a handover joins them, or where messages of one are in the other too.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns
from ros2_memory.history.duplicates import COPY_HORIZON_NS, copy_key
from ros2_memory.history.transforms import sessions_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

_NEAR_NS: Final[Ns] = 10 * NS_PER_S
"""How far around one message others count as recorded at the same time."""
_TRIED: Final = 3
"""How many messages are looked for in the other recording: a subscriber may miss one."""


def note_robots(view: View, topic: str, window: TimeWindow) -> None:
    """Notes the recordings that hold messages of their own on a topic at the same time.

    Nothing is noted of latched topics, which each recording receives anew, and where the time for
    the answer is over before it is known.
    """
    if topic in view.snapshot.timeline.transient_local:
        return
    apart: set[Path] = set()
    noted_before = view.notes.keys()
    try:
        for pair, both in _overlapping_pairs(view, topic, window):
            if not apart.issuperset(pair) and _differ(view, topic, pair, both):
                apart.update(pair)
    except QueryTimeoutError:
        return
    finally:
        # The answer itself needed nothing of what was read here.
        view.notes.retract_before(MAX_NS, noted_before)
    if apart:
        names = sorted(each.name for each in apart)
        view.notes.add(
            f"{len(names)} recordings hold messages of their own on {topic} at the same time, "
            f"as of several robots, and the answer does not tell them apart: {listed(names)}"
        )


def note_robots_near(view: View, found: StoredMessage) -> None:
    """Does as `note_robots`, around the time of a message; a single recording is of one robot."""
    topic = found.record.channel.topic
    if len(view.snapshot.timeline.recordings(topic)) > 1:
        note_robots(view, topic, TimeWindow.around(found.time, _NEAR_NS))


def _overlapping_pairs(
    view: View, topic: str, window: TimeWindow
) -> Iterator[tuple[tuple[Path, Path], TimeWindow]]:
    """Yields pairs of recordings that hold a topic at the same time, and when."""
    open_spans: list[tuple[Ns, Path]] = []
    spans = [(*span, path) for path, span in view.snapshot.timeline.recordings(topic).items()]
    for first, last, path in sorted(each for each in spans if window.overlaps(each[0], each[1])):
        open_spans = [each for each in open_spans if each[0] >= first]
        for until, other in open_spans:
            start, stop = max(first, window.start), min(last + 1, until + 1, window.stop)
            if start < stop:
                yield (path, other), TimeWindow(start, stop)
        open_spans.append((last, path))


def _differ(view: View, topic: str, pair: tuple[Path, Path], both: TimeWindow) -> bool:
    """Whether two recordings hold messages in a window, and the other none of the one's."""
    if sessions_of(view).are_joined(*pair):
        return False
    one, other = pair
    if next(_messages(view, topic, other, both), None) is None:
        return False
    some = list(islice(_messages(view, topic, one, both), _TRIED))
    return bool(some) and not any(_has_duplicate(view, topic, other, each) for each in some)


def _has_duplicate(view: View, topic: str, recording: Path, found: StoredMessage) -> bool:
    """Whether a recording holds a duplicate of a message."""
    near = TimeWindow.around(found.time, COPY_HORIZON_NS)
    key = copy_key(found.record)
    return any(copy_key(each.record) == key for each in _messages(view, topic, recording, near))


def _messages(
    view: View, topic: str, recording: Path, window: TimeWindow
) -> Iterator[StoredMessage]:
    bags = view.stream.overlapping_bags([topic], window)
    own = [each for each in bags if each.bag.recording == recording]
    return view.stream.merged(own, [topic], window, newest_first=False)
