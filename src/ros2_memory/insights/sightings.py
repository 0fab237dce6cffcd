"""Sightings: consecutive matches of a condition, with where the robot and the thing were.

A sighting is a run of consecutive messages of one topic that meet a condition. It ends with a
message that does not, and, unless the topic is latched, where it is silent for longer than
`silence_of` says: a detector may publish only what it sees. A message that cannot be decoded is
neither a match nor an end. In a topic of statuses each goal is a sighting, in a log, or where texts
come now and then, each message.
In one of diagnostics each node has sightings of its own.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, islice, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.conditions import (
    Condition,
    NearPosition,
    matched_texts,
    texts_beside,
)
from ros2_memory.analysis.frames import TF_CACHE_NS
from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import JsonValue, Pose, TimeWindow
from ros2_memory.core.text import (
    Quoted,
    counted,
    leaves,
    looks_like_json,
    named,
    quote,
    repeating,
    shortened,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span
from ros2_memory.history.condition_hints import compared_frames
from ros2_memory.history.conditions import Sought, condition_of
from ros2_memory.history.coverage import note_unread, recorded_reach, unix_text
from ros2_memory.history.detections import seen_at
from ros2_memory.history.held_values import NUMBERS, note_unnamed
from ros2_memory.history.lasting import (
    held_at,
    held_until,
    holds_on,
    is_latched,
    is_text,
    lasting_of,
    says_events,
)
from ros2_memory.history.no_data import matching_topics, require_fields, require_recorded
from ros2_memory.history.reverse_search import MET, UNKNOWN, ReverseSearch
from ros2_memory.history.robots import note_robots_on
from ros2_memory.history.transforms import connects
from ros2_memory.history.view import ANY_TIME, TimeRange, View, clamped, open_search
from ros2_memory.insights.episodes import (
    MOST_COUNTED,
    MeanwhileReader,
    find_episodes,
    says_episodes,
    with_robot,
)
from ros2_memory.insights.sighting_search import Run, SearchedRuns, find_runs, is_flag
from ros2_memory.insights.silences import describe_unsearched
from ros2_memory.insights.topic_events import GoalRun, goals_matching
from ros2_memory.messages.detections import Detection, detections_of
from ros2_memory.places.pose_frames import pose_in, recording_at, robot_at, with_place
from ros2_memory.places.where import Scope
from ros2_memory.results import Episode, LabelledPlace, Sighting, Sightings
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.core.arrays import Ints
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Call, Memory

_MOST_TRIED: Final = 5
"""Messages before the newest of a sighting that are tried for the place of the thing."""
_SURE: Final = 0.7
"""A single detection with this score is hardly an error of the detector."""
_LEFT_TO_SAY_S: Final = 2.0
"""The part of the call's time that a search leaves for reading the messages of matches."""


def find_matches(
    memory: Memory,
    call: Call,
    sought: Sought,
    *,
    fields: Sequence[str] = (),
    span: TimeRange = ANY_TIME,
    limit: int = 5,
    oldest_first: bool = False,
    where: JsonValue = None,
    during: Sequence[Sought] = (),
    frame_id: str | None = None,
    beside: str | None = None,
) -> Sightings:
    """Returns the newest `limit` sightings that meet the condition, newest first.

    On a topic of texts that hold until the next one they are episodes (`insights.episodes`).

    With `oldest_first` all of the `span` is searched, and the oldest sightings are returned. A
    sighting has the `fields` (dot-paths) of its last message, and what the topic `beside` said
    meanwhile.

    With `where` only messages count that were received while the robot was there, with `during`
    while another topic met a condition. Robot positions are in the map, or in `frame_id`.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, the bounds make no window, or no
            sighting has one of the fields.
        NoDataError: nothing is recorded, or no such topic.
        QueryTimeoutError: the call's time is over before anything was found.
    """
    view, now, asked = open_search(memory, call, span)
    require_recorded(view, asked)
    topic, condition = sought.topic, condition_of(view, sought)
    window = clamped(view, asked)
    scope = Scope(view, window, where, during)
    other = None if beside is None else MeanwhileReader(view, beside)
    selection = _Selection(limit, oldest_first, frame_id, fields)
    found = _select_rows(view, topic, condition, scope, selection)
    topics, is_never = matching_topics(view, topic), found.total == 0
    elapsed = view.elapsed_in(found.searched)
    rows = [_with_durations(view, row, elapsed, other) for row in found.rows]
    note_robots_on(view, topics, found.searched)
    note_unread(view, found.searched, nothing=is_never, search=True)
    if is_never:
        view.notes.add(*describe_unsearched(view, topics, found.searched))
    view.notes.add(*compared_frames(view, topics, condition, window), *scope.compared_frames)
    start, end = _searched_times(view, window, [row.first for row in rows])
    notes = view.notes.sentences()
    if is_never:
        bounded = scope.is_bounded
        notes += notes_on_never(view, sought, condition, window, is_bounded=bounded)
    total = found.total if scope.since is None else None
    return Sightings(
        tuple(row for row in rows if isinstance(row, Sighting)),
        more=total is None or total > len(rows),
        total=total,
        start=start,
        end=end,
        now=now,
        unknown=elapsed.among(scope.unknown),
        topic="" if topics[1:] else topics[0],
        of_texts=found.of_texts,
        episodes=tuple(row for row in rows if isinstance(row, Episode)),
        notes=notes,
    )


def _searched_times(view: View, window: TimeWindow, shown_at: Sequence[Ns]) -> Span:
    """Returns from when to when (ns) a window was searched, also in bags of a wrong clock."""
    start, end = window.asked()
    first, last = recorded_reach(view.snapshot, window)
    start = min(max(start, min([first, *shown_at])), end)
    return start, max(min(end, max([last, *shown_at])), start)


class _Selection(NamedTuple):
    """How many rows are shown, from which end, the frame of the robot's positions, and fields."""

    limit: int
    oldest_first: bool
    frame_id: str | None
    fields: Sequence[str]


class _SelectedRows(NamedTuple):
    """The rows of a reply.

    Attributes:
        total: how many there are; None if the search ended before it counted all.
        searched: the part of the window in which all matches are known.
        of_texts: whether rows are episodes.
    """

    total: int | None
    searched: TimeWindow
    rows: Sequence[Sighting | Episode]
    of_texts: bool = False


def _select_rows(
    view: View, pattern: str, condition: Condition, scope: Scope, selection: _Selection
) -> _SelectedRows:
    """Returns the selected goals, the episodes of a topic of texts, or the runs of matches.

    Raises:
        InvalidArgumentsError: nothing can meet the condition, or no row has one of the fields.
        QueryTimeoutError: the call's time is over before anything was found.
    """
    topics = matching_topics(view, pattern)
    goals = goals_matching(view, topics, condition, scope)
    if goals is not None:
        return _goal_sightings(view, goals, scope, selection)
    if says_episodes(view, topics):
        require_fields(view, topics[0], selection.fields, scope.window.stop)
        return _select_episodes(view, topics[0], condition, scope, selection)
    search = ReverseSearch(view, pattern, condition, scope.window)
    selected = _run_sightings(view, search, scope, selection)
    view.notes.add(*_notes_on_begin(view, search, scope.window))
    sightings = [row for row in selected.rows if isinstance(row, Sighting)]
    of_moments = {
        row.topic
        for row in sightings
        if row.first == row.until and holds_on(view, row.topic, row.first)
    }
    view.notes.add(*_notes_on_moments(view, sorted(of_moments)))
    if condition.field is None:
        of_texts = (row for row in sightings if is_text(view, row.topic))
        view.notes.add(*islice(_key_notes(condition, of_texts), 1))
    return selected


def _with_durations(
    view: View, row: Sighting | Episode, elapsed: Elapsed, other: MeanwhileReader | None
) -> Sighting | Episode:
    """Returns a row with how much of its time does not count, and what was said meanwhile."""
    skipped = elapsed.skipped_between(row.first, row.until)
    if isinstance(row, Episode):
        skipped = row.until - row.first - elapsed.among(row.parts)
    said = None if other is None else other.during(row.first, _known_until(view, row))
    return replace(row, skipped=skipped, said=said)


def _known_until(view: View, row: Sighting | Episode) -> Ns:
    """Returns until when (ns, exclusive) a row is known to have gone on.

    A topic that repeats a state may have left it at any time after its last match.
    """
    if isinstance(row, Episode) or not row.messages or holds_on(view, row.topic, row.last):
        return row.until
    return row.last + 1


def _goal_sightings(
    view: View, goals: list[GoalRun], scope: Scope, selection: _Selection
) -> _SelectedRows:
    """Returns the selected goals as sightings. `goals` have the last one first.

    Raises:
        InvalidArgumentsError: no sighting has one of the fields.
    """
    view.notes.retract_outside(scope.window)
    ordered = goals[::-1] if selection.oldest_first else goals
    found = (
        _goal_sighting(view, goal, scope, selection.frame_id)
        for goal in ordered[: selection.limit]
        if view.call.wants(goal.last)
    )
    sightings = _with_fields(view, found, selection.fields)
    return _SelectedRows(len(goals), scope.window, sightings)


def _select_episodes(
    view: View, topic: str, condition: Condition, scope: Scope, selection: _Selection
) -> _SelectedRows:
    """Returns the selected episodes, with the robot's pose when they began."""
    limit, oldest_first = selection.limit, selection.oldest_first
    found = find_episodes(view, topic, condition, scope, limit=limit, oldest_first=oldest_first)
    searched = scope.window
    if found.since is not None:
        searched = TimeWindow(found.since, searched.stop)
    view.notes.retract_outside(searched)
    episodes = [
        with_robot(view, topic, episode, selection.frame_id)
        for episode in found.episodes
        if view.call.wants(episode.until)
    ]
    return _SelectedRows(found.total, searched, episodes, of_texts=True)


def _find_runs_early(
    view: View, search: ReverseSearch, scope: Scope, *, enough: int | None
) -> SearchedRuns:
    """Returns the runs of matches, and leaves some of the call's time to read their messages."""
    view.bags.end_early(_LEFT_TO_SAY_S)
    searched_runs = find_runs(view, search, scope, enough=enough)
    view.bags.finish_within(_LEFT_TO_SAY_S)
    return searched_runs


def _run_sightings(
    view: View, search: ReverseSearch, scope: Scope, selection: _Selection
) -> _SelectedRows:
    """Returns the selected runs of matches as sightings.

    Raises:
        InvalidArgumentsError: no sighting has one of the fields.
    """
    limit, oldest_first = selection.limit, selection.oldest_first
    searched_runs = _find_runs_early(view, search, scope, enough=None if oldest_first else limit)
    if searched_runs.is_over:
        view.notes.add_lack(
            f"the search ran out of time at {unix_text(searched_runs.searched_to or MIN_NS)}: to "
            "continue, pass that time as end"
        )
    # The table has the newest run first.
    runs = searched_runs.runs(slice(None, -limit - 1, -1) if oldest_first else slice(limit))
    searched, total = scope.window, None
    if searched_runs.searched_to is None:
        total = len(searched_runs.table)
    else:
        oldest = runs[0] if oldest_first else runs[-1]
        searched = TimeWindow(oldest.first, searched.stop)
    view.notes.retract_outside(searched)
    found = _found_in(view, search, runs, scope, selection.frame_id)
    sightings = _with_fields(view, found, selection.fields)
    view.notes.add(*_flicker_notes(view, search, runs), *_doubtful_notes(runs, sightings))
    return _SelectedRows(total, searched, sightings)


def _found_in(
    view: View, search: ReverseSearch, runs: Iterable[Run], scope: Scope, frame_id: str | None
) -> Iterator[tuple[Sighting, StoredMessage]]:
    """Yields the runs of matches as sightings, with their last messages."""
    for run in runs:
        # To say where the robot was takes longest.
        newest = _newest_match(view, search, run) if view.call.wants(run.last) else None
        if newest is not None:
            sighting = _sighting(
                view, search.condition, run, newest, scope=scope, frame_id=frame_id
            )
            yield sighting, newest


class SightingSpans(NamedTuple):
    """The times of all sightings.

    Attributes:
        spans: for each sighting its first and last log time (ns), and 1 if it is known to begin
            then: a value of a latched topic may have held before.
        since: the log time (ns) since when sightings are known; None for all of the scope.
        too_many: what there are too many of; empty if the call's time was over instead.
    """

    spans: Ints
    since: Ns | None = None
    too_many: str = ""


def read_sightings(view: View, pattern: str, condition: Condition, scope: Scope) -> SightingSpans:
    """Returns the times of all sightings in a scope.

    Raises:
        InvalidArgumentsError: no value of the topics can meet the condition.
        NoDataError: there is no such topic, or none of its messages can be decoded.
        QueryTimeoutError: the call's time is over before the first match was found.
    """
    topics = matching_topics(view, pattern)
    goals = goals_matching(view, topics, condition, scope)
    if goals is not None:
        of_goals = chain.from_iterable(_goal_spans(view, goal, scope) for goal in goals)
        return SightingSpans(held_spans(of_goals))
    if says_episodes(view, topics):
        found = find_episodes(
            view, topics[0], condition, scope, limit=MOST_COUNTED, oldest_first=False
        )
        is_full = len(found.episodes) == MOST_COUNTED
        start = scope.window.start
        return SightingSpans(
            held_spans(
                (first, last, first == episode.first and episode.spell.first >= start)
                for episode in found.episodes
                for first, last in episode.parts
            ),
            found.since,
            f"more than {MOST_COUNTED:,} episodes" if is_full else "",
        )
    spans = _run_spans(view, ReverseSearch(view, pattern, condition, scope.window), scope)
    first, last, _ = spans.spans.T
    if (first == last).any():
        view.notes.add(*_notes_on_moments(view, topics))
    return spans


def _run_spans(view: View, search: ReverseSearch, scope: Scope) -> SightingSpans:
    """Returns the times of all runs of matches; a value lasts until a message says otherwise."""
    searched_runs = _find_runs_early(view, search, scope, enough=None)
    spans, topics = searched_runs.spans, search.topics
    firsts, lasts, are_begun = spans.T  # views: what is set in them is set in `spans`
    # Without a scope the oldest may have begun before what there was time to search.
    are_begun |= not scope.is_bounded
    are_events = np.array([says_events(view, topic) for topic in topics], np.bool_)
    states = np.flatnonzero(~are_events[searched_runs.table[:, 0]])
    known = 0
    oldest: dict[tuple[str, int], tuple[int, Run]] = {}
    try:
        for known, run in zip(states.tolist(), searched_runs.runs(states), strict=True):
            lasts[known] = _lasted_until(view, search.condition, run, scope)
            oldest[run.topic, run.node] = known, run
    except QueryTimeoutError:
        # The runs of several topics overlap: since when all are known cannot be said.
        if not known or len(topics) > 1:
            raise
        view.bags.finish_within(_LEFT_TO_SAY_S)
        return SightingSpans(spans[:known], int(firsts[known - 1]))
    if searched_runs.is_over:
        return SightingSpans(spans, int(firsts[-1]))
    for row, run in () if scope.is_bounded else oldest.values():
        are_begun[row] = not _matched_before(view, search, run)
    start, end = scope.window.asked()
    lasts_from = partial(held_until, view, last=start, end=end, states=is_flag(search.condition))
    earlier = [
        (first, last, False)
        for topic in topics
        if met_before(view, topic, search.condition, start)
        for first, last in scope.parts_of(start, lasts_from(topic=topic))
    ]
    return SightingSpans(np.concatenate((spans, held_spans(earlier))))


def _matched_before(view: View, search: ReverseSearch, run: Run) -> bool:
    """Returns whether a run of matches goes on from a match before what was searched."""
    if says_events(view, run.topic):
        return False
    states = is_flag(search.condition)
    longest = lasting_of(view, run.topic, states=states).pause(run.first)
    if longest == MAX_NS:
        held = held_at(view, run.topic, run.first, states=states)
        return held is not None and bool(search.matches(held))
    near = TimeWindow(max(run.first - longest, MIN_NS), run.first)
    for block in search.blocks(run.topic, near):
        tested = block.tested()
        met = tested.met[(tested.nodes == run.node) & (tested.met != UNKNOWN)]
        if met.size:
            return bool(met[-1] == MET)
    return False


def _goal_spans(view: View, goal: GoalRun, scope: Scope) -> Iterator[tuple[Ns, Ns, bool]]:
    """Yields when a goal was active. If that began before the window, its end counts as well."""
    yield goal.first, _goes_on_until(view, goal, scope), goal.accepted is not None
    if goal.accepted is None and goal.ended is not None:
        yield goal.ended, goal.ended, True


def held_spans(spans: Iterable[tuple[Ns, Ns, bool]]) -> Ints:
    """Returns spans (ns, inclusive), and whether each begins there for sure, as an N x 3 array."""
    return np.array([*spans], np.int64).reshape(-1, 3)


def met_before(view: View, topic: str, condition: Condition, moment: Ns) -> StoredMessage | None:
    """Returns the message that held at a moment, as `held_at` does, if it meets a condition."""
    held = held_at(view, topic, moment, states=is_flag(condition))
    if held is None:
        return None
    for_type = condition.of_type(held.type, view.extractor)
    return held if for_type.matches(view.value(held)) else None


def _notes_on_moments(view: View, topics: Iterable[str]) -> Iterator[str]:
    """Yields a note if rare texts or numbers, as of states, count as long as their messages."""
    for topic in topics:
        what = "text" if is_text(view, topic) else "number"
        types = view.timeline.types_of(topic)
        is_plain = what == "text" or all(name.startswith(NUMBERS) for name in types)
        if is_plain and not is_latched(view, topic):
            often = ", and matches in a row less than 10 s apart once"
            yield (
                f"a {what} on {topic} counts for the moment in which it was said"
                f"{'' if says_events(view, topic) else often}: get_topic_in_range lists each; its "
                "changes, and by value, have for how long each held until the next one"
            )


def _key_notes(condition: Condition, sightings: Iterable[Sighting]) -> Iterator[str]:
    """Yields of each text of JSON that was found by its keys alone: "rain" in `{"rain_mm": 0}`."""
    for sighting in sightings:
        for text in filter(looks_like_json, sighting.matched):
            with suppress(ValueError, RecursionError):
                value = json.loads(text)
                keys = [path for path, _ in leaves(value) if condition.matches(path)]
                if keys and not condition.matches(value):
                    key = shortened(keys[0])
                    yield repeating(
                        f"{key} of {sighting.topic} is a key of its JSON, whatever its value is: "
                        f"a condition may be on data.{key}",
                        [key],
                    )


def _flicker_notes(view: View, search: ReverseSearch, runs: Sequence[Run]) -> Iterator[str]:
    """Yields that most sightings of a label differ by a moment in which a detector missed it."""
    in_time = sorted(runs, key=lambda run: (run.topic, run.first))
    close = sum(
        after.topic == before.topic and after.first - before.last <= FLICKER_NS
        for before, after in pairwise(in_time)
    )
    if 2 * close < max(len(runs), 2):
        return
    newest = _newest_match(view, search, runs[0])
    message = view.bags.decode(newest)
    if newest is None or message is None:
        return
    _, detections = _counted_content(view, search.condition, newest.type, message)
    if any(search.condition.is_on(detection.label) for detection in detections):
        yield (
            f"{close} of these sightings end because the detector missed it for less than 3 s: "
            "with by they count as one with the next"
        )


def _doubtful_notes(runs: Iterable[Run], sightings: Sequence[Sighting]) -> Iterator[str]:
    """Yields that most sightings are one detection of a low score, between messages without it.

    A detector that publishes what is new alone has no message without it soon after.
    """
    lone = {
        (run.topic, run.last)
        for run in runs
        if run.messages == 1 and run.begun and run.until - run.last <= FLICKER_NS
    }
    scores = (one.score for one in sightings if (one.topic, one.last) in lone)
    doubtful = sum(score is not None and score < _SURE for score in scores)
    if 2 * doubtful > len(sightings):
        yield (
            f"{counted(doubtful, 'sighting')} of one message alone may be an error of the "
            f"detector: min_score {_SURE:g} leaves such out"
        )


def _notes_on_begin(view: View, search: ReverseSearch, window: TimeWindow) -> Iterator[str]:
    """Yields a note for each topic that met the condition when the window began.

    That is a latched topic, or a rare one with a flag.
    """
    start, _ = window.asked()
    for topic in search.topics:
        before = met_before(view, topic, search.condition, start)
        if before is not None:
            yield (
                f"{topic} met this already when the window began: what it said at "
                f"{unix_text(before.time)} holds until its next message"
            )


def _newest_match(view: View, search: ReverseSearch, run: Run) -> StoredMessage | None:
    """Returns a run's last match, or the message before a run without; None if it was deleted."""
    if not run.messages:
        return view.stream.last(run.topic, run.last + 1)
    at = TimeWindow(run.last, run.last + 1)
    at_once = view.stream.messages([run.topic], at, newest_first=True)
    return next(islice(filter(search.matches, at_once), run.later, None), None)


def _lasted_until(view: View, condition: Condition, run: Run, scope: Scope) -> Ns:
    """Returns until when (ns) a match lasted: until a message says otherwise, or the window ends.

    An event does not last, and nothing does beyond the scope.
    """
    last, states, (_, end) = run.last, is_flag(condition), scope.window.asked()
    if says_events(view, run.topic):
        return last
    lasting = lasting_of(view, run.topic, states=states)
    if run.until < MAX_NS:
        until, _ = lasting.until(last, run.until)
    else:
        # In an unbounded window, what follows soon in it is of other nodes of diagnostics.
        is_known = not scope.is_bounded and lasting.pause(last) < MAX_NS
        since = scope.window.stop if is_known else last
        until = held_until(view, run.topic, last, end, states=states, since=since)
    return scope.holds_until(last, max(last, min(until, end)))


def _is_ended(view: View, run: Run, until: Ns) -> bool:
    """Returns whether a message ended a state at a log time, or it is of a moment alone."""
    if says_events(view, run.topic) or _is_said_once(view, run):
        return True
    at = TimeWindow(until, until + 1)
    return until > run.last and view.stream.first([run.topic], at) is not None


def _is_said_once(view: View, run: Run) -> bool:
    """Returns whether a run is of rare texts, each of which counts for its moment."""
    is_plain = is_text(view, run.topic) and not is_latched(view, run.topic)
    return is_plain and holds_on(view, run.topic, run.last)


def _sighting(
    view: View,
    condition: Condition,
    run: Run,
    newest: StoredMessage,
    *,
    scope: Scope,
    frame_id: str | None,
) -> Sighting:
    """Returns a run as a sighting, with the places of the thing and of the robot.

    The thing is where its newest match has it; the robot where it was then, or without a thing,
    where it was at the first match, if that is known.
    """
    message = view.memory.reader.decode(newest.record)
    value, detections = _counted_content(view, condition, newest.type, message)
    labels = {detection.label for detection in detections}
    thing = _sought_detection(detections, condition)
    robot_at_first = thing is None and run.begun > 0
    at = run.first if robot_at_first else run.last
    newest_recording = newest.recording
    recording = recording_at(view, newest.topic, at, newest_recording) or newest_recording
    robot = robot_at(view, at, recording, frame_id)
    if robot is None and robot_at_first:
        # A recording may begin with the match, and have its first pose only after it.
        robot, robot_at_first = robot_at(view, run.last, newest_recording, frame_id), False
    on_type = condition.of_type(newest.type, view.extractor)
    texts = matched_texts(on_type, value) or texts_beside(on_type, value)
    until, ended = run.last, True
    if thing is None:
        until = _lasted_until(view, condition, run, scope)
        ended = _is_ended(view, run, until)
    return Sighting(
        topic=run.topic,
        first=run.first,
        last=run.last,
        until=until,
        messages=run.messages,
        begun=run.begun > 0,
        robot=robot,
        thing=_place_of_thing(
            view, condition, newest, run.first, robot, thing=thing, frame_id=frame_id
        ),
        matched=tuple(named(text) if text in labels else Quoted(text) for text in texts),
        score=None if thing is None else thing.score,
        robot_at_first=robot_at_first,
        ended=ended,
    )


def _counted_content(
    view: View, condition: Condition, type_name: str, message: object
) -> tuple[JsonValue, Sequence[Detection]]:
    """Returns the part of a message that counts for a condition, and the detections in it."""
    value = condition.counted(view.extractor.exact(message, type_name))
    return value, detections_of(value, view.extractor.frame(message))


def _goes_on_until(view: View, goal: GoalRun, scope: Scope) -> Ns:
    """Returns until when (ns) a goal was active: until it ended, or the recorder's run did."""
    if goal.ended is not None or goal.is_lost:
        return goal.last
    _, end = scope.window.asked()
    breaks = [start for start, _ in view.snapshot.breaks if start >= goal.last]
    until = min([end, view.snapshot.latest or end, *breaks])
    return scope.holds_until(goal.last, max(goal.last, until))


def _goal_sighting(
    view: View, goal: GoalRun, scope: Scope, frame_id: str | None
) -> tuple[Sighting, StoredMessage | None]:
    """Returns a goal as a sighting, and its last message (None if it was deleted).

    The sighting has the robot's pose when the goal ended or was last listed.
    """
    message = view.stream.last(goal.topic, goal.last + 1)
    robot = None
    if message is not None:
        robot = robot_at(view, goal.last, message.recording, frame_id)
    sighting = Sighting(
        topic=goal.topic,
        first=goal.first,
        last=goal.last,
        until=_goes_on_until(view, goal, scope),
        messages=0,
        begun=goal.accepted is not None,
        robot=robot,
        thing=None,
        value={"goal": goal.goal, "status": goal.status_word},
        ended=goal.ended is not None,
    )
    return sighting, message


def _with_fields(
    view: View, found: Iterable[tuple[Sighting, StoredMessage | None]], fields: Sequence[str]
) -> list[Sighting]:
    """Returns sightings with fields of their last messages in place of matched texts.

    A sighting stays as it is if its message lacks a field.

    Raises:
        InvalidArgumentsError: no sighting has one of the fields.
    """
    sightings: list[Sighting] = []
    refused: list[InvalidArgumentsError] = []
    for sighting, newest in found:
        narrowed = sighting
        if fields and newest is not None:
            try:
                narrowed = _narrowed(view, sighting, newest, fields)
            except InvalidArgumentsError as error:
                refused.append(error.detached())
        sightings.append(narrowed)
    if refused and len(refused) == len(sightings):
        raise refused.pop(0)
    if fields and sightings:
        values = [sighting.value for sighting in sightings]
        note_unnamed(view, sightings[0].topic, values, sightings[0].last + 1)
    return sightings


def _narrowed(
    view: View, sighting: Sighting, newest: StoredMessage, fields: Sequence[str]
) -> Sighting:
    """Returns a sighting with fields of its last message; a goal keeps its id and status.

    Raises:
        InvalidArgumentsError: the message does not have the fields.
    """
    shown = view.extractor.shown(view.memory.reader.decode(newest.record), newest.type, fields)
    view.notes.add(*shown.notes)
    value = quote(shown.value)
    if isinstance(sighting.value, dict) and isinstance(value, dict):
        value = {**sighting.value, **value}
    return replace(sighting, matched=(), value=value)


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
    """Returns where the thing of a sighting was, by the newest message that can be placed.

    The newest message of all may be newer than the last transform. If no message can be placed, a
    note says so, and the place is in the frame of the message.
    """
    targets = _target_frames(view, robot, frame_id)
    place = _place_of_detection(view, thing, newest, targets)
    if place is None or place.frame_id in targets:
        return place
    try:
        near = TimeWindow.around(newest.time, TF_CACHE_NS)
        if not any(connects(view, (target, place.frame_id), near) for target in targets):
            return place
    except QueryTimeoutError:
        return place
    window = TimeWindow(first, newest.time)
    before = view.stream.messages([newest.topic], window, newest_first=True)
    for stored, message in view.bags.decoded(islice(before, _MOST_TRIED)):
        value, detections = _counted_content(view, condition, stored.type, message)
        if condition.of_type(stored.type, view.extractor).matches(value):
            thing = _sought_detection(detections, condition)
            earlier = _place_of_detection(view, thing, stored, targets)
            if earlier is not None and earlier.frame_id in targets:
                return earlier
    view.notes.add(
        f"the place of the sighting at {unix_text(newest.time)} is in {place.frame_id}: "
        f"no transform leads to {' or '.join(targets)} at that time"
    )
    return place


def _target_frames(view: View, robot: Pose | None, frame_id: str | None) -> tuple[str, ...]:
    """Returns the frames in which places are wanted, the best one first."""
    if frame_id is not None:
        return (frame_id,)
    frames = (view.limits.map_frame, "" if robot is None else robot.frame_id)
    return tuple(dict.fromkeys(filter(None, frames)))


def _place_of_detection(
    view: View, thing: Detection | None, message: StoredMessage, targets: Sequence[str]
) -> LabelledPlace | None:
    """Returns where a message has a thing, in the first target that transforms lead to.

    If they lead to none, the place is in the message's own frame.
    """
    if thing is None or thing.place is None:
        return None
    seen, time = Pose(thing.place, None, thing.frame_id), seen_at(view, message)
    position, frame = thing.place, thing.frame_id
    for target in targets:
        placed = pose_in(view, seen, target, time, message.recording)
        if placed is not None:
            position, frame = placed.position, target
            break
    inside = with_place(view, seen, time, message.recording).places
    return LabelledPlace(thing.label, position, frame, inside)


def _sought_detection(detections: Sequence[Detection], condition: Condition) -> Detection | None:
    """Returns the detection that a condition is about, by its label or place, or the only one.

    Of several it is one with a place, if any; of these the one with the best score.
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
