"""Sightings: consecutive matches of a condition, with where the robot and the thing were.

A sighting is message after message of one topic that meets a condition. It ends with a message of
that topic that does not, and where the topic is silent for longer than `SILENCE_NS`: a detector may
publish only what it sees. A message that cannot be decoded is neither a match nor an end. Of the
status of an action each goal is a sighting, of a log each message.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from ros2_memory.analysis.conditions import NearPosition, matched_texts
from ros2_memory.analysis.frames import TF_CACHE_NS
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.geometry import transform_point
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import Quoted, named, quote
from ros2_memory.core.timebase import (
    MIN_NS,
    Ns,
)
from ros2_memory.counts.tested import tested
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_unread, recorded_reach, unix_text
from ros2_memory.history.no_data import matching_topics, require_recorded
from ros2_memory.history.reverse_search import (
    ReverseSearch,
    compared_frames,
    condition_of,
    unasked_limit,
)
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.transforms import connects, transform_at
from ros2_memory.history.view import TimeRange, clamped, open_view, search_window
from ros2_memory.insights.episodes import (
    SaidMeanwhile,
    episode_times,
    find_episodes,
    says_episodes,
    with_robot,
)
from ros2_memory.insights.goals import goals_asked
from ros2_memory.insights.sighting_search import find_runs
from ros2_memory.insights.silences import describe_silences
from ros2_memory.messages.detections import detections_of
from ros2_memory.places.pose_frames import robot_at
from ros2_memory.places.scope import Scope
from ros2_memory.results import Episode, LabelledPlace, Sighting, Sightings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.model import JsonValue, Pose
    from ros2_memory.counts.tested import Tested
    from ros2_memory.history.candidates import Candidate
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.insights.goals import GoalRun
    from ros2_memory.insights.sighting_search import Found, Run
    from ros2_memory.messages.detections import Detection
    from ros2_memory.places.scope import WhileCondition

_Row = TypeVar("_Row", Sighting, Episode)
_MOST_TRIED: Final = 5
"""Messages before the newest of a sighting that are tried for the place of the thing."""
_LEFT_TO_SAY_S: Final = 2.0
"""How long the messages of what was found are read after a search ran out of time."""
MAX_COUNTED: Final = 20_000
"""Sightings that are counted over time."""


@dataclass(slots=True)
class _Matches:
    """Consecutive matches on one topic, collected from the newest on.

    Attributes:
        topic: the topic.
        last: log time of the last match.
        first: log time of the earliest match so far.
        reach: log time of the earliest message so far, also of one that cannot be decoded.
        begun: whether what came before the earliest match is known.
        until: log time of the next message, which does not match or count; None where that is not
            known.
    """

    topic: str
    last: Ns
    first: Ns
    reach: Ns
    messages: int = 1
    begun: bool = False
    until: Ns | None = None


def find_matches(
    memory: Memory,
    call: Call,
    topic: str,
    condition_type: str,
    value: JsonValue,
    *,
    field: str | None = None,
    fields: Sequence[str] = (),
    start_s: float | None = None,
    end_s: float | None = None,
    last_s: float | None = None,
    limit: int = 5,
    oldest_first: bool = False,
    min_score: float | None = None,
    where: JsonValue = None,
    during: Sequence[WhileCondition] = (),
    frame_id: str | None = None,
    beside: str | None = None,
) -> Sightings:
    """Returns the newest `limit` sightings on a topic, or on all topics of a glob, newest first.

    Of texts that hold until the next one they are episodes (`insights.episodes`). With `beside`
    each has what that topic said meanwhile.

    `start_s` and `end_s` (Unix seconds, inclusive), or `last_s` (before now), bound what is
    searched. With `oldest_first` all of it is searched, and the oldest sightings are returned. A
    sighting has the `fields` (dot-paths) of its last message. Detections of a score below
    `min_score` do not count.
    With `where` only messages count that were received while the robot was there, with `during`
    while another topic met a condition. Robot positions are in the map, or in `frame_id`.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, the bounds make no window, or no
            sighting has one of the fields.
        NoDataError: nothing is recorded, or no such topic.
        QueryTimeoutError: the call's time is over before anything was found.
    """
    span = TimeRange(start_s, end_s, last_s)
    wall = memory.clock.now()
    view = open_view(memory, call, min(search_window(span, wall).stop, wall))
    now = memory.now(wall, view.snapshot.latest, call)
    asked = search_window(span, now)
    require_recorded(view, asked)
    condition = condition_of(view, topic, condition_type, value, field=field, min_score=min_score)
    window = clamped(view, asked)
    scope = Scope(view, window, where, during)
    other = None if beside is None else SaidMeanwhile(view, beside)
    topics, shown = matching_topics(view, topic), _Shown(limit, oldest_first, frame_id)
    goals = goals_asked(view, topics, condition, scope)
    is_spoken = goals is None and says_episodes(view, topics)
    if goals is not None:
        rows = _of_goals(view, goals, window, shown)
    elif is_spoken:
        rows = _of_texts(view, topics[0], condition, scope, shown)
    else:
        rows = _of_matches(view, ReverseSearch(view, topic, condition), scope, shown, fields)
    elapsed = elapsed_in(view, rows.searched)
    sightings = tuple(_finished(each, elapsed, other) for each in rows.sightings)
    episodes = tuple(_finished(each, elapsed, other) for each in rows.episodes)
    shown_rows = len(sightings) + len(episodes)
    note_robots_on(view, topics, rows.searched)
    note_unread(
        view,
        rows.searched,
        nothing=rows.is_nothing,
        search=True,
        gaps=rows.is_nothing or not is_spoken,
    )
    if rows.is_nothing:
        silences = describe_silences(view, topics, rows.searched)
        for sentence in (*silences, *unasked_limit(condition, min_score)):
            view.notes.add(sentence)
    for sentence in (*compared_frames(view, topics, condition), *scope.compared_frames):
        view.notes.add(sentence)
    start, end = window.asked()
    first, last = recorded_reach(view.snapshot, window) or (start, end)
    start = min(max(start, first), end)
    end = max(min(end, last), start)
    return Sightings(
        sightings,
        more=rows.total is None or rows.total > shown_rows,
        total=rows.total,
        start=start,
        end=end,
        now=now,
        unknown=elapsed.among(scope.unknown),
        topic="" if topics[1:] else topics[0],
        of_texts=is_spoken,
        episodes=episodes,
        notes=view.notes.sentences(),
    )


class _Shown(NamedTuple):
    """How many rows are shown, which of them, and the frame of the robot's positions."""

    limit: int
    oldest_first: bool
    frame_id: str | None


class _Rows(NamedTuple):
    """The rows of a reply; `total` is None where the search ended before it had counted all.

    `searched` is the part of the window in which all matches are known.
    """

    total: int | None
    searched: TimeWindow
    is_nothing: bool
    sightings: tuple[Sighting, ...] = ()
    episodes: tuple[Episode, ...] = ()


def _finished(row: _Row, elapsed: Elapsed, other: SaidMeanwhile | None) -> _Row:
    """Returns a row with how much of its time the clock skipped, and what was said meanwhile."""
    return replace(
        row,
        skipped=elapsed.skipped_between(row.first, row.until),
        said=None if other is None else other.during(row.first, row.until),
    )


def _of_goals(view: View, goals: list[GoalRun], window: TimeWindow, shown: _Shown) -> _Rows:
    view.notes.retract_before(window.start)
    found = tuple(
        _goal_sighting(view, each, shown.frame_id)
        for each in (goals[::-1] if shown.oldest_first else goals)[: shown.limit]
        if view.call.wants(each.last)
    )
    return _Rows(len(goals), window, not goals, sightings=found)


def _of_texts(view: View, topic: str, condition: Condition, scope: Scope, shown: _Shown) -> _Rows:
    texts = find_episodes(
        view, topic, condition, scope, limit=shown.limit, oldest_first=shown.oldest_first
    )
    searched = scope.window
    if texts.since is not None:
        searched = TimeWindow(texts.since, searched.stop)
    view.notes.retract_before(searched.start)
    found = tuple(
        with_robot(view, topic, each, shown.frame_id)
        for each in texts.episodes
        if view.call.wants(each.until)
    )
    return _Rows(texts.total, searched, not texts.episodes, episodes=found)


def _of_matches(
    view: View, search: ReverseSearch, scope: Scope, shown: _Shown, fields: Sequence[str]
) -> _Rows:
    is_log, window = view.snapshot.timeline.is_log, scope.window
    collected = _Sightings(shown.limit, is_log, oldest_first=shown.oldest_first)
    if scope.is_bounded:
        _collect(view, search, scope, collected)
    else:
        enough = None if shown.oldest_first else shown.limit
        collected.take(find_runs(view, search, window, is_log, enough=enough), view)
    searched = window
    if collected.cut and collected.selected:
        searched = TimeWindow(collected.selected[-1].first, window.stop)
    view.notes.retract_before(searched.start)
    # To say where the robot was takes longest.
    wanted = [
        (matches, newest)
        for matches in collected.selected
        if view.call.wants(matches.last) and (newest := _newest(view, matches)) is not None
    ]
    found = tuple(
        _sighting(view, search.condition, matches, newest, scope=scope, frame_id=shown.frame_id)
        for matches, newest in wanted
    )
    if fields:
        found = _with_fields(view, found, [newest for _, newest in wanted], fields)
    total = None if collected.cut else collected.count
    return _Rows(total, searched, not collected.selected, sightings=found)


def read_sightings(
    view: View, pattern: str, condition: Condition, scope: Scope
) -> tuple[list[tuple[Ns, Ns]], Ns | None]:
    """Returns the times (inclusive) of all sightings in a scope, oldest first.

    With them since when they are known, where the call's time is over before all is searched.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: there is no such topic, or none of its messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    goals = goals_asked(view, matching_topics(view, pattern), condition, scope)
    if goals is not None:
        return [(each.first, each.last) for each in reversed(goals)], None
    topics = matching_topics(view, pattern)
    if says_episodes(view, topics):
        return episode_times(view, topics[0], condition, scope)
    is_log = view.snapshot.timeline.is_log
    if not scope.is_bounded:
        search = ReverseSearch(view, pattern, condition)
        runs = find_runs(view, search, scope.window, is_log, enough=None)
        if runs.is_over:
            view.bags.finish_within(_LEFT_TO_SAY_S)
        spans = [(run.first, _until(view, run, scope)) for run in reversed(runs.runs)]
        return spans, spans[0][0] if runs.is_over else None
    found = _Sightings(MAX_COUNTED, is_log, oldest_first=True)
    _collect(view, ReverseSearch(view, pattern, condition), scope, found)
    if found.count > MAX_COUNTED:
        view.notes.add(f"only the first {MAX_COUNTED} of {found.count} sightings are counted")
    spans = [(each.first, _until(view, each, scope)) for each in found.selected]
    return spans, spans[0][0] if found.cut and spans else None


def _collect(view: View, search: ReverseSearch, scope: Scope, found: _Sightings) -> None:
    """Collects the matches in a window, newest first, until there are enough.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: none of the topics' messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    window = scope.window
    candidates = search.candidates(window.stop)
    before = window.stop
    try:
        parts = _parts(candidates.windows(), window)
        for part, topics in scope.narrowed(parts):
            found.end_silent(part.stop)
            _end_in_gap(view, found, TimeWindow(part.stop, max(before, part.stop)))
            # Only topics that can begin or end a sighting are read: there may be thousands.
            relevant = sorted({*topics, *found.open_topics()})
            found.newer.clear()
            for each in tested(view, search, relevant, part):
                before = each.time
                found.end_silent(each.time)
                # Where the scope does not hold, a match counts as no match.
                if each.met and scope.holds_at(each.time):
                    found.add(each)
                elif each.met is None:
                    found.skip(each)
                else:
                    found.end(each.topic)
                    found.newer[each.topic] = each.time
                if found.enough:
                    _stop(search, found)
                    return
            before = part.start
    except QueryTimeoutError:
        if not found.count:
            raise
        found.cut = True
        _note_out_of_time(view, before)
        return
    for topic in found.open_topics():
        found.end(topic)
    if found.enough:
        _stop(search, found)
    else:
        # What lies outside of a scope is not read, and may well be decodable.
        candidates.ruled_out |= scope.is_bounded
        search.close(candidates, window, found=bool(found.count))


def _note_out_of_time(view: View, reached: Ns) -> None:
    view.notes.complete = False
    view.notes.add(
        f"the search ran out of time at {unix_text(reached)}: to continue, pass that time as end"
    )


def _end_in_gap(view: View, found: _Sightings, gap: TimeWindow) -> None:
    """Ends the sightings of topics that have a message in a time without a match."""
    for topic in found.open_topics():
        if _has_messages(view, topic, gap):
            found.end(topic)


def _stop(search: ReverseSearch, found: _Sightings) -> None:
    """Ends a search that has enough."""
    found.cut = True
    search.note_undecodable(found.selected[-1].first)


class _Sightings:
    """Collects matches that come newest first; selects the newest or the oldest sightings.

    Args:
        limit: how many are selected.
        is_log: whether each message of a topic is a sighting of its own.
        oldest_first: whether the oldest are selected.

    Attributes:
        count: how many sightings there are so far.
        cut: whether the search ended before all was searched, or might have.
        newer: log time of the earliest message of each topic so far that does not count, in the
            part that is searched.
    """

    def __init__(self, limit: int, is_log: Callable[[str], bool], *, oldest_first: bool) -> None:
        self._limit = limit
        self._is_log = is_log
        self._oldest_first = oldest_first
        self._kept: deque[_Matches] = deque(maxlen=limit if oldest_first else None)
        self._open: OrderedDict[str, _Matches] = OrderedDict()  # least recently matched first
        self.count = 0
        self.cut = False
        self.newer: dict[str, Ns] = {}

    def add(self, found: Tested) -> None:
        """Adds the next older match; call `end_silent` with its time before."""
        topic, time = found.topic, found.time
        matches = self._open.get(topic)
        if matches is None:
            until = self.newer.get(topic)
            matches = _Matches(topic, time, time, time, until=until)
            self._open[topic] = matches
            self._kept.append(matches)
            self.count += 1
            if self._is_log(topic):
                self.end(topic)
        else:
            matches.first = matches.reach = time
            matches.messages += 1
            self._open.move_to_end(topic)

    def take(self, found: Found, view: View) -> None:
        """Takes runs of matches in place of single ones."""
        self.cut = found.searched_to is not None
        self.count = len(found.runs)
        self._kept.extend(
            _Matches(run.topic, run.last, run.first, run.first, run.messages, run.begun, run.until)
            for run in found.runs
        )
        if found.is_over:
            view.bags.finish_within(_LEFT_TO_SAY_S)
            _note_out_of_time(view, found.searched_to or MIN_NS)

    def skip(self, found: Tested) -> None:
        """Adds a message that cannot be decoded: no match, but it ends no sighting either."""
        matches = self._open.get(found.topic)
        if matches is not None:
            matches.reach = found.time
            self._open.move_to_end(found.topic)

    def end_silent(self, until: Ns) -> None:
        """Ends the sightings to which no message before a moment can belong."""
        while self._open:
            matches = next(iter(self._open.values()))
            if matches.reach - until <= SILENCE_NS:
                return
            self.end(matches.topic)

    def end(self, topic: str) -> None:
        """Ends the sighting of a topic: its next match begins another one."""
        matches = self._open.pop(topic, None)
        if matches is not None:
            matches.begun = True

    def open_topics(self) -> tuple[str, ...]:
        """Returns the topics whose sighting may have begun earlier."""
        return tuple(self._open)

    @property
    def selected(self) -> list[_Matches]:
        """As many sightings as were asked for, in the order that was asked for."""
        if self._oldest_first:
            return [*reversed(self._kept)]
        return [*islice(self._kept, self._limit)]

    @property
    def enough(self) -> bool:
        """Whether no older match can change the sightings that are selected."""
        return (
            not self._oldest_first
            and self.count > self._limit
            and all(matches.begun for matches in self.selected)
        )


def _parts(
    windows: Iterator[Candidate], window: TimeWindow
) -> Iterator[tuple[TimeWindow, Sequence[str]]]:
    """Yields the parts of a window in which topics can have matches, and these, newest first."""
    for each in windows:
        if each.window.stop <= window.start:
            return
        part = each.window.intersect(window)
        if not part.empty:
            yield part, each.topics


def _has_messages(view: View, topic: str, gap: TimeWindow) -> bool:
    """Whether a topic has a message in a time; by the index where that is enough."""
    if gap.empty:
        return False
    held = view.stream.overlapping_bags([topic], gap)
    is_alone = len({each.bag.recording for each in held}) == 1
    counts = is_alone and not view.stream.may_be_relatched([topic])
    if counts and any(gap.contains(each.first) or gap.contains(each.last) for each in held):
        return True
    return bool(held) and view.stream.first([topic], gap) is not None


def _newest(view: View, matches: _Matches) -> StoredMessage | None:
    """Returns the last match; None where its bag was deleted since."""
    at = TimeWindow(matches.last, matches.last + 1)
    return view.stream.first([matches.topic], at, newest_first=True)


def _until(view: View, matches: _Matches | Run, scope: Scope) -> Ns:
    """Returns until when a state lasted: to the message that says otherwise, or the window's end.

    To its last match where a silence, or the end of a scope, is next; so does a log entry.
    """
    last, until = matches.last, matches.until
    if view.snapshot.timeline.is_log(matches.topic):
        return last
    if until is None:
        after = TimeWindow(last + 1, last + SILENCE_NS + 1)
        found = view.stream.first([matches.topic], after)
        until = last if found is None else found.time
    until = max(last, min(until, scope.window.asked()[1]))
    return until if until - last <= SILENCE_NS and scope.holds_at(until) else last


def _sighting(
    view: View,
    condition: Condition,
    matches: _Matches,
    newest: StoredMessage,
    *,
    scope: Scope,
    frame_id: str | None,
) -> Sighting:
    """Returns the result, with where the robot was and, at the newest match, the thing.

    What happens is where the robot was when it began; a thing is where it was last seen from.
    """
    message = view.memory.reader.decode(newest.record)
    value = condition.counted(view.memory.extractor.exact(message, newest.record.channel.type))
    seen = detections_of(value, view.memory.extractor.frame(message))
    thing, labels = _matching(seen, condition), {each.label for each in seen}
    robot_at_first = thing is None and matches.begun
    at = matches.first if robot_at_first else newest.time
    robot = robot_at(view, at, _recording_at(view, newest, at), frame_id)
    return Sighting(
        topic=matches.topic,
        first=matches.first,
        last=matches.last,
        until=_until(view, matches, scope) if thing is None else matches.last,
        messages=matches.messages,
        begun=matches.begun,
        robot=robot,
        thing=_spot_of(
            view, condition, newest, matches.first, robot, thing=thing, frame_id=frame_id
        ),
        matched=tuple(
            named(text) if text in labels else Quoted(text)
            for text in matched_texts(condition, value)
        ),
        score=None if thing is None else thing.score,
        robot_at_first=robot_at_first,
    )


def _goal_sighting(view: View, goal: GoalRun, frame_id: str | None) -> Sighting:
    """Returns a goal of an action as a sighting, with where the robot was when it ended."""
    newest = view.stream.newest(goal.topic, TimeWindow(MIN_NS, goal.last + 1))
    return Sighting(
        topic=goal.topic,
        first=goal.first,
        last=goal.last,
        until=goal.last,
        messages=0,
        begun=goal.accepted is not None,
        robot=None
        if newest is None
        else robot_at(view, newest.time, newest.bag.recording, frame_id),
        thing=None,
        value={"goal": goal.goal, "status": goal.status_word},
    )


def _with_fields(
    view: View,
    sightings: Sequence[Sighting],
    found: Sequence[StoredMessage],
    fields: Sequence[str],
) -> tuple[Sighting, ...]:
    """Returns the sightings with the fields of their last messages in place of matched texts.

    Raises:
        InvalidArgumentsError: none of them has these fields.
    """
    extended: list[Sighting] = []
    refused: list[InvalidArgumentsError] = []
    for sighting, newest in zip(sightings, found, strict=True):
        record = newest.record
        message = view.memory.reader.decode(record)
        try:
            shown = view.memory.extractor.shown(message, record.channel.type, fields)
        except InvalidArgumentsError as error:
            refused.append(error)
            extended.append(sighting)
            continue
        for sentence in shown.notes:
            view.notes.add(sentence)
        extended.append(replace(sighting, matched=(), value=quote(shown.value)))
    if refused and len(refused) == len(extended):
        raise refused[0]
    return tuple(extended)


def _recording_at(view: View, newest: StoredMessage, at: Ns) -> Path:
    """Returns the recording of a sighting's message at a time: its last may be of a later one."""
    topic, own = newest.record.channel.topic, newest.bag.recording
    bags = view.stream.overlapping_bags([topic], TimeWindow(at, at + 1))
    every = {each.bag.recording for each in bags}
    return own if own in every else min(every, default=own)


def _spot_of(
    view: View,
    condition: Condition,
    newest: StoredMessage,
    first: Ns,
    robot: Pose | None,
    *,
    thing: Detection | None,
    frame_id: str | None,
) -> LabelledPlace | None:
    """Returns where the thing of a sighting was, by its newest message that can be placed.

    The newest message of all may be newer than the last transform: then one of those just before it
    counts. A note says where none of them can be placed.
    """
    spot = _spot(view, thing, newest, robot, frame_id)
    targets = _targets(view, robot, frame_id)
    if spot is None or spot.frame_id in targets:
        return spot
    try:
        near = TimeWindow.around(newest.time, TF_CACHE_NS)
        if not any(connects(view, (each, spot.frame_id), near) for each in targets):
            return spot
    except QueryTimeoutError:
        return spot
    topic = newest.record.channel.topic
    window = TimeWindow(first, newest.time)
    extractor = view.memory.extractor
    before = view.stream.messages([topic], window, newest_first=True)
    for found in islice(before, _MOST_TRIED):
        message = view.bags.decode(found)
        if message is None:
            continue
        value = condition.counted(extractor.exact(message, found.record.channel.type))
        if condition.matches(value):
            seen = _matching(detections_of(value, extractor.frame(message)), condition)
            earlier = _spot(view, seen, found, robot, frame_id)
            if earlier is not None and earlier.frame_id in targets:
                return earlier
    view.notes.add(
        f"the place of the sighting at {unix_text(newest.time)} is in {spot.frame_id}: "
        f"no transform leads to {' or '.join(targets)} at that time"
    )
    return spot


def _targets(view: View, robot: Pose | None, frame_id: str | None) -> tuple[str, ...]:
    """Returns the frames that places are given in, the first that can be had."""
    if frame_id is not None:
        return (frame_id,)
    frames = (view.memory.limits.map_frame, "" if robot is None else robot.frame_id)
    return tuple(dict.fromkeys(filter(None, frames)))


def _spot(
    view: View,
    thing: Detection | None,
    found: StoredMessage,
    robot: Pose | None,
    frame_id: str | None,
) -> LabelledPlace | None:
    """Returns where the thing of a message was: in a frame of `_targets`, or the message's own."""
    if thing is None or thing.place is None:
        return None
    for target in _targets(view, robot, frame_id):
        if target == thing.frame_id:
            return LabelledPlace(thing.label, thing.place, target)
        try:
            recording = found.bag.recording
            found_transform = transform_at(
                view, target, thing.frame_id, found.time, recording, explains=False
            )
        except NoDataError:
            continue
        in_target = transform_point(found_transform.transform, thing.place)
        return LabelledPlace(thing.label, in_target, target)
    return LabelledPlace(thing.label, thing.place, thing.frame_id)


def _matching(detections: Sequence[Detection], condition: Condition) -> Detection | None:
    """Returns the detection that a condition is about: by label or place, or the only one.

    Of several it is one with a place, and of these the one with the best score.
    """
    test = condition.test
    if isinstance(test, NearPosition):
        about = [
            each for each in detections if each.place is not None and test.is_near(*each.place)
        ]
    else:
        about = [each for each in detections if test.matches(each.label)]
    if not about and len(detections) == 1:
        about = list(detections)
    return max(about, key=_rank, default=None)


def _rank(detection: Detection) -> tuple[bool, float]:
    return detection.place is not None, -math.inf if detection.score is None else detection.score
