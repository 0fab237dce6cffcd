"""Search backwards in time for the last message that meets a condition.

Zones and words of columns rule out parts. The times of the others are searched, with every message
there that decides which ones count.
"""

from __future__ import annotations

import heapq
import re
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
    parse_condition,
)
from ros2_memory.analysis.facts import FULL_CHARGE, charge_of
from ros2_memory.analysis.refusals import refusal_for, shows_field, summary_conditions
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.truth import ColumnCondition
from ros2_memory.columns.values import TruthValues
from ros2_memory.core.errors import (
    BagError,
    InvalidArgumentsError,
    QueryTimeoutError,
    UndecodableError,
)
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import Reason, abbreviate, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.history.context import READING_S, Note
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.held_values import is_text
from ros2_memory.history.no_data import matching_topics, undecodable, with_notes
from ros2_memory.history.scan import decoded_rows, scan
from ros2_memory.history.transforms import connects
from ros2_memory.history.view import View
from ros2_memory.messages.detections import detections_of
from ros2_memory.messages.levels import level_number, level_path, unknown_name_hint

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.storage.base import IntArray, Mask, Schema

_ELSEWHERE: Final = "for a place in another frame, such as the map, ask visits, or give where"
_CONSTANT: Final = re.compile(
    r"^[ \t]*[a-z]+[0-9]*[ \t]+([A-Z][A-Z0-9_]*)[ \t]*=[ \t]*(-?[0-9]+)\b", re.MULTILINE
)
"""A constant in the text of a message definition, as ROS 2 writes it."""
_CONSTANT_NAME: Final = re.compile(r"[A-Z][A-Z0-9_]*")
_NUMBER_FIELD: Final = r"^[ \t]*(?:u?int[0-9]+|byte|char|float[0-9]+)[ \t]+{}\b"
_MOST_EMPTY: Final = 200
"""Messages that are looked at for one with elements in its lists."""
MOST_UNSURE: Final = 32
"""Messages of a part that are read one by one, where its columns leave open what they meet."""
_MOST_LEFT: Final = 0.5
"""Where a bag's columns leave open more of them, those of its type are left to the messages."""
_IN_DEGREES: Final = frozenset({"latitude", "longitude", "altitude"})
_MOST_TYPES: Final = 3
"""Types of which the constants are looked at: each costs the channels of a file."""
_MOST_FRAMES: Final = 3
"""Topics whose frame is named: each costs one message."""
_TOGETHER_NS: Final = NS_PER_S
"""Messages that may match and are no farther apart are read at once."""
_MOST_TOGETHER: Final = 256
_NO_TIMES: Final = np.empty(0, np.int64)


def condition_of(
    view: View,
    pattern: str,
    condition_type: str,
    value: JsonValue,
    *,
    field: str | None,
    min_score: float | None,
) -> Condition:
    """Returns the condition of a question; without a `min_score` of its own the configured one.

    `pattern` is the name or glob of the topics. The field may be a full path in their messages.
    Where all are of one type, the level of a log or status may be named (WARN), also without a
    field where it is to be equal, as may a constant of the message definition where the field is a
    number.

    Raises:
        NoDataError: no such topic is recorded.
        InvalidArgumentsError: it is no condition.
    """
    memory = view.memory
    limits = memory.limits
    least = limits.min_score if min_score is None else min_score
    timeline = view.timeline
    types = frozenset(chain.from_iterable(map(timeline.types_of, matching_topics(view, pattern))))
    type_name = next(iter(types)) if len(types) == 1 else ""
    if not field and condition_type == "equals":
        field = level_path(value, type_name)
    if field and type_name:
        field = memory.extractor.own_path(field.strip(), type_name)
        value = level_number(value, field, type_name)
        value = _constant_number(view, value, field, type_name)
    try:
        condition = parse_condition(
            condition_type, value, limits.position_tolerance_m, field, least
        )
    except InvalidArgumentsError as error:
        hint = unknown_name_hint(value, field, types)
        raise InvalidArgumentsError(f"{error}{hint}") from error
    _require_fraction(view, pattern, condition)
    return condition


def _require_fraction(view: View, pattern: str, condition: Condition) -> None:
    """Checks that a charge is not compared with percent where all messages state fractions.

    As sensor_msgs/BatteryState asks for; some drivers publish percent, or no charge. Nothing is
    refused where there is no time to look at all messages.

    Raises:
        InvalidArgumentsError: it is.
    """
    test = condition.test
    if condition.field != "percentage" or not isinstance(test, Beyond) or test.limit <= FULL_CHARGE:
        return
    brief = View(view.memory, view.call.within(READING_S))
    try:
        charged, percent = (
            ReverseSearch(brief, pattern, replace(condition, test=beyond)).newest(MAX_NS)
            for beyond in (Beyond(0, above=True), Beyond(FULL_CHARGE, above=True))
        )
    except QueryTimeoutError:
        return
    if charged is not None and charge_of(brief.value(charged)) is not None and percent is None:
        raise InvalidArgumentsError(
            "value: percentage is a fraction here, from 0 to 1: "
            f"{test.limit:g} % is {test.limit / 100:g}"
        )


def _constant_number(view: View, value: JsonValue, field: str, type_name: str) -> JsonValue:
    """Returns the number of a constant, where a condition on a number gives its whole name.

    Else the value. A field is a number where the definition has one of its name.
    """
    word = value.strip() if isinstance(value, str) else ""
    if not _CONSTANT_NAME.fullmatch(word):
        return value
    is_number = re.compile(_NUMBER_FIELD.format(re.escape(field.rpartition(".")[2])), re.MULTILINE)
    for schema in _schemas_of(view, type_name):
        if is_number.search(_text_of(schema)):
            constants = _CONSTANT.findall(_text_of(schema))
            numbers = {number for name, number in constants if name == word}
            return int(numbers.pop()) if len(numbers) == 1 else value
    return value


def _schemas_of(view: View, type_name: str) -> list[Schema]:
    """Returns the definitions of a type in the first file that has it; none where it is damaged."""
    timeline = view.timeline
    topic = next((name for name in timeline.topics() if type_name in timeline.types_of(name)), None)
    if topic is None:
        return []
    try:
        channels = [*view.memory.reader.channels(timeline.first_with(topic, type_name).path)]
    except BagError:
        return []
    return [channel.schema for channel in channels if channel.type == type_name]


def _text_of(schema: Schema) -> str:
    return schema.text.decode("utf-8", "replace")


def score_limit(condition: Condition, min_score: float | None) -> tuple[str, ...]:
    """Returns the note for "never" on a limit of scores that was not asked for, or is above 1."""
    if not condition.min_score or (min_score is not None and min_score <= 1):
        return ()
    unless = "and most scores are from 0 to 1" if min_score else "unless min_score is given"
    return (f"detections with a score below {condition.min_score:g} do not count here, {unless}",)


def named_numbers(view: View, topics: Sequence[str], condition: Condition) -> tuple[str, ...]:
    """Returns the note on constants that have the word of a text condition, for "never"."""
    test = condition.test
    word = test.folded if isinstance(test, Contains | Equals) else None
    if condition.field or not word:
        return ()
    types = sorted({*chain.from_iterable(map(view.timeline.types_of, topics))})
    named = {
        constant: type_name
        for type_name in types[:_MOST_TYPES]
        for schema in _schemas_of(view, type_name)
        for constant in _constants_named(schema, "", word)
    }
    if not named:
        return ()
    of_types = listed([f"{constant} ({type_name})" for constant, type_name in named.items()])
    return (f"{abbreviate(word)} names {of_types}: ask equals on the field of that number",)


def compared_frames(view: View, topics: Sequence[str], condition: Condition) -> tuple[str, ...]:
    """Returns the note on the frames in which `near_position` compared; none for another test."""
    if not isinstance(condition.test, NearPosition):
        return ()
    named = [f"{', '.join(frames)} ({topic})" for topic, frames in position_frames(view, topics)]
    if not named:
        return ()
    axes = "x and y" if condition.test.z is None else "x, y and z"
    within = f"within {condition.test.tolerance_m:g} m"
    compared = f"near_position compared {axes} ({within}) in the frame of each message: "
    compared += listed(named)
    return (f"{compared}; {_ELSEWHERE}",)


def note_no_fix(view: View, topic: str, window: TimeWindow, fields: Sequence[str]) -> None:
    """Notes that numbers of a satellite receiver in a window include those without a fix."""
    types = view.timeline.types_of(topic)
    mapped = set(chain.from_iterable(map(view.extractor.fields_of, types)))
    if "fix_status" not in mapped or not _IN_DEGREES.intersection(fields):
        return
    no_fix = Condition(Beyond(0, above=False), "fix_status")
    newest = None
    with suppress(QueryTimeoutError):
        newest = ReverseSearch(view, topic, no_fix).newest(window.stop, window.start)
    if newest is not None:
        view.notes.add(
            f"until {unix_text(newest.time)} some messages have no fix (fix_status -1): their "
            "latitude, longitude and altitude are not its position, but count here"
        )


def may_be_elsewhere(view: View, topics: Sequence[str], condition: Condition) -> bool:
    """Returns whether positions of other tools' replies are in another frame than `near_position`.

    They are in the map where transforms lead there.
    """
    target = view.limits.map_frame
    if not isinstance(condition.test, NearPosition) or not target or condition.test.frame_id:
        return False
    others = {frame for _, frames in position_frames(view, topics) for frame in frames} - {target}
    try:
        return any(connects(view, (target, frame)) for frame in sorted(others))
    except QueryTimeoutError:
        return True


def _require_frame(view: View, topics: Sequence[str], condition: Condition) -> None:
    """Checks that positions of the topics are in the frame of a `near_position` that names one.

    Raises:
        InvalidArgumentsError: those of a topic are not.
    """
    test = condition.test
    asked = test.frame_id if isinstance(test, NearPosition) else None
    for topic, frames in position_frames(view, topics) if asked else ():
        if (asked or "").lstrip("/") not in {frame.lstrip("/") for frame in frames}:
            raise InvalidArgumentsError(
                f"value: frame_id is {abbreviate(asked)}, and near_position compares x and y in "
                f"the frame of each message, which is {', '.join(frames)} on {topic}; {_ELSEWHERE}"
            )


def position_frames(view: View, topics: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Returns the first topics that have positions, and the frames of these."""
    frames = [(topic, _frames_of_newest(view, topic)) for topic in topics[:_MOST_FRAMES]]
    return [(topic, of_topic) for topic, of_topic in frames if of_topic]


def _frames_of_newest(view: View, topic: str) -> list[str]:
    """Returns the frames of the positions in a topic's newest message; none where not known."""
    try:
        stored = view.stream.last(topic)
    except QueryTimeoutError:
        return []
    message = None if stored is None else view.bags.decode(stored)
    if stored is None or message is None:
        return []
    extractor, type_name = view.extractor, stored.type
    own_frame = extractor.frame(message)
    seen = detections_of(extractor.exact(message, type_name), own_frame)
    frames = {detection.frame_id for detection in seen if detection.place is not None}
    pose = extractor.pose(message, type_name)
    return sorted(filter(None, frames or {own_frame if pose is None else pose.frame_id}))


def _constants_named(schema: Schema, field: str, word: str) -> list[str]:
    """Returns the constants of a definition whose names have a word as a whole, with their values.

    Only the one whose name is the field's and the word, where there is one.
    """
    wanted = "_".join(word.upper().split())
    constants = _CONSTANT.findall(_text_of(schema)) if wanted else []
    whole = {wanted, f"{field.upper()}_{wanted}"}
    same = [(name, value) for name, value in constants if name in whole]
    shown = same or [pair for pair in constants if f"_{wanted}_" in f"_{pair[0]}_"]
    return [f"{name} = {value}" for name, value in dict.fromkeys(shown)]


def out_of_time(view: View, searched_to: Ns) -> QueryTimeoutError:
    """Returns the error of a search that found no match back to a time when it had to end."""
    back_to, budget_s = unix_text(searched_to), view.call.deadline.budget_s
    return QueryTimeoutError(
        f"no match back to {back_to}, and {budget_s:g} s are over; "
        f"{view.bags.filling_progress()}to continue from there, ask again with before={back_to}",
        searched_back_to=searched_to,
    )


class RowCondition:
    """Finds which rows of scans meet a condition: by their columns, also by those of their bags.

    A topic beyond its share of the store has not all of its columns there; where these leave many
    rows open, the columns of the bags mostly say it. What they leave open only messages can say.

    Args:
        view: of the call.
        condition: what is asked.
    """

    def __init__(self, view: View, condition: Condition) -> None:
        self._view = view
        self._test = ColumnCondition(condition, view.extractor)
        self._left_to_messages: set[str] = set()

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a row that meets it, as known without reading a column."""
        return self._test.may_match(parts)

    def unstated(self, rows: Rows) -> Mask:
        """Returns which rows of a table say nothing of the field, as far as columns show it."""
        return self._test.unstated(rows.table)

    def truth(self, rows: Rows) -> TruthValues:
        """Returns which rows of a table meet the condition.

        Bags are read for the rows that count alone.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        truth, channel = self._test.truth(rows.table), rows.table.channel
        is_stored = isinstance(rows.table, StoredTable) and "" not in rows.table.left_out
        if not is_stored or channel.type in self._left_to_messages or truth.is_settled:
            return truth
        index = np.arange(len(rows.table)) if rows.index is None else rows.index
        left = np.flatnonzero(truth.unsure[index])
        if left.size <= MOST_UNSURE:
            return truth
        surely, perhaps = truth.surely.copy(), truth.perhaps.copy()
        for positions, decoded in decoded_rows(self._view, rows.some(left)):
            of_bag = index[left[positions]]
            decoded_truth, at = self._test.truth(decoded.table), decoded.index
            surely[of_bag], perhaps[of_bag] = decoded_truth.surely[at], decoded_truth.perhaps[at]
            if (perhaps & ~surely)[of_bag].mean() > _MOST_LEFT:
                self._left_to_messages.add(channel.type)
                break
        return TruthValues(surely, perhaps)


class CandidateRows:
    """Finds the times of messages of a window that may meet a condition.

    Attributes:
        ruled_out: whether a message was left out, because its columns do not meet the condition.
        has_looked: whether any message was looked at.
    """

    def __init__(
        self, view: View, topics: Sequence[str], condition: Condition, window: TimeWindow
    ) -> None:
        self.ruled_out = False
        self.has_looked = False
        newest = view.timeline.latest
        # Of each topic, from when on all is looked at.
        self._left: dict[str, Ns] = dict.fromkeys(topics, min(window.stop, newest + 1))
        self._group: list[tuple[Ns, str]] = []
        self._view = view
        self._window = window
        self._test = RowCondition(view, condition)

    def _windows(self) -> Iterator[tuple[TimeWindow, Sequence[str]]]:
        """Yields the times at which a match can lie, newest first, and of which topics it would be.

        They do not overlap.
        """
        most = 1
        times = heapq.merge(*map(self._times_of, self._left), reverse=True)
        for time, topic in chain(times, [(MIN_NS - 1, "")]):
            group = self._group
            if group and (group[-1][0] - time > _TOGETHER_NS or len(group) >= most):
                (latest, _), (earliest, _) = group[0], group[-1]
                yield TimeWindow(earliest, latest + 1), sorted({topic for _, topic in group})
                # The first that may match mostly does; where many do not, more are read at once.
                most, self._group = min(2 * most, _MOST_TOGETHER), []
            self._group.append((time, topic))

    def messages(self) -> Iterator[StoredMessage]:
        """Yields the messages at the times at which a match can lie, newest first."""
        for window, topics in self._windows():
            yield from self._view.stream.messages(topics, window, newest_first=True)

    @property
    def reached(self) -> Ns:
        """The log time from which on all has been looked at, and what may match was searched."""
        return max(
            [*self._left.values(), *(time + 1 for time, _ in self._group[:1])], default=MIN_NS
        )

    def _times_of(self, topic: str) -> Iterator[tuple[Ns, str]]:
        """Yields the log times of messages of a topic that may match, newest first, each once."""
        waiting = _NO_TIMES  # ascending; no table that is left is newer than what was yielded

        def reached(last: Ns) -> None:
            newest = max([last, *waiting[-1:].tolist()])
            self._left[topic] = min(newest + 1, self._window.stop)

        def newest_after(last: Ns) -> Iterator[tuple[Ns, str]]:
            for time in map(int, waiting[np.searchsorted(waiting, last, "right") :][::-1]):
                self._left[topic] = time + 1
                yield time, topic

        for rows in scan(
            self._view,
            topic,
            self._window,
            newest_first=True,
            may_match=self._may_match,
            may_be_empty=True,
            reached=reached,
        ):
            yield from newest_after(rows.last)
            waiting = waiting[: np.searchsorted(waiting, rows.last, "right")]
            waiting = np.union1d(waiting, self._candidates(rows))
            reached(rows.last)
        yield from newest_after(MIN_NS)
        self._left[topic] = MIN_NS

    def _may_match(self, parts: PartZones) -> bool | Mask:
        may_match = self._test.may_match(parts)
        self.has_looked = True
        self.ruled_out |= not np.all(may_match)
        return may_match

    def _candidates(self, rows: Rows) -> IntArray:
        self.has_looked = True
        truth = self._test.truth(rows)
        if truth.is_none:
            self.ruled_out = True
            return _NO_TIMES
        may = truth.perhaps
        if rows.index is not None:
            may = may[rows.index]
        self.ruled_out |= not may.all()
        return rows.times[may]


def note_summarised(view: View, topic: str, fields: Iterable[str], window: TimeWindow) -> None:
    """Notes when arrays at or below some fields were too long to be more than summarised."""
    newest = view.stream.last(topic)
    if newest is None:
        return
    value = view.value(newest)
    paths = (view.extractor.own_path(field, newest.type) for field in fields)
    try:
        for condition in chain(*(summary_conditions(path, value) for path in paths)):
            candidates = CandidateRows(view, [topic], condition, window).messages()
            long = next((at for at in candidates if condition.matches(view.value(at))), None)
            if long is not None:
                array, _, _ = (condition.field or "").rpartition(".")
                view.notes.add_lack(
                    f"{topic}: where {array} is long it is only summarised, last at "
                    f"{unix_text(long.time)}, and its numbers are not looked at"
                )
    except QueryTimeoutError:
        view.notes.add_lack(f"{topic}: out of time: some arrays may be only summarised")


class ReverseSearch:
    """A search for one condition on the topics of a name or glob.

    Attributes:
        topics: the recorded topics that match.
        condition: what is searched for.

    Raises:
        InvalidArgumentsError: the condition names a frame in which a topic has no positions.
        NoDataError: there is no such topic.
    """

    def __init__(self, view: View, pattern: str, condition: Condition) -> None:
        self._view = view
        self.condition = condition
        self.topics = matching_topics(view, pattern)
        _require_frame(view, self.topics, condition)
        self._failures: dict[tuple[str, str], tuple[UndecodableError, Ns]] = {}
        self._has_decoded = False

    def newest(self, until: Ns, since: Ns = MIN_NS) -> StoredMessage | None:
        """Returns the newest match before a moment; notes report what could not be tested.

        Reads the messages whose columns may match, until one does; none before `since`.

        Raises:
            InvalidArgumentsError: no value of the topics can meet the condition.
            NoDataError: no message could be decoded.
            QueryTimeoutError: the call's time is over; reports how far back was searched.
        """
        window = TimeWindow(since, until)
        candidates = CandidateRows(self._view, self.topics, self.condition, window)
        noted_before = self._view.notes.keys()
        try:
            for stored in candidates.messages():
                if self.matches(stored):
                    read = TimeWindow(stored.time, MAX_NS)
                    self._view.notes.retract_outside(read, keep=noted_before)
                    self._view.stream.find_first_copy(stored)
                    self.note_untested(read.intersect(window))
                    return stored
        except QueryTimeoutError as error:
            if not candidates.has_looked:
                raise
            raise out_of_time(self._view, candidates.reached) from error
        self.close(window, is_found=False, ruled_out=candidates.ruled_out)
        return None

    def close(self, window: TimeWindow, *, is_found: bool, ruled_out: bool) -> None:
        """Ends a search that looked everywhere in a window, and notes what could not be tested.

        `ruled_out`: whether something in it was known to be no match, without being read.

        Raises:
            InvalidArgumentsError: nothing was found, and no value of the topics can be a match.
            NoDataError: nothing was found, since no message could be decoded.
        """
        if not is_found and self._failures and not self._has_decoded and not ruled_out:
            failure, _ = next(iter(self._failures.values()))
            if len(self._failures) > 1:
                self._note_undecodable(MIN_NS)
            raise with_notes(self._view, window, undecodable(failure))
        if not is_found:
            self.require_testable()
        self.note_untested(window)

    def require_testable(self) -> None:
        """Checks that some value of the topics can meet the condition: else "never" is no answer.

        Raises:
            InvalidArgumentsError: the newest value of none of the topics has what is tested.
        """
        are_texts = all(is_text(self._view, topic) for topic in self.topics)
        is_number_in_texts = are_texts and isinstance(self.condition.test, Equals)
        if not self.condition.can_be_refused and not is_number_in_texts:
            return
        refusals = []
        for topic in self.topics:
            refusal = self._refusal(topic)
            if refusal is None:
                return
            refusals.append(refusal)
        raise InvalidArgumentsError(f"{self.topics[0]}: {refusals[0]}")

    def require_met(self, until: Ns) -> None:
        """Checks that a message before a moment meets the condition, or that its topics may.

        Raises:
            InvalidArgumentsError: none does, and no value of the topics can.
        """
        try:
            self.require_testable()
        except InvalidArgumentsError:
            # The topic may have had other messages before.
            self.newest(until)

    def _refusal(self, topic: str) -> str | None:
        """Returns why no message of a topic can match, whichever type it has."""
        types = self._view.timeline.types_of(topic)
        if len(types) == 1:
            return self._refusal_of(topic, MAX_NS, types[0])
        refusals = []
        for type_name, totals in self._view.census(topic).items():
            refusal = self._refusal_of(topic, totals.last + 1, type_name)
            if refusal is None:
                return None
            refusals.append(f"of {type_name} {refusal}")
        return "; ".join(refusals) or None

    def _refusal_of(self, topic: str, before: Ns, type_name: str) -> str | None:
        """Returns why no message of a type can match, by the newest one that shows its fields."""
        window = TimeWindow(MIN_NS, before)
        messages = self._view.stream.messages([topic], window, newest_first=True)
        looked_at = islice(messages, _MOST_EMPTY)
        own = (stored for stored in looked_at if stored.type == type_name)
        newest = next(own, None)
        value = None if newest is None else self._view.value(newest)
        if newest is None or value is None:
            return None
        condition = self.condition.of_type(type_name, self._view.extractor)
        field, test = condition.field or "", condition.test
        if field and not shows_field(value, field):
            # An empty list does not show what its elements have, nor a part of the joints the rest.
            values = map(self._view.value, own)
            value = next((older for older in values if shows_field(older, field)), value)
        refusal = refusal_for(condition, value)
        word = test.folded if isinstance(test, Contains | Equals) else None
        if refusal is None or word is None:
            return refusal
        _, _, name = field.rpartition(".")
        constants = _constants_named(newest.record.channel.schema, name, word)
        if not constants:
            return refusal
        # Without a field the number is also found in the bytes of an id.
        ask = "" if field else ": ask equals on the field of that number"
        return f"{refusal}, such as {listed(constants)}{ask}"

    def matches(self, stored: StoredMessage) -> bool | None:
        """Whether a message meets the condition; None where it does not say, or is not decoded."""
        failures: list[UndecodableError] = []
        with self._view.call.stages.timed("extract"):
            message = self._view.bags.decode(stored, failures)
            if not failures:  # a message may be null, as JSON
                self._has_decoded = True
                value = self._view.extractor.exact(message, stored.type)
                own = self.condition.of_type(stored.type, self._view.extractor)
                return None if own.is_unstated(value) else own.matches(value)
        key = stored.topic, stored.type
        # The newest is reported, in whatever order messages are tested.
        if key not in self._failures or self._failures[key][1] < stored.time:
            self._failures[key] = failures[0], stored.time
        return None

    def note_untested(self, window: TimeWindow) -> None:
        """Notes which topics have messages in a window that could not be tested, or not wholly."""
        self._note_undecodable(window.start)
        for topic in self.topics if self.condition.looks_at_numbers else ():
            note_summarised(self._view, topic, [self.condition.array], window)

    def _note_undecodable(self, since: Ns) -> None:
        for (topic, type_name), (error, newest) in self._failures.items():
            if newest >= since:
                self._view.notes.complete = False
                kind = Reason(f"could not be decoded: {error.reason}", "topic", of="messages of ")
                self._view.notes.add(Note(kind, f"{topic} ({type_name})"))
