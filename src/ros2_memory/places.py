"""In which frame places are told, and how the poses of a topic become places in it.

That is `data.map_frame` where recorded transforms lead from the poses' own frame to it, and else
the poses' own: odometry, which begins anew whenever the robot is started.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.errors import InvalidArgumentsError, NoDataError
from ros2_memory.frames import connected, graph_over, statics
from ros2_memory.geometry import compose, distance, invert, rotate
from ros2_memory.glimpse import glimpse
from ros2_memory.model import TimeWindow, Transform
from ros2_memory.tf_tree import FrameGraph

if TYPE_CHECKING:
    from ros2_memory.history import View
    from ros2_memory.model import Vector3
    from ros2_memory.timebase import Ns

_SAME_M = 1e-6
_LEVEL = 1e-6


@dataclass(slots=True)
class Placing:
    """How positions of poses become places.

    Attributes:
        frame_id: of the places.
        pose_frame: of the positions.
        fixed: the pose of `pose_frame` in `frame_id`, where it never changes; None where it moves.
    """

    view: View
    frame_id: str
    pose_frame: str
    fixed: Transform | None
    _graph: FrameGraph | None = None

    @property
    def is_map(self) -> bool:
        """Whether places keep their meaning when odometry begins anew."""
        return self.frame_id == self.view.memory.limits.map_frame

    def look_at(self, window: TimeWindow) -> None:
        """Gathers what is needed to place the poses of a window."""
        if self.fixed is None:
            self._graph = graph_over(self.view, window)

    def of(self, time: Ns, position: Vector3) -> Vector3 | None:
        """The place of a position then; None where no transform tells it."""
        pose = self.fixed
        if pose is None:
            if self._graph is None:
                return None
            try:
                pose = self._graph.lookup(self.frame_id, self.pose_frame, time).transform
            except NoDataError:
                return None
        x, y, z = rotate(pose.rotation, position)
        dx, dy, dz = pose.translation
        return (x + dx, y + dy, z + dz)

    def in_poses(self, x: float, y: float) -> tuple[float, float] | None:
        """A place of the plane in the poses' own frame; None where that changes, or is tilted."""
        if self.fixed is None:
            return None
        qx, qy, _, _ = self.fixed.rotation
        if abs(qx) > _LEVEL or abs(qy) > _LEVEL:
            return None
        back = invert(self.fixed)
        px, py, _ = rotate(back.rotation, (x, y, 0.0))
        return px + back.translation[0], py + back.translation[1]


_NOWHERE = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def placing(view: View, pose_frame: str, frame_id: str | None = None) -> Placing:
    """How places are told of poses in this frame; in `frame_id` where one is asked for.

    Raises:
        InvalidArgumentsError: places are not told in that frame.
    """
    own = Placing(view, pose_frame, pose_frame, _NOWHERE)
    place = own if frame_id == pose_frame else _best(view, own)
    if frame_id not in (None, place.frame_id):
        known = " or ".join(dict.fromkeys((place.frame_id, pose_frame)))
        raise InvalidArgumentsError(
            f"frame_id was {glimpse(frame_id)}; places are told in {known}, and "
            "get_transform_at leads from any other frame"
        )
    return place


def _best(view: View, own: Placing) -> Placing:
    """In the map, where recorded transforms lead there from the poses' own frame."""
    target, pose_frame = view.memory.limits.map_frame, own.pose_frame
    if not target or target == pose_frame or not connected(view, (target, pose_frame)):
        return own
    return Placing(view, target, pose_frame, _fixed(view, target, pose_frame))


def _fixed(view: View, target: str, pose_frame: str) -> Transform | None:
    """The pose of a frame in another by static transforms alone; None where it ever changed."""
    by_pair: dict[tuple[str, str], list[Transform]] = {}
    for each in statics(view):
        by_pair.setdefault((each.parent, each.child), []).append(each.transform)
    if any(not _alike(one, some[0]) for some in by_pair.values() for one in some):
        return None
    try:
        return FrameGraph(statics(view)).lookup(target, pose_frame, 0).transform
    except NoDataError:
        return None


def _alike(one: Transform, other: Transform) -> bool:
    apart = compose(invert(one), other)
    return distance(apart.translation, (0.0, 0.0, 0.0)) < _SAME_M and abs(apart.rotation[3]) > (
        1 - _SAME_M
    )
