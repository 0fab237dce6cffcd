"""What a topic said, and until when: a value holds until a message says another one.

So do the texts that say what a robot does (`std_msgs/msg/String`): nothing of them is known to have
ended only because a topic is silent, or because nothing was recorded for a while. Where another run
of the recorder begins, only what a latched topic said is known to hold on; of a topic that is
usually heard often, no value where it falls silent for `SILENCE_NS`. No value is known to hold
where messages of the topic were deleted.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.bag_dir.state_files import excluded_between
from ros2_memory.columns.shown import words_of
from ros2_memory.columns.table import Texts, joined_texts
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.context import READING_S
from ros2_memory.history.coverage import cut_spans, deleted_by_gap
from ros2_memory.history.scan import blocks, of_columns, scan
from ros2_memory.messages.conversions import Summary
from ros2_memory.messages.to_json import round_integer, round_real

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

TEXT: Final = "std_msgs/msg/String"
_DELETIONS: Final[Key[dict[str, list[Ns]]]] = Key()
"""Of a view: the `deletions` of topics."""
_MOST_CHARS: Final = 16 << 20
"""How much of values a call may hold, as JSON text."""


class Held(NamedTuple):
    """A value, and when it held.

    Attributes:
        word: the value as JSON text.
        start: log time of the first message that says so.
        stop: of the next one that says otherwise; where none is known to do so, until when it is
            known to hold.
        ended: whether a message says otherwise then.
    """

    word: str
    start: Ns
    stop: Ns
    ended: bool

    @property
    def exact(self) -> JsonValue:
        """The value."""
        value: JsonValue = json.loads(self.word)
        return value

    @property
    def value(self) -> JsonValue:
        """The same as replies round it: NaN and infinity are None."""
        exact = self.exact
        if isinstance(exact, float):
            return round_real(exact)
        # In the word a whole float has all its digits.
        return round_integer(exact) if isinstance(exact, int) else exact

    @property
    def is_blank(self) -> bool:
        """Whether it is a text that says nothing: it only ends the one before."""
        value = self.value
        return isinstance(value, str) and not value.strip()


class _Run(NamedTuple):
    """Consecutive messages that say the same: log times of the first and the last."""

    word: str
    first: Ns
    last: Ns


class HeldValues:
    """Reads the values that a topic held.

    Args:
        view: the call's.
        topic: its name.
        field: dot-path of the value in the messages; None for all that they have.
        asked: the argument that asks for it, as errors name it.
        until: the moment before which it is asked for; a topic may have had other types then.

    Attributes:
        reached: what began from then on was yielded by `back`.
        known: what `during` found, newest first, also where time was over.

    Raises:
        InvalidArgumentsError: what the newest message before then has there is no single value.
    """

    def __init__(
        self,
        view: View,
        topic: str,
        field: str | None = None,
        *,
        asked: str = "",
        until: Ns = MAX_NS,
    ) -> None:
        self._view = view
        self._topic = topic
        self._field = field
        self._holds_on = is_text(view, topic) or holds_on(view, [topic])
        self._breaks = breaks_of(view, topic)
        self._reading = view.call.partial_after(READING_S)
        self.reached: Ns = MAX_NS
        self.known: list[Held] = []
        self._require_single_value(asked, until)

    def _require_single_value(self, asked: str, until: Ns) -> None:
        newest = self._view.stream.last(self._topic, until)
        message = None if newest is None else self._view.bags.decode(newest)
        if newest is None or message is None:
            return
        if isinstance(self._said(message, newest.type), list | dict | None):
            of_field = "" if self._field is None else f"field {self._field} of "
            raise InvalidArgumentsError(
                f"{asked}: {of_field}{self._topic} ({newest.type}) is no text, number or "
                "boolean, which holds until the next one: ask about a topic that has one, such "
                "as std_msgs/msg/String, or name one of its fields where the tool takes fields"
            )

    def back(self, until: Ns) -> Iterator[Held]:
        """Yields the values that were said before a moment, newest first.

        Raises:
            QueryTimeoutError: while it is iterated, when the time for reading is over.
        """
        self.reached = until
        later = self._runs(TimeWindow(until, MAX_NS), newest_first=False)
        after = next(later, None)
        for before in self._runs(TimeWindow(MIN_NS, until), newest_first=True):
            run = before
            if after is not None and self._goes_on(before, after):
                # It goes on after `until`.
                run, after = before._replace(last=after.last), next(later, None)
            stop, ended = self._end_of(run, after)
            self.reached = run.first
            yield Held(run.word, run.first, stop, ended)
            after = run

    def during(self, start: Ns, stop: Ns) -> list[Held]:
        """Returns the values that held at some time from `start` on and before `stop`, in order.

        Raises:
            QueryTimeoutError: the time for reading is over, or the values are too long to be held.
        """
        self.known = []
        chars = 0
        for held in self.back(stop):
            chars += len(held.word)
            if chars > _MOST_CHARS:
                self.reached = self.known[-1].start if self.known else stop
                raise QueryTimeoutError(f"the values take more than {_MOST_CHARS:,} characters")
            if held.stop > start:
                self.known.append(held)
            if held.start <= start:
                break
        return self.known[::-1]

    def named_after(self, moment: Ns) -> Held | None:
        """Returns the first value said from a moment on that is no blank text; its end is not read.

        Raises:
            QueryTimeoutError: the time for reading is over.
        """
        for run in self._runs(TimeWindow(moment, MAX_NS), newest_first=False):
            held = Held(run.word, run.first, run.last, ended=False)
            if not held.is_blank:
                return held
        return None

    def _runs(self, window: TimeWindow, *, newest_first: bool) -> Iterator[_Run]:
        """Yields runs in order, or the newest first; those that go on in the next rows joined."""
        waiting: _Run | None = None
        scanned = scan(
            self._view, self._topic, window, newest_first=newest_first, reached=self._check
        )
        for together in blocks(scanned, newest_first=newest_first):
            parts = [of_columns(self._view, rows, self._texts_of) for rows in together]
            if any(part is None for part in parts):
                runs = self._runs_of_messages(together, window, newest_first=newest_first)
            else:
                joined = self._runs_of_columns([column for part in parts for column in part or ()])
                runs = reversed(joined) if newest_first else iter(joined)
            for run in runs:
                older, newer = (run, waiting) if newest_first else (waiting, run)
                if older is not None and newer is not None and self._goes_on(older, newer):
                    waiting = _Run(run.word, older.first, newer.last)
                    continue
                if waiting is not None:
                    yield waiting
                waiting = run
        if waiting is not None:
            yield waiting

    def _check(self, _: Ns) -> None:
        if self._reading.expired():
            raise QueryTimeoutError("out of time; ask about a shorter window")

    def _runs_of_columns(self, parts: Sequence[tuple[IntArray, Texts]]) -> list[_Run]:
        """Returns the runs of rows that overlap in time, in order."""
        times = np.concatenate([part_times for part_times, _ in parts])
        if not times.size:
            return []
        order = np.argsort(times, kind="stable")
        texts = joined_texts([part_texts for _, part_texts in parts]).rows(order)
        times, codes = times[order], texts.codes
        breaks = np.diff(codes) != 0
        breaks |= np.diff(np.searchsorted(self._breaks, times)) > 0
        if not self._holds_on:
            breaks |= np.diff(times) > SILENCE_NS
        firsts = np.append(0, np.flatnonzero(breaks) + 1)
        lasts = np.append(firsts[1:], times.size) - 1
        return [
            _Run(texts.words[code], first, last)
            for code, first, last in zip(
                codes[firsts].tolist(), times[firsts].tolist(), times[lasts].tolist(), strict=True
            )
        ]

    def _texts_of(self, rows: Rows) -> tuple[IntArray, Texts] | None:
        """Returns the log times of some rows, and what each says; None where columns lack it."""
        texts = words_of(rows.table, self._field, self._view.extractor)
        if texts is None:
            return None
        return rows.times, texts if rows.index is None else texts.rows(rows.index)

    def _runs_of_messages(
        self, together: Sequence[Rows], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[_Run]:
        """Yields a run for each message of the times of some rows, one of which may be large."""
        first, last = min(rows.first for rows in together), max(rows.last for rows in together)
        part = window.intersect(TimeWindow(first, last + 1))
        for stored in self._view.stream.messages([self._topic], part, newest_first=newest_first):
            self._check(stored.time)
            message = self._view.bags.decode(stored)
            if message is not None:
                word = json.dumps(self._said(message, stored.type))
                yield _Run(word, stored.time, stored.time)

    def _said(self, message: object, type_name: str) -> JsonValue:
        """Returns the value of a message, of an object with one key that; but no array's size."""
        extractor, field = self._view.extractor, self._field
        value = (
            extractor.exact(message, type_name)
            if field is None
            else extractor.exact_at(message, type_name, field)
        )
        if isinstance(value, dict) and len(value) == 1 and not isinstance(value, Summary):
            [value] = value.values()
        return _as_said(value)

    def _goes_on(self, older: _Run, newer: _Run) -> bool:
        return older.word == newer.word and self._end_of(older, newer) == (newer.first, True)

    def _end_of(self, run: _Run, after: _Run | None) -> tuple[Ns, bool]:
        """Returns until when a run is known to hold, and whether the next run ends it then."""
        following = MAX_NS if after is None else after.first
        if not self._holds_on and following - run.last > SILENCE_NS:
            return run.last, False
        nth = bisect_left(self._breaks, run.last)
        if nth < len(self._breaks) and self._breaks[nth] < following:
            return self._breaks[nth], False
        if after is None:
            return max(run.last, self._view.snapshot.latest or run.last), False
        return following, True


def breaks_of(view: View, topic: str) -> list[Ns]:
    """Returns the moments from which on what a topic said before is not known to hold, in order.

    Also where bags of a wrong clock end before the others, and where these end before more.
    """
    snapshot, breaks = view.snapshot, list[Ns]()
    breaks += deletions(view, topic)
    if not is_latched(view, topic):
        breaks += [start for start, _ in snapshot.breaks]
    if snapshot.earliest is not None and snapshot.latest is not None:
        bags = [fault.bag for fault in snapshot.misdated]
        breaks += sorted(bag.end for bag in bags if bag.end < snapshot.earliest)[-1:]
        breaks += [snapshot.latest] if any(bag.start > snapshot.latest for bag in bags) else []
    return sorted(set(breaks))


def deletions(view: View, topic: str) -> Sequence[Ns]:
    """Returns the moments from which on messages of a topic may have been deleted, up to its next.

    Of bags that go as a whole, retention carries on what a latched topic said newest, and what held
    while something was recorded that stays. So after its last message in a time that was deleted,
    no more was; nor where it has none there.
    """
    known = view.memo.of(_DELETIONS, dict)
    if topic not in known:
        cut = cut_spans(view.bag_dir, topic, TimeWindow.everything())
        known[topic] = [start for start, _ in cut]
        statics = view.limits.latching.static_topics
        is_carried_on = view.timeline.is_transient_state(topic) or topic in statics
        for end, deleted in deleted_by_gap(view, TimeWindow(0, MAX_NS)):
            window = TimeWindow(deleted[0][0], end + 1)
            if not is_carried_on:
                known[topic].append(window.start)
                continue
            scanned = scan(view, topic, window, columns=False)
            times = [*chain.from_iterable(rows.times.tolist() for rows in scanned)]
            newest = max(times, default=MIN_NS)
            known[topic] += [at for at in (window.start, *times) if at < newest]
    return known[topic]


def _as_said(value: JsonValue) -> JsonValue:
    """Returns a value in the form that all equal ones have: 2 for 2.0, and 0 for -0.0."""
    if isinstance(value, dict):
        return {name: _as_said(part) for name, part in value.items()}
    return int(value) if isinstance(value, float) and value.is_integer() else value


def is_latched(view: View, topic: str) -> bool:
    """Returns whether a topic is latched: what it said last holds."""
    return view.limits.latching.is_latched(view.snapshot, topic)


def is_text(view: View, topic: str) -> bool:
    """Returns whether all messages of a topic are plain texts."""
    return set(view.timeline.types_of(topic)) == {TEXT}


def held_until(view: View, topic: str, last: Ns, end: Ns) -> Ns:
    """Returns until when what a message at `last` stated held, at most until `end`.

    On a latched topic to its next message, or as far as something is recorded. On another one to
    its next message, too, and not at all after `last` where that comes later than `SILENCE_NS`.
    """
    lasting = is_latched(view, topic)
    stop = end if lasting else last + SILENCE_NS
    following = view.stream.first([topic], TimeWindow(last + 1, stop + 1))
    if lasting:
        ends = [moment for moment in breaks_of(view, topic) if moment >= last]
        ends += [end, view.snapshot.latest or end]
        return max(last, min([*ends, *([] if following is None else [following.time])]))
    return last if following is None else max(last, min(following.time, end))


def held_at(view: View, topic: str, moment: Ns) -> StoredMessage | None:
    """Returns the message before a moment that still held then, on a latched topic."""
    if not is_latched(view, topic):
        return None
    before = view.stream.last(topic, moment)
    if before is None or any(before.time <= at < moment for at in breaks_of(view, topic)):
        return None
    return before


def still_holds(view: View, stored: StoredMessage, moment: Ns) -> bool:
    """Returns whether the newest message of its topic before a moment is latched and holds then.

    Nothing is known to hold in a time that was excluded.
    """
    return (
        view.limits.latching.holds(view.snapshot, stored)
        and not any(stored.time <= start < moment for start in deletions(view, stored.topic))
        and not excluded_between(view.bag_dir, moment, moment + 1)
    )


def holds_on(view: View, topics: Iterable[str]) -> bool:
    """Returns whether the newest messages of topics hold on: they are latched, or seldom."""
    timeline = view.timeline
    return all(
        is_latched(view, topic)
        or all(timeline.pace(topic, recording).is_rare for recording in timeline.recordings(topic))
        for topic in topics
    )
