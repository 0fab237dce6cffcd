"""In which frame places are told, and how the poses of a topic become places in it.

That is `data.map_frame` where recorded transforms lead from the poses' own frame to it, and else
the poses' own: odometry, which begins anew whenever the robot is started. Which transform holds is
a question of the pose's time and of its recording.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.geometry import alike, invert, rotate
from ros2_memory.core.model import TimeWindow, Transform
from ros2_memory.core.text import Reason, abbreviate
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MIN_NS, Ns
from ros2_memory.history.notes import Note
from ros2_memory.history.transforms import (
    children_moving,
    connected,
    graph_of,
    holding_at,
    lending_to,
    moving_in,
    sessions_of,
    statics,
)

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.analysis.transform_tree import FrameGraph
    from ros2_memory.core.model import StampedTransform, Vector3
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View

_LEVEL: Final = 1e-6
_NOWHERE_IN: Final = Reason(
    "has no transforms that place its poses: they are left out",
    "recording",
    many="have no transforms that place their poses: they are left out",
)
_NOWHERE: Final = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class _Known:
    """What a session's transforms say of the poses' frame.

    Attributes:
        static: its static transforms, in order.
        changes: the log times at which one of them changed.
        fixed: the pose of the poses' frame in that of the places, where it never changes in the
            session; None where it moves, or is not known.
    """

    static: list[StampedTransform]
    changes: list[Ns]
    fixed: Transform | None


@dataclass(slots=True)
class MapPlacement:
    """How positions of poses become places.

    Attributes:
        frame_id: of the places.
        pose_frame: of the positions.
    """

    view: View
    frame_id: str
    pose_frame: str
    _window: TimeWindow = field(default_factory=TimeWindow.everything)
    _known: dict[Session, _Known] = field(default_factory=dict)
    _moving: dict[Session, list[StampedTransform]] = field(default_factory=dict)
    _graphs: dict[tuple[Session, int], FrameGraph] = field(default_factory=dict)

    @property
    def is_map(self) -> bool:
        """Whether places keep their meaning when odometry begins anew."""
        return self.frame_id == self.view.memory.limits.map_frame

    def look_at(self, window: TimeWindow) -> None:
        """Names the window of which poses are placed next: what they need is gathered once."""
        self._window = window
        self._moving.clear()
        self._graphs.clear()

    def of(self, recording: Path, time: Ns, position: Vector3) -> Vector3 | None:
        """The place of a position of a recording then; None where no transform tells it."""
        pose = self._pose(recording, time)
        if pose is None:
            return None
        x, y, z = rotate(pose.rotation, position)
        dx, dy, dz = pose.translation
        return (x + dx, y + dy, z + dz)

    def in_poses(self, recording: Path, at: Ns, x: float, y: float) -> tuple[float, float] | None:
        """A place of the plane in the own frame of a recording's poses.

        None where that changes in its session, or is tilted.
        """
        fixed = self._fixed(recording, at)
        if fixed is None:
            return None
        qx, qy, _, _ = fixed.rotation
        if abs(qx) > _LEVEL or abs(qy) > _LEVEL:
            return None
        back = invert(fixed)
        px, py, _ = rotate(back.rotation, (x, y, 0.0))
        return px + back.translation[0], py + back.translation[1]

    def is_fixed(self, topic: str) -> bool:
        """Whether what is fixed is the same in every recording of a topic."""
        if self.frame_id == self.pose_frame:
            return True
        found = [
            self._fixed(recording, first)
            for recording, (first, _) in self.view.snapshot.recordings(topic).items()
        ]
        return None not in found and all(
            one is not None and other is not None and alike(one, other)
            for one, other in pairwise(found)
        )

    def _fixed(self, recording: Path, at: Ns) -> Transform | None:
        if self.frame_id == self.pose_frame:
            return _NOWHERE
        return self._of(self._session(recording, at)).fixed

    def _pose(self, recording: Path, time: Ns) -> Transform | None:
        """The pose of the poses' frame in that of the places."""
        if self.frame_id == self.pose_frame:
            return _NOWHERE
        session = self._session(recording, time)
        known = self._of(session)
        if known.fixed is not None:
            return known.fixed
        number = bisect_right(known.changes, time + AT_OR_BEFORE_SLACK_NS)
        graph = self._graphs.get((session, number))
        if graph is None:
            if session not in self._moving:
                self._moving[session] = moving_in(self.view, self._window, session)
            static = holding_at(known.static, known.changes[number - 1] if number else MIN_NS)
            graph = graph_of(self.view, static, self._moving[session])
            self._graphs[session, number] = graph
        try:
            return graph.lookup(self.frame_id, self.pose_frame, time)
        except NoDataError:
            return None

    def _session(self, recording: Path, at: Ns) -> Session:
        """Whose transforms place the poses of a recording; a note says where none do."""
        session = lending_to(self.view, recording, (self.frame_id, self.pose_frame), at)
        if not session:
            self.view.notes.add(Note(_NOWHERE_IN, recording.name))
        return session

    def _of(self, session: Session) -> _Known:
        if session not in self._known:
            static = statics(self.view, session)
            changes = _changes(static)
            fixed = None
            if not changes and not children_moving(self.view, session) & _children(static):
                fixed = self._by_static_alone(static)
            self._known[session] = _Known(static, changes, fixed)
        return self._known[session]

    def _by_static_alone(self, static: list[StampedTransform]) -> Transform | None:
        graph = graph_of(self.view, holding_at(static, MIN_NS), ())
        try:
            return graph.lookup(self.frame_id, self.pose_frame, 0)
        except NoDataError:
            return None


def map_placement(
    view: View, pose_frame: str, topic: str, frame_id: str | None = None
) -> MapPlacement:
    """How places are told of the poses of a topic in this frame; in `frame_id` where one is asked.

    Raises:
        InvalidArgumentsError: places are not told in that frame.
    """
    own = MapPlacement(view, pose_frame, pose_frame)
    place = own if frame_id == pose_frame else _best(view, topic, own)
    if frame_id not in (None, place.frame_id):
        known = " or ".join(dict.fromkeys((place.frame_id, pose_frame)))
        raise InvalidArgumentsError(
            f"frame_id was {abbreviate(frame_id)}; places are told in {known}, and "
            "get_transform_at leads from any other frame"
        )
    return place


def _best(view: View, topic: str, own: MapPlacement) -> MapPlacement:
    """In the map, where the transforms of some recording lead there from its poses' frame."""
    target, pose_frame = view.memory.limits.map_frame, own.pose_frame
    if not target or target == pose_frame or not connected(view, (target, pose_frame)):
        return own
    recordings = view.snapshot.recordings(topic).items()
    lending = {sessions_of(view).lending_to(each, first) for each, (first, _) in recordings}
    if any(connected(view, (target, pose_frame), among=each) for each in lending):
        return MapPlacement(view, target, pose_frame)
    return own


def _changes(static: list[StampedTransform]) -> list[Ns]:
    """The log times at which a static transform says something else of its child than before."""
    changes: dict[Ns, None] = {}
    latest: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        before = latest.get(child)
        if before is not None and not (
            before.parent.lstrip("/") == each.parent.lstrip("/")
            and alike(before.transform, each.transform)
        ):
            changes[each.log_time] = None
        latest[child] = each
    return [*changes]


def _children(static: list[StampedTransform]) -> set[str]:
    return {each.child.lstrip("/") for each in static}
