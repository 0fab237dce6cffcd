"""The kinds of fragments of motion and of events, and the classes that each consists of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.motion.odometry import Leg, MotionTotals, NearbyMotion, TimedPosition
from ros2_memory.analysis.motion.path_length import Creep, End
from ros2_memory.analysis.motion.robot_track import PartialTrack, settled_tracks
from ros2_memory.analysis.motion.standstills import Blocks, SpeedDrop, Stands
from ros2_memory.analysis.motion.trajectory import Line, PathSlice
from ros2_memory.analysis.poses import FrameCodes, Poses
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    Report,
    TopicEvents,
    joined_events,
)
from ros2_memory.columns.fragments import FragmentKind
from ros2_memory.core.arrays import stacked

if TYPE_CHECKING:
    from collections.abc import Sequence


def _joined_stands(parts: Sequence[Stands]) -> Sequence[Stands]:
    drops = tuple(drop for part in parts for drop in part.drops)
    return [
        Stands(stacked([part.blocks for part in parts]), drops, max(part.last for part in parts))
    ]


def _joined_events(parts: Sequence[TopicEvents]) -> Sequence[TopicEvents]:
    whole = joined_events(parts)
    return [] if whole.is_empty else [whole]


_MOTION: Final = (PathSlice, Line, MotionTotals, Leg, TimedPosition, NearbyMotion, End, Creep)
PATHS: Final[FragmentKind[PathSlice]] = FragmentKind("path", (*_MOTION, Poses, FrameCodes))
"""The path of the poses of a topic in a slice of the clock."""
STANDS: Final = FragmentKind("stands", (Stands, Blocks, SpeedDrop), _joined_stands)
"""Where the robot may have stood in a slice of the clock, by the poses of a topic."""
EVENTS: Final = FragmentKind(
    "events", (TopicEvents, IntervalTable, KnownState, Change, Report), _joined_events
)
"""What came into view, changed or failed on a topic in a part."""
TRACKS: Final = FragmentKind("track", (PartialTrack,), settled_tracks)
"""Where the poses of a part have the robot in a frame; joined, those of a recording."""
