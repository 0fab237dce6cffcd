"""The frame of places: the map where there is one, or that of the poses themselves.

The frame is `data.map_frame` where recorded transforms lead from the poses' own frame to it, and
else the poses' own: odometry, which begins at its origin whenever the robot is started.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.errors import InvalidArgumentsError, NoDataError, UndecodableError
from ros2_memory.core.text import abbreviate
from ros2_memory.history.driven_path import pose_frame, resolve_path_topic
from ros2_memory.history.transforms import connected, connects, sessions_of

if TYPE_CHECKING:
    from ros2_memory.history.view import View


@dataclass(frozen=True, slots=True)
class MapPlacement:
    """Which frames the robot's places are in.

    Attributes:
        frame_id: of the places.
        pose_frame: of the poses.
        is_map: whether the coordinates of places keep their meaning when odometry is reset.
    """

    frame_id: str
    pose_frame: str
    is_map: bool

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames that positions are known in."""
        return tuple(dict.fromkeys((self.frame_id, self.pose_frame)))


def map_placement(view: View, topic: str, frame_id: str | None = None) -> MapPlacement:
    """Returns how the poses of a topic are placed; in `frame_id` where one is given.

    Raises:
        InvalidArgumentsError: places are in another frame than `frame_id`, or it is of no poses.
        QueryTimeoutError: the time is over before it is known whether they are in `frame_id`.
        UndecodableError: no pose can be decoded.
    """
    frame = pose_frame(view, topic)
    own = MapPlacement(frame, frame, frame == view.limits.map_frame)
    asked_for = frame_id is not None
    placement = own if frame_id == frame else _map_or_own(view, topic, own, asked_for)
    if frame_id not in (None, placement.frame_id):
        known = " or ".join(placement.frames)
        raise InvalidArgumentsError(
            f"frame_id was {abbreviate(frame_id)}; places are in {known}; "
            "get_transform_at converts from other frames"
        )
    return placement


def known_placement(view: View) -> MapPlacement | None:
    """Returns how the robot's poses are placed; None where no topic of them is recorded."""
    try:
        return map_placement(view, resolve_path_topic(view))
    except (InvalidArgumentsError, NoDataError, UndecodableError):
        return None


def _map_or_own(view: View, topic: str, own: MapPlacement, asked_for: bool) -> MapPlacement:
    """Returns the placement in the map, where transforms of some recording lead there."""
    target, pose_frame = view.limits.map_frame, own.pose_frame
    # No answer is better than one that denies a frame which is asked for, since the time is over.
    leads = connects if asked_for else connected
    if not target or target == pose_frame or not leads(view, (target, pose_frame)):
        return own
    recordings = view.timeline.recordings(topic).items()
    lending = {sessions_of(view).lending_to(each, first) for each, (first, _) in recordings}
    if any(leads(view, (target, pose_frame), among=each) for each in lending):
        return MapPlacement(target, pose_frame, is_map=True)
    return own
