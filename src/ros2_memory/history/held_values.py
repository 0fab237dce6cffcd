"""The values that a topic held, and until when: a value holds until a message says another one.

Before that it ends as any state does (see `Lasting`), and where a message cannot be decoded, which
may say another one.
"""

from __future__ import annotations

import json
import math
from itertools import chain, islice
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import at_field
from ros2_memory.columns.shown import words_of
from ros2_memory.columns.table import Texts, joined_texts
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError, UndecodableError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import listed, repeating
from ros2_memory.core.timebase import MAX_NS, MIN_NS, START_SLACK_NS, Ns
from ros2_memory.history.context import READING_S, UNDECODED, Note
from ros2_memory.history.lasting import TEXT, Lasting
from ros2_memory.history.scan import blocks, of_columns, scan
from ros2_memory.messages.conversions import (
    Summary,
    names_beside,
    names_others,
    segments_of,
    single_values,
)
from ros2_memory.messages.to_json import round_integer, round_real

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

NUMBERS: Final = ("std_msgs/msg/Int", "std_msgs/msg/UInt", "std_msgs/msg/Float")
"""How the types of messages that are one number, or an array of such, begin."""
_MOST_TRIED: Final = 200
"""At most this many messages are read to find one that says something of the field."""
_MOST_CHARS: Final = 16 << 20
"""The most characters of values (as JSON text) that a call may hold in memory."""
_MOST_LISTED: Final = 8
"""How many fields a refusal lists."""


class HeldValue(NamedTuple):
    """A value, and when it held.

    Attributes:
        word: the value as JSON text.
        start: log time of the first message that says it.
        stop: log time until which it is known to hold.
        ended: whether a message says another value at `stop`.
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
        """The value, rounded for replies: NaN and infinity are None."""
        exact = self.exact
        if isinstance(exact, float):
            return round_real(exact)
        # A whole float is an integer in the word, with all its digits.
        return round_integer(exact) if isinstance(exact, int) else exact

    @property
    def is_blank(self) -> bool:
        """Whether it is a text without words: it only ends the value before."""
        return self.word.startswith('"') and not str(self.exact).strip()


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
        field: dot-path of the value in the messages; None for whole messages.
        asked: the argument that asks for it, for errors.
        until: the end of the time that is asked about: later messages may have another type.

    Attributes:
        complete_since: `back` has yielded all values that began at this log time or later.
        known: the values that `during` has found, newest first, also if time was over.

    Raises:
        InvalidArgumentsError: the newest message before `until` that says something of the field
            has no single value there.
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
        self._lasting = Lasting(view, [topic], texts=True)
        self._undecoded: dict[Ns, Note] = {}  # by log time, which is one of the breaks
        self._reading = view.call.partial_after(READING_S)
        self.complete_since: Ns = MAX_NS
        self.known: list[HeldValue] = []
        self._require_single_value(asked, until)

    def _require_single_value(self, asked: str, until: Ns) -> None:
        newest, value = self._newest_stated(until)
        if newest is None:
            names = self._field and names_without(self._view, self._topic, self._field, until)
            if self._field and names:
                raise InvalidArgumentsError(f"{asked}: {unnamed(self._topic, self._field, names)}")
        elif value is None and self._field is not None:
            # Null is a value, as behind the end of a list, unless there is no such field.
            if not self._is_in(newest):
                message = self._view.bags.decode(newest)
                self._view.extractor.require(message, newest.type, self._field)
        elif isinstance(value, list | dict | None):
            of_field = "" if self._field is None else f"field {self._field} of "
            how = f"as {self._topic}.FIELD" if asked == "with" else "where the tool takes fields"
            advice = self._advice_on_element(newest) or (
                "ask about a topic that has one, such as std_msgs/msg/String, or name one of its "
                f"fields, {how}{self._fields_in(value)}"
            )
            raise InvalidArgumentsError(
                f"{asked}: {of_field}{self._topic} ({newest.type}) is no text, number or "
                f"boolean, which holds until the next one: {advice}"
            )

    def _newest_stated(self, until: Ns) -> tuple[StoredMessage | None, JsonValue]:
        """Returns the newest message before a moment that says something of the field, with that.

        An empty text, which only ends a value, says nothing of the keys of others; and not each
        text of JSON has all keys.
        """
        window = TimeWindow(MIN_NS, until)
        messages = self._view.stream.messages([self._topic], window, newest_first=True)
        stated = self._stated(islice(messages, _MOST_TRIED))
        said = (pair for pair in stated if pair[1] != "")
        newest, value = next(said, (None, None))
        if newest is not None and value is None and newest.type == TEXT and not self._is_in(newest):
            return next((pair for pair in said if self._is_in(pair[0])), (newest, value))
        return newest, value

    def _is_in(self, stored: StoredMessage) -> bool:
        """Returns whether the value of a message has the field, be it null."""
        path = self._view.extractor.own_path(self._field or "", stored.type)
        return bool(at_field(self._view.value(stored), path))

    def _fields_in(self, value: JsonValue) -> str:
        """Returns the end of a sentence: fields of an object that hold a value; or nothing."""
        names = [name for name, _ in single_values(value, self._field or "")]
        return f": {listed(names, at_most=_MOST_LISTED)}" if names else ""

    def _advice_on_element(self, stored: StoredMessage) -> str:
        """Returns which single value to ask for if the field leads through a list; else nothing."""
        value = self._view.example(stored)
        own = self._field and self._view.extractor.own_path(self._field, stored.type)
        path = segments_of(own) if own else []
        for nth in range(1, len(path) + 1):
            of_first = ".".join((*path[:nth], "0", *path[nth:]))
            found = at_field(value, of_first)
            if len(found) == 1 and not isinstance(found[0], list | dict | None):
                return f"ask about one element of the list, such as {of_first}"
        return ""

    def back(self, until: Ns) -> Iterator[HeldValue]:
        """Yields the values that began before a moment, newest first.

        Raises:
            QueryTimeoutError: while it is iterated, when the time for reading is over.
        """
        self.complete_since = until
        later = self._runs(TimeWindow(until, MAX_NS), newest_first=False)
        following = next(later, None)
        for earlier in self._runs(TimeWindow(MIN_NS, until), newest_first=True):
            run = earlier
            if following is not None and self._goes_on(run, following):
                # Only the newest run can go on after `until`.
                run, following = run._replace(last=following.last), next(later, None)
            stop, ended = self._lasting.until(
                run.last, MAX_NS if following is None else following.first
            )
            if not ended and stop in self._undecoded:
                self._view.notes.add_lack(self._undecoded[stop])
            self.complete_since = run.first
            yield HeldValue(run.word, run.first, stop, ended)
            following = run

    def during(self, start: Ns, stop: Ns) -> list[HeldValue]:
        """Returns the values that held at some time in `[start, stop)`, in order.

        Raises:
            QueryTimeoutError: the time for reading is over, or the values take too much memory.
        """
        self.known = []
        chars = 0
        for held in self.back(stop):
            chars += len(held.word)
            if chars > _MOST_CHARS:
                self.complete_since = self.known[-1].start if self.known else stop
                raise QueryTimeoutError(f"the values take more than {_MOST_CHARS:,} characters")
            if held.stop > start or held.start >= start - START_SLACK_NS:
                self.known.append(held)
            if held.start <= start:
                break
        return self.known[::-1]

    def named_after(self, moment: Ns) -> HeldValue | None:
        """Returns the first value from a moment on that is no blank text. Its end is not read.

        Raises:
            QueryTimeoutError: the time for reading is over.
        """
        for run in self._runs(TimeWindow(moment, MAX_NS), newest_first=False):
            held = HeldValue(run.word, run.first, run.last, ended=False)
            if not held.is_blank:
                return held
        return None

    def _runs(self, window: TimeWindow, *, newest_first: bool) -> Iterator[_Run]:
        """Yields the runs of messages with one value, in order or the newest first."""
        waiting: _Run | None = None
        for run in self._runs_of_blocks(window, newest_first=newest_first):
            older, newer = (run, waiting) if newest_first else (waiting, run)
            if older is not None and newer is not None and self._goes_on(older, newer):
                waiting = _Run(run.word, older.first, newer.last)
                continue
            if waiting is not None:
                yield waiting
            waiting = run
        if waiting is not None:
            yield waiting

    def _runs_of_blocks(self, window: TimeWindow, *, newest_first: bool) -> Iterator[_Run]:
        """Yields the runs of each block of rows: a run may go on in the next block."""
        scanned = scan(
            self._view, self._topic, window, newest_first=newest_first, before_table=self._check
        )
        for block in blocks(scanned, newest_first=newest_first):
            columns: list[tuple[IntArray, Texts]] = []
            for rows in block:
                of_rows = of_columns(self._view, rows, self._words_of)
                if of_rows is None:
                    yield from self._runs_of_messages(block, window, newest_first=newest_first)
                    break
                columns += of_rows
            else:
                runs = self._runs_of_columns(columns)
                yield from reversed(runs) if newest_first else runs

    def _check(self, _: Ns) -> None:
        """Checks that there is time left for reading."""
        if self._reading.expired():
            raise QueryTimeoutError("out of time; ask about a shorter window")

    def _runs_of_columns(self, parts: Sequence[tuple[IntArray, Texts]]) -> list[_Run]:
        """Returns the runs, in order, of the log times and words of rows that overlap in time."""
        times = np.concatenate([part_times for part_times, _ in parts])
        if not times.size:
            return []
        order = np.argsort(times, kind="stable")
        texts = joined_texts([part_texts for _, part_texts in parts])[order]
        times, codes = times[order], texts.codes
        breaks = (np.diff(codes) != 0) | self._lasting.ends(times)
        firsts = np.append(0, np.flatnonzero(breaks) + 1)
        lasts = np.append(firsts[1:], times.size) - 1
        return [
            _Run(texts.words[code], first, last)
            for code, first, last in zip(
                codes[firsts].tolist(), times[firsts].tolist(), times[lasts].tolist(), strict=True
            )
        ]

    def _words_of(self, rows: Rows) -> tuple[IntArray, Texts] | None:
        """Returns the log time and the value, as JSON text, of each row.

        None if the columns do not have the values.
        """
        words = words_of(rows.table, self._field, self._view.extractor)
        if words is None:
            return None
        return rows.times, words[rows.positions]

    def _runs_of_messages(
        self, block: Sequence[Rows], window: TimeWindow, *, newest_first: bool
    ) -> Iterator[_Run]:
        """Yields a run for each message in the time of some rows."""
        first, last = min(rows.first for rows in block), max(rows.last for rows in block)
        part = window.intersect(TimeWindow(first, last + 1))
        messages = self._view.stream.messages([self._topic], part, newest_first=newest_first)
        for stored, value in self._stated(messages):
            self._check(stored.time)
            yield _Run(json.dumps(value), stored.time, stored.time)

    def _stated(
        self, messages: Iterable[StoredMessage]
    ) -> Iterator[tuple[StoredMessage, JsonValue]]:
        """Yields messages with their value, without those that name other elements (joints) alone.

        Those say nothing of the field.
        """
        extractor, field = self._view.extractor, self._field
        failures: list[UndecodableError] = []
        for stored in messages:
            message = self._view.bags.decode(stored, failures)
            if failures:
                self._break_at(stored, failures.pop().reason)
            if message is None:
                continue
            value = self._value_of(message, stored.type)
            if value is None and field is not None:
                path = extractor.own_path(field, stored.type)
                if names_others(extractor.exact(message, stored.type), path):
                    continue
            yield stored, value

    def _break_at(self, stored: StoredMessage, why: str) -> None:
        """Ends what held before a message that cannot be decoded."""
        at = stored.time
        if at not in self._undecoded:
            self._lasting.end_at(at)
            self._undecoded[at] = Note(UNDECODED, stored.topic, why, at, at)

    def _value_of(self, message: object, type_name: str) -> JsonValue:
        """Returns the value in a message; an object with one key stands for its value."""
        extractor, field = self._view.extractor, self._field
        value = (
            extractor.exact(message, type_name)
            if field is None
            else self._field_of(message, type_name, field)
        )
        # A summary stands for an array that is too long to be shown.
        if isinstance(value, dict) and len(value) == 1 and not isinstance(value, Summary):
            [value] = value.values()
        return _canonical(value)

    def _field_of(self, message: object, type_name: str, field: str) -> JsonValue:
        """Returns a field, which may go on into a text of JSON; a blank text says it has none."""
        text, below = self._view.extractor.text_above(message, type_name, field)
        if not below:
            return self._view.extractor.exact_at(message, type_name, field)
        found: list[JsonValue] = at_field(text, ".".join(below)) if text.strip() else [text]
        return found[0] if len(found) == 1 else found or None

    def _goes_on(self, older: _Run, newer: _Run) -> bool:
        """Whether a run goes on in the next one, with nothing in between that ends it."""
        return older.word == newer.word and self._lasting.until(older.last, newer.first)[1]


def _canonical(value: JsonValue) -> JsonValue:
    """Returns a value in the one form of all that replies show alike: 2 for 2.0, 0 for -0.0.

    And 0.3 for 0.1 + 0.2, which is another float.
    """
    if isinstance(value, dict):
        return {name: _canonical(part) for name, part in value.items()}
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    return int(value) if value.is_integer() else round_real(value)


def newest_stating(
    view: View, stored: StoredMessage, fields: Sequence[str], since: Ns
) -> StoredMessage | None:
    """Returns the newest message from a log time up to `stored` that says something of a field.

    `stored` itself, unless it names other joints than the fields do: several nodes may publish
    those of one robot. None if all of these messages name others.
    """
    if not fields or _says_something(view, stored, fields):
        return stored
    window = TimeWindow(since, stored.time + 1)
    messages = view.stream.messages([stored.topic], window, newest_first=True)
    for earlier in islice(messages, _MOST_TRIED):
        is_alike = earlier.recording == stored.recording
        if is_alike and _says_something(view, earlier, fields):
            return earlier
    return None


def _says_something(view: View, stored: StoredMessage, fields: Sequence[str]) -> bool:
    """Whether a message says something of a field; True if it cannot be decoded."""
    message, type_name = view.bags.decode(stored), stored.type
    extractor = view.extractor
    if message is None or any(
        extractor.exact_at(message, type_name, field) is not None for field in fields
    ):
        return True
    value = extractor.exact(message, type_name)
    return not all(names_others(value, extractor.own_path(field, type_name)) for field in fields)


def note_unnamed(view: View, topic: str, values: Sequence[JsonValue], until: Ns) -> None:
    """Notes which named elements (joints) are null in values because messages do not name them.

    Args:
        view: of the call.
        topic: of the messages.
        values: the fields of messages by dot-path, as replies show them.
        until: the newest messages before this log time are looked at.
    """
    shown = [value for value in values if isinstance(value, dict)]
    fields = dict.fromkeys(chain.from_iterable(shown))
    for field in fields:
        if all(value.get(field) is None for value in shown):
            names = names_without(view, topic, field, until)
            if names:
                view.notes.add(unnamed(topic, field, names))


def unnamed(topic: str, field: str, names: Sequence[str]) -> str:
    """Returns a sentence on a named element that the newest messages of a topic do not have."""
    others = f"the newest messages of {topic} have no {field}, but name {listed(names)}"
    return repeating(others, names)


def names_without(view: View, topic: str, field: str, until: Ns) -> list[str]:
    """Returns the names of elements in the newest messages before a log time, if none has a field.

    Empty if one has it, or if the field names no element.
    """
    names: dict[str, None] = {}
    window = TimeWindow(MIN_NS, until)
    messages = view.stream.messages([topic], window, newest_first=True)
    for stored, message in view.bags.decoded(islice(messages, _MOST_TRIED)):
        value = view.extractor.exact(message, stored.type)
        path = view.extractor.own_path(field, stored.type)
        if not names_others(value, path):
            return []
        names.update(dict.fromkeys(map(str, names_beside(value, path))))
    return sorted(names)
