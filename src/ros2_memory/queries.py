"""Queries: one function for each tool of the specification, plain values in, `results` out.

Times that come in are Unix seconds (see `timebase`); "ago" counts from the memory's now, which is
the wall clock or, for replayed and simulated bags, the newest recorded moment. Every function may
raise `NoDataError`, `InvalidArgumentsError` and `QueryTimeoutError`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from ros2_memory import results
from ros2_memory.analysis.frames import TF_CACHE_NS
from ros2_memory.analysis.motion.trajectory import MAX_WAYPOINTS
from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.model import BagFile, JsonValue, Pose, Sample, TimeWindow
from ros2_memory.core.text import listed, match_topics
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    FUTURE_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    START_SLACK_NS,
    Ns,
    ns_from_unix,
)
from ros2_memory.history import transforms as frame_history
from ros2_memory.history.clock_steps import across_steps, clock_steps, elapsed_in, while_recorded
from ros2_memory.history.context import READING_S, Call, Memory
from ros2_memory.history.coverage import (
    by_remark,
    describe_gaps,
    describe_misdated,
    describe_odd,
    not_covered,
    note_edges,
    note_unread,
    note_unrecorded,
    seconds,
    unexcluded,
    unix_text,
)
from ros2_memory.history.driven_path import (
    Body,
    body_of,
    driven_path,
    length_notes,
    newest_of_body,
    resolve_path_topic,
)
from ros2_memory.history.held_values import still_holds
from ros2_memory.history.no_data import (
    decode,
    describe_lack,
    no_data_at,
    no_data_between,
    require_bags,
    require_recorded,
    resolve_pose_topic,
    resolve_topic,
    topics_of_robot,
    topics_with,
    with_notes,
)
from ros2_memory.history.reverse_search import (
    ReverseSearch,
    compared_frames,
    condition_of,
    may_be_elsewhere,
    note_no_fix,
    out_of_time,
)
from ros2_memory.history.robots import note_robots, note_robots_near, require_one_robot
from ros2_memory.history.scan import pick
from ros2_memory.history.view import (
    AtTime,
    TimeRange,
    View,
    ns_argument,
    open_moment,
    open_span,
    open_view,
    search_window,
)
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.insights.fields import extremes_of
from ros2_memory.insights.silences import describe_silences, silences_of
from ros2_memory.insights.status import (
    bags_with_remarks,
    clock_faults,
    gaps_with_deleted,
    left_open,
    undecodable_topics,
    undecodable_types,
)
from ros2_memory.places.driven_inside import farthest_from
from ros2_memory.places.pose_frames import (
    axes_of,
    note_runs,
    placed,
    placed_waypoints,
    with_place,
)
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.analysis.motion.trajectory import Trajectory
    from ros2_memory.extract import Extracted
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.index.clock_faults import ClockFault
    from ros2_memory.index.snapshot import Snapshot

A = TypeVar("A", results.Match, results.ValueWhen)

_MAX_ODD_BAGS: Final = 5
_FEWEST_OF_A_LINE: Final = 2
_FINE_PATH_M: Final = 0.05 + 1e-9
"""The deviation that a simplified path is expected to have; a larger one is noted."""
_REACH_M: Final = 0.05
"""How far a robot may have got before the next pose without a note."""
_THINNED_POSES_NS: Final = 3 * NS_PER_S
"""No farther apart are the poses of a thinned day, where they were recorded."""


def topic_value(
    memory: Memory,
    call: Call,
    topic: str,
    moment: AtTime,
    *,
    tolerance_s: float | None = None,
    fields: Sequence[str] = (),
) -> results.TopicValue:
    """Returns the newest message of a topic at or before a moment, within the tolerance (s).

    A latched topic has no tolerance unless one is given: its newest message holds.
    """
    view, at, now = open_moment(memory, call, moment)
    stored = _newest_at(view, resolve_topic(view, topic), at, tolerance_s, moment.rest_s)
    value = _as_value(view, stored, fields, now)
    return _with_latched_age(view, value, stored, at)


def topic_range(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    *,
    max_samples: int = 100,
    fields: Sequence[str] = (),
) -> results.TopicRange:
    """Returns samples of a topic, evenly spaced over all its messages in a window.

    With them the extremes of `fields` that hold numbers, unless the messages are too many.
    """
    view, window = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    total, picked = pick(view, name, window, max_samples)
    shown, failures = _show_each(view, picked, fields)
    chosen = len(shown) + failures.total()
    if not chosen:
        raise no_data_between(view, (name,), window)
    note_unrecorded(view, window)
    if not shown:
        undecodable = NoDataError(NoDataReason.UNDECODABLE, next(iter(failures)))
        raise with_notes(view, window, undecodable)
    for sample in shown:
        view.notes.add(*sample.notes)
    view.notes.add(*(f"{count} samples left out: {why}" for why, count in failures.items()))
    types = [*dict.fromkeys(sample.type_name for sample in shown)]
    if len(types) > 1:
        view.notes.add(f"the topic was recorded under several types: {', '.join(types)}")
    if chosen < total:
        view.notes.add(f"{chosen} of {total} samples, evenly spaced over the window")
    note_unread(view, window, gaps=chosen < total)
    note_edges(view, window)
    note_robots(view, name, window)
    extremes = extremes_of(view, name, window, fields) if fields else ()
    note_no_fix(view, name, window, fields)
    samples = tuple(Sample(sample.time, sample.value) for sample in shown)
    return results.TopicRange(
        name, types[-1], total, samples, extremes, (*fields,), notes=view.notes.sentences()
    )


def position(
    memory: Memory,
    call: Call,
    moment: AtTime,
    *,
    topic: str | None = None,
    tolerance_s: float | None = None,
    frame_id: str | None = None,
) -> results.Position:
    """Returns where the robot was: its newest pose at or before a moment, within the tolerance (s).

    In the pose's own frame, or in `frame_id`. A topic of a satellite receiver gives degrees.
    """
    view, at, now = open_moment(memory, call, moment)
    name = resolve_path_topic(view, topic, degrees=True)
    body = body_of(view, name)
    if body is not None:
        return _position_of_body(
            view,
            body,
            at,
            tolerance_s=tolerance_s,
            rest_s=moment.rest_s,
            now=now,
            frame_id=frame_id,
        )
    _require_kind(view, name, "position", "geodetic")
    stored = _newest_at(view, name, at, tolerance_s, moment.rest_s, is_pose=True)
    return _position_in(view, stored, at, now, frame_id)


def _position_in(
    view: View, stored: StoredMessage, at: Ns, now: Ns | None, frame_id: str | None
) -> results.Position:
    """Returns the pose in a message, as that of a moment; see `position`."""
    memory, name = view.memory, stored.topic
    _note_latched(view, stored, at)
    message, type_name = decode(view, stored), stored.type
    pose, geodetic = memory.extractor.pose(message, type_name), None
    if pose is None:
        geodetic = memory.extractor.geodetic(message, type_name)
        if geodetic is None:
            raise InvalidArgumentsError(describe_lack(view, "position", stored))
        pose = Pose((math.nan,) * 3, None, geodetic.frame_id)
        coordinates: tuple[float, ...] = (geodetic.latitude, geodetic.longitude)
    else:
        coordinates = pose.position
    if not all(map(math.isfinite, coordinates)):
        view.notes.add("the recorded position is not a number")
    if geodetic is not None and not geodetic.has_fix:
        view.notes.add("no fix: the receiver states (fix_status -1) that this is not its position")
    if geodetic is None and pose.orientation is None:
        view.notes.add("the recorded orientation is not a rotation")
    if geodetic is None:
        recording = stored.bag.recording
        if is_thinned(stored.bag.file):
            _note_reach(view, stored, pose)
        if frame_id is not None:
            pose = placed(view, pose, stored.time, recording, frame_id)
        view.notes.add(*axes_of(pose.frame_id))
        if memory.limits.places:
            pose = with_place(view, pose, stored.time, recording)
    notes = view.notes.sentences()
    return results.Position(name, stored.time, pose, _age(stored, now), geodetic, notes=notes)


def _note_reach(view: View, stored: StoredMessage, pose: Pose) -> None:
    """Notes between which coordinates the robot was, in a second of which one pose stayed."""
    window = TimeWindow(stored.time + 1, stored.time + 2 * NS_PER_S)
    newer = view.stream.first([stored.topic], window)
    message = None if newer is None else view.bags.decode(newer)
    if newer is None or message is None:
        return
    after = view.extractor.pose(message, newer.type)
    if after is not None and math.dist(after.position, pose.position) > _REACH_M:
        spans = zip("xy", pose.position[:2], after.position[:2], strict=True)
        ends = [f"{axis} {min(span):.2f} to {max(span):.2f}" for axis, *span in spans]
        view.notes.add(
            f"it moved: until {unix_text(newer.time)} it was within {' and '.join(ends)} m of "
            f"{pose.frame_id or 'its frame'}; of that time one pose a second stayed"
        )


def _position_of_body(
    view: View,
    body: Body,
    at: Ns,
    *,
    tolerance_s: float | None,
    rest_s: float,
    now: Ns | None,
    frame_id: str | None,
) -> results.Position:
    """Returns where transforms have the robot's body, and the latitude and longitude beside it.

    Raises:
        NoDataError: none places it at the moment, or within the tolerance before.
    """
    limits, extractor = view.limits, view.extractor
    window, tolerance = _window_before(view, at, tolerance_s, rest_s)
    of_body = newest_of_body(view, body, window, frame_id)
    if of_body is None:
        raise _not_placed(view, body, at, tolerance, frame_id)
    stored, pose = of_body
    note_robots_near(view, stored)
    note_unread(view, TimeWindow(stored.time, window.stop))
    if limits.places:
        pose = with_place(view, pose, stored.time, stored.bag.recording)
    geodetic, fixes = None, topics_of_robot(view, "geodetic")
    near = TimeWindow.around(stored.time, ns_from_unix(limits.time_tolerance_s))
    fix = view.stream.newest(fixes[0], near) if len(fixes) == 1 else None
    if fix is not None and (message := view.bags.decode(fix)) is not None:
        geodetic = extractor.geodetic(message, fix.type)
    topic, notes = stored.topic, view.notes.sentences()
    return results.Position(topic, stored.time, pose, _age(stored, now), geodetic, notes=notes)


def _not_placed(
    view: View, body: Body, at: Ns, tolerance: Ns | None, frame_id: str | None
) -> NoDataError:
    """Returns the error for no transform that places the robot's body at a moment."""
    try:
        frame_history.transform_at(view, frame_id or body.parent, body.child, at)
        error = no_data_at(view, view.moving_topics, at, tolerance)
    except NoDataError as none_then:
        error = with_notes(view, TimeWindow.around(at, TF_CACHE_NS), none_then)
    fixes = topics_with(view, "geodetic")
    advice = f"; latitude and longitude are on {listed(fixes)}: give topic" if fixes else ""
    return NoDataError(error.reason, error.detail + advice, error.notes)


def velocity(
    memory: Memory,
    call: Call,
    moment: AtTime,
    *,
    topic: str | None = None,
    tolerance_s: float | None = None,
) -> results.Velocity:
    """Returns the robot's newest twist at or before a moment, within the tolerance (s)."""
    view, at, now = open_moment(memory, call, moment)
    name = resolve_pose_topic(view, topic, "velocity")
    _require_kind(view, name, "velocity")
    stored = _newest_at(view, name, at, tolerance_s, moment.rest_s, is_pose=True)
    _note_latched(view, stored, at)
    twist = memory.extractor.twist(decode(view, stored), stored.type)
    if twist is None:
        raise InvalidArgumentsError(describe_lack(view, "velocity", stored))
    return results.Velocity(
        name, stored.time, twist, _age(stored, now), notes=view.notes.sentences()
    )


def transform(
    memory: Memory, call: Call, parent: str, child: str, moment: AtTime
) -> results.TransformAt:
    """Returns the pose of `child` in `parent` at a moment, interpolated by tf2's rules."""
    view, at, now = open_moment(memory, call, moment)
    try:
        transform = frame_history.transform_at(view, parent, child, at)
    except NoDataError as error:
        raise with_notes(view, TimeWindow.around(at, TF_CACHE_NS), error) from error
    note_unread(view, TimeWindow.around(at, transform.reach))
    age = None if now is None else now - at
    return results.TransformAt(
        parent, child, at, transform.transform, transform.clock, age, notes=view.notes.sentences()
    )


def frames(memory: Memory, call: Call) -> results.Frames:
    """Returns every frame and parent-child pair that was recorded."""
    view = open_view(memory, call, memory.clock.now())
    edges = view.sessions.edges
    note_unread(view, TimeWindow.everything(), nothing=True)
    return results.Frames(edges, notes=view.notes.sentences())


def find_last_match(
    memory: Memory,
    call: Call,
    topic: str,
    condition_type: str,
    value: JsonValue,
    *,
    field: str | None = None,
    fields: Sequence[str] = (),
    before_s: float | None = None,
    min_score: float | None = None,
) -> results.Match:
    """Returns the newest message of a topic, or of all topics of a glob, that meets a condition.

    With `before_s` (Unix seconds) only messages up to and including then are searched. Detections
    of a score below `min_score` do not count.
    """
    now, until = memory.clock.now(), _search_end(before_s)

    def found(view: View, match: StoredMessage) -> results.Match:
        note_robots_near(view, match)
        note_unread(view, _searched_window(view, match, until, now), search=True)
        # What the view shows may be some days of long ago.
        newest_known = memory.index.published or view.snapshot
        counted_from = memory.now(now, newest_known.latest, call)
        is_future = match.time > counted_from + FUTURE_NS
        if is_future:
            after = seconds(match.time - counted_from)
            view.notes.add(f"dated {after} after now: when it was is unknown")
        value_found = _as_value(view, match, fields, None if is_future else counted_from)
        return results.Match(value_found, notes=value_found.notes)

    reach = min(now, until)
    sought = _Sought(topic, condition_type, value, field, min_score, until)
    return _last_match(View(memory, call, reach), reach, sought, found)


def value_when(
    memory: Memory,
    call: Call,
    value_topic: str,
    condition_topic: str,
    *,
    condition_type: str,
    value: JsonValue,
    field: str | None = None,
    fields: Sequence[str] = (),
    before_s: float | None = None,
    min_score: float | None = None,
) -> results.ValueWhen | results.Match:
    """Returns a topic's value at or before the last time that another topic met a condition.

    Else that there was no match. With `before_s` (Unix seconds) the condition is looked for up to
    and including then. Detections of a score below `min_score` do not count.
    """
    now, until = memory.clock.now(), _search_end(before_s)
    view = View(memory, call, now)
    name = resolve_topic(view, value_topic)

    def found(view: View, match: StoredMessage) -> results.ValueWhen:
        note_unread(view, _searched_window(view, match, until, now), search=True)
        note_robots_near(view, match)
        matched = _as_value(view, match, (), None)
        upto = TimeWindow.until(match.time)
        held = _newest_beside(view, name, upto, match)
        read = upto if held is None else replace(upto, start=held.time)
        note_unread(view, read, nothing=not held)
        if held is None:
            view.notes.add(f"no message of {name} is here at or before {unix_text(match.time)}")
            notes = (*matched.notes, *view.notes.sentences())
            return results.ValueWhen(matched, notes=tuple(dict.fromkeys(notes)))
        distance = match.time - held.time
        latched = still_holds(view, held, match.time)
        if distance > ns_from_unix(memory.limits.time_tolerance_s) and not latched:
            view.notes.add(f"the value is {seconds(distance)} older than the match")
        held_value = _with_latched_age(view, _as_value(view, held, fields, None), held, match.time)
        notes = (*matched.notes, *held_value.notes)
        return results.ValueWhen(matched, held_value, notes=tuple(dict.fromkeys(notes)))

    sought = _Sought(condition_topic, condition_type, value, field, min_score, until)
    return _last_match(view, now, sought, found)


def list_recorded_topics(
    memory: Memory, call: Call, *, pattern: str | None = None
) -> tuple[results.TopicRow, ...]:
    """Returns every topic that has messages, under each of its types; none for an empty memory.

    With `pattern`, a glob, those that match it. A row has notes where its numbers are of bags that
    are not whole, or that a wrong clock dated.

    Raises:
        NoDataError: the bag directory or its disk is missing: what was recorded is not known; or
            no topic matches.
    """
    view = View(memory, call, memory.clock.now())
    if view.snapshot.problem is not None:
        require_bags(view)
    notes = _notes_by_topic(view.snapshot)
    rows = []
    for topic in view.timeline.topics():
        reasons = undecodable_types(view, topic)
        for type_name, census in sorted(view.census(topic).items()):
            rows.append(
                results.TopicRow(
                    topic,
                    type_name,
                    census.first,
                    census.last,
                    census.messages,
                    reasons.get(type_name),
                    notes.get(topic, ()),
                )
            )
    if pattern is None or not rows:
        return tuple(rows)
    matched = {*match_topics([row.topic for row in rows], pattern)}
    named = tuple(row for row in rows if row.topic in matched)
    if not named:
        raise NoDataError(
            NoDataReason.TOPIC_NOT_RECORDED,
            f"none of the {len(rows)} recorded topics matches {pattern}; "
            "a glob such as */scene_objects matches anywhere, no pattern at all lists every topic",
        )
    return named


def data_time_range(
    memory: Memory, call: Call, start_s: float | None = None, end_s: float | None = None
) -> results.DataTimeRange:
    """Returns what the memory spans, where it has gaps, and which files do not answer.

    Bags that a wrong clock dated are listed, and neither begin nor end the span or a gap in it.
    Gaps, silences and steps of the clock are those that a window overlaps.

    Raises:
        InvalidArgumentsError: the bounds make no window.
    """
    now = memory.clock.now()
    window = search_window(TimeRange(start_s, end_s), now)
    view = View(memory, call, now if memory.limits.now == "wall" else None)
    view.bags.track_all_sources()
    snapshot = view.snapshot
    if snapshot.problem:
        view.notes.add(snapshot.problem)
    if snapshot.dating.note:
        view.notes.add(snapshot.dating.note)
    # Except crashes and wrong clocks.
    odd = [(bag, "; ".join(bag.summary.notes)) for bag in bags_with_remarks(snapshot)]
    odd += memory.scanner.damaged_parts(snapshot.bags)
    view.notes.add(*by_remark(odd, _MAX_ODD_BAGS))
    thinned, since = view.timeline.thinned, read_thinned(view.bag_dir).since
    if thinned and (since is None or thinned[0].start < since):
        before = "" if since is None else f" before {unix_text(since)}"
        view.notes.add(
            f"silences and steps of the clock within the days of memory/{before} are not known"
        )
    view.notes.add(*describe_absent(memory.absent_splits(snapshot)))
    undecodable = undecodable_topics(view)
    steps = clock_steps(view, window)
    return results.DataTimeRange(
        earliest=snapshot.dating.earliest,
        latest=snapshot.dating.latest,
        now=memory.now(now, snapshot.latest, call),
        bags=len(snapshot.bags),
        gaps=gaps_with_deleted(view, unexcluded(view, view.gaps(window))),
        incomplete=left_open(snapshot),
        active=snapshot.active,
        damaged=snapshot.damaged,
        unread=snapshot.unread,
        silent_topics=len(snapshot.silent_topics),
        notes=view.notes.sentences(),
        undecodable=undecodable,
        clock_faults=clock_faults(snapshot),
        silences=tuple(
            silence
            for silence in silences_of(memory, snapshot)
            if window.overlaps(silence.start, silence.end)
        ),
        clock_steps=steps,
    )


def _newest_beside(
    view: View, topic: str, window: TimeWindow, match: StoredMessage
) -> StoredMessage | None:
    """Returns the newest message of a topic in a window, from the match's recording if it has one.

    A note says where recordings of several robots may be mixed.
    """
    newest = view.stream.newest(topic, window)
    if newest is None or newest.bag.recording == match.bag.recording:
        return newest
    recording = match.bag.recording
    newest = view.sessions.newest(topic, window, recording) or newest
    if not view.sessions.are_joined(recording, newest.bag.recording):
        view.notes.add(
            f"the match is of recording {recording.name}, and the value of "
            f"{newest.bag.recording.name}: no handover proves that both are of one robot"
        )
    return newest


def trajectory_summary(
    memory: Memory,
    call: Call,
    span: TimeRange,
    *,
    topic: str | None = None,
    frame_id: str | None = None,
    max_waypoints: int = MAX_WAYPOINTS,
    farthest: JsonValue = None,
) -> results.TrajectorySummary:
    """Returns the driven path in a window, from one pose topic in log-time order.

    Its waypoints are in the poses' own frame or in `frame_id`; 0 asks for none, 1 for the last.
    `farthest` is the point from which the farthest pose is wanted.
    """
    view, window = open_span(memory, call, span)
    name = resolve_path_topic(view, topic)
    path, _ = driven_path(view, name, window)
    if path is None:
        raise no_data_between(view, (name,), window)
    note_unrecorded(view, window)
    if len(path.frames) > 1:
        view.notes.add(f"poses in several frames were joined: {', '.join(path.frames)}")
    require_one_robot(view, name, window)
    note_unread(view, window)
    note_edges(view, window)
    note_runs(view, name, path.frames[0], window)
    view.notes.add(*axes_of(frame_id or path.frames[0]))
    elapsed = elapsed_in(view, window)
    whole = path.trajectory(max(max_waypoints, _FEWEST_OF_A_LINE))
    driven = while_recorded(across_steps(whole, path, elapsed), elapsed, path)
    drawn = driven
    if max_waypoints < _FEWEST_OF_A_LINE:
        last = driven.waypoints[-1:] if max_waypoints else ()
        drawn = replace(driven, waypoints=last, waypoint_error_m=0.0)
    if frame_id is not None:
        moved = placed_waypoints(view, name, drawn.waypoints, path.frames[0], frame_id)
        drawn = replace(drawn, waypoints=moved)
        view.notes.retract_outside(window)
    ends = [(window.start, window.stop - 1)]
    away = None if farthest is None else farthest_from(view, farthest, name, ends, frame_id)
    return results.TrajectorySummary(
        name,
        frame_id or path.frames[0],
        path.first,
        path.last,
        drawn,
        elapsed.skipped_between(path.first, path.last),
        driven.totals.gap_ns,
        away,
        notes=(*view.notes.sentences(), *_path_notes(drawn)),
    )


def _path_notes(path: Trajectory) -> Iterator[str]:
    """Yields what a path leaves out, and how it was measured."""
    yield from length_notes(path)
    if path.totals.jumps:
        drawn = sum(point.jump for point in path.waypoints)
        if drawn:
            longest = "the longest lead" if drawn < path.totals.jumps else "each leads"
            yield (
                f"of the jumps {longest} to a waypoint with jump: true; "
                "that distance was not driven"
            )
    mean, fastest = path.avg_speed, path.max_speed
    if path.poses and fastest is not None and path.max_speed_from == "positions":
        yield "max_speed is measured from positions: the messages have no speed"
    # By more than the rounding of both.
    if mean is not None and fastest is not None and mean > fastest + 0.01:
        yield (
            "avg_speed, by the positions, is above max_speed of the messages: "
            "one of the two is wrong"
        )
    if path.waypoint_error_m > _FINE_PATH_M:
        yield f"the path is within {path.waypoint_error_m:.2f} m of the waypoints' line"


def _searched_window(view: View, stored: StoredMessage, until: Ns, now: Ns) -> TimeWindow:
    """Returns the window from a match to where its search began, or to now."""
    stop = until if view.limits.now == "latest" else min(until, now + 1)
    return TimeWindow(stored.time, max(stop, stored.time + 1))


class _Sought(NamedTuple):
    """The condition of a search, and the log time before which its last match is looked for."""

    topic: str
    condition_type: str
    value: JsonValue
    field: str | None
    min_score: float | None
    until: Ns


def _last_match(
    view: View, reach: Ns, sought: _Sought, found: Callable[[View, StoredMessage], A]
) -> A | results.Match:
    """Returns what `found` makes of the last match in a view that reaches to a time, or older.

    An index of years shows some days at a time. Where these have nothing, those before them are
    searched, for some seconds in all; the index reports what it has not shown.

    Raises:
        NoDataError: none of the days has anything that could be searched.
        QueryTimeoutError: the call's time is over; reports how far back was searched.
    """
    topic, condition_type, value, field, min_score, until = sought
    reading = view.call.partial_after(READING_S)
    missed: results.Match | NoDataError | None = None
    notes: tuple[str, ...] = ()
    while True:
        try:
            condition = condition_of(
                view, topic, condition_type, value, field=field, min_score=min_score
            )
            search = ReverseSearch(view, topic, condition)
            if until < MAX_NS:
                require_recorded(view, TimeWindow(MIN_NS, until))
            match = search.newest(until)
            if match is not None:
                return found(view, match)
            notes += _notes_on_never(view, topic, search, until, min_score)
            missed = results.Match(None, notes=tuple(dict.fromkeys(notes)))
        except NoDataError as error:
            missed = missed or error
        except QueryTimeoutError as error:
            if missed is None or error.searched_back_to is not None:
                raise
            raise out_of_time(view, reach + 1) from error
        older = view.snapshot.older
        if older is None or older >= reach or reading.expired() or view.call.deadline.expired():
            if isinstance(missed, NoDataError):
                raise missed
            return missed
        reach = older
        view = View(view.memory, view.call, reach)


def _notes_on_never(
    view: View, topic: str, search: ReverseSearch, until: Ns, min_score: float | None
) -> tuple[str, ...]:
    """Returns the notes on a search that found nothing; without any the reply is a plain null.

    They are on what was not read, on when recording was interrupted, and on when its topics were
    silent.
    """
    window, condition = TimeWindow(MIN_NS, until), search.condition
    notes = (
        *not_covered(view, search.topics, window),
        *describe_gaps(view, window, explained=True),
        *describe_silences(view, search.topics, window),
        *notes_on_never(view, topic, condition, window, min_score),
    )
    is_doubtful = notes or may_be_elsewhere(view, search.topics, condition)
    return (*notes, *compared_frames(view, search.topics, condition)) if is_doubtful else ()


def _search_end(before_s: float | None) -> Ns:
    """Returns the end of a search: just after a moment, with the slack of a float of seconds."""
    if before_s is None:
        return MAX_NS
    return min(ns_argument("before", before_s) + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS)


def _newest_at(
    view: View,
    topic: str,
    at: Ns,
    tolerance_s: float | None,
    rest_s: float,
    *,
    is_pose: bool = False,
) -> StoredMessage:
    """Returns the newest message of a topic at or before a moment: of any age where it is latched.

    Raises:
        NoDataError: there is none within the tolerance.
    """
    latching = view.limits.latching
    window, tolerance = _window_before(view, at, tolerance_s, rest_s)
    stored = view.stream.newest(topic, window)
    if stored is None and tolerance_s is None and is_pose:
        before = TimeWindow(max(window.stop - _THINNED_POSES_NS, MIN_NS), window.stop)
        pose = view.stream.newest(topic, before)
        if pose is not None and is_thinned(pose.bag.file):
            # A pose of a thinned day holds until the next: farther apart none was recorded.
            after = TimeWindow(pose.time + 1, pose.time + _THINNED_POSES_NS)
            stored = pose if view.stream.first([topic], after) is not None else None
    deleted = False
    if stored is None and tolerance_s is None and latching.may_hold(view.snapshot, topic):
        newest = view.stream.last(topic, window.stop)
        if newest is None:
            tolerance = None
        elif latching.holds(view.snapshot, newest):
            if still_holds(view, newest, at):
                stored = newest
            else:
                note_unread(view, TimeWindow(newest.time, window.stop), nothing=True)
                deleted = True
    if stored is None:
        raise no_data_at(view, (topic,), at, tolerance, deleted=deleted)
    note_robots_near(view, stored)
    note_unread(view, TimeWindow(stored.time, window.stop))
    return stored


def _window_before(
    view: View, at: Ns, tolerance_s: float | None, rest_s: float
) -> tuple[TimeWindow, Ns | None]:
    """Returns when a message is near enough before a moment, and the tolerance; None for any."""
    limit = view.limits.time_tolerance_s if tolerance_s is None else tolerance_s
    tolerance: Ns | None = ns_argument("tolerance_s", limit)
    start = at - (tolerance or 0) - START_SLACK_NS
    if start <= MIN_NS:
        start, tolerance = MIN_NS, None
    stop = at + ns_from_unix(rest_s) + AT_OR_BEFORE_SLACK_NS + 1
    return TimeWindow(start, min(stop, MAX_NS)), tolerance


def _require_kind(view: View, topic: str, what: str, *or_else: str) -> None:
    """Checks that a topic of types that are in the schema map can answer, before a time is sought.

    Raises:
        InvalidArgumentsError: none of its types carries the `what` that is asked for, or another.
    """
    extractor, types = view.extractor, view.timeline.types_of(topic)
    if any(
        not extractor.is_mapped(type_name) or extractor.kinds_of(type_name) & {what, *or_else}
        for type_name in types
    ):
        return
    newest = view.stream.last(topic)
    if newest is not None:
        raise InvalidArgumentsError(describe_lack(view, what, newest))


def _with_latched_age(
    view: View, value: results.TopicValue, stored: StoredMessage, at: Ns
) -> results.TopicValue:
    """Returns a value with whether it is latched, and then how old it is."""
    if not still_holds(view, stored, at):
        return value
    age = max(at - stored.time, 0) if value.age is None else value.age
    return replace(value, latched=True, age=age)


def _note_latched(view: View, stored: StoredMessage, at: Ns) -> None:
    """Notes of an answer that does not show its age that it is latched, and how old it is."""
    if still_holds(view, stored, at):
        topic = stored.topic
        view.notes.add(
            f"{topic} is latched: its value of {seconds(max(at - stored.time, 0))} before is still "
            "valid"
        )


def _decode_shown(
    view: View, stored: StoredMessage, fields: Sequence[str]
) -> tuple[object, Extracted]:
    """Returns a message, and as a reply shows it, with the notes on that message alone."""
    with view.call.stages.timed("extract"):
        message = decode(view, stored)
        return message, view.extractor.shown(message, stored.type, fields)


def _as_value(
    view: View, stored: StoredMessage, fields: Sequence[str], now: Ns | None
) -> results.TopicValue:
    """Returns a message as a reply shows it, with all notes of the view so far."""
    message, shown = _decode_shown(view, stored, fields)
    return results.TopicValue(
        stored.topic,
        stored.type,
        Sample(stored.time, shown.value),
        _age(stored, now),
        frame_id=view.extractor.frame(message),
        notes=(*view.notes.sentences(), *shown.notes),
    )


class _Shown(NamedTuple):
    """A message as a reply shows it, and what is to be noted on it."""

    time: Ns
    type_name: str
    value: JsonValue
    notes: tuple[str, ...]


def _show_each(
    view: View, picked: Iterable[StoredMessage], fields: Sequence[str]
) -> tuple[list[_Shown], Counter[str]]:
    """Returns messages as a reply shows them, and how often which reason kept one from decoding.

    None is in memory when the next one is read. Those without one of the fields, as of another
    type, are left out with a note.

    Raises:
        InvalidArgumentsError: none has them.
    """
    shown: list[_Shown] = []
    failures, lacking = Counter[str](), Counter[str]()
    for message in picked:
        try:
            _, extracted = _decode_shown(view, message, fields)
            shown.append(_Shown(message.time, message.type, extracted.value, extracted.notes))
        except NoDataError as error:
            failures[error.detail] += 1
        except InvalidArgumentsError as error:
            lacking[str(error)] += 1
        del message
    for detail, count in lacking.items():
        if not shown:
            raise InvalidArgumentsError(detail)
        view.notes.add(f"{count} samples left out: {detail}")
    return shown, failures


def _age(stored: StoredMessage, now: Ns | None) -> Ns | None:
    return None if now is None else now - stored.time


def _notes_by_topic(snapshot: Snapshot) -> dict[str, tuple[str, ...]]:
    """Returns, for topics with odd or misdated bags, the sentences on these."""
    odd: dict[str, list[BagFile]] = {}
    for bag in snapshot.timeline.faulty(TimeWindow.everything()):
        for topic in _topics_of(bag):
            odd.setdefault(topic, []).append(bag)
    misdated: dict[str, list[ClockFault]] = {}
    for fault in snapshot.misdated:
        for topic in _topics_of(fault.bag):
            misdated.setdefault(topic, []).append(fault)
    notes = {topic: tuple(describe_odd(bags)) for topic, bags in odd.items()}
    for topic, faults in misdated.items():
        notes[topic] = (*notes.get(topic, ()), describe_misdated(faults))
    return notes


def _topics_of(bag: BagFile) -> frozenset[str]:
    """Returns the topics that a bag declares; one may be declared under several types."""
    return frozenset(declared.topic for declared in bag.summary.schema.topics)
