"""Makes the rows of closed bags.

The rows are of the bag as the memory sees it: messages that count in another recording are left
out, as in answers. `channels` has the robot's own bytes, so that a later version, too, answers from
it as from the bag. All other rows are for people, and are derived from the same memory.
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
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

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
from ros2_memory.analysis.poses import NO_POSES, Poses, joined_poses, positions_apart
from ros2_memory.analysis.sights import Spot
from ros2_memory.columns.decode import BULKY_TYPES
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.arrays import distinct
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.detections import DetectionRows
from ros2_memory.history.driven_path import (
    body_by_transforms,
    poses_by_session,
    resolve_path_topic,
)
from ros2_memory.history.poses import PoseReader
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.insights.topic_events import events_by_bag, toggle_sentence
from ros2_memory.lake.tables import KEYS, ROWS_VERSION, TABLES, Row, ShippedBag, packed_messages
from ros2_memory.places.pose_frames import known_placement
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.things.labels import Labels
from ros2_memory.things.seen import SightReader, may_have_detections
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    import pyarrow as pa
    from numpy.typing import NDArray

    from ros2_memory.analysis.sights import Sights
    from ros2_memory.analysis.topic_events import TopicEvents
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.detections import Detected
    from ros2_memory.storage.base import Batch, Channel, IntArray

_MOST_OF_MESSAGE: Final = 512
"""The lake has only the times of a channel whose messages take more packed bytes on average, ..."""
_LEAST_OF_CHANNEL: Final = 16 << 10
"""... unless the channel takes less than this, such as a robot description or a map of a room."""
_MOST_BYTES: Final = 64 << 20
"""Payloads of a bag, besides those shipped whole, that are in memory at once."""
_MAP_OF: Final = {bool: "flags", int: "integers", float: "numbers", str: "texts"}
"""The map of `messages` that has values of a type."""
_LARGEST: Final = 1 << 63
"""The first integer that is too large for Iceberg."""
_NO_SCORE: Final = -1
_NOWHERE: Final = (math.nan,) * 3
_MM: Final = 1000.0
_ANGLE_DIGITS: Final = 9
_SCORE_UNIT: Final = 1000.0
_Rows: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.int64]]"


def bag_id_of(robot: str, recording: str, file: str, first: Ns) -> str:
    """Returns the id of a bag, a hash of its robot, recording, file name and first log time.

    It is the same for a copy of the bag, as in a saved moment, and another one for another bag of
    the same name. It does not depend on the size: a bag is the same after messages were forgotten.
    `first` is the log time of the first message in the file, whether it counts there or in another
    recording. The id begins with it, so that few files of a table have ids of one time.
    """
    return f"{max(first, 0):016x}{_digest([robot, recording, file, first])}"


def _digest(value: object) -> str:
    """Returns the first half of the SHA-256 of a JSON value, in hexadecimal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def sha256_of(path: Path) -> str:
    """Returns the SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb", buffering=0) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class _Derived(NamedTuple):
    """What rows of bags that lie close together are made of; all but things and detections by file.

    `undecodable`: messages that cannot be decoded, of topics that may have detections.
    """

    poses: Mapping[str, Poses]
    events: Mapping[str, Sequence[Row]]
    things: Mapping[BagFile, Sequence[Row]]
    detections: Mapping[BagFile, Mapping[str, Sequence[Rows]]]
    undecodable: Mapping[str, int]


@dataclass(eq=False, repr=False)
class RowMaker:
    """Makes the rows of a robot's bags, all as one call sees the memory.

    It remembers all that it has read, so a long run makes a new one from time to time.

    Args:
        memory: the memory over the bag directory.
        config: names the settings that rows depend on.
        whole: the topics whose messages are shipped whatever they take.
    """

    memory: Memory
    config: str
    whole: Collection[str]

    def __post_init__(self) -> None:
        """Opens a view of the memory as it is now."""
        self._view = View(self.memory, Call())
        self._body = body_by_transforms(self._view)
        self._path_topic = self._view.pose_topic
        if self._body is not None:
            self._path_topic = resolve_path_topic(self._view)
        self._sight_reader = SightReader(self._view)
        self._detections = DetectionRows(self._view)
        self._thing = cache(Labels(self.memory.limits.labels).key)

    def made_of(self, bag: BagFile) -> str:
        """Returns a digest of all inputs of a bag's rows besides its bytes.

        These are the messages that count, the handovers of its recording, the static transforms in
        force, the pose topic, the spellings of labels, the settings and the topics shipped whole.
        """
        counted = [
            (topic.topic, topic.type, topic.count, topic.first, topic.last)
            for topic in bag.summary.topics
        ]
        sessions = self._view.sessions
        recordings = sessions.lending_to(bag.recording, bag.end)
        statics = repr(static_at(sessions.static(recordings), bag.end))
        of_labels = self.memory.limits.labels.items()
        labels = {name: sorted(variants) for name, variants in of_labels}
        settings = ROWS_VERSION, self.config, self._path_topic, labels
        joined = self.memory.index.joined_with(bag.recording)
        return _digest([*settings, statics, sorted(self.whole), counted, *joined])

    def rows(self, bags: Mapping[BagFile, ShippedBag]) -> dict[str, pa.Table]:
        """Returns the rows of bags, which lie close together in time, by table.

        Raises:
            BagError: a bag, or a part of it, cannot be read.
        """
        rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        derived = self._derive(bags)
        for bag, shipped in bags.items():
            keys = {name: getattr(shipped, name) for name in KEYS}
            for name, of_table in self._rows_of_bag(bag, shipped, derived).items():
                rows[name] += ({**keys, **row} for row in of_table)
        return {name: table.to_arrow(rows[name]) for name, table in TABLES.items()}

    def _derive(self, bags: Collection[BagFile]) -> _Derived:
        """Reads the poses, events, things and detections of all bags at once."""
        view, files = self._view, {bag.file for bag in bags}
        window = TimeWindow(min(bag.start for bag in bags), max(bag.end for bag in bags) + 1)
        things: dict[BagFile, list[Row]] = defaultdict(list)
        for bag, frame, sights in self._sight_reader.sights_by_bag([*bags]):
            things[bag] += self._things(frame, sights)
        events: dict[str, list[Row]] = defaultdict(list)
        detections: dict[BagFile, dict[str, list[Rows]]] = defaultdict(lambda: defaultdict(list))
        undecodable = Counter[str]()
        for topic in view.timeline.topics():
            types = view.timeline.types_of(topic)
            if not any(map(has_events, types)):
                continue
            tables = scan(view, topic, window, copies=True)
            by_file = events_by_bag(view, tables, files)
            for file, of_topic in by_file.items():
                events[file] += self._events_of(topic, of_topic)
            if not any(map(may_have_detections, types)):
                continue
            undecodable.update({file: of_topic.undecodable for file, of_topic in by_file.items()})
            # A bag whose events show no detections is not decoded.
            seen = {file for file, of_topic in by_file.items() if of_topic.visible.size}
            for bag, rows in self._rows_by_bag(topic, window, seen) if seen else ():
                detections[bag][topic].append(rows)
        poses = self._poses_by_file(bags, window)
        return _Derived(poses, events, things, detections, undecodable)

    def _rows_by_bag(
        self, topic: str, window: TimeWindow, files: Collection[str]
    ) -> Iterator[tuple[BagFile, Rows]]:
        """Yields the messages of a topic in each of some bags, which may come several times."""
        for rows in scan(self._view, topic, window, copies=True):
            for bag, positions in rows.bag_rows(files):
                yield bag, rows.some(positions)

    def _poses_by_file(self, bags: Collection[BagFile], window: TimeWindow) -> Mapping[str, Poses]:
        """Returns the robot's poses in each bag, by transforms where no topic has poses.

        Without bags of which a message has no pose. Transforms give at most twenty poses a second.
        """
        view = self._view
        parts: dict[str, list[Poses]] = defaultdict(list)
        if self._body is None:
            reader, files = PoseReader(view), {bag.file for bag in bags}
            for bag, rows in self._rows_by_bag(self._path_topic, window, files):
                parts[bag.file].append(reader.poses_of_all(rows) or NO_POSES)
        else:
            for bag in bags:
                session = view.sessions.session_of(bag.recording)
                poses = poses_by_session(view, bag.window, session)
                parts[bag.file].append(poses.rows(positions_apart(poses.times)))
        return {
            file: joined_poses(of_bag) for file, of_bag in parts.items() if all(map(len, of_bag))
        }

    def _rows_of_bag(
        self, bag: BagFile, shipped: ShippedBag, derived: _Derived
    ) -> Mapping[str, Iterable[Row]]:
        """Returns the rows of one bag by table, without the columns that all tables have."""
        tracks = self._tracks(bag)
        map_frame, track = tracks[0] if tracks else (None, empty_track())
        channels = self._channels(bag)
        sightings: list[Row] = []
        for topic, rows in derived.detections.get(bag, {}).items():
            numbers = _numbers_by_type(channels, topic)
            sightings += self._sightings(topic, rows, numbers, map_frame, track)
        driven, stops = self._driven(derived.poses.get(bag.file))
        joined = self.memory.index.joined_with(bag.recording)
        of_bag_alone = {
            "recording": bag.recording.name,
            "messages": bag.summary.count,
            "undecodable": derived.undecodable[bag.file],
            "detections": len(sightings),
            "pose_topic": self._path_topic,
            "map_frame": map_frame,
            **driven,
            "summary": bag.summary.schema.to_json(),
            "counts": bag.summary.data,
            "joined": "/".join(joined) or None,
        }
        return {
            "channels": _channel_rows(channels),
            "poses": (row for of_frame in tracks for row in self._poses(*of_frame)),
            "sightings": sightings,
            "things": derived.things.get(bag, ()),
            "events": (*stops, *derived.events.get(bag.file, ())),
            "messages": self._messages(bag),
            "bags": (shipped._asdict() | of_bag_alone,),
        }

    def _tracks(self, bag: BagFile) -> list[tuple[str, RobotTrack]]:
        """Returns the robot's track in the bag with its frame: in the map, and in the poses' frame.

        Other rows take their places from the first track.
        """
        window = bag.window
        placement = known_placement(self._view)
        if placement is None:
            return []
        tracks: list[tuple[str, RobotTrack]] = []
        for frame in dict.fromkeys((placement.frame_id, placement.pose_frame)):
            reader = TrackReader(self._view, frame)
            # Raised if a message of the part has no position.
            with suppress(InvalidArgumentsError):
                track = cut_track(reader.track_in(window.aligned(PART_NS)).track, window)
                if len(track.times):
                    tracks.append((frame, track))
        return tracks

    def _poses(self, frame: str, track: RobotTrack) -> Iterator[Row]:
        same = {"topic": self._path_topic, "frame_id": frame, "error_m": TOLERANCE_M}
        # A track counts whole turns; here headings are from -pi to pi.
        wrapped = np.remainder(track.heading + math.pi, 2 * math.pi) - math.pi
        heading = wrapped.round(_ANGLE_DIGITS)
        begins, x, y, z = track.begins, track.x, track.y, track.z
        return _rows(same, time_ns=track.times, x=x, y=y, z=z, begins=begins, heading=heading)

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
        """Returns columns of `bags` that follow from poses, and standstills and drops as events."""
        topic = self._path_topic
        if poses is None:
            return {}, []
        fastest_mps = self.memory.limits.max_plausible_speed_mps
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
        for stop in standstills:
            x, y, _ = stop.box.centre
            events.append(_event(topic, "stop", stop.start, "stood", last_ns=stop.end, x=x, y=y))
        for time, before_mps, after_mps in stands.drops:
            text = f"slowed down suddenly from {before_mps:.2f} to {after_mps:.2f} m/s"
            events.append(_event(topic, "drop", time, text, value=before_mps - after_mps))
        stood_ns = sum(stop.length for stop in standstills)
        return {**driven, "stood_s": unix_from_ns(stood_ns)}, events

    def _channels(self, bag: BagFile) -> list[_Messages]:
        """Returns the messages of a bag by channel, in order of topics and types.

        Raises:
            BagError: the bag is damaged; it is not shipped as if it were whole.
        """
        # By identity, since hashing a channel hashes its definition.
        by_channel: dict[int, _Messages] = {}
        topics = bag.summary.schema.positions.keys()
        for batch in self.memory.reader.batches(bag.path, topics, TimeWindow.everything()):
            channel = batch.channel
            if id(channel) not in by_channel:
                is_whole = channel.topic in self.whole
                has_payloads = is_whole or channel.type not in BULKY_TYPES
                by_channel[id(channel)] = _Messages(channel, is_whole, [] if has_payloads else None)
            by_channel[id(channel)].add(batch)
            _drop_payloads(by_channel.values())
        return sorted(by_channel.values(), key=attrgetter("channel.topic", "channel.type"))

    def _sightings(
        self,
        topic: str,
        of_bag: Iterable[Rows],
        numbers: Mapping[str, _Numbers],
        frame: str | None,
        track: RobotTrack,
    ) -> Iterator[Row]:
        """Yields a row for each detection on a topic in a bag."""
        for rows, detected in chain.from_iterable(map(self._detected, of_bag)):
            kind = rows.table.channel.type
            ranks = rows.ranks[np.isin(rows.times, detected.log_times)]
            at = np.searchsorted(numbers[kind].times, detected.log_times) + ranks
            same = {"topic": topic, "type": kind}
            yield from self._sighting_rows(same, detected, numbers[kind].numbers[at], frame, track)

    def _detected(self, rows: Rows) -> Iterator[tuple[Rows, Detected]]:
        """Yields rows with their detections; apart by rank if any is undecodable and some are tied.

        Of messages of one log time only then it shows which is undecodable.
        """
        detected, ranks = self._detections.read(rows), rows.ranks
        if len(detected.log_times) == len(rows) or not ranks.any():
            yield rows, detected
            return
        for rank in np.unique(ranks).tolist():
            alike = rows.some(np.flatnonzero(ranks == rank))
            yield alike, self._detections.read(alike)

    def _sighting_rows(
        self, same: Row, detected: Detected, message: IntArray, frame: str | None, track: RobotTrack
    ) -> Iterator[Row]:
        """Yields a row for each detection; `message` is the number of each message in its topic."""
        found, at = detected.found, detected.found.rows
        places = [place_at(track, time) for time in detected.log_times.tolist()]
        robot_x, robot_y, robot_z = (
            np.array([place or _NOWHERE for place in places]).reshape(-1, 3).T
        )
        labels, (x, y, z) = found.labels.values(), found.places.T
        return _rows(
            same,
            time_ns=detected.log_times[at],
            message=message[at],
            label=labels,
            thing=map(self._thing, labels),
            score=found.scores,
            frame_id=found.frames.values(),
            x=x,
            y=y,
            z=z,
            robot_frame=[frame if places[row] else None for row in at.tolist()],
            robot_x=robot_x[at],
            robot_y=robot_y[at],
            robot_z=robot_z[at],
        )

    def _messages(self, bag: BagFile) -> Iterator[Row]:
        """Yields the messages of the topics that are shipped whole."""
        reader, extractor = self.memory.reader, self.memory.extractor
        numbers = Counter[str]()
        topics = bag.summary.schema.positions.keys() & {*self.whole}
        if not topics:
            return
        for record in reader.records(bag.path, topics, TimeWindow.everything()):
            topic, kind = record.channel.topic, record.channel.type
            try:
                value = _split_value(extractor.exact(reader.decode(record), kind))
            except UndecodableError as error:
                value = {"undecodable": error.reason}
            times = {"time_ns": record.log_time, "publish_ns": record.publish_time}
            yield {"topic": topic, "type": kind, **times, "message": numbers[topic], **value}
            numbers[topic] += 1

    def _events_of(self, topic: str, events: TopicEvents) -> Iterator[Row]:
        for seen in events.visible.intervals():
            thing = {"thing": self._thing(seen.label), "value": seen.best, "last_ns": seen.last}
            yield _event(topic, "thing", seen.first, seen.label, **thing)
        _, flips = events.of_kind(FLAG)
        for flip in flips:
            text, value = toggle_sentence(topic, flip), float(flip.value)
            yield _event(topic, "flip", flip.time, text, value=value)
        for error in events.errors:
            reports = {"last_ns": error.last, "count": error.reports}
            yield _event(topic, "error", error.first, error.text, **reports)


class _Numbers(NamedTuple):
    """The log times of messages in order, and their numbers among all messages of the topic."""

    times: IntArray
    numbers: IntArray


def _numbers_by_type(channels: Iterable[_Messages], topic: str) -> dict[str, _Numbers]:
    """Returns the numbers of a topic's messages, in order of log time and place, by type."""
    of_topic = [messages for messages in channels if messages.channel.topic == topic]
    parts = [np.concatenate(messages.parts, 1) for messages in of_topic]
    times, places, _ = np.concatenate(parts, 1)
    order = np.lexsort((places, times))
    types = [messages.channel.type for messages in of_topic]
    type_of = np.repeat(types, [part.shape[1] for part in parts])[order]
    at = {kind: np.flatnonzero(type_of == kind) for kind in types}
    return {kind: _Numbers(times[order][numbers], numbers) for kind, numbers in at.items()}


def _channel_rows(channels: Sequence[_Messages]) -> Iterator[Row]:
    """Yields the rows of a bag's channels."""
    times = [distinct(np.concatenate(messages.parts, 1)[0]) for messages in channels]
    none = np.empty(0, np.int64)
    log_times, occurrences = np.unique(np.concatenate([none, *times]), return_counts=True)
    tied = log_times[occurrences > 1]
    for number, messages in enumerate(channels):
        yield messages.row(number, tied)


def _drop_payloads(channels: Collection[_Messages]) -> None:
    """Drops payloads of the largest channels, until those not shipped whole have `_MOST_BYTES`."""
    droppable = [messages for messages in channels if not messages.is_whole]
    while sum(messages.size for messages in droppable) > _MOST_BYTES:
        largest = max(droppable, key=attrgetter("size"))
        largest.payloads, largest.size = None, 0


def _rows(same: Row, **columns: IntArray | NDArray[np.float64] | Iterable[object]) -> Iterator[Row]:
    """Yields rows with the values that are the `same` in all, and a value of each column."""
    values = (
        column.tolist() if isinstance(column, np.ndarray) else column for column in columns.values()
    )
    for row in zip(*values, strict=True):
        yield {**same, **dict(zip(columns, row, strict=True))}


def _event(topic: str, kind: str, first: Ns, text: str, **more: object) -> Row:
    return {"topic": topic, "kind": kind, "first_ns": first, "text": text, **more}


def _split_value(value: JsonValue) -> Row:
    """Returns a value as `messages` has it: maps of its scalars by dot-path, and `value`, as JSON.

    In the JSON every scalar that a map has is null. So the JSON is the same for all messages of a
    type without lists, and Parquet stores it once. Lists, and fields with a dot in their name, stay
    in the JSON.
    """
    scalars: dict[str, list[tuple[str, object]]] = {name: [] for name in _MAP_OF.values()}

    def without_scalars(inner: JsonValue, path: str) -> JsonValue:
        if isinstance(inner, dict):
            left: dict[str, JsonValue] = {}
            for name, part in inner.items():
                has_path = name and "." not in name
                inner_path = f"{path}.{name}" if path else name
                left[name] = without_scalars(part, inner_path) if has_path else part
            return left
        kind = _MAP_OF.get(type(inner))
        is_large = type(inner) is int and not -_LARGEST <= inner < _LARGEST
        if kind is None or not path or is_large:
            return inner
        scalars[kind].append((path, inner))
        return None

    return {**scalars, "value": to_json_text(without_scalars(value, ""))}


@dataclass(slots=True, eq=False)
class _Messages:
    """The messages of a channel.

    Attributes:
        is_whole: whether the payloads are shipped whatever they take.
        payloads: the payloads; None if only the times are shipped.
        parts: log times, places and publish times, as rows of arrays.
        size: the bytes of the payloads.
    """

    channel: Channel
    is_whole: bool
    payloads: list[bytes] | None
    parts: list[_Rows] = field(default_factory=list)
    size: int = 0

    def add(self, batch: Batch) -> None:
        """Adds more messages."""
        self.parts.append(np.stack((batch.log_times, batch.places, batch.publish_times)))
        if self.payloads is not None:
            buffer, starts, sizes = batch.buffer, batch.starts, batch.sizes
            spans = zip(starts.tolist(), (starts + sizes).tolist(), strict=True)
            self.payloads += [buffer[begin:end] for begin, end in spans]
            self.size += int(batch.sizes.sum())

    def row(self, number: int, tied: IntArray) -> Row:
        """Returns the row of channel `number` of the bag; without payloads if these are too large.

        `tied` are the log times at which several channels have messages.
        """
        times, channel = np.concatenate(self.parts, 1), self.channel
        order = np.lexsort((times[1], times[0]))
        logged, places, published = times[:, order]
        payloads = None
        if self.payloads is not None:
            payloads = [*map(self.payloads.__getitem__, order.tolist())]
        needed_places = places if np.isin(logged, tied).any() else None
        packed = packed_messages(logged, published, payloads, needed_places)
        most = max(_MOST_OF_MESSAGE * len(logged), _LEAST_OF_CHANNEL)
        if payloads is not None and not self.is_whole and len(packed) > most:
            payloads = None
            packed = packed_messages(logged, published, None, needed_places)
        return {
            "topic": channel.topic,
            "type": channel.type,
            "encoding": channel.encoding,
            "latched": channel.latched,
            "channel": number,
            "schema_encoding": channel.schema.encoding,
            "schema": channel.schema.text,
            "metadata": json.dumps(channel.metadata),
            "messages": len(logged),
            "first_ns": int(logged[0]),
            "last_ns": int(logged[-1]),
            "has_payloads": payloads is not None,
            "packed": packed,
        }
