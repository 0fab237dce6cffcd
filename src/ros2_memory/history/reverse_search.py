"""Search backwards in time for the last message that meets a condition.

Zones and words of columns rule out most messages. At the times of the others, messages are read
from the merged stream, which decides which copies count.
"""

from __future__ import annotations

import heapq
import re
from bisect import bisect_left
from contextlib import suppress
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
from ros2_memory.analysis.facts import BATTERY, FULL_CHARGE, GOALS
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
    r"^[ \t]*(?:u?int[0-9]+|byte|char)[ \t]+([A-Z][A-Z0-9_]*)[ \t]*=[ \t]*(-?[0-9]+)\s*(?:#|$)",
    re.MULTILINE,
)
"""A constant that is a whole number, in the text of a message definition, as ROS 2 writes it."""
_CONSTANT_NAME: Final = re.compile(r"[A-Z][A-Z0-9_]*")
_NUMBER_FIELD: Final = r"^[ \t]*(?:u?int[0-9]+|byte|char|float[0-9]+)[ \t]+{}\b"
_MOST_EMPTY: Final = 200
"""At most this many messages are read to find one with elements in its lists."""
MOST_UNSURE: Final = 32
"""Up to this many unsure rows of a part are left to their messages; for more, bags are decoded."""
_MOST_LEFT: Final = 0.5
"""If the columns of a bag leave a larger share unsure, bags of that type are not decoded again."""
_FRACTIONS: Final = frozenset({"percentage", "relative_humidity"})
"""Fields that are fractions by the definitions of their messages."""
_FIX_FIELDS: Final = frozenset({"latitude", "longitude", "altitude"})
_MOST_TYPES: Final = 3
"""The constants of this many types are looked up: each reads the channels of a file."""
_MOST_FRAMES: Final = 3
"""The frames of this many topics are named: each reads one message."""
_GROUP_GAP_NS: Final = NS_PER_S
"""Candidates that are no farther apart are read as one group."""
_LARGEST_GROUP: Final = 256
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
    """Returns the condition of a question.

    If all topics have one type, the value may be the name of a level (WARN) of a log or status, or
    of a constant of the message definition if the field is a number.

    Args:
        view: of the call.
        pattern: name or glob of the topics.
        condition_type: such as "equals".
        value: what is compared.
        field: dot-path; may be a full path in the messages. Not needed for equal levels.
        min_score: least score of detections; None for the configured one.

    Raises:
        NoDataError: no such topic is recorded.
        InvalidArgumentsError: it is no condition.
    """
    limits = view.limits
    least = limits.min_score if min_score is None else min_score
    types = types_matching(view, pattern)
    type_name = next(iter(types)) if len(types) == 1 else ""
    if not field and condition_type == "equals":
        field = level_path(value, type_name)
    if field and type_name:
        field = view.extractor.own_path(field.strip(), type_name)
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


def types_matching(view: View, pattern: str) -> frozenset[str]:
    """Returns the types of the topics that a name or glob matches."""
    topics = matching_topics(view, pattern)
    return frozenset(chain.from_iterable(map(view.timeline.types_of, topics)))


def _require_fraction(view: View, pattern: str, condition: Condition) -> None:
    """Checks that fractions are not compared with percent: no message, or each, would match.

    sensor_msgs/BatteryState and RelativeHumidity ask for fractions, but some drivers publish
    percent, or no charge. A note says where a battery has stated both. Nothing is refused or noted
    if there is no time to look at all messages.

    Raises:
        InvalidArgumentsError: the limit is in percent, and all numbers are fractions.
    """
    test, field = condition.test, condition.field
    if field not in _FRACTIONS or not isinstance(test, Beyond):
        return
    brief = View(view.memory, view.call.within(READING_S), view.reach)
    with suppress(QueryTimeoutError):
        if newest_above(brief, pattern, field, FULL_CHARGE) is not None:
            for topic in matching_topics(brief, pattern):
                if BATTERY in view.timeline.types_of(topic):
                    view.notes.add(*_mixed_charges(brief, topic))
            return
        newest = newest_above(brief, pattern, field, 0) if test.limit > FULL_CHARGE else None
        value = None if newest is None else brief.value(newest)
        if isinstance(value, dict) and isinstance(value.get(field), float):
            raise InvalidArgumentsError(
                f"value: {field} is a fraction here, from 0 to 1: "
                f"{test.limit:g} % is {test.limit / 100:g}"
            )


def newest_above(
    view: View, pattern: str, field: str, limit: float, window: TimeWindow | None = None
) -> StoredMessage | None:
    """Returns the newest message (of a window) with a number above a limit in a field.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    search = ReverseSearch(view, pattern, Condition(Beyond(limit, above=True), field))
    asked = window or TimeWindow.everything()
    return search.newest(asked.stop, asked.start)


def _mixed_charges(view: View, topic: str) -> tuple[str, ...]:
    """Returns a note if a battery states fractions in its first recordings, then percent.

    Or the reverse, as after an update of its driver.
    """
    spans = sorted(view.timeline.recordings(topic).values())

    def is_percent(nth: int) -> bool:
        first, last = spans[nth]
        recorded = TimeWindow(first, last + 1)
        return newest_above(view, topic, "percentage", FULL_CHARGE, recorded) is not None

    was_percent = is_percent(0)
    if was_percent == is_percent(-1):
        return ()
    nth = bisect_left(range(len(spans)), True, key=lambda nth: is_percent(nth) != was_percent)
    (_, until), (since, _) = spans[nth - 1], spans[nth]
    was, now = "a fraction, from 0 to 1,", "percent"
    if was_percent:
        was, now = "percent", "a fraction, from 0 to 1,"
    switch = f"{was} until {unix_text(until)} and {now} from {unix_text(since)} on"
    return (f"percentage of {topic} is {switch}: ask about each time with a limit of its own",)


def _constant_number(view: View, value: JsonValue, field: str, type_name: str) -> JsonValue:
    """Returns the number of a constant if the value is its name and the field a number.

    Else returns the value.
    """
    word = value.strip() if isinstance(value, str) else ""
    if not _CONSTANT_NAME.fullmatch(word):
        return value
    shown, _, below = field.partition(".")
    path = below or ".".join(view.extractor.fields_of(type_name).get(shown, (shown,)))
    _, _, name = path.rpartition(".")
    number_field = re.compile(_NUMBER_FIELD.format(re.escape(name)), re.MULTILINE)
    texts = [_text_of(schema) for schema in _schemas_of(view, type_name)]
    numbers = {
        number
        for text in texts
        if number_field.search(text)
        for constant, number in _CONSTANT.findall(text)
        if constant == word
    }
    return int(numbers.pop()) if len(numbers) == 1 else value


def _schemas_of(view: View, type_name: str) -> list[Schema]:
    """Returns the definitions of a type in the first and the last file that have it.

    They differ after an update of the robot. None are returned of a damaged file.
    """
    timeline = view.timeline
    topic = next((name for name in timeline.topics() if type_name in timeline.types_of(name)), None)
    if topic is None:
        return []
    schemas: list[Schema] = []
    first, last = (find(topic, type_name) for find in (timeline.first_with, timeline.last_with))
    for path in dict.fromkeys((first.path, last.path)):
        with suppress(BagError):
            channels = view.memory.reader.channels(path)
            schemas += [channel.schema for channel in channels if channel.type == type_name]
    return schemas


def _text_of(schema: Schema) -> str:
    return schema.text.decode("utf-8", "replace")


def score_limit(condition: Condition, min_score: float | None) -> tuple[str, ...]:
    """Returns a note for "never" if the least score was not asked for, or is above 1."""
    if not condition.min_score or (min_score is not None and min_score <= 1):
        return ()
    unless = "and most scores are from 0 to 1" if min_score else "unless min_score is given"
    return (f"detections with a score below {condition.min_score:g} do not count here, {unless}",)


def named_numbers(view: View, topics: Sequence[str], condition: Condition) -> tuple[str, ...]:
    """Returns a note for "never" if constants of the topics' types have the word of the condition.

    Then a number stands for the word.
    """
    test = condition.test
    word = test.folded if isinstance(test, Contains | Equals) else None
    if condition.field or not word:
        return ()
    # The statuses of goals are searched by their words.
    types = sorted({*chain.from_iterable(map(view.timeline.types_of, topics))} - {GOALS})
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
    """Returns a note on the frames in which `near_position` compared; none for another test."""
    if not isinstance(condition.test, NearPosition):
        return ()
    named = [f"{', '.join(frames)} ({topic})" for topic, frames in position_frames(view, topics)]
    if not named:
        return ()
    axes = "x and y" if condition.test.z is None else "x, y and z"
    note = (
        f"near_position compared {axes} (within {condition.test.tolerance_m:g} m) in the frame of "
        f"each message: {listed(named)}; {_ELSEWHERE}"
    )
    return (note,)


def note_no_fix(view: View, topic: str, window: TimeWindow, fields: Sequence[str]) -> None:
    """Notes if numbers of a satellite receiver in a window are from messages without a fix."""
    types = view.timeline.types_of(topic)
    mapped = set(chain.from_iterable(map(view.extractor.fields_of, types)))
    if "fix_status" not in mapped or not _FIX_FIELDS.intersection(fields):
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
    """Returns whether `near_position` compared in other frames than other tools use.

    Other tools use the map if transforms lead there.
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
    """Checks that a topic has positions in the frame that `near_position` names, if it does.

    Raises:
        InvalidArgumentsError: a topic has positions in other frames.
    """
    asked = condition.test.frame_id if isinstance(condition.test, NearPosition) else None
    if not asked:
        return
    for topic, frames in position_frames(view, topics):
        if asked.lstrip("/") not in {frame.lstrip("/") for frame in frames}:
            raise InvalidArgumentsError(
                f"value: frame_id is {abbreviate(asked)}, and near_position compares x and y in "
                f"the frame of each message, which is {', '.join(frames)} on {topic}; {_ELSEWHERE}"
            )


def position_frames(view: View, topics: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Returns the topics that have positions, with the frames of these; reads the first few."""
    frames = [(topic, _frames_of_newest(view, topic)) for topic in topics[:_MOST_FRAMES]]
    return [(topic, of_topic) for topic, of_topic in frames if of_topic]


def _frames_of_newest(view: View, topic: str) -> list[str]:
    """Returns the frames of the positions in a topic's newest message; none if unknown."""
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
    """Returns the constants of a definition that a word names, with their values.

    A constant whose whole name is the word, or the field and the word, comes alone. Else all are
    returned that have the word between underscores.
    """
    wanted = "_".join(word.upper().split())
    constants = dict.fromkeys(_CONSTANT.findall(_text_of(schema))) if wanted else {}
    whole_names = {wanted, f"{field.upper()}_{wanted}"}
    named = [(name, value) for name, value in constants if name in whole_names]
    if not named:
        named = [(name, value) for name, value in constants if f"_{wanted}_" in f"_{name}_"]
    return [f"{name} = {value}" for name, value in named]


def out_of_time(view: View, searched_to: Ns) -> QueryTimeoutError:
    """Returns the error of a search that had to end without a match, back to a log time."""
    back_to, budget_s = unix_text(searched_to), view.call.deadline.budget_s
    return QueryTimeoutError(
        f"no match back to {back_to}, and {budget_s:g} s are over; "
        f"{view.bags.filling_progress()}to continue from there, ask again with before={back_to}",
        searched_back_to=searched_to,
    )


class RowCondition:
    """Finds which rows of scans meet a condition, by their columns.

    Large topics do not have all of their columns in the store. If these leave many rows unsure,
    their bags are decoded: their columns mostly tell. Rows that stay unsure are left to the
    messages.

    Args:
        view: of the call.
        condition: what is asked.
    """

    def __init__(self, view: View, condition: Condition) -> None:
        self._view = view
        self._test = ColumnCondition(condition, view.extractor)
        self._left_to_messages: set[str] = set()

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a row that meets it, by their zones."""
        return self._test.may_match(parts)

    def unstated(self, rows: Rows) -> Mask:
        """Returns which rows of the table lack the field; of rows that count alone, if decoded.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        unstated = self._test.unstated(rows.table)
        if unstated is not None:
            return unstated
        index = np.arange(len(rows.table)) if rows.index is None else rows.index
        unstated = np.zeros(len(rows.table), np.bool_)
        for positions, decoded in decoded_rows(self._view, rows):
            of_bag = self._test.unstated(decoded.table)
            if of_bag is not None:
                unstated[index[positions]] = of_bag[decoded.index]
        return unstated

    def truth(self, rows: Rows) -> TruthValues:
        """Returns which rows of the table meet the condition.

        Bags are decoded only for rows that count.

        Raises:
            QueryTimeoutError: the call's time is over.
        """
        truth, channel = self._test.truth(rows.table), rows.table.channel
        is_stored = isinstance(rows.table, StoredTable) and "" not in rows.table.left_out
        if not is_stored or channel.type in self._left_to_messages or truth.is_settled:
            return truth
        index = np.arange(len(rows.table)) if rows.index is None else rows.index
        unsure = np.flatnonzero(truth.unsure[index])
        if unsure.size <= MOST_UNSURE:
            return truth
        surely, perhaps = truth.surely.copy(), truth.perhaps.copy()
        for positions, decoded in decoded_rows(self._view, rows.some(unsure)):
            in_table = index[unsure[positions]]
            of_bag, in_bag = self._test.truth(decoded.table), decoded.index
            surely[in_table], perhaps[in_table] = of_bag.surely[in_bag], of_bag.perhaps[in_bag]
            if (perhaps & ~surely)[in_table].mean() > _MOST_LEFT:
                self._left_to_messages.add(channel.type)
                break
        return TruthValues(surely, perhaps)


class CandidateRows:
    """Finds the messages of a window that may meet a condition, by their columns.

    Attributes:
        ruled_out: whether columns showed that some message does not meet the condition.
        has_looked: whether any message, or its columns, were looked at.
    """

    def __init__(
        self, view: View, topics: Sequence[str], condition: Condition, window: TimeWindow
    ) -> None:
        self.ruled_out = False
        self.has_looked = False
        end = min(window.stop, view.timeline.latest + 1)
        # By topic, the log time from which on all of its candidates are known.
        self._scanned_to: dict[str, Ns] = dict.fromkeys(topics, end)
        # The candidates that are read next, newest first: log time and topic.
        self._group: list[tuple[Ns, str]] = []
        self._view = view
        self._window = window
        self._test = RowCondition(view, condition)

    def messages(self) -> Iterator[StoredMessage]:
        """Yields the messages at the times of candidates, newest first."""
        for window, topics in self._windows():
            yield from self._view.stream.messages(topics, window, newest_first=True)

    @property
    def reached(self) -> Ns:
        """The log time from which on all messages were searched."""
        unread = [time + 1 for time, _ in self._group[:1]]
        return max([*self._scanned_to.values(), *unread], default=MIN_NS)

    def _windows(self) -> Iterator[tuple[TimeWindow, Sequence[str]]]:
        """Yields the windows of groups of candidates, newest first, with the topics of these.

        They do not overlap. The first candidate mostly matches, so the first group is small; if it
        does not, groups grow.
        """
        largest = 1
        by_topic = [self._candidates_of(topic) for topic in self._scanned_to]
        candidates = heapq.merge(*by_topic, reverse=True)
        for time, topic in chain(candidates, [(MIN_NS - 1, "")]):
            group = self._group
            if group:
                (newest, _), (oldest, _) = group[0], group[-1]
                if oldest - time > _GROUP_GAP_NS or len(group) >= largest:
                    yield TimeWindow(oldest, newest + 1), sorted({name for _, name in group})
                    largest = min(2 * largest, _LARGEST_GROUP)
                    self._group = []
            self._group.append((time, topic))

    def _candidates_of(self, topic: str) -> Iterator[tuple[Ns, str]]:
        """Yields the log times of candidates of a topic, newest first, each once."""
        pending = _NO_TIMES  # ascending: candidates that a later table may still precede

        def note_progress(last: Ns) -> None:
            newest = max([last, *pending[-1:].tolist()])
            self._scanned_to[topic] = min(newest + 1, self._window.stop)

        def pending_after(last: Ns) -> Iterator[tuple[Ns, str]]:
            for time in map(int, pending[np.searchsorted(pending, last, "right") :][::-1]):
                self._scanned_to[topic] = time + 1
                yield time, topic

        for rows in scan(
            self._view,
            topic,
            self._window,
            newest_first=True,
            may_match=self._may_match,
            may_be_empty=True,
            reached=note_progress,
        ):
            yield from pending_after(rows.last)
            pending = pending[: np.searchsorted(pending, rows.last, "right")]
            pending = np.union1d(pending, self._candidate_times(rows))
            note_progress(rows.last)
        yield from pending_after(MIN_NS)
        self._scanned_to[topic] = MIN_NS

    def _may_match(self, parts: PartZones) -> bool | Mask:
        may_match = self._test.may_match(parts)
        self.has_looked = True
        self.ruled_out |= not np.all(may_match)
        return may_match

    def _candidate_times(self, rows: Rows) -> IntArray:
        self.has_looked = True
        truth = self._test.truth(rows)
        if truth.is_none:
            self.ruled_out = True
            return _NO_TIMES
        perhaps = truth.perhaps if rows.index is None else truth.perhaps[rows.index]
        self.ruled_out |= not perhaps.all()
        return rows.times[perhaps]


def note_summarised(view: View, topic: str, fields: Iterable[str], window: TimeWindow) -> None:
    """Notes if long arrays at or below some fields are only summarised in messages of a window."""
    try:
        newest = view.stream.last(topic)
        if newest is None:
            return
        value = view.value(newest)
        paths = (view.extractor.own_path(field, newest.type) for field in fields)
        for condition in chain.from_iterable(summary_conditions(path, value) for path in paths):
            candidates = CandidateRows(view, [topic], condition, window).messages()
            long = next((one for one in candidates if condition.matches(view.value(one))), None)
            if long is not None:
                array, _, _ = (condition.field or "").rpartition(".")
                view.notes.add_lack(
                    f"{topic}: where {array} is long it is only summarised, last at "
                    f"{unix_text(long.time)}, and its numbers are not looked at"
                )
    except QueryTimeoutError:
        view.notes.add_lack(f"{topic}: out of time: some arrays may be only summarised")


class ReverseSearch:
    """A search for a condition on the topics of a name or glob.

    Attributes:
        topics: the recorded topics that match the name or glob.
        condition: the condition.

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
        """Returns the newest match before `until` and not before `since` (log times).

        Notes report what could not be tested.

        Raises:
            InvalidArgumentsError: no value of the topics can meet the condition.
            NoDataError: no message could be decoded.
            QueryTimeoutError: the call's time is over. It has how far back was searched.
        """
        window = TimeWindow(since, until)
        candidates = CandidateRows(self._view, self.topics, self.condition, window)
        noted_before = self._view.notes.so_far()
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
        """Ends a search that looked everywhere in a window; notes what could not be tested.

        `ruled_out`: whether columns showed that some message is no match.

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
        """Checks that a value of the topics can meet the condition: else "never" is no answer.

        Raises:
            InvalidArgumentsError: the newest values of all topics lack what is tested.
        """
        are_texts = all(is_text(self._view, topic) for topic in self.topics)
        is_number_in_texts = are_texts and isinstance(self.condition.test, Equals)
        if not self.condition.can_be_refused and not is_number_in_texts:
            return
        first, *others = self.topics
        refusal = self._refusal(first)
        if refusal is not None and all(self._refusal(topic) is not None for topic in others):
            raise InvalidArgumentsError(f"{first}: {refusal}")

    def require_met(self, until: Ns) -> None:
        """Checks that a message before a moment meets the condition, or that its topics may.

        Raises:
            InvalidArgumentsError: no message does, and no value of the topics can.
        """
        try:
            self.require_testable()
        except InvalidArgumentsError:
            # Older messages may have had other fields; if not, this raises the error.
            self.newest(until)

    def _refusal(self, topic: str) -> str | None:
        """Returns why no message of a topic can match; None if one may."""
        types = self._view.timeline.types_of(topic)
        if len(types) == 1:
            return self._refusal_of_type(topic, MAX_NS, types[0])
        refusals = []
        for type_name, totals in self._view.census(topic).items():
            refusal = self._refusal_of_type(topic, totals.last + 1, type_name)
            if refusal is None:
                return None
            refusals.append(f"of {type_name} {refusal}")
        return "; ".join(refusals) or None

    def _refusal_of_type(self, topic: str, before: Ns, type_name: str) -> str | None:
        """Returns why no message of a type can match, by the newest message with its fields."""
        condition = self.condition.of_type(type_name, self._view.extractor)
        field, test = condition.field or "", condition.test
        messages = self._view.stream.messages(
            [topic], TimeWindow(MIN_NS, before), newest_first=True
        )
        newest, value = None, None
        for stored in islice(messages, _MOST_EMPTY):
            if stored.type != type_name:
                continue
            read = self._view.with_examples(self._view.value(stored), stored)
            if newest is None:
                newest, value = stored, read
                if value is None:
                    return None
            # An empty list does not show what its elements have, nor one joint what others have.
            if not field or shows_field(read, field):
                value = read
                break
        if newest is None:
            return None
        refusal = refusal_for(condition, value)
        word = test.folded if isinstance(test, Contains | Equals) else None
        if refusal is None or word is None:
            return refusal
        _, _, name = field.rpartition(".")
        constants = _constants_named(newest.record.channel.schema, name, word)
        if not constants:
            return refusal
        # Without a field, the number would also match in the bytes of an id.
        advice = "" if field else ": ask equals on the field of that number"
        return f"{refusal}, such as {listed(constants)}{advice}"

    def matches(self, stored: StoredMessage) -> bool | None:
        """Whether a message meets the condition; None if it lacks the field, or is not decoded."""
        failures: list[UndecodableError] = []
        with self._view.call.stages.timed("extract"):
            message = self._view.bags.decode(stored, failures)
            if not failures:  # a message may be null, as JSON
                self._has_decoded = True
                value = self._view.extractor.exact(message, stored.type)
                own = self.condition.of_type(stored.type, self._view.extractor)
                return None if own.is_unstated(value) else own.matches(value)
        key = stored.topic, stored.type
        # The newest failure is reported; messages may be tested in any order.
        if key not in self._failures or self._failures[key][1] < stored.time:
            self._failures[key] = failures[0], stored.time
        return None

    def note_untested(self, window: TimeWindow) -> None:
        """Notes on which topics messages of a window could not be tested, or only in part."""
        self._note_undecodable(window.start)
        if self.condition.looks_at_numbers:
            for topic in self.topics:
                note_summarised(self._view, topic, [self.condition.array], window)

    def _note_undecodable(self, since: Ns) -> None:
        for (topic, type_name), (error, newest) in self._failures.items():
            if newest >= since:
                kind = Reason(f"could not be decoded: {error.reason}", "topic", of="messages of ")
                self._view.notes.add_lack(Note(kind, f"{topic} ({type_name})"))
