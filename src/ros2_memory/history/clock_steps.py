"""Steps of the clock that dates messages: when bags show that it was set."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.clock_steps import (
    ALIKE_NS,
    BESIDE_NS,
    SHORTEST_STEP_NS,
    STAMPS_BESIDE_NS,
    ClockStep,
    Elapsed,
    delay_change,
    step_by_delays,
    step_over,
)
from ros2_memory.analysis.frames import is_odometry, joined_edges
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.poses import FrameCodes, Poses, joined_poses
from ros2_memory.bag_dir.state_files import read_thinned
from ros2_memory.columns.table import Texts
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    QueryTimeoutError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.coverage import seconds, unix_text
from ros2_memory.history.no_data import topics_of_robot
from ros2_memory.history.poses import pose_rows
from ros2_memory.history.scan import of_columns, scan
from ros2_memory.history.transforms import edges_of_rows
from ros2_memory.index.clock_faults import FaultyClock
from ros2_memory.index.holes import Pause

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

    from ros2_memory.analysis.frames import Edges
    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.spans import Spans
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View

_MOST_SUSPECTS: Final = 32
"""Only the newest suspects are looked at: each costs some milliseconds."""
_MOST_STAMPED: Final = 8
"""The header stamps of this many topics are looked at."""
_STAMP: Final = "header.stamp"
_STEPS_BYTES: Final = 1_000
"""About how much memory the steps of a pause take."""


def clock_steps(view: View, window: TimeWindow | None = None) -> tuple[ClockStep, ...]:
    """Returns when the clock was set (in a window, or over a part of it), in order of time.

    A step back of 2 s or more shows in the order of log times. A step forward looks like a pause of
    a recording: of 2 s or more if the robot drove through it, of 0.5 s or more if the header stamps
    of two topics go on in their cadence.
    """
    window = TimeWindow.everything() if window is None else window
    _note_pauses(view, window)
    return tuple(step for step in _steps_around(view, window) if _reaches_into(window, step))


def _reaches_into(window: TimeWindow, step: ClockStep) -> bool:
    return window.overlaps(step.at, step.at + max(step.by - 1, 0))


def elapsed_in(view: View, window: TimeWindow) -> Elapsed:
    """Returns how much time passed between moments of a window; notes name the steps in it."""
    around = _steps_in_time(view, window)
    if around is None:
        return Elapsed()
    steps = [step for step in around if _reaches_into(window, step)]
    _note_pauses(view, window)
    for at, by in steps:
        when = unix_text(at)
        if by > 0:
            note = f"the clock was set {seconds(by)} ahead at {when}: durations are without that"
        else:
            note = (
                f"the clock was set back by {seconds(-by)} or more at {when}: durations across "
                "that may be wrong by as much"
            )
        view.notes.add(note)
    return Elapsed(steps)


def skipped_in(view: View, window: TimeWindow) -> Spans:
    """Returns the times of a window, and around it, that steps forward skipped, in order."""
    return [(at, at + by) for at, by in _steps_in_time(view, window) or () if by > 0]


def _steps_in_time(view: View, window: TimeWindow) -> list[ClockStep] | None:
    """Returns the steps in and near a window; None, with a note, if the call's time is over."""
    try:
        return _steps_around(view, window)
    except QueryTimeoutError:
        view.notes.add_lack(
            "out of time before it was known whether the clock was set: durations are by the clock"
        )
        return None


def _steps_around(view: View, window: TimeWindow) -> list[ClockStep]:
    """Returns the steps in a window, and some near it, in order of time."""
    steps = [
        ClockStep(fault.at, -fault.by)
        for fault in view.snapshot.dating.faults
        if fault.kind is FaultyClock.SET_BACK and fault.by >= SHORTEST_STEP_NS
    ]
    steps += [ClockStep(at, -by) for at, by in read_thinned(view.bag_dir).set_back]
    for pause in _suspects(view, window)[-_MOST_SUSPECTS:]:
        steps += _steps_of_pause(view, pause)
    distinct: list[ClockStep] = []
    for step in sorted(steps):
        # Overlapping recordings show one step back some milliseconds apart. Each shows at least how
        # far it was, so the longest is nearest to the truth.
        apart = OUT_OF_ORDER_NS if step.by < 0 and distinct and distinct[-1].by < 0 else 0
        if distinct and step.at - distinct[-1].at <= apart:
            distinct[-1] = ClockStep(distinct[-1].at, min(distinct[-1].by, step.by))
        else:
            distinct.append(step)
    return distinct


def _suspects(view: View, window: TimeWindow) -> list[Pause]:
    """Returns the suspect pauses in a window, including those that deleted bags showed."""
    suspects = {span: Pause(*span, (), ran_on=True) for span in read_thinned(view.bag_dir).pauses}
    suspects |= {pause.span: pause for pause in view.snapshot.suspects}
    return sorted(pause for span, pause in suspects.items() if window.overlaps(*span))


def _note_pauses(view: View, window: TimeWindow) -> None:
    """Notes if there are too many pauses to look at all of them."""
    pauses = len(_suspects(view, window))
    if pauses > _MOST_SUSPECTS:
        view.notes.add(
            f"only the newest {_MOST_SUSPECTS} of {pauses} pauses of all topics were looked at for "
            "whether the clock was set there"
        )


def _steps_of_pause(view: View, pause: Pause) -> tuple[ClockStep, ...]:
    """Returns the step in a pause, if any; remembers it if the bags around are closed."""
    around = TimeWindow(pause.start, pause.end + 1).widened(STAMPS_BESIDE_NS)
    bags = view.timeline.overlapping(around)
    topics = _topics_placing(view)
    key = (topics, pause.start, pause.end, *[bag.identity for bag in bags])
    cache = view.memory.scanner.caches.clock_steps
    steps = cache.get(key)
    if steps is None:
        with view.bags.watched() as reading:
            step = _find_step(view, topics, pause)
        steps = () if step is None else (step,)
        if reading.is_final:
            cache.put(key, steps, _STEPS_BYTES)
    return steps


def _topics_placing(view: View) -> tuple[str, ...]:
    """Returns the topics that show whether the robot drove: the one that places it comes alone.

    Else those with its poses are returned, or those of transforms.
    """
    if view.pose_topic in view.timeline.topics() and view.pose_topic not in view.moving_topics:
        return (view.pose_topic,)
    return tuple(topics_of_robot(view, "position")) or view.moving_topics


def _find_step(view: View, topics: Sequence[str], pause: Pause) -> ClockStep | None:
    """Returns the step in a pause, by header stamps, else by the poses of one of the topics."""
    step = _step_by_stamps(view, pause)
    if step is not None or pause.length < SHORTEST_STEP_NS:
        return step
    by_topics = (_step_by_poses(view, topic, pause) for topic in topics)
    return next((found for found in by_topics if found is not None), None)


def _step_by_poses(view: View, topic: str, pause: Pause) -> ClockStep | None:
    """Returns the step in a pause by the poses of a topic, or by its transforms that move."""
    if _had_stalled(view, topic, pause):
        return None
    before = TimeWindow.before(pause.start, BESIDE_NS)
    after = TimeWindow(pause.end, pause.end + BESIDE_NS)
    # A recording that ended before the pause tells nothing about one that began after it.
    recordings = {bag.recording for bag in view.timeline.overlapping(before)}
    recordings &= {bag.recording for bag in view.timeline.overlapping(after)}
    read = _poses_of_frames if topic in view.moving_topics else _poses_of_recordings
    poses_before, poses_after = (
        read(view, topic, window, recordings) for window in (before, after)
    )
    tried = (
        step_over(pause.span[0], poses, poses_after[frame])
        for frame, poses in poses_before.items()
        if frame in poses_after
    )
    return next((step for step in tried if step is not None), None)


def _step_by_stamps(view: View, pause: Pause) -> ClockStep | None:
    """Returns the step in a pause, by the header stamps of topics on both sides of it."""
    around = TimeWindow(pause.start - STAMPS_BESIDE_NS, pause.end + STAMPS_BESIDE_NS)
    counts: Counter[str] = Counter()
    for bag in view.timeline.overlapping(around):
        counts.update({info.topic: info.count for info in bag.summary.topics})
    changes: list[Ns] = []
    for topic, _ in counts.most_common(_MOST_STAMPED):
        if view.timeline.is_log(topic):
            continue  # logs have no header, and are slow to scan: they are latched, in many parts
        for times, stamps in _stamps_by_recording(view, topic, around).values():
            change = delay_change(pause.span, times, stamps)
            if change is not None:
                changes.append(change)
                break
    return step_by_delays(pause.span[0], changes)


def _had_stalled(view: View, topic: str, pause: Pause) -> bool:
    """Returns whether messages that were logged after a pause were sent during it."""
    after = TimeWindow(pause.end, pause.end + BESIDE_NS)
    first = view.stream.first((topic,), after)
    sent = [] if first is None else [first.record.publish_time]
    for _, stamps in _stamps_by_recording(view, topic, after).values():
        sent += stamps.tolist()
    if topic in view.moving_topics:
        for edge in _edges(view, topic, after).values():
            sent += edge.stamps.tolist()
    return any(pause.start + ALIKE_NS < at < pause.end - ALIKE_NS for at in sent)


def _stamps_by_recording(view: View, topic: str, window: TimeWindow) -> dict[Path, Ints]:
    """Returns for each recording the log times and header stamps (ns) of a topic in a window."""
    by_recording: dict[Path, list[Ints]] = defaultdict(list)

    def may_match(parts: PartZones) -> bool:
        return _STAMP in parts.topic.layout.paths

    def read_stamps(rows: Rows) -> Ints | None:
        column = rows.table.columns.get(_STAMP)
        if column is None or isinstance(column, Texts):
            return None
        stamps = np.asarray(column, np.int64)
        return np.stack((rows.times, stamps[rows.positions]))

    for rows in scan(view, topic, window, may_match=may_match):
        by_recording[rows.recording] += of_columns(view, rows, read_stamps) or []
    return {path: np.concatenate(parts, axis=1) for path, parts in by_recording.items() if parts}


def _poses_of_recordings(
    view: View, topic: str, window: TimeWindow, recordings: Collection[Path]
) -> dict[str, Poses]:
    """Returns by topic its poses in a window of some recordings, without invalid positions."""
    blocks = pose_rows(view, topic, window, among=recordings.__contains__)
    try:
        poses = joined_poses([rows.poses for rows in blocks])
    except InvalidArgumentsError:
        return {}
    return {topic: poses.rows(np.flatnonzero(are_places(poses.positions)))}


def _poses_of_frames(
    view: View, topic: str, window: TimeWindow, recordings: Collection[Path]
) -> dict[str, Poses]:
    """Returns by frame its poses in odometry or in the map, by transforms of some recordings."""
    edges = _edges(view, topic, window, among=recordings.__contains__)
    poses: dict[str, Poses] = {}
    for (parent, child), edge in edges.items():
        if is_odometry(parent) or parent == view.limits.map_frame:
            count = edge.log_times.size
            frames = FrameCodes(np.zeros(count, np.uint32), (parent,))
            speeds = np.full(count, np.nan)
            placed = Poses(edge.log_times, edge.translation, edge.rotation, frames, speeds)
            poses[child] = placed.rows(np.argsort(placed.times, kind="stable"))
    return poses


def _edges(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    among: Callable[[Path], bool] = lambda _: True,
) -> Edges:
    """Returns the transforms of a topic that were recorded in a window."""
    return joined_edges(
        [
            edges_of_rows(view, rows, view.sessions.session_of(rows.recording))
            for rows in scan(view, topic, window)
            if among(rows.recording)
        ]
    )
