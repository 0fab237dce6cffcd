"""The rows of one closed bag.

The bag is the one that the memory sees: messages that count in another recording are left out, as
in answers.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.facts import FLAG, has_events
from ros2_memory.analysis.frames import static_at
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.motion.robot_track import TOLERANCE_M, cut, empty_track, place_at
from ros2_memory.analysis.motion.standstills import stands_of, standstills_of
from ros2_memory.analysis.motion.trajectory import path_slice
from ros2_memory.analysis.sights import Spot
from ros2_memory.analysis.topic_events import MAX_PER_BAG
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.history.poses import poses_of_bag
from ros2_memory.history.transforms import sessions_of, static_transforms
from ros2_memory.history.view import View
from ros2_memory.insights.topic_events import events_of_bag, toggled
from ros2_memory.lake.channel_rows import ChannelRows
from ros2_memory.lake.tables import ROWS_VERSION, TABLES
from ros2_memory.lake.typed_values import taken_apart
from ros2_memory.messages.detections import detections_of
from ros2_memory.places.robot_places import robot_places
from ros2_memory.places.robot_tracks import RobotTracks
from ros2_memory.things.seen import Watching, may_have_detections

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from datetime import date
    from pathlib import Path

    from ros2_memory.analysis.motion.robot_track import RobotTrack
    from ros2_memory.analysis.sights import Sights
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.tables import Row
    from ros2_memory.storage.base import Record

_NO_SCORE: Final = -1
_MM: Final = 1000.0
_SCORE_UNIT: Final = 1000.0


class ShippedBag(NamedTuple):
    """The columns of `bags` that identify a bag.

    Attributes:
        robot: its name.
        bag_id: see `bag_id_of`.
        day: (UTC) of its start.
        file: its path below the bag directory.
        size: of its file (bytes).
        sha256: of the bytes of its file, in hexadecimal.
        mtime_ns: of its file.
        made_of: see `made_of`.
        start_ns: log time of its first message.
        end_ns: of its last one.
    """

    robot: str
    bag_id: str
    day: date
    file: str
    size: int
    sha256: str
    mtime_ns: Ns
    made_of: str
    start_ns: Ns
    end_ns: Ns


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
    memory: Memory, bag: BagFile, shipped: ShippedBag, messages: Sequence[str] = ()
) -> dict[str, list[Row]]:
    """Returns the rows of a bag, by table; `messages` are topics to ship whole.

    Raises:
        BagError: the bag, or a part of it, cannot be read.
    """
    keys = {"robot": shipped.robot, "bag_id": shipped.bag_id, "day": shipped.day}
    found = _BagRows(memory, bag).rows(shipped, messages)
    return {name: [{**keys, **row} for row in rows] for name, rows in found.items()}


class _BagRows:
    """Makes the rows of one bag."""

    def __init__(self, memory: Memory, bag: BagFile) -> None:
        self._memory = memory
        self._bag = bag
        self._pose_topic = memory.limits.pose_topic
        self._poses = poses_of_bag(View(memory, Call()), bag, self._pose_topic)
        self._types: dict[str, list[str]] = {}
        for each in bag.summary.topics:
            self._types.setdefault(each.topic, []).append(each.type)
        self._undecodable = 0
        self._rows: dict[str, list[Row]] = {name: [] for name in TABLES}

    def rows(self, shipped: ShippedBag, messages: Sequence[str]) -> dict[str, list[Row]]:
        tracks = self._tracks()
        events = self._events()
        for track in tracks:
            self._rows["poses"] += self._vertices(*track)
        self._rows["things"] += self._things()
        stood_s = self._add_events(events)
        in_map: tuple[str | None, RobotTrack] = tracks[0] if tracks else (None, empty_track())
        self._add_messages(events, messages, *in_map)
        self._rows["bags"].append({**shipped._asdict(), **self._bag_row(in_map[0], stood_s)})
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

    def _bag_row(self, map_frame: str | None, stood_s: float | None) -> Row:
        """Returns what the row of the bag has besides what names it."""
        bag, driven = self._bag, {}
        if self._poses is not None:
            path = path_slice(self._poses, self._memory.limits.max_plausible_speed_mps)
            whole = path.trajectory(0)
            driven = {
                "poses": whole.poses,
                "distance_m": whole.totals.distance_m,
                "gap_m": whole.totals.gap_m,
                "max_mps": whole.max_speed,
            }
        return {
            "recording": bag.recording.name,
            "messages": bag.summary.count,
            "undecodable": self._undecodable,
            "detections": len(self._rows["sightings"]),
            "pose_topic": self._pose_topic,
            "map_frame": map_frame,
            **driven,
            "stood_s": stood_s,
            "summary": bag.summary.schema.to_json(),
            "counts": bag.summary.packed,
        }

    def _vertices(self, frame: str, track: RobotTrack) -> Iterator[Row]:
        shared = {"topic": self._pose_topic, "frame_id": frame, "error_m": TOLERANCE_M}
        columns = (track.times, track.x, track.y, track.heading, track.begins)
        for time, x, y, heading, begins in zip(*(each.tolist() for each in columns), strict=True):
            yield {
                **shared,
                "time_ns": time,
                "x": x,
                "y": y,
                "heading": None if math.isnan(heading) else heading,
                "begins": begins,
            }

    def _things(self) -> Iterator[Row]:
        for one in Watching(View(self._memory, Call())).in_bag(self._bag):
            for sights in one.sights:
                for spot in sights.spots.tolist():
                    yield _thing(one.frame_id, sights, spot)

    def _add_events(self, events: Mapping[str, TopicEvents]) -> float | None:
        """Adds the events of the bag alone, and returns how long the robot stood in it."""

        def add(topic: str, kind: str, first: Ns, text: str, **more: object) -> None:
            row = {"topic": topic, "kind": kind, "first_ns": first, "text": text}
            self._rows["events"].append({**row, **more})

        for topic, found in events.items():
            for seen in found.visible.intervals():
                add(topic, "thing", seen.first, seen.label, last_ns=seen.last, value=seen.best)
            for flip in found.of_kind(FLAG)[1]:
                add(topic, "flip", flip.time, toggled(topic, flip), value=float(flip.value))
            for error in found.errors:
                add(
                    topic,
                    "error",
                    error.first,
                    error.text,
                    last_ns=error.last,
                    count=error.reports,
                )
        if self._poses is None or not are_places(self._poses.positions).any():
            return None
        stands = stands_of(self._poses, MIN_NS, MAX_NS)
        standstills = standstills_of(stands.blocks)
        for start, end, box in standstills:
            x, y, _ = box.centre
            add(self._pose_topic, "stop", start, "stood", last_ns=end, x=x, y=y)
        for time, before_mps, after_mps in stands.drops:
            text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
            add(self._pose_topic, "drop", time, text, value=before_mps - after_mps)
        return unix_from_ns(sum(each.end - each.start for each in standstills))

    def _add_messages(
        self,
        events: Mapping[str, TopicEvents],
        messages: Sequence[str],
        frame: str | None,
        track: RobotTrack,
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
        numbers = Counter[str]()
        # Of all topics: a bag with damage anywhere is not shipped as if it were whole.
        every, window = tuple(self._types), TimeWindow.everything()
        for record in self._memory.reader.records(self._bag.path, every, window):
            channels.add(record)
            topic = record.channel.topic
            nth = numbers[topic]
            numbers[topic] += 1
            if topic not in whole and topic not in seen:
                continue
            row = {
                "topic": topic,
                "type": record.channel.type,
                "time_ns": record.log_time,
                "message": nth,
            }
            if topic in whole:
                self._rows["messages"].append({**row, **self._content(record)})
            if topic in seen:
                self._rows["sightings"] += [
                    {**row, **found} for found in self._sightings(record, frame, track)
                ]
        self._rows["channels"] += channels.rows()

    def _sightings(self, record: Record, frame: str | None, track: RobotTrack) -> Iterator[Row]:
        extractor = self._memory.extractor
        try:
            message = self._memory.reader.decode(record)
        except UndecodableError:
            self._undecodable += 1
            return
        shown = extractor.exact(message, record.channel.type)
        at = place_at(track, record.log_time)
        robot: Row = {}
        if at is not None:
            robot = {"robot_frame": frame, "robot_x": at[0], "robot_y": at[1]}
        for each in detections_of(shown, extractor.frame(message)):
            x, y, z = each.place or (None, None, None)
            yield {
                "label": each.label,
                "score": each.score,
                "frame_id": each.frame_id,
                "x": x,
                "y": y,
                "z": z,
                **robot,
            }

    def _content(self, record: Record) -> Row:
        """Returns when a message was published, and its value in columns."""
        published = {"publish_ns": record.publish_time}
        try:
            message = self._memory.reader.decode(record)
            value = self._memory.extractor.exact(message, record.channel.type)
        except UndecodableError as error:
            return {**published, "undecodable": error.reason}
        return {**published, **taken_apart(value)}


def _thing(frame: str, sights: Sights, spot: Sequence[int]) -> Row:
    best = spot[Spot.BEST]
    return {
        "topic": sights.topics[spot[Spot.TOPIC]],
        "label": sights.labels[spot[Spot.LABEL]],
        "count": spot[Spot.N],
        "first_ns": spot[Spot.FIRST],
        "last_ns": spot[Spot.LAST],
        "frame_id": frame,
        "x": spot[Spot.X] / _MM,
        "y": spot[Spot.Y] / _MM,
        "z": spot[Spot.Z] / _MM,
        "spread_m": spot[Spot.DEV] / _MM,
        "best_score": None if best == _NO_SCORE else best / _SCORE_UNIT,
    }
