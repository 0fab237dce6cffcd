"""Places of poses in the map, or in their own frame where there is no map.

The frame is `data.map_frame` where recorded transforms lead from the poses' own frame to it, and
else the poses' own: odometry, which begins at its origin whenever the robot is started. Which
transform applies depends on the time of the pose and on its recording.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.frames import static_at, static_changes
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.geometry import alike, invert, transform_point
from ros2_memory.core.model import TimeWindow, Transform
from ros2_memory.core.text import Reason, abbreviate
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MIN_NS, Ns
from ros2_memory.history.context import Note
from ros2_memory.history.transforms import (
    children_moving,
    connected,
    connected_by_statics,
    connects,
    graph_of,
    lending_to,
    moving_in,
    sessions_of,
    static_transforms,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.analysis.transform_tree import FrameGraph
    from ros2_memory.core.model import StampedTransform, Vector3
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View

_LEVEL_TOLERANCE: Final = 1e-6
_NOT_PLACED: Final = Reason(
    "has no transforms that place its poses: they are left out",
    "recording",
    many="have no transforms that place their poses: they are left out",
)
_IDENTITY: Final = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class _SessionTransforms:
    """The transforms of one session, as far as they place its poses.

    Attributes:
        static: its static transforms, in log-time order.
        changes: the log times at which one of them changed.
        fixed: the pose of the poses' frame in that of the places, where it never changes in the
            session; None where it moves, or is not known.
    """

    static: Sequence[StampedTransform]
    changes: list[Ns]
    fixed: Transform | None


@dataclass(slots=True)
class MapPlacement:
    """Converts positions of poses to places.

    Attributes:
        frame_id: of the places.
        pose_frame: of the positions.
    """

    view: View
    frame_id: str
    pose_frame: str
    _window: TimeWindow = field(default_factory=TimeWindow.everything)
    _known: dict[Session, _SessionTransforms] = field(default_factory=dict)
    _moving: dict[Session, Sequence[StampedTransform]] = field(default_factory=dict)
    _graphs: dict[tuple[Session, int], FrameGraph] = field(default_factory=dict)

    @property
    def is_map(self) -> bool:
        """Whether the coordinates of places keep their meaning when odometry is reset."""
        return self.frame_id == self.view.memory.limits.map_frame

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames that positions are known in."""
        return tuple(dict.fromkeys((self.frame_id, self.pose_frame)))

    @property
    def moves(self) -> bool:
        """Whether the frame of the poses may move in that of the places."""
        frames = self.frame_id, self.pose_frame
        return self.frame_id != self.pose_frame and not connected_by_statics(self.view, frames)

    def use_window(self, window: TimeWindow) -> None:
        """Sets the window of the next poses: the moving transforms in it are gathered once."""
        self._window = window
        self._moving.clear()
        self._graphs.clear()

    def of(self, recording: Path, time: Ns, position: Vector3) -> Vector3 | None:
        """Returns the place (m) of a recording's position at a time; None without a transform."""
        pose = self._pose(recording, time)
        return None if pose is None else transform_point(pose, position)

    def to_pose_frame(
        self, recording: Path, at: Ns, x: float, y: float
    ) -> tuple[float, float] | None:
        """Transforms a point (m) from the map into the frame of a recording's poses.

        None where that frame moves in its session, or is tilted.
        """
        fixed = self._fixed(recording, at)
        if fixed is None:
            return None
        qx, qy, _, _ = fixed.rotation
        if abs(qx) > _LEVEL_TOLERANCE or abs(qy) > _LEVEL_TOLERANCE:
            return None
        return transform_point(invert(fixed), (x, y, 0.0))[:2]

    def is_fixed(self, topic: str) -> bool:
        """Whether one fixed transform places the poses of all recordings of a topic."""
        if self.frame_id == self.pose_frame:
            return True
        found = [
            self._fixed(recording, first)
            for recording, (first, _) in self.view.snapshot.timeline.recordings(topic).items()
        ]
        return None not in found and all(
            one is not None and other is not None and alike(one, other)
            for one, other in pairwise(found)
        )

    def _fixed(self, recording: Path, at: Ns) -> Transform | None:
        if self.frame_id == self.pose_frame:
            return _IDENTITY
        return self._transforms_of(self._session(recording, at)).fixed

    def _pose(self, recording: Path, time: Ns) -> Transform | None:
        """Returns the pose of the poses' frame in that of the places."""
        if self.frame_id == self.pose_frame:
            return _IDENTITY
        session = self._session(recording, time)
        known = self._transforms_of(session)
        if known.fixed is not None:
            return known.fixed
        number = bisect_right(known.changes, time + AT_OR_BEFORE_SLACK_NS)
        graph = self._graphs.get((session, number))
        if graph is None:
            if session not in self._moving:
                self._moving[session] = moving_in(self.view, self._window, session)
            valid_then = static_at(known.static, known.changes[number - 1] if number else MIN_NS)
            graph = graph_of(self.view, valid_then, self._moving[session])
            self._graphs[session, number] = graph
        return self._placed_by(graph, time)

    def _session(self, recording: Path, at: Ns) -> Session:
        """Returns the session that places a recording's poses; a note says if none does."""
        session = lending_to(self.view, recording, (self.frame_id, self.pose_frame), at)
        if not session:
            self.view.notes.add(Note(_NOT_PLACED, recording.name))
        return session

    def _transforms_of(self, session: Session) -> _SessionTransforms:
        if session not in self._known:
            recorded = static_transforms(self.view, session)
            changes = static_changes(recorded)
            fixed = None
            children = {each.child.lstrip("/") for each in recorded}
            if not changes and children.isdisjoint(children_moving(self.view, session)):
                fixed = self._placed_by(graph_of(self.view, static_at(recorded, MIN_NS), ()), 0)
            self._known[session] = _SessionTransforms(recorded, changes, fixed)
        return self._known[session]

    def _placed_by(self, graph: FrameGraph, time: Ns) -> Transform | None:
        try:
            return graph.lookup(self.frame_id, self.pose_frame, time)
        except NoDataError:
            return None


def map_placement(
    view: View, pose_frame: str, topic: str, frame_id: str | None = None
) -> MapPlacement:
    """Returns how the poses of a topic in this frame are placed; in `frame_id` where one is given.

    Raises:
        InvalidArgumentsError: places are in another frame than `frame_id`.
        QueryTimeoutError: the time is over before it is known whether they are in `frame_id`.
    """
    own = MapPlacement(view, pose_frame, pose_frame)
    asked_for = frame_id is not None
    placement = own if frame_id == pose_frame else _map_or_own(view, topic, own, asked_for)
    if frame_id not in (None, placement.frame_id):
        known = " or ".join(dict.fromkeys((placement.frame_id, pose_frame)))
        raise InvalidArgumentsError(
            f"frame_id was {abbreviate(frame_id)}; places are in {known}; "
            "get_transform_at converts from other frames"
        )
    return placement


def _map_or_own(view: View, topic: str, own: MapPlacement, asked_for: bool) -> MapPlacement:
    """Returns the placement in the map, where transforms of some recording lead there."""
    target, pose_frame = view.memory.limits.map_frame, own.pose_frame
    # No answer is better than one that denies a frame which is asked for, since the time is over.
    leads = connects if asked_for else connected
    if not target or target == pose_frame or not leads(view, (target, pose_frame)):
        return own
    recordings = view.snapshot.timeline.recordings(topic).items()
    lending = {sessions_of(view).lending_to(each, first) for each, (first, _) in recordings}
    if any(leads(view, (target, pose_frame), among=each) for each in lending):
        return MapPlacement(view, target, pose_frame)
    return own
