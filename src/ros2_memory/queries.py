"""Queries: one function for each tool of the specification, plain values in, `results` out.

Times that come in are Unix seconds (see `timebase`); "ago" counts from the memory's now, which is
the wall clock or, for replayed and simulated bags, the newest recorded moment. Every function may
raise `NoDataError`, `InvalidArgumentsError` and `QueryTimeoutError`.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory import results
from ros2_memory.analysis.clock_steps import across_steps, while_recorded
from ros2_memory.analysis.conditions import NearPosition
from ros2_memory.analysis.facts import GOALS
from ros2_memory.analysis.frames import TF_CACHE_NS
from ros2_memory.analysis.motion.trajectory import MAX_WAYPOINTS, length_notes
from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    QueryTimeoutError,
)
from ros2_memory.core.model import BagFile, JsonValue, Pose, Sample, TimeWindow
from ros2_memory.core.text import counted, listed, match_topics
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
from ros2_memory.history.clock_steps import clock_steps
from ros2_memory.history.condition_hints import compared_frames, position_frames
from ros2_memory.history.conditions import Sought, condition_of, note_no_fix, types_matching
from ros2_memory.history.coverage import (
    by_remark,
    describe_gaps,
    describe_misdated,
    describe_odd,
    is_whole,
    not_covered,
    note_edges,
    note_unread,
    note_unrecorded,
    seconds,
    unexcluded,
    unix_text,
)
from ros2_memory.history.driven_path import (
    body_at,
    body_of,
    driven_path,
    follow,
    newest_of_body,
    no_path,
    resolve_path_topic,
)
from ros2_memory.history.held_values import newest_stating, note_unnamed
from ros2_memory.history.lasting import still_holds
from ros2_memory.history.no_data import (
    accepting,
    describe_earlier_poses,
    describe_lack,
    no_data_at,
    no_data_between,
    require_bags,
    require_decoded,
    require_recorded,
    resolve_pose_topic,
    resolve_topic,
    topics_of_robot,
    topics_with,
    with_notes,
)
from ros2_memory.history.reverse_search import ReverseSearch, out_of_time
from ros2_memory.history.robots import (
    note_robots,
    note_robots_near,
    require_one_robot,
)
from ros2_memory.history.scan import pick
from ros2_memory.history.transforms import connects
from ros2_memory.history.view import (
    ANY_TIME,
    AtTime,
    TimeRange,
    View,
    days_back,
    ns_argument,
    open_moment,
    open_span,
    open_view,
    search_window,
)
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.insights.fields import extremes_of
from ros2_memory.insights.silences import describe_unsearched, silences_of
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
    placed_waypoints,
    pose_in_map,
    with_place,
    with_runs,
)
from ros2_memory.things.unseen import notes_on_never

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.clock_steps import Elapsed
    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.analysis.motion.trajectory import PathSlice, Trajectory
    from ros2_memory.core.model import Geodetic
    from ros2_memory.extract import Extracted
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.driven_path import Body
    from ros2_memory.index.clock_faults import ClockFault
    from ros2_memory.index.snapshot import Snapshot

_NOT_A_NUMBER: Final = "the recorded position is not a number"
_NO_PLACE: Final = "the recorded pose is no place: NaN, or all zeros, as where tracking is lost"

_MAX_ODD_BAGS: Final = 5
_FEWEST_OF_A_LINE: Final = 2
_FINE_PATH_M: Final = 0.05 + 1e-9
"""A note tells that a simplified path deviates by more."""
_REACH_M: Final = 0.05
"""A note tells that a robot got farther before the next pose of a thinned day."""
_THINNED_POSES_NS: Final = 3 * NS_PER_S
"""The longest time between two poses of a thinned day, while poses were recorded."""
_ROUNDING_MPS: Final = 0.01
_MOST_TRIED: Final = 1000
"""So many poses at most are tried to place one in another frame."""
_OTHER_CLOCK_NS: Final = NS_PER_S
"""Stamps of transforms that are so far from log times are those of another computer's clock."""
_CORRECTED_NS: Final = 2 * NS_PER_S
"""A map is mostly corrected more often."""
_ENDED_GOALS: Final = (
    "these messages list the numbers of statuses, of goals also for minutes after they ended: "
    'find_matches, such as contains "aborted", finds each goal with when it ended'
)


class _Asked(NamedTuple):
    """A moment that is asked about, and how old a message may be then.

    Attributes:
        view: shows the moment.
        at: the moment.
        now: what ages count from; None if the moment was not relative to it.
        window: of the messages that count.
        tolerance: how old they may be; None for any age.
        is_strict: whether the tolerance was given, so that no message may be older.
    """

    view: View
    at: Ns
    now: Ns | None
    window: TimeWindow
    tolerance: Ns | None
    is_strict: bool

    @classmethod
    def of(cls, memory: Memory, call: Call, moment: AtTime, tolerance_s: float | None) -> _Asked:
        """Opens the view of a moment, with a tolerance (s) or that of the settings."""
        view, at, now = open_moment(memory, call, moment)
        limit = view.limits.time_tolerance_s if tolerance_s is None else tolerance_s
        tolerance: Ns | None = ns_argument("tolerance_s", limit)
        start = at - (tolerance or 0) - START_SLACK_NS
        if start <= MIN_NS:
            start, tolerance = MIN_NS, None
        stop = at + ns_from_unix(moment.rest_s) + AT_OR_BEFORE_SLACK_NS + 1
        window = TimeWindow(start, min(stop, MAX_NS))
        return cls(view, at, now, window, tolerance, tolerance_s is not None)

    def age(self, stored: StoredMessage) -> Ns | None:
        """Returns the age of a message, if the moment was relative to now."""
        return None if self.now is None else self.now - stored.time

    def newest(self, topic: str, *, is_pose: bool = False) -> StoredMessage:
        """Returns the newest message of a topic in the window.

        Unless it is strict, a latched message may have any age, and a pose of a thinned day holds
        until the next.

        Raises:
            NoDataError: there is no such message.
        """
        view, stop, tolerance = self.view, self.window.stop, self.tolerance
        stored = view.stream.newest(topic, self.window)
        if stored is None and not self.is_strict and is_pose:
            stored = _thinned_pose(view, topic, stop)
        deleted = False
        latching = view.limits.latching
        if stored is None and not self.is_strict and latching.may_latch(view.snapshot, topic):
            newest = view.stream.last(topic, stop)
            if newest is None:
                tolerance = None  # there is none of any age
            elif latching.holds(view.snapshot, newest):
                deleted = not still_holds(view, newest, self.at)
                if deleted:
                    note_unread(view, TimeWindow(newest.time, stop), nothing=True)
                else:
                    stored = newest
        if stored is None:
            raise no_data_at(view, (topic,), self.at, tolerance, deleted=deleted)
        note_robots_near(view, stored)
        note_unread(view, TimeWindow(stored.time, stop))
        return stored

    def note_latched(self, stored: StoredMessage) -> None:
        """Notes the age of a latched message, for replies that do not show it."""
        if still_holds(self.view, stored, self.at):
            age = seconds(_age_of_latched(self.view, stored, self.at))
            still = f"its value of {age} before is still valid"
            self.view.notes.add(f"{stored.topic} is latched: {still}")


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
    asked = _Asked.of(memory, call, moment, tolerance_s)
    view = asked.view
    stored = asked.newest(resolve_topic(view, topic))
    stating = newest_stating(view, stored, fields, asked.window.start)
    if stating is None and (earlier := newest_stating(view, stored, fields, MIN_NS)):
        last = f"{listed(fields)}: last at {unix_text(earlier.time)}"
        view.notes.add(f"{last}; a longer tolerance_s reaches it")
    stored = stating or stored
    value = _as_value(view, stored, fields, asked.now)
    return _with_latched_age(view, value, stored, asked.at)


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

    And the extremes of those `fields` that hold numbers, unless there are too many messages.
    """
    view, window = open_span(memory, call, span)
    name = resolve_topic(view, topic)
    total, picked = pick(view, name, window, max_samples)
    read = _read_samples(view, picked, fields, window.start)
    if not read.picked:
        raise no_data_between(view, (name,), window)
    if read.unnamed == read.picked:
        note_unnamed(view, name, [dict.fromkeys(fields)], window.stop)
        detail = f"the messages of {name} in this time say nothing of {listed(fields)}"
        raise with_notes(view, window, NoDataError(NoDataReason.BETWEEN_MESSAGES, detail))
    note_unrecorded(view, window)
    if not read.samples:
        undecodable = NoDataError(NoDataReason.UNDECODABLE, next(iter(read.undecodable)))
        raise with_notes(view, window, undecodable)
    _note_samples(view, read)
    note_unread(view, window, gaps=read.picked < total)
    note_edges(view, window)
    note_robots(view, name, window)
    extremes = extremes_of(view, name, window, fields) if fields else ()
    if fields:
        note_unnamed(view, name, [sample.value for sample in read.samples], window.stop)
    note_no_fix(view, name, window, fields)
    return results.TopicRange(
        name,
        [*read.types][-1],
        total,
        tuple(read.samples),
        extremes,
        (*fields,),
        notes=view.notes.sentences(),
    )


@dataclass(slots=True)
class _Samples:
    """Messages as replies show them, and how many were left out.

    Attributes:
        samples: log times and values.
        types: the types of these messages, each once.
        notes: on these messages alone.
        undecodable: how often each error kept a message from being decoded.
        unnamed: how many messages name other joints, as all do since the message before.
        picked: how many messages there were.
    """

    samples: list[Sample] = field(default_factory=list)
    types: dict[str, None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    undecodable: Counter[str] = field(default_factory=Counter)
    unnamed: int = 0
    picked: int = 0


def _note_samples(view: View, read: _Samples) -> None:
    """Notes what samples leave out of all messages of a window."""
    view.notes.add(*read.notes)
    for why, count in read.undecodable.items():
        view.notes.add(f"{counted(count, 'sample')} left out: {why}")
    if len(read.types) > 1:
        view.notes.add(f"the topic was recorded under several types: {', '.join(read.types)}")
    if read.unnamed:
        samples = counted(read.unnamed, "sample")
        view.notes.add(f"{samples} left out, without any of the fields")


def _read_samples(
    view: View, messages: Iterable[StoredMessage], fields: Sequence[str], since: Ns
) -> _Samples:
    """Returns messages, given in order, as replies show them.

    In place of a message that names other joints stands the newest one, but not before `since` or
    the message before, that says something of the fields. A message without one of the fields, as
    of another type, is left out with a note.

    Raises:
        InvalidArgumentsError: no message has the fields.
    """
    read, lacking = _Samples(), Counter[str]()
    for message in messages:
        read.picked += 1
        stating = newest_stating(view, message, fields, since)
        since = message.time + 1
        if stating is None:
            read.unnamed += 1
            continue
        try:
            _, extracted = _decode_shown(view, stating, fields)
        except NoDataError as error:
            read.undecodable[error.detail] += 1
        except InvalidArgumentsError as error:
            lacking[str(error)] += 1
        else:
            read.samples.append(Sample(stating.time, extracted.value))
            read.types[stating.type] = None
            read.notes.extend(extracted.notes)
        del message, stating  # frees it before the next one is read
    for detail, count in lacking.items():
        if not read.samples:
            raise InvalidArgumentsError(detail)
        view.notes.add(f"{counted(count, 'sample')} left out: {detail}")
    return read


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

    The pose is in its own frame, or in `frame_id`. A satellite receiver's topic gives degrees.
    """
    asked = _Asked.of(memory, call, moment, tolerance_s)
    view = asked.view
    name = resolve_path_topic(view, topic, degrees=True)
    if body_of(view, name) is not None:
        return _position_of_body(asked, frame_id)
    _require_kind(view, name, "position", "geodetic")
    try:
        stored = asked.newest(name, is_pose=True)
    except NoDataError as error:
        detail = error.detail + describe_earlier_poses(view, name, asked.at + 1)
        raise NoDataError(error.reason, detail, error.notes) from error
    asked.note_latched(stored)
    message = require_decoded(view, stored)
    pose, geodetic = view.extractor.pose(message, stored.type), None
    if pose is not None:
        stored, pose = _newest_placed(asked, stored, pose, frame_id)
    else:
        geodetic = view.extractor.geodetic(message, stored.type)
        if geodetic is None:
            raise InvalidArgumentsError(describe_lack(view, "position", stored))
        _note_geodetic(view, geodetic)
        pose = Pose((math.nan,) * 3, geodetic.orientation, geodetic.frame_id)
    notes = view.notes.sentences()
    return results.Position(name, stored.time, pose, asked.age(stored), geodetic, notes=notes)


def _note_geodetic(view: View, geodetic: Geodetic) -> None:
    """Notes that a satellite receiver gives no valid position."""
    if not (math.isfinite(geodetic.latitude) and math.isfinite(geodetic.longitude)):
        view.notes.add(_NOT_A_NUMBER)
    if not geodetic.has_fix:
        view.notes.add("no fix: the receiver states that this is not its position")


def _newest_placed(
    asked: _Asked, newest: StoredMessage, pose: Pose, frame_id: str | None
) -> tuple[StoredMessage, Pose]:
    """Returns the newest message whose pose can be placed in `frame_id`, and its pose there.

    A map is corrected more rarely than poses come: transforms may not lead there from the newest.
    Unless the tolerance was given, a pose of the time since a usual correction will do.

    Raises:
        NoDataError: none within the tolerance can be placed; it names the tolerance that suffices.
    """
    try:
        return newest, _place_pose(asked.view, newest, pose, frame_id)
    except NoDataError as error:
        start = min(asked.window.start, asked.at - _CORRECTED_NS)
        older = _last_placed(asked.view, newest.topic, TimeWindow(start, newest.time), frame_id)
        if older is None:
            raise
        if asked.is_strict and older[0].time < asked.window.start:
            detail = f"{error.detail}; or, {accepting(older[0], asked.at)}"
            raise NoDataError(error.reason, detail, error.notes) from error
        return older


def _last_placed(
    view: View, topic: str, window: TimeWindow, frame_id: str | None
) -> tuple[StoredMessage, Pose] | None:
    """Returns the newest message of a window whose pose can be placed in `frame_id`, or None."""
    messages = view.stream.messages([topic], window, newest_first=True)
    for stored, message in view.bags.decoded(islice(messages, _MOST_TRIED)):
        pose = view.extractor.pose(message, stored.type)
        with suppress(NoDataError):
            if pose is not None:
                return stored, _place_pose(view, stored, pose, frame_id)
    return None


def _place_pose(view: View, stored: StoredMessage, pose: Pose, frame_id: str | None) -> Pose:
    """Returns the pose in a message in `frame_id`, with the named place; notes tell its flaws."""
    recording = stored.recording
    if not all(map(math.isfinite, pose.position)):
        view.notes.add(_NO_PLACE)
    elif pose.orientation is None:
        view.notes.add("the recorded orientation is not a rotation")
    if is_thinned(stored.bag.file):
        _note_reach(view, stored, pose)
    if frame_id is not None:
        pose = pose_in_map(view, pose, stored.time, recording, frame_id)
    view.notes.add(*axes_of(pose.frame_id))
    if view.limits.places:
        pose = with_place(view, pose, stored.time, recording)
    return pose


def _note_reach(view: View, stored: StoredMessage, pose: Pose) -> None:
    """Notes how far the robot got until the next pose: a thinned day has one pose a second."""
    window = TimeWindow(stored.time + 1, stored.time + 2 * NS_PER_S)
    newer = view.stream.first([stored.topic], window)
    message = view.bags.decode(newer)
    if newer is None or message is None:
        return
    after = view.extractor.pose(message, newer.type)
    if after is None or math.dist(after.position, pose.position) <= _REACH_M:
        return
    ends = []
    for axis, here, there in zip("xy", pose.position[:2], after.position[:2], strict=True):
        ends.append(f"{axis} {min(here, there):.2f} to {max(here, there):.2f}")
    view.notes.add(
        f"it moved: until {unix_text(newer.time)} it was within {' and '.join(ends)} m of "
        f"{pose.frame_id or 'its frame'}; of that time one pose a second stayed"
    )


def _position_of_body(asked: _Asked, frame_id: str | None) -> results.Position:
    """Returns where transforms place the robot's body, and the latitude and longitude then.

    Raises:
        NoDataError: no transform places it at the moment, or within the tolerance before.
    """
    view = asked.view
    newest = newest_of_body(view, asked.window, frame_id)
    if newest is None:
        raise _unplaced_error(asked, frame_id)
    stored, pose = newest
    note_robots_near(view, stored)
    note_unread(view, TimeWindow(stored.time, asked.window.stop))
    if view.limits.places:
        pose = with_place(view, pose, stored.time, stored.recording)
    geodetic, fix_topics = None, topics_of_robot(view, "geodetic")
    if len(fix_topics) == 1:
        near = TimeWindow.around(stored.time, ns_from_unix(view.limits.time_tolerance_s))
        fix = view.stream.newest(fix_topics[0], near)
        message = view.bags.decode(fix)
        if fix is not None and message is not None:
            geodetic = view.extractor.geodetic(message, fix.type)
    topic, notes = stored.topic, view.notes.sentences()
    return results.Position(topic, stored.time, pose, asked.age(stored), geodetic, notes=notes)


def _unplaced_error(asked: _Asked, frame_id: str | None) -> NoDataError:
    """Returns why no transform places the robot's body at a moment."""
    view, at = asked.view, asked.at
    near = TimeWindow.around(at, TF_CACHE_NS)
    body = body_at(view, at)
    error = None
    try:
        if body is not None:
            parent = frame_id or body.parent
            error = _too_old_error(asked, body, parent)
            if error is None:
                frame_history.transform_at(view, parent, body.child, at)
        error = error or no_data_at(view, view.moving_topics, at, asked.tolerance)
    except NoDataError as no_transform:
        error = with_notes(view, near, no_transform)
    fixes = [
        named
        for named in topics_with(view, "geodetic")
        if view.stream.newest(named.partition(" ")[0], near) is not None
    ]
    advice = f"; latitude and longitude are on {listed(fixes)}: give topic" if fixes else ""
    return NoDataError(error.reason, error.detail + advice, error.notes)


def _too_old_error(asked: _Asked, body: Body, parent: str) -> NoDataError | None:
    """Returns that the newest transform of the body is older than the tolerance, and how old.

    None unless other frames have newer ones on these topics: else messages are lacking.
    """
    view, at, tolerance = asked.view, asked.at, asked.tolerance
    newest = newest_of_body(view, TimeWindow(at - TF_CACHE_NS, at + 1), parent)
    within = TimeWindow(at if tolerance is None else at - tolerance, at + 1)
    has_others = any(view.stream.newest(topic, within) for topic in view.moving_topics)
    if newest is None or tolerance is None or not has_others:
        return None
    age = at - newest[0].time
    detail = (
        f"no transform of {body.child} in {parent} within {seconds(tolerance)} before "
        f"{unix_text(at)}; the nearest older one is {seconds(age)} before it, at "
        f"{unix_text(newest[0].time)}; {accepting(newest[0], at)}"
    )
    error = NoDataError(NoDataReason.BETWEEN_MESSAGES, detail)
    return with_notes(view, within, error)


def velocity(
    memory: Memory,
    call: Call,
    moment: AtTime,
    *,
    topic: str | None = None,
    tolerance_s: float | None = None,
) -> results.Velocity:
    """Returns the robot's newest twist at or before a moment, within the tolerance (s)."""
    asked = _Asked.of(memory, call, moment, tolerance_s)
    view = asked.view
    name = resolve_pose_topic(view, topic, "velocity")
    _require_kind(view, name, "velocity")
    stored = asked.newest(name, is_pose=True)
    asked.note_latched(stored)
    twist = memory.extractor.twist(require_decoded(view, stored), stored.type)
    if twist is None:
        raise InvalidArgumentsError(describe_lack(view, "velocity", stored))
    return results.Velocity(
        name, stored.time, twist, asked.age(stored), notes=view.notes.sentences()
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
    note_unread(view, TimeWindow.around(at, transform.around))
    if transform.clock == "stamp" and abs(transform.late) >= _OTHER_CLOCK_NS:
        side, age_then = ("before", "older") if transform.late > 0 else ("after", "newer")
        view.notes.add(
            f"stamps of transforms are {abs(transform.late) / NS_PER_S:.1f} s {side} log times, as "
            "of another computer's clock: messages and positions of this time are that much "
            f"{age_then}"
        )
    age = None if now is None else now - at
    return results.TransformAt(
        parent, child, at, transform.transform, transform.clock, age, notes=view.notes.sentences()
    )


def frames(memory: Memory, call: Call) -> results.Frames:
    """Returns every frame and parent-child pair that was recorded."""
    view = open_view(memory, call, memory.clock.now())
    edges = tuple(view.sessions.edges())
    note_unread(view, TimeWindow.everything(), nothing=True)
    return results.Frames(edges, notes=view.notes.sentences())


def find_last_match(
    memory: Memory,
    call: Call,
    sought: Sought,
    *,
    fields: Sequence[str] = (),
    before_s: float | None = None,
) -> results.Match:
    """Returns the newest message that meets the condition that is sought.

    With `before_s` (Unix seconds) only messages up to and including then are searched.
    """
    now, until = memory.clock.now(), _search_end(before_s)
    found = _last_match(View(memory, call, min(now, until)), sought, until)
    if isinstance(found, results.Match):
        return found
    view, match = found
    note_robots_near(view, match)
    _note_unsearched(view, match, until, now)
    # The view may show some days of long ago only.
    newest_known = memory.index.published or view.snapshot
    counted_from = memory.now(newest_known.latest, call)
    is_future = match.time > counted_from + FUTURE_NS
    if is_future:
        after = seconds(match.time - counted_from)
        view.notes.add(f"dated {after} after now: when it was is unknown")
    shown = _as_value(view, match, fields, None if is_future else counted_from)
    return results.Match(shown, notes=shown.notes)


def value_when(
    memory: Memory,
    call: Call,
    value_topic: str,
    sought: Sought,
    *,
    fields: Sequence[str] = (),
    before_s: float | None = None,
) -> results.ValueWhen | results.Match:
    """Returns a topic's value at or before the last time that what is sought was so.

    Or that there was no match. With `before_s` (Unix seconds) only matches up to and including then
    count.
    """
    now, until = memory.clock.now(), _search_end(before_s)
    view = View(memory, call, min(now, until))
    name = _resolve_in_days(view, value_topic)
    found = _last_match(view, sought, until)
    if isinstance(found, results.Match):
        return found
    days, match = found
    _note_unsearched(days, match, until, now)
    return _value_at_match(days, name, match, fields)


def _value_at_match(
    days: View, name: str, match: StoredMessage, fields: Sequence[str]
) -> results.ValueWhen:
    """Returns a match, and the value of a topic then, which may be of days before it.

    Args:
        days: shows the days of the match.
        name: of the topic.
        match: the message that meets the condition.
        fields: to show of the value; all if empty.
    """
    note_robots_near(days, match)
    matched = _as_value(days, match, (), None)
    until_match = TimeWindow.until(match.time)
    found = _newest_back(days, name, until_match, match)
    if found is None:
        note_unread(days, until_match, nothing=True)
        days.notes.add(f"no message of {name} is here at or before {unix_text(match.time)}")
        notes = (*matched.notes, *days.notes.sentences())
        return results.ValueWhen(matched, notes=tuple(dict.fromkeys(notes)))
    view, stored = found
    stored = newest_stating(view, stored, fields, MIN_NS) or stored
    for shown_days in dict.fromkeys((days, view)):
        note_unread(shown_days, replace(until_match, start=stored.time))
    age = match.time - stored.time
    is_old = age > ns_from_unix(days.limits.time_tolerance_s)
    if is_old and not still_holds(view, stored, match.time):
        view.notes.add(f"the value is {seconds(age)} older than the match")
    shown = _with_latched_age(view, _as_value(view, stored, fields, None), stored, match.time)
    notes = (*matched.notes, *days.notes.sentences(), *shown.notes)
    return results.ValueWhen(matched, shown, notes=tuple(dict.fromkeys(notes)))


def _newest_back(
    days: View, topic: str, window: TimeWindow, match: StoredMessage
) -> tuple[View, StoredMessage] | None:
    """Returns the newest message of a topic in a window, and the view of the days that have it."""
    for view in days_back(days):
        stored = _newest_of_recording(view, topic, window, match)
        if stored is not None:
            return view, stored
    return None


def list_recorded_topics(
    memory: Memory, call: Call, *, pattern: str | None = None
) -> tuple[results.TopicRow, ...]:
    """Returns a row for each type of each topic with messages; none for an empty memory.

    With `pattern`, a glob, only the topics that match.

    Raises:
        NoDataError: no topic matches, or what was recorded is not known since the bag directory or
            its disk is missing.
    """
    view = View(memory, call, memory.clock.now())
    if view.snapshot.problem is not None:
        require_bags(view)
    rows = tuple(_topic_rows(view))
    if pattern is None or not rows:
        return rows
    names = {*match_topics([row.topic for row in rows], pattern)}
    matching = tuple(row for row in rows if row.topic in names)
    if not matching:
        raise NoDataError(
            NoDataReason.TOPIC_NOT_RECORDED,
            f"none of the {len(rows)} recorded topics matches {pattern}; "
            "a glob such as */scene_objects matches anywhere, no pattern at all lists every topic",
        )
    return matching


def _topic_rows(view: View) -> Iterator[results.TopicRow]:
    """Yields the rows of all topics. Notes name damaged bags, and bags that a wrong clock dated."""
    notes = _notes_by_topic(view.snapshot)
    for topic in view.timeline.topics():
        reasons = undecodable_types(view, topic)
        for type_name, census in sorted(view.census(topic).items()):
            yield results.TopicRow(
                topic,
                type_name,
                census.first,
                census.last,
                census.messages,
                reasons.get(type_name),
                notes.get(topic, ()),
            )


def data_time_range(
    memory: Memory, call: Call, span: TimeRange = ANY_TIME
) -> results.DataTimeRange:
    """Returns what the memory spans, where it has gaps, and which files do not answer.

    A window selects the gaps, silences and steps of the clock that it overlaps. Bags that a wrong
    clock dated are listed, and count neither for the span nor for gaps.

    Raises:
        InvalidArgumentsError: the bounds make no window.
    """
    now = memory.clock.now()
    window = search_window(span, now)
    view = View(memory, call, now if memory.limits.now == "wall" else None)
    view.bags.track_all_sources()
    snapshot = view.snapshot
    _note_bags(view)
    undecodable = undecodable_topics(view)
    steps = clock_steps(view, window)
    silences = tuple(
        silence
        for silence in silences_of(memory, snapshot)
        if window.overlaps(silence.start, silence.end)
    )
    return results.DataTimeRange(
        earliest=snapshot.dating.earliest,
        latest=snapshot.dating.latest,
        now=memory.now(snapshot.latest, call),
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
        silences=silences,
        clock_steps=steps,
    )


def _note_bags(view: View) -> None:
    """Notes odd, thinned and absent bags. Crashes and wrong clocks are listed, not noted."""
    snapshot, memory = view.snapshot, view.memory
    if snapshot.problem:
        view.notes.add(snapshot.problem)
    if snapshot.dating.note:
        view.notes.add(snapshot.dating.note)
    odd = [(bag, "; ".join(bag.summary.notes)) for bag in bags_with_remarks(snapshot)]
    found = memory.scanner.damaged_parts(snapshot.bags)
    odd += [(bag, fault) for bag, fault in found if fault not in bag.summary.notes]
    in_order = sorted(odd, key=lambda remark: remark[0].start)
    view.notes.add(*by_remark(in_order, _MAX_ODD_BAGS))
    thinned, since = view.timeline.thinned, read_thinned(view.bag_dir).since
    if thinned and (since is None or thinned[0].start < since):
        before = "" if since is None else f" before {unix_text(since)}"
        view.notes.add(
            f"silences and steps of the clock within the days of memory/{before} are not known"
        )
    view.notes.add(*describe_absent(memory.absent_splits(snapshot)))


def _newest_of_recording(
    view: View, topic: str, window: TimeWindow, match: StoredMessage
) -> StoredMessage | None:
    """Returns the newest message of a topic in a window, of the match's recording if it has one.

    A message of another recording may be another robot's: a note says so.
    """
    newest = view.stream.newest(topic, window)
    recording = match.recording
    if newest is None or newest.recording == recording:
        return newest
    newest = view.sessions.newest(topic, window, recording) or newest
    if not view.sessions.are_joined(recording, newest.recording):
        view.notes.add(
            f"the match is of recording {recording.name}, and the value of "
            f"{newest.recording.name}: no handover proves that both are of one robot"
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

    Its waypoints are in the poses' own frame or in `frame_id`: none for `max_waypoints` 0, the last
    one for 1. `farthest` is the point from which the farthest pose is wanted.
    """
    view, window = open_span(memory, call, span)
    name = follow(view, topic)
    path, _ = driven_path(view, name, window)
    if path is None:
        raise no_path(view, name, window)
    own_frame = path.frames[0]
    note_unrecorded(view, window)
    if len(path.frames) > 1:
        view.notes.add(f"poses in several frames were joined: {', '.join(path.frames)}")
    require_one_robot(view, name, window)
    note_unread(view, window)
    note_edges(view, window)
    if (max_waypoints or farthest is not None) and frame_id in {None, own_frame}:
        note_runs(view, name, own_frame, window)
    view.notes.add(*axes_of(frame_id or own_frame))
    elapsed = view.elapsed_in(window)
    shown = _drawn(view, name, path, elapsed, max_waypoints)
    if frame_id is not None:
        waypoints = placed_waypoints(view, name, shown.waypoints, own_frame, frame_id)
        shown = replace(shown, waypoints=waypoints)
        view.notes.retract_outside(window)
    away = None
    if farthest is not None:
        spans = [(window.start, window.stop - 1)]
        away = farthest_from(view, farthest, name, spans, frame_id)
    return results.TrajectorySummary(
        name,
        frame_id or own_frame,
        path.first,
        path.last,
        shown,
        elapsed.skipped_between(path.first, path.last),
        shown.totals.gap_ns,
        away,
        notes=(*view.notes.sentences(), *_path_notes(shown, view.limits.max_plausible_speed_mps)),
    )


def _drawn(
    view: View, topic: str, path: PathSlice, elapsed: Elapsed, max_waypoints: int
) -> Trajectory:
    """Returns a path without steps of the clock, with at most so many waypoints."""
    # The least line has two ends: fewer waypoints are cut from it.
    whole = with_runs(view, topic, path, path.trajectory(max(max_waypoints, _FEWEST_OF_A_LINE)))
    drawn = while_recorded(across_steps(whole, path, elapsed), elapsed, path)
    if max_waypoints >= _FEWEST_OF_A_LINE:
        return drawn
    last = drawn.waypoints[-1:] if max_waypoints else ()
    return replace(drawn, waypoints=last, waypoint_error_m=0.0)


def _path_notes(path: Trajectory, plausible_mps: float) -> Iterator[str]:
    """Yields what a path leaves out, and how it was measured."""
    yield from length_notes(path)
    mean, fastest = path.avg_speed, path.max_speed
    is_stated = path.max_speed_from == "twist"
    if path.totals.jumps and is_stated and fastest is not None and fastest > plausible_mps:
        yield (
            f"the messages state up to {fastest:.1f} m/s, and steps faster than {plausible_mps:g} "
            "m/s (data.max_plausible_speed_mps) are taken for jumps: set it higher"
        )
    if path.poses and fastest is not None and path.max_speed_from == "positions":
        yield "max_speed is measured from positions: the messages have no speed"
    if mean is not None and fastest is not None and mean > fastest + _ROUNDING_MPS:
        yield (
            "avg_speed, by the positions, is above max_speed of the messages: "
            "one of the two is wrong"
        )
    if path.waypoint_error_m > _FINE_PATH_M:
        yield f"the path is within {path.waypoint_error_m:.2f} m of the waypoints' line"


def _note_unsearched(view: View, match: StoredMessage, until: Ns, now: Ns) -> None:
    """Notes what was not read from a match to the end of its search, or to now."""
    stop = until if view.limits.now == "latest" else min(until, now + 1)
    note_unread(view, TimeWindow(match.time, max(stop, match.time + 1)), search=True)


def _resolve_in_days(view: View, name: str) -> str:
    """Returns the recorded topic with a name, be it of days before those of a view.

    Raises:
        NoDataError: as `resolve_topic` does for the view.
    """
    for days in days_back(view):
        with suppress(NoDataError):
            return resolve_topic(days, name)
    return resolve_topic(view, name)


def _last_match(
    view: View, sought: Sought, until: Ns
) -> tuple[View, StoredMessage] | results.Match:
    """Returns the last match, with the view of the days that have it; or that there is none.

    `view` shows the newest days to search.

    Raises:
        NoDataError: no day has anything that could be searched.
        QueryTimeoutError: the call's time is over; it says how far back was searched.
    """
    missed: results.Match | NoDataError | None = None
    notes: tuple[str, ...] = ()
    searched_to = MAX_NS
    for days in days_back(view):
        try:
            match, notes_on_days = _last_match_in(days, sought, until)
        except NoDataError as error:
            missed = missed or error.detached()
        except QueryTimeoutError as error:
            if missed is None or error.searched_back_to is not None:
                raise
            raise out_of_time(days, searched_to + 1) from error
        else:
            if match is not None:
                return days, match
            notes += notes_on_days
            missed = results.Match(None, notes=tuple(dict.fromkeys(notes)))
        searched_to = days.snapshot.older or searched_to
    if isinstance(missed, NoDataError):
        raise missed
    return missed or results.Match(None)


def _last_match_in(
    view: View, sought: Sought, until: Ns
) -> tuple[StoredMessage | None, tuple[str, ...]]:
    """Returns the last match in the days that a view shows, or the notes on finding none.

    Raises:
        NoDataError: the days have nothing that could be searched.
        QueryTimeoutError: the call's time is over.
    """
    reverse_search = ReverseSearch(view, sought.topic, condition_of(view, sought))
    if until < MAX_NS:
        require_recorded(view, TimeWindow(MIN_NS, until))
    match = reverse_search.newest(until)
    if match is None:
        of_condition = view.notes.sentences()
        notes = (*of_condition, *_notes_on_never(view, sought, reverse_search, until))
        lists_goals = GOALS in types_matching(view, sought.topic)
        return None, (_ENDED_GOALS, *notes) if lists_goals else notes
    if match.type == GOALS:
        view.notes.add(_ENDED_GOALS)
    return match, ()


def _notes_on_never(
    view: View, sought: Sought, reverse_search: ReverseSearch, until: Ns
) -> tuple[str, ...]:
    """Returns the notes on a search that found nothing; without any the reply is a plain null.

    They tell what was not read, and when recording was interrupted or topics were silent.
    """
    window, condition = TimeWindow(MIN_NS, until), reverse_search.condition
    topics = reverse_search.topics
    notes = (
        *not_covered(view, topics, window),
        *describe_gaps(view, window, explained=True),
        *describe_unsearched(view, topics, window),
        *notes_on_never(view, sought, condition, window),
    )
    if notes or _may_be_elsewhere(view, topics, condition):
        return (*notes, *compared_frames(view, topics, condition, window))
    return ()


def _may_be_elsewhere(view: View, topics: Sequence[str], condition: Condition) -> bool:
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


def _search_end(before_s: float | None) -> Ns:
    """Returns the end of a search (ns), just after a moment: floats of seconds are inexact."""
    if before_s is None:
        return MAX_NS
    return min(ns_argument("before", before_s) + AT_OR_BEFORE_SLACK_NS + 1, MAX_NS)


def _thinned_pose(view: View, topic: str, stop: Ns) -> StoredMessage | None:
    """Returns the pose of a thinned day that holds just before a log time (ns).

    It holds until the next pose, which is near unless recording was interrupted.
    """
    before = TimeWindow(max(stop - _THINNED_POSES_NS, MIN_NS), stop)
    pose = view.stream.newest(topic, before)
    if pose is None or not is_thinned(pose.bag.file):
        return None
    after = TimeWindow(pose.time + 1, pose.time + _THINNED_POSES_NS)
    return pose if view.stream.first([topic], after) is not None else None


def _require_kind(view: View, topic: str, what: str, *or_else: str) -> None:
    """Checks, before any message is read, that a topic's types can answer.

    Types that the schema map does not have may answer.

    Raises:
        InvalidArgumentsError: no type has the kind of data `what`, or another one in `or_else`.
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
    """Returns a value, marked with its age if it is latched."""
    if not still_holds(view, stored, at):
        return value
    age = _age_of_latched(view, stored, at) if value.age is None else value.age
    notes = tuple(dict.fromkeys((*value.notes, *view.notes.sentences())))
    return replace(value, latched=True, age=age, notes=notes)


def _age_of_latched(view: View, stored: StoredMessage, at: Ns) -> Ns:
    """Returns how long before a moment a message was received, without what the clock skipped."""
    return max(view.elapsed_in(TimeWindow(stored.time, at + 1)).between(stored.time, at), 0)


def _decode_shown(
    view: View, stored: StoredMessage, fields: Sequence[str]
) -> tuple[object, Extracted]:
    """Returns a decoded message, and its fields as replies show them."""
    with view.call.stages.timed("extract"):
        message = require_decoded(view, stored)
        return message, view.extractor.shown(message, stored.type, fields)


def _as_value(
    view: View, stored: StoredMessage, fields: Sequence[str], now: Ns | None
) -> results.TopicValue:
    """Returns a message as replies show it, with all notes of the view so far."""
    message, shown = _decode_shown(view, stored, fields)
    if fields:
        note_unnamed(view, stored.topic, [shown.value], stored.time + 1)
    return results.TopicValue(
        stored.topic,
        stored.type,
        Sample(stored.time, shown.value),
        None if now is None else now - stored.time,
        frame_id=view.extractor.frame(message),
        notes=(*view.notes.sentences(), *shown.notes),
    )


def _notes_by_topic(snapshot: Snapshot) -> dict[str, tuple[str, ...]]:
    """Returns the notes on topics of bags that may lack messages, or that a wrong clock dated."""
    odd: dict[str, list[BagFile]] = {}
    for bag in snapshot.timeline.faulty(TimeWindow.everything()):
        for topic in () if is_whole(bag) else _topics_of(bag):
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
    """Returns the topics that a bag declares, each once, whatever its types."""
    return frozenset(declared.topic for declared in bag.summary.schema.topics)
