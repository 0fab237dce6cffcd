"""Sightings: consecutive matches of a condition, with where the robot and the thing were.

A sighting is message after message of one topic that meets a condition. It ends with a message of
that topic that does not, and where the topic is silent for longer than `SILENCE_NS`: a detector may
publish only what it sees. A message that cannot be decoded is neither a match nor an end. Of the
status of an action each goal is a sighting, of a log each message.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.analysis.conditions import Condition, NearPosition, matched_texts
from ros2_memory.analysis.frames import TF_CACHE_NS
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, Pose, TimeWindow
from ros2_memory.core.regions import places_at
from ros2_memory.core.text import Quoted, named, quote
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.history.clock_steps import elapsed_in
from ros2_memory.history.coverage import note_unread, recorded_reach, unix_text
from ros2_memory.history.detections import seen_at
from ros2_memory.history.held_values import held_at, held_until, is_latched
from ros2_memory.history.no_data import matching_topics, require_recorded
from ros2_memory.history.reverse_search import (
    ReverseSearch,
    compared_frames,
    condition_of,
)
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.transforms import connects
from ros2_memory.history.view import TimeRange, View, clamped, open_search
from ros2_memory.insights.episodes import (
    MOST_COUNTED,
    SaidMeanwhile,
    find_episodes,
    says_episodes,
    with_robot,
)
from ros2_memory.insights.sighting_search import Run, SearchedRuns, find_runs
from ros2_memory.insights.silences import describe_silences
from ros2_memory.insights.topic_events import GoalRun, goals_asked
from ros2_memory.messages.detections import Detection, detections_of
from ros2_memory.places.pose_frames import pose_in, recording_at, robot_at
from ros2_memory.places.where import Scope, WhileCondition
from ros2_memory.results import Episode, LabelledPlace, Sighting, Sightings
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.stored_message import StoredMessage

_SightingOrEpisode = TypeVar("_SightingOrEpisode", Sighting, Episode)
_MOST_TRIED: Final = 5
"""Messages before the newest of a sighting that are tried for the place of the thing."""
_LEFT_TO_SAY_S: Final = 2.0
"""A search ends so long before the call's time does: then the messages of matches are read."""


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
    view, now, asked = open_search(memory, call, span)
    require_recorded(view, asked)
    condition = condition_of(view, topic, condition_type, value, field=field, min_score=min_score)
    window = clamped(view, asked)
    scope = Scope(view, window, where, during)
    other = None if beside is None else SaidMeanwhile(view, beside)
    topics, shown = matching_topics(view, topic), _Selection(limit, oldest_first, frame_id)
    goals = goals_asked(view, topics, condition, scope)
    is_spoken = goals is None and says_episodes(view, topics)
    sightings: Sequence[Sighting] = ()
    episodes: Sequence[Episode] = ()
    if goals is not None:
        sightings, total, searched = _goal_sightings(view, goals, scope, shown)
    elif is_spoken:
        episodes, total, searched = _episodes_of_text(view, topics[0], condition, scope, shown)
    else:
        search = ReverseSearch(view, topic, condition)
        sightings, total, searched = _runs_as_sightings(view, search, scope, shown, fields)
        view.notes.add(*_latched_notes(view, search, window))
    elapsed = elapsed_in(view, searched)
    sightings = tuple(_completed(sighting, elapsed, other) for sighting in sightings)
    episodes = tuple(_completed(episode, elapsed, other) for episode in episodes)
    rows: list[Sighting | Episode] = [*sightings, *episodes]
    note_robots_on(view, topics, searched)
    note_unread(view, searched, nothing=total == 0, search=True)
    if total == 0:
        view.notes.add(*describe_silences(view, topics, searched))
    view.notes.add(*compared_frames(view, topics, condition), *scope.compared_frames)
    start, end = _searched_times(view, window, [row.first for row in rows])
    notes = view.notes.sentences()
    if total == 0:
        bounded = scope.is_bounded
        notes += notes_on_never(view, topic, condition, window, min_score, is_bounded=bounded)
    total = total if scope.since is None else None
    return Sightings(
        sightings,
        more=total is None or total > len(rows),
        total=total,
        start=start,
        end=end,
        now=now,
        unknown=elapsed.among(scope.unknown),
        topic="" if topics[1:] else topics[0],
        of_texts=is_spoken,
        episodes=episodes,
        notes=notes,
    )


def _searched_times(view: View, window: TimeWindow, shown_at: Sequence[Ns]) -> Span:
    """Returns from when to when a window was searched (inclusive), and has what is shown."""
    start, end = window.asked()
    first, last = recorded_reach(view.snapshot, window) or (start, end)
    # Also bags of a wrong clock are searched, whose matches lie outside of the others' time.
    start = min(max(start, min([first, *shown_at])), end)
    return start, max(min(end, max([last, *shown_at])), start)


class _Selection(NamedTuple):
    """How many rows are shown, which of them, and the frame of the robot's positions."""

    limit: int
    oldest_first: bool
    frame_id: str | None


_Found: TypeAlias = tuple[Sequence[_SightingOrEpisode], int | None, TimeWindow]
"""The rows of a reply; how many there are, None where the search ended before it had counted all;
and the part of the window in which all matches are known."""


def _completed(
    row: _SightingOrEpisode, elapsed: Elapsed, other: SaidMeanwhile | None
) -> _SightingOrEpisode:
    """Returns a row with how much of its time the clock skipped, and what was said meanwhile."""
    return replace(
        row,
        skipped=elapsed.skipped_between(row.first, row.until),
        said=None if other is None else other.during(row.first, row.until),
    )


def _goal_sightings(
    view: View, goals: list[GoalRun], scope: Scope, shown: _Selection
) -> _Found[Sighting]:
    """Returns the goals that are shown as sightings; `goals` have the last one first."""
    view.notes.retract_outside(scope.window)
    sightings = [
        _goal_sighting(view, goal, scope, shown.frame_id)
        for goal in (goals[::-1] if shown.oldest_first else goals)[: shown.limit]
        if view.call.wants(goal.last)
    ]
    return sightings, len(goals), scope.window


def _episodes_of_text(
    view: View, topic: str, condition: Condition, scope: Scope, shown: _Selection
) -> _Found[Episode]:
    found, total, since = find_episodes(
        view, topic, condition, scope, limit=shown.limit, oldest_first=shown.oldest_first
    )
    searched = scope.window if since is None else TimeWindow(since, scope.window.stop)
    view.notes.retract_outside(searched)
    episodes = [
        with_robot(view, topic, episode, shown.frame_id)
        for episode in found
        if view.call.wants(episode.until)
    ]
    return episodes, total, searched


def _search(view: View, search: ReverseSearch, scope: Scope, *, enough: int | None) -> SearchedRuns:
    """Returns what `find_runs` finds with some of the call's time left to say it."""
    view.bags.end_early(_LEFT_TO_SAY_S)
    result = find_runs(view, search, scope, enough=enough)
    view.bags.finish_within(_LEFT_TO_SAY_S)
    return result


def _runs_as_sightings(
    view: View, search: ReverseSearch, scope: Scope, shown: _Selection, fields: Sequence[str]
) -> _Found[Sighting]:
    result = _search(view, search, scope, enough=None if shown.oldest_first else shown.limit)
    if result.is_over:
        view.notes.add_lack(
            f"the search ran out of time at {unix_text(result.searched_to or MIN_NS)}: to "
            "continue, pass that time as end"
        )
    runs = result.runs(
        slice(None, -shown.limit - 1, -1) if shown.oldest_first else slice(shown.limit)
    )
    searched, total = scope.window, len(result.table) if result.searched_to is None else None
    if total is None:
        searched = TimeWindow(runs[0 if shown.oldest_first else -1].first, searched.stop)
    view.notes.retract_outside(searched)
    # To say where the robot was takes longest.
    sightings: list[Sighting] = []
    refused: list[InvalidArgumentsError] = []
    for run in runs:
        newest = _newest_match(view, search, run) if view.call.wants(run.last) else None
        if newest is None:
            continue
        sighting = _sighting(
            view, search.condition, run, newest, scope=scope, frame_id=shown.frame_id
        )
        if fields:
            try:
                sighting = _with_fields(view, sighting, newest, fields)
            except InvalidArgumentsError as error:
                # A traceback has this frame, which has the errors: they would stay for long.
                refused.append(error.with_traceback(None))
        sightings.append(sighting)
    if refused and len(refused) == len(sightings):
        raise refused.pop(0)
    return sightings, total, searched


def read_sightings(
    view: View, pattern: str, condition: Condition, scope: Scope
) -> tuple[Ints, Ns | None, str]:
    """Returns all sightings in a scope, since when they are known, and what there are too many of.

    Of each sighting, as a row, its first and last log time (ns), and whether it is known to begin
    then: what a latched topic reported before may have begun earlier. The second is None where all
    was searched; the third is empty where the call's time was over.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: there is no such topic, or none of its messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    topics = matching_topics(view, pattern)
    goals = goals_asked(view, topics, condition, scope)
    if goals is not None:
        spans = held_spans(chain.from_iterable(_goal_spans(view, goal, scope) for goal in goals))
        return spans, None, ""
    if says_episodes(view, topics):
        found, _, since = find_episodes(
            view, topics[0], condition, scope, limit=MOST_COUNTED, oldest_first=False
        )
        too_many = f"more than {MOST_COUNTED:,} episodes" if len(found) == MOST_COUNTED else ""
        spans = held_spans((episode.first, episode.until, True) for episode in found)
        return spans, since, too_many
    result = _search(view, ReverseSearch(view, pattern, condition), scope, enough=None)
    start, end = scope.window.asked()
    spans, is_log = result.spans, np.array([*map(view.timeline.is_log, topics)], np.bool_)
    states = np.flatnonzero(~is_log[result.table[:, 0]])
    # Without a scope the oldest may have begun before what there was time to search.
    spans[:, 2] |= not scope.is_bounded
    known = 0
    try:
        for known, run in zip(states.tolist(), result.runs(states), strict=True):
            spans[known, 1] = _lasted_until(view, run, scope)
    except QueryTimeoutError:
        # Those of several topics overlap.
        if not known or len(topics) > 1:
            raise
        view.bags.finish_within(_LEFT_TO_SAY_S)
        return spans[:known], int(spans[known - 1, 0]), ""
    if result.is_over:
        return spans, int(spans[-1, 0]), ""
    earlier = [
        (first, last, False)
        for topic in topics
        if met_before(view, topic, condition, start)
        for first, last in scope.parts_of(start, held_until(view, topic, start, end))
    ]
    return np.concatenate((spans, held_spans(earlier))), None, ""


def _goal_spans(view: View, goal: GoalRun, scope: Scope) -> Iterator[tuple[Ns, Ns, bool]]:
    """Yields when a goal was active; one of before the window counts where it ended, if it did."""
    yield goal.first, _goes_on_until(view, goal, scope), goal.accepted is not None
    if goal.accepted is None and goal.ended is not None:
        yield goal.ended, goal.ended, True


def held_spans(spans: Iterable[tuple[Ns, Ns, bool]]) -> Ints:
    """Returns times (inclusive), and whether each is known to begin then, as an array, N x 3."""
    return np.array([*spans], np.int64).reshape(-1, 3)


def met_before(view: View, topic: str, condition: Condition, moment: Ns) -> StoredMessage | None:
    """Returns what a latched topic had said last before a moment, if it meets a condition."""
    held = held_at(view, topic, moment)
    if held is None:
        return None
    own = condition.of_type(held.type, view.extractor)
    return held if own.matches(view.value(held)) else None


def _latched_notes(view: View, search: ReverseSearch, window: TimeWindow) -> Iterator[str]:
    """Yields which latched topics met a condition when a window began, by an earlier message."""
    for topic in search.topics:
        before = met_before(view, topic, search.condition, window.asked()[0])
        if before is not None:
            yield (
                f"{topic} met this already when the window began: what it said at "
                f"{unix_text(before.time)} holds until its next message"
            )


def _newest_match(view: View, search: ReverseSearch, run: Run) -> StoredMessage | None:
    """Returns the last match, or what held without one; None where its bag was deleted since."""
    if not run.messages:
        return view.stream.last(run.topic, run.last + 1)
    at = TimeWindow(run.last, run.last + 1)
    at_once = view.stream.messages([run.topic], at, newest_first=True)
    return next(islice(filter(search.matches, at_once), run.later, None), None)


def _lasted_until(view: View, run: Run, scope: Scope) -> Ns:
    """Returns until when a state lasted: to the message that says otherwise, or the window's end.

    To its last match where a silence is next; so does a log entry. What a latched topic states
    lasts through silences. Not beyond the end of a scope.
    """
    last = run.last
    if view.timeline.is_log(run.topic):
        return last
    _, end = scope.window.asked()
    if run.until == MAX_NS or is_latched(view, run.topic):
        return scope.holds_until(last, held_until(view, run.topic, last, end))
    is_silent = run.until - last > SILENCE_NS
    return scope.holds_until(last, last if is_silent else max(last, min(run.until, end)))


def _sighting(
    view: View,
    condition: Condition,
    run: Run,
    newest: StoredMessage,
    *,
    scope: Scope,
    frame_id: str | None,
) -> Sighting:
    """Returns the result, with where the robot was and, at the newest match, the thing.

    What happens is where the robot was when it began; a thing is where it was last seen from.
    """
    message = view.memory.reader.decode(newest.record)
    value, detections = _counted(view, condition, newest.type, message)
    labels = {detection.label for detection in detections}
    thing = _sought_detection(detections, condition)
    robot_at_first = thing is None and run.begun > 0
    at = run.first if robot_at_first else run.last
    newest_recording = newest.bag.recording
    recording = recording_at(view, newest.topic, at, newest_recording) or newest_recording
    robot = robot_at(view, at, recording, frame_id)
    return Sighting(
        topic=run.topic,
        first=run.first,
        last=run.last,
        until=_lasted_until(view, run, scope) if thing is None else run.last,
        messages=run.messages,
        begun=run.begun > 0,
        robot=robot,
        thing=_place_of_thing(
            view, condition, newest, run.first, robot, thing=thing, frame_id=frame_id
        ),
        matched=tuple(
            named(text) if text in labels else Quoted(text)
            for text in matched_texts(condition.of_type(newest.type, view.extractor), value)
        ),
        score=None if thing is None else thing.score,
        robot_at_first=robot_at_first,
    )


def _counted(
    view: View, condition: Condition, type_name: str, message: object
) -> tuple[JsonValue, Sequence[Detection]]:
    """Returns what of a message counts for a condition, and the detections in that."""
    value = condition.counted(view.extractor.exact(message, type_name))
    return value, detections_of(value, view.extractor.frame(message))


def _goes_on_until(view: View, goal: GoalRun, scope: Scope) -> Ns:
    """Returns until when a goal went on; one that has not ended until another run of a recorder."""
    if goal.ended is not None or goal.is_lost:
        return goal.last
    _, end = scope.window.asked()
    breaks = [start for start, _ in view.snapshot.breaks if start >= goal.last]
    until = min([end, view.snapshot.latest or end, *breaks])
    return scope.holds_until(goal.last, max(goal.last, until))


def _goal_sighting(view: View, goal: GoalRun, scope: Scope, frame_id: str | None) -> Sighting:
    """Returns a goal as a sighting, with where the robot was when it ended or was last listed."""
    message = view.stream.last(goal.topic, goal.last + 1)
    robot = None
    if message is not None:
        robot = robot_at(view, goal.last, message.bag.recording, frame_id)
    return Sighting(
        topic=goal.topic,
        first=goal.first,
        last=goal.last,
        until=_goes_on_until(view, goal, scope),
        messages=0,
        begun=goal.accepted is not None,
        robot=robot,
        thing=None,
        value={"goal": goal.goal, "status": goal.status_word},
    )


def _with_fields(
    view: View, sighting: Sighting, newest: StoredMessage, fields: Sequence[str]
) -> Sighting:
    """Returns a sighting with the fields of its last message in place of matched texts.

    Raises:
        InvalidArgumentsError: the message does not have them.
    """
    shown = view.extractor.shown(view.memory.reader.decode(newest.record), newest.type, fields)
    view.notes.add(*shown.notes)
    return replace(sighting, matched=(), value=quote(shown.value))


def _place_of_thing(
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
    targets = _target_frames(view, robot, frame_id)
    spot = _place_of_detection(view, thing, newest, targets)
    if spot is None or spot.frame_id in targets:
        return spot
    try:
        near = TimeWindow.around(newest.time, TF_CACHE_NS)
        if not any(connects(view, (target, spot.frame_id), near) for target in targets):
            return spot
    except QueryTimeoutError:
        return spot
    window = TimeWindow(first, newest.time)
    before = view.stream.messages([newest.topic], window, newest_first=True)
    for stored in islice(before, _MOST_TRIED):
        message = view.bags.decode(stored)
        if message is None:
            continue
        value, detections = _counted(view, condition, stored.type, message)
        if condition.of_type(stored.type, view.extractor).matches(value):
            thing = _sought_detection(detections, condition)
            earlier = _place_of_detection(view, thing, stored, targets)
            if earlier is not None and earlier.frame_id in targets:
                return earlier
    view.notes.add(
        f"the place of the sighting at {unix_text(newest.time)} is in {spot.frame_id}: "
        f"no transform leads to {' or '.join(targets)} at that time"
    )
    return spot


def _target_frames(view: View, robot: Pose | None, frame_id: str | None) -> tuple[str, ...]:
    """Returns the frames that places are given in, the first that can be had."""
    if frame_id is not None:
        return (frame_id,)
    frames = (view.limits.map_frame, "" if robot is None else robot.frame_id)
    return tuple(dict.fromkeys(filter(None, frames)))


def _place_of_detection(
    view: View, thing: Detection | None, message: StoredMessage, targets: Sequence[str]
) -> LabelledPlace | None:
    """Returns where the thing of a message was: in one of some frames, or the message's own."""
    if thing is None or thing.place is None:
        return None
    seen, time = Pose(thing.place, None, thing.frame_id), seen_at(view, message)
    position, frame = thing.place, thing.frame_id
    for target in targets:
        placed = pose_in(view, seen, target, time, message.bag.recording)
        if placed is not None:
            position, frame = placed.position, target
            break
    inside = places_at(view.limits.places, frame, *position[:2])
    return LabelledPlace(thing.label, position, frame, inside)


def _sought_detection(detections: Sequence[Detection], condition: Condition) -> Detection | None:
    """Returns the detection that a condition is about: by label or place, or the only one.

    Of several it is one with a place, and of these the one with the best score.
    """
    test = condition.test
    if isinstance(test, NearPosition):
        about = [
            detection
            for detection in detections
            if detection.place is not None and test.is_near(*detection.place)
        ]
    else:
        about = [detection for detection in detections if test.passes(detection.label)]
    if not about and len(detections) == 1:
        about = list(detections)
    return max(
        about,
        key=lambda detection: (
            detection.place is not None,
            -math.inf if detection.score is None else detection.score,
        ),
        default=None,
    )
