"""Where the robot was at moments of a window, in the frame that answers are given in.

By its track: as exact as that, some 5 cm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.motion.robot_track import empty_track, place_at
from ros2_memory.core.errors import (
    QueryTimeoutError,
)
from ros2_memory.core.regions import places_at
from ros2_memory.history.coverage import unix_text
from ros2_memory.history.driven_path import resolve_path_topic
from ros2_memory.places.pose_frames import known_placement, map_placement
from ros2_memory.places.robot_tracks import RobotTracks

if TYPE_CHECKING:
    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View


@dataclass
class RobotPlaces:
    """Looks the robot up in a window.

    Attributes:
        frame_id: that positions are given in: the map where transforms lead there, or the one asked
            for.
        pose_frame: of the poses themselves.
        map_frame: the former, whatever was asked for; named places are looked up in it.
    """

    view: View
    window: TimeWindow
    frame_id: str
    pose_frame: str
    map_frame: str

    def at(self, time: Ns) -> tuple[float, float] | None:
        """Returns where the robot was (m) in `frame_id`; None outside the track."""
        if self.frame_id != self.map_frame:
            return None
        return place_at(self._track, time, SILENCE_NS)

    def names_at(self, time: Ns) -> tuple[str, ...]:
        """Returns the named places that the robot was in, if that is known; the smallest first."""
        places = self.view.limits.places
        if not any(each.frame_id == self.map_frame for each in places):
            return ()
        point = place_at(self._track, time, SILENCE_NS)
        return () if point is None else places_at(places, self.map_frame, *point)

    @cached_property
    def _track(self) -> RobotTrack:
        try:
            joined = RobotTracks(self.view, self.map_frame).over(self.window)
        except QueryTimeoutError:
            self.view.bags.check_deadline()
            joined = None
        if joined is None or joined.since is not None:
            since = "" if joined is None or joined.since is None else unix_text(joined.since)
            reach = f"known back to {since} alone" if since else "not known"
            self.view.notes.add(
                f"where the robot was in {self.map_frame} is {reach}: reading the bags that "
                "are not stored takes too long"
            )
        return empty_track() if joined is None else joined.track


def robot_places(view: View, window: TimeWindow, frame_id: str | None = None) -> RobotPlaces | None:
    """Returns where the robot was in a window; None where no topic of its poses is recorded.

    Raises:
        InvalidArgumentsError: no position is given in `frame_id`.
    """
    usual = known_placement(view)
    if usual is None:
        return None
    asked = usual if frame_id is None else map_placement(view, resolve_path_topic(view), frame_id)
    return RobotPlaces(view, window, asked.frame_id, usual.pose_frame, usual.frame_id)
