"""The rows of closed bags.

The bag is the one that the memory sees: messages that count in another recording are left out, as
in answers. Its channels are the robot's own bytes: whatever is asked of them is asked as of the
bag, by a later version, too. All other rows are for people, and follow from the same memory.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ros2_memory.analysis.facts import FLAG, has_events
from ros2_memory.analysis.frames import static_at
from ros2_memory.analysis.motion.odometry import are_places
from ros2_memory.analysis.motion.robot_track import (
    TOLERANCE_M,
    RobotTrack,
    cut_track,
    empty_track,
    place_at,
)
from ros2_memory.analysis.motion.standstills import stands_of, standstills_of
from ros2_memory.analysis.motion.trajectory import path_slice
from ros2_memory.analysis.sights import Spot
from ros2_memory.analysis.topic_events import MAX_PER_BAG, TopicEvents
from ros2_memory.columns.decode import BULKY_TYPES
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.detections import DetectionRows
from ros2_memory.history.poses import poses_by_bag
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.insights.topic_events import events_by_bag, toggle_sentence
from ros2_memory.lake.tables import KEYS, ROWS_VERSION, TABLES, Row, ShippedBag, packed_messages
from ros2_memory.places.pose_frames import robot_places
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.things.labels import Labels
from ros2_memory.things.seen import SightReader, may_have_detections

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    import pyarrow as pa
    from numpy.typing import NDArray

    from ros2_memory.analysis.poses import Poses
    from ros2_memory.analysis.sights import Sights
    from ros2_memory.columns.units import Rows
    from ros2_memory.storage.base import Batch, Channel, IntArray

_MOST_OF_MESSAGE: Final = 512
"""Packed bytes of each message on average; of a channel with more the lake has the times alone."""
_LEAST_OF_CHANNEL: Final = 16 << 10
"""A channel may take this, however few its messages are: a description, a map of a room."""
_MOST_BYTES: Final = 64 << 20
"""Payloads of a bag that are in memory at once; beyond it the largest channel goes first."""
_MAP_OF: Final = {bool: "flags", int: "integers", float: "numbers", str: "texts"}
"""The map of `messages` that has values of a type."""
_LARGEST: Final = 1 << 63
_NO_SCORE: Final = -1
_NOWHERE: Final = (math.nan, math.nan)
_MM: Final = 1000.0
_ANGLE_DIGITS: Final = 9
_SCORE_UNIT: Final = 1000.0
_Rows: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.int64]]"


def bag_id_of(robot: str, recording: str, file: str, first: Ns) -> str:
    """Returns the id of a bag: of its robot, its recording, its file's name and its first message.

    So it is the same wherever the bag is copied to, also into a saved moment, and another one for
    another bag of the same name. Its size is no part of it: a bag of which messages were deleted
    by request is the same bag with less in it. `first` is the log time of the first message in the
    file, whether it counts there or in another recording. The id begins with it, so that the files
    of a table that can hold a bag are few: ids of one time lie side by side.
    """
    return f"{max(first, 0):016x}{_digest([robot, recording, file, first])}"


def _digest(value: object) -> str:
    """Returns half of the hash of a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def sha256_of(path: Path) -> str:
    """Returns the hash of a file's bytes.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb", buffering=0) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class RowMaker:
    """Makes the rows of a robot's bags, all as one call sees the memory.

    Who makes many takes a new one from time to time: it remembers what it has read.

    Attributes:
        memory: over the bag directory.
        config: names the settings that rows depend on.
        whole: topics whose messages are shipped, whatever they take.
    """

    def __init__(self, memory: Memory, config: str, whole: Collection[str]) -> None:
        self._memory, self._config, self._whole = memory, config, whole
        self._view = View(memory, Call())
        self._sight_reader = SightReader(self._view)
        self._detections = DetectionRows(self._view)
        self._thing = cache(Labels(memory.limits.labels).key)

    def made_of(self, bag: BagFile) -> str:
        """Returns a digest of all inputs of a bag's rows besides its bytes.

        These are the messages that count, the handovers of its recording, the static transforms in
        force, the pose topic, the spellings of labels, the settings and the topics shipped whole.
        """
        counted = [*map(attrgetter("topic", "type", "count", "first", "last"), bag.summary.topics)]
        sessions = self._view.sessions
        recordings = sessions.lending_to(bag.recording, bag.end)
        statics = repr(static_at(sessions.static(recordings), bag.end))
        of_labels = self._memory.limits.labels.items()
        labels = {name: sorted(variants) for name, variants in of_labels}
        settings = ROWS_VERSION, self._config, self._view.pose_topic, labels
        joined = self._memory.index.joined_with(bag.recording)
        return _digest([*settings, statics, sorted(self._whole), counted, *joined])

    def rows(self, bags: Mapping[BagFile, ShippedBag]) -> dict[str, pa.Table]:
        """Returns the rows of some bags, which lie close together in time, by table.

        Raises:
            BagError: one of them, or a part of it, cannot be read.
        """
        rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        window = TimeWindow(min(bag.start for bag in bags), max(bag.end for bag in bags) + 1)
        files = {bag.file for bag in bags}
        posed = scan(self._view, self._view.pose_topic, window, copies=True)
        poses = poses_by_bag(self._view, posed, files)
        events = self._events(window, files)
        things: dict[BagFile, list[Row]] = defaultdict(list)
        for bag, frame, sights in self._sight_reader.sights_by_bag([*bags]):
            things[bag] += self._things(frame, sights)
        seen: dict[BagFile, dict[str, list[Rows]]] = defaultdict(lambda: defaultdict(list))
        for topic in dict.fromkeys(chain(*(topics for _, topics in events.values()))):
            among = {file for file, (_, topics) in events.items() if topic in topics}
            for rows_of_bags in scan(self._view, topic, window, copies=True):
                for bag, positions in rows_of_bags.bag_rows(among):
                    seen[bag][topic].append(rows_of_bags.some(positions))
        for bag, shipped in bags.items():
            tracks = self._tracks(bag, window)
            map_frame, track = tracks[0] if tracks else (None, empty_track())
            sightings, undecodable = self._sightings(seen[bag], map_frame, track)
            driven, stood = self._driven(poses.get(bag.file))
            joined = self._memory.index.joined_with(bag.recording)
            of_bag_alone = {
                "recording": bag.recording.name,
                "messages": bag.summary.count,
                "undecodable": undecodable,
                "detections": len(sightings),
                "pose_topic": self._view.pose_topic,
                "map_frame": map_frame,
                **driven,
                "summary": bag.summary.schema.to_json(),
                "counts": bag.summary.data,
                "joined": "/".join(joined) or None,
            }
            made = {
                "channels": self._channels(bag),
                "poses": (row for of_frame in tracks for row in self._poses(*of_frame)),
                "sightings": sightings,
                "things": things[bag],
                "events": (*stood, *events.get(bag.file, ([], ()))[0]),
                "messages": self._messages(bag),
                "bags": (shipped._asdict() | of_bag_alone,),
            }
            keys = {name: getattr(shipped, name) for name in KEYS}
            for name, of_table in made.items():
                rows[name] += ({**keys, **row} for row in of_table)
        return {name: table.filled(rows[name]) for name, table in TABLES.items()}

    def _tracks(self, bag: BagFile, around: TimeWindow) -> list[tuple[str, RobotTrack]]:
        """Returns the robot's track in the bag, with its frame: in the map, and in the poses' own.

        The first of them has the place that other rows name. That `around` is made once.
        """
        window = TimeWindow(bag.start, bag.end + 1)
        places = robot_places(self._view, window)
        if places is None:
            return []
        tracks = [
            (frame, cut_track(self._track(frame, around, window), window))
            for frame in dict.fromkeys((places.map_frame, places.pose_frame))
        ]
        return [(frame, track) for frame, track in tracks if len(track.times)]

    def _track(self, frame: str, *windows: TimeWindow) -> RobotTrack:
        """Returns the track in the first of some windows in which all messages carry positions."""
        reader = TrackReader(self._view, frame)
        for window in windows:
            with suppress(InvalidArgumentsError):
                return reader.track_in(window.aligned(PART_NS)).track
        return empty_track()

    def _poses(self, frame: str, track: RobotTrack) -> Iterator[Row]:
        same = {"topic": self._view.pose_topic, "frame_id": frame, "error_m": TOLERANCE_M}
        # In a track it goes on beyond half a turn, as it did since the first vertex.
        turned = np.remainder(track.heading + math.pi, 2 * math.pi) - math.pi
        heading = turned.round(_ANGLE_DIGITS)
        begins, x, y = track.begins, track.x, track.y
        return _rows(same, time_ns=track.times, x=x, y=y, begins=begins, heading=heading)

    def _things(self, frame: str, sights: Sights) -> Iterator[Row]:
        spots = sights.spots
        labels = [sights.labels[code] for code in spots[:, Spot.LABEL].tolist()]
        x, y, z, spread_m = spots[:, [Spot.X, Spot.Y, Spot.Z, Spot.DEV]].T / _MM
        best = spots[:, Spot.BEST]
        return _rows(
            {"frame_id": frame},
            topic=[sights.topics[number] for number in spots[:, Spot.TOPIC].tolist()],
            label=labels,
            thing=map(self._thing, labels),
            count=spots[:, Spot.N],
            first_ns=spots[:, Spot.FIRST],
            last_ns=spots[:, Spot.LAST],
            x=x,
            y=y,
            z=z,
            spread_m=spread_m,
            best_score=np.where(best == _NO_SCORE, math.nan, best / _SCORE_UNIT),
        )

    def _driven(self, poses: Poses | None) -> tuple[Row, list[Row]]:
        """Returns what the row of a bag has of its poses, and their standstills and drops."""
        topic = self._view.pose_topic
        if poses is None:
            return {}, []
        fastest_mps = self._memory.limits.max_plausible_speed_mps
        whole = path_slice(poses, fastest_mps, draws=False).trajectory(0)
        driven = {
            "poses": whole.poses,
            "distance_m": whole.totals.distance_m,
            "gap_m": whole.totals.gap_m,
            "max_mps": whole.max_speed,
        }
        if not are_places(poses.positions).any():
            return driven, []
        stands, events = stands_of(poses, MIN_NS, MAX_NS), list[Row]()
        standstills = standstills_of([stands.blocks])
        for start, end, box in standstills:
            x, y, _ = box.centre
            events.append(_event(topic, "stop", start, "stood", last_ns=end, x=x, y=y))
        for time, before_mps, after_mps in stands.drops:
            text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
            events.append(_event(topic, "drop", time, text, value=before_mps - after_mps))
        stood_ns = sum(stop.end - stop.start for stop in standstills)
        return {**driven, "stood_s": unix_from_ns(stood_ns)}, events

    def _channels(self, bag: BagFile) -> Iterator[Row]:
        """Yields the channels, by topic. A bag with damage anywhere is not shipped as if whole."""
        # By identity, since hashing a channel hashes its definition.
        by_channel: dict[int, _Messages] = {}
        topics = {topic.topic for topic in bag.summary.topics}
        for batch in self._memory.reader.batches(bag.path, topics, TimeWindow.everything()):
            channel = batch.channel
            if id(channel) not in by_channel:
                is_whole = channel.topic in self._whole
                has_payloads = is_whole or channel.type not in BULKY_TYPES
                by_channel[id(channel)] = _Messages(channel, is_whole, [] if has_payloads else None)
            by_channel[id(channel)].add(batch)
            _drop_payloads(by_channel.values())
        order = sorted(by_channel.values(), key=attrgetter("channel.topic", "channel.type"))
        times = [np.unique(np.concatenate(messages.parts, 1)[0]) for messages in order]
        none = np.empty(0, np.int64)
        moments, channels = np.unique(np.concatenate([none, *times]), return_counts=True)
        tied = moments[channels > 1]
        for number, messages in enumerate(order):
            yield messages.row(number, tied)

    def _sightings(
        self,
        rows_of_topics: Mapping[str, Sequence[Rows]],
        frame: str | None,
        track: RobotTrack,
    ) -> tuple[list[Row], int]:
        """Returns the detections in a bag, and how many messages of its topics are undecodable."""
        sightings, undecodable = list[Row](), 0
        for topic, of_topic in rows_of_topics.items():
            times = np.sort(np.concatenate([rows.times for rows in of_topic]))
            left = [*of_topic]
            for rows in left:
                detected = self._detections.of(rows)
                lost = len(rows) - len(detected.log_times)
                if lost and len(rows) > 1 and rows.ranks.any():
                    # Which of those of one log time are lost shows where they are read alone.
                    tied = np.isin(rows.times, rows.times[rows.ranks > 0])
                    alone = map(rows.some, np.flatnonzero(tied)[:, np.newaxis])
                    left += [rows.some(np.flatnonzero(~tied)), *alone]
                    continue
                undecodable += lost
                number = np.searchsorted(times, detected.log_times)
                number += 0 if lost else rows.ranks
                found, at = detected.found, detected.found.rows
                places = [place_at(track, time) for time in detected.log_times.tolist()]
                robot_x, robot_y = (
                    np.array([place or _NOWHERE for place in places]).reshape(-1, 2).T
                )
                labels, (x, y, z) = found.labels.values(), found.places.T
                sightings += _rows(
                    {"topic": topic, "type": rows.table.channel.type},
                    time_ns=detected.log_times[at],
                    message=number[at],
                    label=labels,
                    thing=map(self._thing, labels),
                    score=found.scores,
                    frame_id=found.frames.values(),
                    x=x,
                    y=y,
                    z=z,
                    robot_frame=[frame if places[message] else None for message in at.tolist()],
                    robot_x=robot_x[at],
                    robot_y=robot_y[at],
                )
        return sightings, undecodable

    def _messages(self, bag: BagFile) -> Iterator[Row]:
        """Yields the messages of the topics that are shipped whole."""
        reader, extractor = self._memory.reader, self._memory.extractor
        numbers = Counter[str]()
        topics = {*self._whole}.intersection(topic.topic for topic in bag.summary.topics)
        for record in reader.records(bag.path, topics, TimeWindow.everything()) if topics else ():
            topic, kind = record.channel.topic, record.channel.type
            try:
                value = taken_apart(extractor.exact(reader.decode(record), kind))
            except UndecodableError as error:
                value = {"undecodable": error.reason}
            times = {"time_ns": record.log_time, "publish_ns": record.publish_time}
            yield {"topic": topic, "type": kind, **times, "message": numbers[topic], **value}
            numbers[topic] += 1

    def _events(
        self, window: TimeWindow, files: Collection[str]
    ) -> dict[str, tuple[list[Row], list[str]]]:
        """Returns the events in each of some bags, and the topics that may have detections there.

        By their files.
        """
        found: dict[str, tuple[list[Row], list[str]]] = defaultdict(lambda: ([], []))
        for topic in self._view.timeline.topics():
            types = self._view.timeline.types_of(topic)
            if not any(map(has_events, types)):
                continue
            may_be_seen = any(map(may_have_detections, types))
            tables = scan(self._view, topic, window, copies=True)
            for file, of_bag in events_by_bag(self._view, tables, files).items():
                events = of_bag.limited(MAX_PER_BAG, MAX_PER_BAG)
                rows, seen = found[file]
                rows += self._events_of(topic, events)
                # What the events of a topic rule out is not decoded.
                if may_be_seen and (events.visible.size or events.left_out):
                    seen.append(topic)
        return found

    def _events_of(self, topic: str, events: TopicEvents) -> Iterator[Row]:
        for seen in events.visible.intervals():
            columns = {"thing": self._thing(seen.label), "value": seen.best, "last_ns": seen.last}
            yield _event(topic, "thing", seen.first, seen.label, **columns)
        _, flips = events.of_kind(FLAG)
        for flip in flips:
            yield _event(
                topic, "flip", flip.time, toggle_sentence(topic, flip), value=float(flip.value)
            )
        for error in events.errors:
            reports = {"last_ns": error.last, "count": error.reports}
            yield _event(topic, "error", error.first, error.text, **reports)


def _drop_payloads(channels: Collection[_Messages]) -> None:
    """Drops payloads of the largest channels until `_MOST_BYTES` hold all; those whole stay."""
    droppable = [messages for messages in channels if not messages.is_whole]
    while droppable and sum(messages.size for messages in channels) > _MOST_BYTES:
        largest = max(droppable, key=attrgetter("size"))
        largest.payloads, largest.size = None, 0
        droppable.remove(largest)


def _rows(same: Row, **columns: IntArray | NDArray[np.float64] | Iterable[object]) -> Iterator[Row]:
    """Yields rows with what is the `same` in all, and a value of each column."""
    values = (
        column.tolist() if isinstance(column, np.ndarray) else column for column in columns.values()
    )
    return ({**same, **dict(zip(columns, row, strict=True))} for row in zip(*values, strict=True))


def _event(topic: str, kind: str, first: Ns, text: str, **more: object) -> Row:
    return {"topic": topic, "kind": kind, "first_ns": first, "text": text, **more}


def taken_apart(value: JsonValue) -> Row:
    """Returns a value as `messages` has it: scalars in maps by dot-path, and `value`, JSON of else.

    In the JSON every scalar that a map has is null. So it is one text for all messages of a type
    without lists, which Parquet stores once. Lists stay whole, and what has a dot in its name.
    """
    scalars: dict[str, list[tuple[str, object]]] = {name: [] for name in _MAP_OF.values()}

    def rest(inner: JsonValue, path: str) -> JsonValue:
        if isinstance(inner, dict):
            return {
                name: part if "." in name or not name else rest(part, f"{path}.{name}".lstrip("."))
                for name, part in inner.items()
            }
        kind = _MAP_OF.get(type(inner))
        is_large = type(inner) is int and not -_LARGEST <= inner < _LARGEST
        if kind is None or not path or is_large:
            return inner
        scalars[kind].append((path, inner))
        return None

    text = json.dumps(rest(value, ""), ensure_ascii=False, separators=(",", ":"))
    return {**scalars, "value": text}


@dataclass(slots=True, eq=False)
class _Messages:
    """The messages of a channel. `payloads`: None where they are not shipped; `size`: of these.

    `is_whole`: they are shipped whatever they take; of other images, clouds, scans and the like,
    the times alone are. `parts`: their log times, places and publish times.
    """

    channel: Channel
    is_whole: bool
    payloads: list[bytes] | None
    parts: list[_Rows] = field(default_factory=list)
    size: int = 0

    def add(self, batch: Batch) -> None:
        """Takes more messages."""
        self.parts.append(np.stack((batch.log_times, batch.places, batch.publish_times)))
        if self.payloads is not None:
            buffer, starts, sizes = batch.buffer, batch.starts, batch.sizes
            spans = zip(starts.tolist(), (starts + sizes).tolist(), strict=True)
            self.payloads += [buffer[begin:end] for begin, end in spans]
            self.size += int(batch.sizes.sum())

    def row(self, number: int, tied: IntArray) -> Row:
        """Returns its row, the n-th of the bag; without payloads where these take too much.

        `tied`: log times of which several channels have messages.
        """
        times, channel = np.concatenate(self.parts, 1), self.channel
        order = np.lexsort((times[1], times[0]))
        logged, places, published = times[:, order]
        payloads = self.payloads and [self.payloads[nth] for nth in order.tolist()]
        order_counts = places if np.isin(logged, tied).any() else None
        packed = packed_messages(logged, published, payloads, order_counts)
        most = max(_MOST_OF_MESSAGE * len(logged), _LEAST_OF_CHANNEL)
        if payloads is not None and not self.is_whole and len(packed) > most:
            payloads = None
            packed = packed_messages(logged, published, None, order_counts)
        schema = {"schema_encoding": channel.schema.encoding, "schema": channel.schema.text}
        return {
            **{name: getattr(channel, name) for name in ("topic", "type", "encoding", "latched")},
            "channel": number,
            **schema,
            "metadata": json.dumps(channel.metadata),
            "messages": len(logged),
            "first_ns": int(logged[0]),
            "last_ns": int(logged[-1]),
            "has_payloads": payloads is not None,
            "packed": packed,
        }
