"""Until when what a topic says lasts: at most until its next message.

It ends before that, in this order:

1. with its own message, if the next one comes after more than the pause of its session. There is no
   such pause where the topic is latched, nor where its messages are rare and it says a state (a
   boolean, a value, what `while` asks for). Else it is `SILENCE_NS`, or one and a half periods of a
   topic that is published regularly, if these are longer;
2. where messages of the topic were deleted;
3. in a pause of more than `SILENCE_NS`, at any other of its `breaks_of`: where the clock was wrong;
   and unless the topic is latched, where another run of the recorder begins, a gap begins (not of
   texts and goals), or the topic falls silent for longer than usual.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from heapq import nlargest
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple
from weakref import proxy

import numpy as np

from ros2_memory.analysis.facts import GOALS
from ros2_memory.analysis.intervals import PACED, SILENCE_NS, pause_of
from ros2_memory.bag_dir.state_files import excluded_between
from ros2_memory.core.memo import Key
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, lies_inside, united, without
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.coverage import cut_spans, deleted_by_gap
from ros2_memory.history.scan import open_scan, scan

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from ros2_memory.core.arrays import Flags, Ints
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Pace
    from ros2_memory.storage.base import IntArray

TEXT: Final = "std_msgs/msg/String"
_MOST_PACED: Final = 1000
"""The newest messages of a session that say whether a topic is regular."""
_MOST_JUDGED: Final = 20
"""The newest sessions that say whether the texts of a topic are events."""


class _Heard(NamedTuple):
    """How a session has a topic that is not latched, from its first message to the session's end.

    Attributes:
        start, stop: log times.
        is_frequent: whether a message comes more often than every `RARE_NS`.
        messages: how many of the topic there are.
    """

    start: Ns
    stop: Ns
    is_frequent: bool
    messages: int


_NOWHERE: Final = _Heard(0, 0, is_frequent=False, messages=0)
_HEARD: Final[Key[dict[str, list[_Heard]]]] = Key()
"""Of a timeline: by topic, the sessions that have it."""
_PAUSES: Final[Key[dict[tuple[str, _Heard], Ns]]] = Key()
"""Of a timeline: by topic and session, its `pause_of`."""
_DELETIONS: Final[Key[dict[str, list[Ns]]]] = Key()
"""Of a view: by topic, its `deletions`."""


class Lasting:
    """Says until when the messages of topics last, the newest of which counts.

    Args:
        view: the call's.
        topics: their names.
        states: whether they say states.
        texts: whether they do so for any pause where they are texts, however frequent.

    Attributes:
        longest: the longest pause (ns) through which one of their messages may last.
        frequent: the times in which no state lasts through more than `SILENCE_NS`.
        breaks: the moments, in order, after which what was said before is not known to last.
    """

    def __init__(
        self, view: View, topics: Collection[str], *, states: bool = True, texts: bool = False
    ) -> None:
        # The view refers to it: without a circle, what was read is freed as the call ends.
        self._view: View = proxy(view)
        self._topics = topics
        ending = [topic for topic in topics if not (texts and is_text(view, topic))]
        self._heard = [heard for topic in ending for heard in _heard_in(view, topic)]
        self._near = _NOWHERE  # the session of the last lookup
        may_last = states or all(is_latched(view, topic) for topic in topics)
        self.longest = MAX_NS if may_last else SILENCE_NS
        self.frequent = united(heard[:2] for heard in self._heard if heard.is_frequent)
        self.breaks = sorted({*chain.from_iterable(breaks_of(view, topic) for topic in topics)})
        self._cuts = sorted(chain.from_iterable(deletions(view, topic) for topic in topics))

    def end_at(self, at: Ns) -> None:
        """Ends at a log time whatever was said before."""
        insort(self.breaks, at)
        insort(self._cuts, at)

    def pause(self, at: Ns) -> Ns:
        """Returns the longest pause (ns) through which a message at a log time lasts."""
        if lies_inside(self.frequent, at):
            return SILENCE_NS
        if self.longest == MAX_NS:
            return MAX_NS
        if not self._near.start <= at < self._near.stop:
            near = (heard for heard in self._heard if heard.start <= at < heard.stop)
            self._near = next(near, _NOWHERE)
        [topic] = self._topics
        return _pause_in(self._view, topic, self._near)

    def ends(self, times: Ints) -> Flags:
        """Returns for each log time but the last whether what was said ends before the next."""
        pauses = np.diff(times)
        ended = np.diff(np.searchsorted(self._cuts, times)) > 0
        for nth in np.flatnonzero(pauses > SILENCE_NS).tolist():
            _, is_reached = self.until(*times[nth : nth + 2].tolist())
            ended[nth] = not is_reached
        return ended

    def until(self, last: Ns, following: Ns) -> tuple[Ns, bool]:
        """Returns until when a message lasts, and whether the next one ends it.

        Args:
            last: log time of the message.
            following: log time of the next one; `MAX_NS` without one.
        """
        if following - last > self.pause(last):
            return last, False
        breaks = self.breaks if following - last > SILENCE_NS else self._cuts
        nth = bisect_left(breaks, last)
        if nth < len(breaks) and breaks[nth] < following:
            return breaks[nth], False
        if following == MAX_NS:
            return max(last, self._view.snapshot.latest or last), False
        return following, True


_LASTING: Final[Key[dict[tuple[str, bool], Lasting]]] = Key()
"""Of a view: by topic, and whether it says states."""


def _heard_in(view: View, topic: str) -> list[_Heard]:
    """Returns the sessions that have a topic; none, if it is latched.

    Another session decides nothing: its driver may be another one, and it may be deleted.
    """
    known = view.timeline.memo.of(_HEARD, dict)
    if topic not in known:
        # A wrong clock spreads a recording over years: it counts if its session has no other.
        misdated = {fault.bag.recording for fault in view.snapshot.dating.faults}
        recordings = view.timeline.paces(topic).items()
        paces: dict[Session, Pace] = {}
        for recording, pace in sorted(recordings, key=lambda item: item[0] in misdated):
            session = view.sessions.session_of(recording)
            if session not in paces:
                paces[session] = pace
            elif recording not in misdated:
                paces[session] |= pace
        known[topic] = [
            _Heard(pace.topic.first, pace.end + 1, not pace.is_rare, pace.topic.messages)
            for pace in paces.values()
        ]
    return [] if is_latched(view, topic) else known[topic]


def _pause_in(view: View, topic: str, heard: _Heard) -> Ns:
    """Returns the `pause_of` the newest messages of a topic in a session."""
    if heard.messages < PACED:
        return SILENCE_NS
    known = view.timeline.memo.of(_PAUSES, dict)
    if (topic, heard) not in known:
        parts: list[IntArray] = [np.empty(0, np.int64)]
        window = TimeWindow(heard.start, heard.stop)
        scanned = open_scan(view, topic, window, columns=False).rows(newest_first=True)
        for rows in scanned:
            parts.append(rows.times)
            if sum(map(len, parts)) > _MOST_PACED:
                break
        known[topic, heard] = pause_of(np.sort(np.concatenate(parts))[-_MOST_PACED:])
    return known[topic, heard]


def breaks_of(view: View, topic: str) -> list[Ns]:
    """Returns the moments, in order, after which an earlier value is not known to hold.

    Messages were deleted then, or the clock was wrong: misdated bags before the memory end, or
    those after it begin. Unless the topic is latched, another run of the recorder began, or it fell
    silent for longer than usual, too; and unless it says texts or goals, nothing was recorded for
    more than `SILENCE_NS`.
    """
    snapshot = view.snapshot
    breaks = {*deletions(view, topic)}
    if not is_latched(view, topic):
        breaks.update(start for start, _ in snapshot.breaks)
        breaks.update(silence.start for silence in snapshot.silences if silence.topic == topic)
        if not {*view.timeline.types_of(topic)} <= {TEXT, GOALS}:
            breaks.update(start for start, end in snapshot.gaps if end - start > SILENCE_NS)
    earliest, latest = snapshot.earliest, snapshot.latest
    if earliest is not None and latest is not None:
        spans = [fault.span for fault in snapshot.misdated]
        ends_before = [end for _, end in spans if end < earliest]
        if ends_before:
            breaks.add(max(ends_before))
        if any(start > latest for start, _ in spans):
            breaks.add(latest)
    return sorted(breaks)


def deletions(view: View, topic: str) -> Sequence[Ns]:
    """Returns the moments after which messages of a topic may have been deleted, up to its next.

    When retention deletes bags as a whole, it carries on the newest value of a latched topic, and
    the values that held while something was recorded that stays. So after the last carried message
    of a deleted time nothing is missing, and if the topic has none there, nothing was deleted.
    """
    known = view.memo.of(_DELETIONS, dict)
    if topic not in known:
        cut = cut_spans(view.bag_dir, topic, TimeWindow.everything())
        moments = [start for start, _ in cut]
        statics = view.limits.latching.static_topics
        is_carried_on = view.timeline.is_transient_state(topic) or topic in statics
        for gap_end, deleted in deleted_by_gap(view, TimeWindow(0, MAX_NS)):
            begin, _ = deleted[0]
            if not is_carried_on:
                moments.append(begin)
                continue
            scanned = scan(view, topic, TimeWindow(begin, gap_end + 1), columns=False)
            times = [*chain.from_iterable(rows.times.tolist() for rows in scanned)]
            newest = max(times, default=MIN_NS)
            moments += [at for at in (begin, *times) if at < newest]
        known[topic] = moments
    return known[topic]


def is_latched(view: View, topic: str) -> bool:
    """Returns whether a topic is latched: its last message holds."""
    return view.limits.latching.is_latched(view.snapshot, topic)


def is_text(view: View, topic: str) -> bool:
    """Returns whether all messages of a topic are plain texts."""
    return set(view.timeline.types_of(topic)) == {TEXT}


def says_events(view: View, topic: str) -> bool:
    """Returns whether each message of a topic is an event: of a log, or a text now and then.

    Texts that come regularly, or more often than every `SILENCE_NS`, describe what goes on. The
    newest sessions say so: there may be thousands.
    """
    heard = nlargest(_MOST_JUDGED, _heard_in(view, topic)) if is_text(view, topic) else []
    length = sum(each.stop - each.start for each in heard)
    is_seldom = length > SILENCE_NS * sum(each.messages for each in heard)
    is_paced = any(
        each.is_frequent or _pause_in(view, topic, each) > SILENCE_NS for each in heard if is_seldom
    )
    return view.timeline.is_log(topic) or (is_seldom and not is_paced)


def lasting_of(view: View, topic: str, *, states: bool) -> Lasting:
    """Returns the `Lasting` of a topic, which is made once in a call."""
    known = view.memo.of(_LASTING, dict)
    if (topic, states) not in known:
        known[topic, states] = Lasting(view, [topic], states=states)
    return known[topic, states]


def held_until(
    view: View, topic: str, last: Ns, end: Ns, *, states: bool = False, since: Ns | None = None
) -> Ns:
    """Returns until when the message of a topic at `last` lasts (log time, ns), at most `end`.

    The next message is looked for from `since` on, if that is later.
    """
    lasting = lasting_of(view, topic, states=states)
    pause = lasting.pause(last)
    near = TimeWindow(max(last + 1, since or last), (end if pause == MAX_NS else last + pause) + 1)
    following = None if near.empty else view.stream.first([topic], near)
    stop, _ = lasting.until(last, MAX_NS if following is None else following.time)
    return max(last, min(stop, end))


def held_at(view: View, topic: str, moment: Ns, *, states: bool = False) -> StoredMessage | None:
    """Returns the message of a topic that lasts at a moment after any pause; None without one."""
    lasting = lasting_of(view, topic, states=states)
    before = view.stream.last(topic, moment) if lasting.longest == MAX_NS else None
    if before is None or lasting.pause(before.time) < MAX_NS:
        return None
    _, is_reached = lasting.until(before.time, moment)
    return before if is_reached else None


def still_holds(view: View, stored: StoredMessage, moment: Ns) -> bool:
    """Returns whether the newest message before a moment is latched and holds then.

    In a time that was excluded, nothing is known to hold.
    """
    return (
        view.limits.latching.holds(view.snapshot, stored)
        and not any(stored.time <= start < moment for start in deletions(view, stored.topic))
        and not excluded_between(view.bag_dir, moment, moment + 1)
    )


def holds_on(view: View, topic: str, at: Ns) -> bool:
    """Returns whether what a topic said at a log time is latched, or rare in its session."""
    return not lies_inside(lasting_of(view, topic, states=True).frequent, at)


def held_times(view: View, topics: Collection[str], window: TimeWindow) -> Spans:
    """Returns when it is known what topics said while their messages hold on, up to a window's end.

    That is from their first message on, but not from a break to their next message.
    """
    lasting = Lasting(view, topics)
    frequent, breaks = lasting.frequent, lasting.breaks
    recordings = (view.timeline.recordings(topic).values() for topic in topics)
    firsts = [first for first, _ in chain.from_iterable(recordings)]
    if all(lies_inside(frequent, first) for first in firsts):
        return []
    bounds = [view.bounds(topic, window)[0] for topic in topics]
    begins = np.append(np.sort(np.concatenate(bounds)), window.stop)
    unknown: Spans = []
    known_again = MIN_NS
    for at in breaks[max(bisect_right(breaks, window.start) - 1, 0) :]:
        if known_again <= at < window.stop:
            # Bags that begin later need not be compared with the next one.
            near = int(begins[np.searchsorted(begins, at, side="right")])
            parts = TimeWindow(at + 1, near + 1), TimeWindow(near + 1, window.stop)
            following = (view.stream.first([*topics], part) for part in parts if not part.empty)
            known_again = next((message.time for message in following if message), MAX_NS)
            unknown.append((at, known_again))
    return without([(min(firsts), MAX_NS)], united([*unknown, *frequent]))
