"""The rows of one closed bag.

The bag is the one that the memory sees: messages that count in another recording are left out, as
in answers.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.facts import FLAG, has_events
from ros2_memory.analysis.frames import static_at
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.motion.robot_track import TOLERANCE_M, cut
from ros2_memory.analysis.motion.standstills import stands_of, standstills_of
from ros2_memory.analysis.motion.trajectory import path_slice
from ros2_memory.analysis.sights import Spot
from ros2_memory.analysis.topic_events import MAX_PER_BAG
from ros2_memory.columns.store import relative
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.history.poses import poses_of_bag
from ros2_memory.history.transforms import sessions_of, static_transforms
from ros2_memory.history.view import View
from ros2_memory.insights.topic_events import events_of_bag, toggled
from ros2_memory.lake.channel_rows import ChannelRows
from ros2_memory.lake.tables import ROWS_VERSION, TABLES, microseconds, topic_key
from ros2_memory.lake.typed_values import MAPS, taken_apart
from ros2_memory.messages.detections import detections_of
from ros2_memory.places.robot_places import robot_places
from ros2_memory.places.robot_tracks import RobotTracks
from ros2_memory.things.seen import Watching, may_have_detections

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.analysis.sights import Sights
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.core.model import BagFile, JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.tables import Row
    from ros2_memory.storage.base import Record

_BLOCK: Final = 1 << 20
_NO_SCORE: Final = -1
_MM: Final = 1000.0
_SCORE_UNIT: Final = 1000.0


@dataclass(frozen=True, slots=True)
class BagContent:
    """One bag as it is named in a lake.

    Attributes:
        bag: the bag of the index.
        bag_id: see `bag_id_of`.
        sha256: of the bytes of its file, in hexadecimal.
        made_of: see `made_of`.
    """

    bag: BagFile
    bag_id: str
    sha256: str
    made_of: str


def bag_id_of(robot: str, bag: BagFile, first: Ns) -> str:
    """Returns the id of a bag: of its robot, its recording, its file's name and its first message.

    So it is the same wherever the bag is copied to, also into a saved moment, and another one for
    another bag of the same name. Its size is no part of it: a bag of which messages were deleted
    by request is the same bag with less in it. `first` is the log time of the first message in the
    file, whether it counts there or in another recording. The id begins with it, so that the files
    of a table that can hold a bag are few: ids of one time lie side by side.
    """
    return id_of_file(robot, bag.recording.name, bag.path.name, first)


def id_of_file(robot: str, recording: str, file: str, first: Ns) -> str:
    """Returns the id of a bag that need not be there any more; see `bag_id_of`."""
    name = json.dumps([robot, recording, file, first])
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()
    return f"{max(first, 0):016x}{digest[:16]}"


def sha256_of(path: Path) -> str:
    """Returns the hash of a file's bytes.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb", buffering=0) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def made_of(memory: Memory, bag: BagFile, config: str, messages: Sequence[str] = ()) -> str:
    """Returns what the rows of a bag depend on besides its bytes.

    That is which of its messages count, the static transforms in force, the settings (`config`)
    and the topics whose `messages` are shipped.
    """
    counted = [
        (each.topic, each.type, each.count, each.first, each.last) for each in bag.summary.topics
    ]
    view = View(memory, Call())
    among = sessions_of(view).lending_to(bag.recording, bag.end)
    statics = repr(static_at(static_transforms(view, among), bag.end))
    parts = json.dumps([ROWS_VERSION, config, statics, sorted(messages), counted])
    return hashlib.sha256(parts.encode("utf-8", "surrogatepass")).hexdigest()[:16]


def rows_of(
    memory: Memory, content: BagContent, messages: Sequence[str] = ()
) -> dict[str, list[Row]]:
    """Returns the rows of a bag, by table; `messages` are topics to ship whole.

    Raises:
        BagError: the bag, or a part of it, cannot be read.
    """
    return _BagRows(memory, content).rows(messages)


class _BagRows:
    """Makes the rows of one bag."""

    def __init__(self, memory: Memory, content: BagContent) -> None:
        self._memory = memory
        self._content = content
        self._bag = content.bag
        self._pose_topic = memory.limits.pose_topic
        self._poses = poses_of_bag(View(memory, Call()), content.bag, self._pose_topic)
        self._types: dict[str, list[str]] = {}
        for each in self._bag.summary.topics:
            self._types.setdefault(each.topic, []).append(each.type)
        self._undecodable = 0
        self._rows: dict[str, list[Row]] = {name: [] for name in TABLES}

    def rows(self, messages: Sequence[str]) -> dict[str, list[Row]]:
        tracks = self._tracks()
        in_map = tracks[0] if tracks else None
        events = self._events()
        self._add_poses(tracks)
        self._add_things()
        stood_s = self._add_events(events)
        self._add_messages(events, messages, in_map)
        self._add_bag(in_map, stood_s)
        return self._rows

    def _tracks(self) -> list[tuple[str, RobotTrack]]:
        """Returns the robot's track in the bag, with its frame: in the map, and in the poses' own.

        The first of them has the place that other rows name.
        """
        view = View(self._memory, Call())
        window = TimeWindow(self._bag.start, self._bag.end + 1)
        places = robot_places(view, window)
        if places is None:
            return []
        frames = dict.fromkeys((places.map_frame, places.pose_frame))
        tracks = [(frame, RobotTracks(view, frame).over(window).track) for frame in frames]
        within = [(frame, cut(track, window)) for frame, track in tracks]
        return [(frame, track) for frame, track in within if len(track.times)]

    def _events(self) -> dict[str, TopicEvents]:
        """Returns the events on each topic that can have some."""
        topics = [topic for topic, types in self._types.items() if any(map(has_events, types))]
        found = events_of_bag(View(self._memory, Call()), self._bag, topics)
        return {topic: events.limited(MAX_PER_BAG, MAX_PER_BAG) for topic, events in found.items()}

    def _add_bag(self, in_map: tuple[str, RobotTrack] | None, stood_s: float | None) -> None:
        bag, content = self._bag, self._content
        driven = None
        if self._poses is not None:
            fastest = self._memory.limits.max_plausible_speed_mps
            driven = path_slice(self._poses, fastest).trajectory(0)
        self._rows["bags"].append(
            (
                bag.recording.name,
                relative(bag.file, str(self._memory.index.bag_dir)),
                bag.size,
                content.sha256,
                bag.mtime_ns,
                content.made_of,
                bag.start,
                bag.end,
                microseconds(bag.start),
                bag.summary.count,
                self._undecodable,
                len(self._rows["sightings"]),
                self._pose_topic,
                None if in_map is None else in_map[0],
                None if driven is None else driven.poses,
                None if driven is None else driven.totals.distance_m,
                None if driven is None else driven.totals.gap_m,
                None if driven is None else driven.max_speed,
                stood_s,
                bag.summary.schema.to_json(),
                bag.summary.packed,
            )
        )

    def _add_poses(self, tracks: Sequence[tuple[str, RobotTrack]]) -> None:
        key = topic_key(self._pose_topic)
        for frame, track in tracks:
            columns = (track.times, track.x, track.y, track.heading, track.begins)
            self._rows["poses"] += [
                (
                    self._pose_topic,
                    key,
                    frame,
                    time,
                    microseconds(time),
                    x,
                    y,
                    _finite(heading),
                    begins,
                    TOLERANCE_M,
                )
                for time, x, y, heading, begins in zip(
                    *(column.tolist() for column in columns), strict=True
                )
            ]

    def _add_things(self) -> None:
        for one in Watching(View(self._memory, Call())).in_bag(self._bag):
            for sights in one.sights:
                for spot in sights.spots.tolist():
                    self._add_thing(one.frame_id, sights, spot)

    def _add_thing(self, frame: str, sights: Sights, spot: Sequence[int]) -> None:
        topic, best = sights.topics[spot[Spot.TOPIC]], spot[Spot.BEST]
        self._rows["things"].append(
            (
                topic,
                topic_key(topic),
                sights.labels[spot[Spot.LABEL]],
                spot[Spot.N],
                spot[Spot.FIRST],
                spot[Spot.LAST],
                microseconds(spot[Spot.FIRST]),
                frame,
                *(spot[column] / _MM for column in (Spot.X, Spot.Y, Spot.Z, Spot.DEV)),
                None if best == _NO_SCORE else best / _SCORE_UNIT,
            )
        )

    def _add_events(self, events: Mapping[str, TopicEvents]) -> float | None:
        """Adds the events of the bag alone, and returns how long the robot stood in it."""

        def add(
            topic: str, kind: str, first: Ns, last: Ns | None, text: str, **more: object
        ) -> None:
            values = (more.get(name) for name in ("value", "count", "x", "y"))
            self._rows["events"].append(
                (topic, topic_key(topic), kind, first, last, microseconds(first), text, *values)
            )

        for topic, found in events.items():
            for seen in found.visible.intervals():
                add(topic, "thing", seen.first, seen.last, seen.label, value=seen.best)
            for flip in found.of_kind(FLAG)[1]:
                add(topic, "flip", flip.time, None, toggled(topic, flip), value=float(flip.value))
            for error in found.errors:
                add(topic, "error", error.first, error.last, error.text, count=error.reports)
        pose_topic = self._pose_topic
        if self._poses is None or not are_places(self._poses.positions).any():
            return None
        stands = stands_of(self._poses, MIN_NS, MAX_NS)
        standstills = standstills_of(stands.blocks)
        for start, end, box in standstills:
            x, y, _ = box.centre
            add(pose_topic, "stop", start, end, "stood", x=x, y=y)
        for time, before_mps, after_mps in stands.drops:
            text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
            add(pose_topic, "drop", time, None, text, value=before_mps - after_mps)
        return unix_from_ns(sum(each.end - each.start for each in standstills))

    def _add_messages(
        self,
        events: Mapping[str, TopicEvents],
        messages: Sequence[str],
        in_map: tuple[str, RobotTrack] | None,
    ) -> None:
        """Reads the bag: its channels, its detections, and the messages of the chosen topics."""
        # What the events of a topic rule out is not decoded.
        seen = {
            topic
            for topic, found in events.items()
            if (found.visible.size or found.left_out)
            and any(map(may_have_detections, self._types[topic]))
        }
        whole = {topic for topic in messages if topic in self._types}
        channels = ChannelRows(whole)
        robot = _RobotAt(in_map)
        numbers: dict[str, int] = {}
        # Of all topics: a bag with damage anywhere is not shipped as if it were whole.
        every, window = tuple(self._types), TimeWindow.everything()
        for record in self._memory.reader.records(self._bag.path, every, window):
            channels.add(record)
            topic = record.channel.topic
            nth = numbers[topic] = numbers.get(topic, -1) + 1
            if topic in whole:
                self._rows["messages"].append(self._message(record, nth))
            if topic in seen:
                value = self._decoded(record)
                if value is None:
                    self._undecodable += 1
                else:
                    self._rows["sightings"] += self._sightings(record, nth, value, robot)
        self._rows["channels"] += channels.rows()

    def _decoded(self, record: Record) -> _Decoded | None:
        try:
            message = self._memory.reader.decode(record)
        except UndecodableError:
            return None
        extractor = self._memory.extractor
        return _Decoded(extractor.exact(message, record.channel.type), extractor.frame(message))

    def _sightings(
        self, record: Record, nth: int, value: _Decoded, robot: _RobotAt
    ) -> Iterator[Row]:
        channel, time = record.channel, record.log_time
        detections = detections_of(value.shown, value.frame_id)
        if not detections:
            return
        start = (
            channel.topic,
            topic_key(channel.topic),
            channel.type,
            time,
            microseconds(time),
            nth,
        )
        end = robot.at(time)
        for each in detections:
            place = each.place or (None, None, None)
            yield (*start, each.label, each.score, each.frame_id, *place, *end)

    def _message(self, record: Record, nth: int) -> Row:
        memory, channel, time = self._memory, record.channel, record.log_time
        columns: Sequence[object] = [None] * (len(MAPS) + 1)
        reason = None
        try:
            message = memory.reader.decode(record)
            value = taken_apart(memory.extractor.exact(message, channel.type))
            columns = [value.rest, *([*each.items()] for each in value[1:])]
        except UndecodableError as error:
            reason = error.reason
        return (
            channel.topic,
            topic_key(channel.topic),
            channel.type,
            time,
            microseconds(time),
            record.publish_time,
            nth,
            columns[0],
            reason,
            *columns[1:],
        )


class _Decoded(NamedTuple):
    """What a message shows, and the frame that its header names."""

    shown: JsonValue
    frame_id: str


class _RobotAt:
    """Where the robot was, by the track of a bag."""

    def __init__(self, in_map: tuple[str, RobotTrack] | None) -> None:
        self._track: RobotTrack | None = None
        self._frame = ""
        if in_map is not None:
            self._frame, self._track = in_map

    def at(self, time: Ns) -> tuple[str | None, float | None, float | None]:
        """Returns the frame, x and y (m); nulls where the track has a gap, or has not begun."""
        track = self._track
        if track is None:
            return None, None, None
        after = int(np.searchsorted(track.times, time, side="right"))
        if after == 0:
            return None, None, None
        last = after == len(track.times)
        if last or track.begins[after]:
            # Between two pieces the newest place that is known counts.
            return self._frame, float(track.x[after - 1]), float(track.y[after - 1])
        begin, end = int(track.times[after - 1]), int(track.times[after])
        share = (time - begin) / (end - begin)
        x = float(track.x[after - 1] + share * (track.x[after] - track.x[after - 1]))
        y = float(track.y[after - 1] + share * (track.y[after] - track.y[after - 1]))
        return self._frame, x, y


def _finite(number: float) -> float | None:
    return number if np.isfinite(number) else None
