"""Rows of a lake as messages: detections, whole ones, states, and the robot's track as poses."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.lake.state_runs import EmptyRun, state_of_lists
from ros2_memory.lake.typed_values import MAPS, put_together
from ros2_memory.storage.base import Channel, Record, Schema

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.topic_events import State
    from ros2_memory.core.bag_summary import TopicSummary
    from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.state_runs import StateRun

    Row = Mapping[str, JsonValue]

_STATED: Final = "stated"
"""The encoding of messages of which only what they state is known."""


def channel(topic: str, type_name: str) -> Channel:
    """Returns the channel of messages that are made of rows."""
    return Channel(topic, "json", Schema(type_name))


def record(topic: str, type_name: str, time: Ns, value: JsonValue, published: Ns = 0) -> Record:
    """Returns a message of a value."""
    payload = json.dumps(value).encode()
    return Record(channel(topic, type_name), time, published or time, payload)


def message(topic: str, row: Row) -> Record:
    """Returns a message of a row of `messages`; without a payload where it was undecodable."""
    text = row["value"]
    scalars = {path: each for name in MAPS for path, each in _items(row.get(name))}
    value = put_together(text, scalars) if isinstance(text, str) else None
    found = record(topic, str(row["type"]), _ns(row["time_ns"]), value, _ns(row["publish_ns"]))
    return found if isinstance(text, str) else found._replace(payload=b"")


def _items(column: object) -> Iterator[tuple[str, JsonValue]]:
    """Yields what a column of maps has in one row, which is null in rows of older versions."""
    for each in column if isinstance(column, list) else ():
        key, value = each.values() if isinstance(each, dict) else each
        yield key, value


def states(topic: str, type_name: str, runs: Iterable[StateRun]) -> Iterator[Record]:
    """Yields messages that have nothing but what they state: `stated_in` has that.

    Those of a run are equally far apart. An undecodable one has no payload.
    """
    here = Channel(topic, _STATED, Schema(type_name))
    for state, first, last, count in runs:
        payload = b"" if state is None else json.dumps(state).encode()
        for time in even_times(first, last, count).tolist():
            yield Record(here, time, time, payload)


def is_only_stated(record: Record) -> bool:
    """Returns whether no more is known of a message than what it states."""
    return record.channel.encoding == _STATED


def stated_in(record: Record) -> State | None:
    """Returns what a message states, if no more is known of it; None where it is to be decoded."""
    is_known = is_only_stated(record) and record.payload
    return state_of_lists(json.loads(record.payload)) if is_known else None


def detections(
    bag: BagFile, topic: str, rows: Sequence[Row], empty: Iterable[EmptyRun] | None
) -> Sequence[Record]:
    """Returns the messages with detections, and those that end sightings without any.

    Of messages in a row without a detection (`empty`) that is the first and the last. Where they
    are not known, messages are taken to be equally far apart between those that have detections.
    """
    [summary, *_] = bag.summary.of(topic)
    messages: dict[int, tuple[Ns, list[JsonValue]]] = {}
    for row in rows:
        entry = messages.setdefault(_ns(row["message"]), (_ns(row["time_ns"]), []))
        entry[1].append(_detection(row))
    if empty is None:
        empty = [*_gaps(summary, {nth: time for nth, (time, _) in messages.items()})]
    for run in empty:
        messages[run.nth] = run.first, []
        messages[run.nth + run.messages - 1] = run.last, []
    return [
        record(topic, summary.type, time, {"detections": found})
        for _, (time, found) in sorted(messages.items())
    ]


def _gaps(summary: TopicSummary, known: Mapping[int, Ns]) -> Iterator[EmptyRun]:
    """Yields the runs of messages that are not known, with times equally far apart."""
    times = {-1: summary.first, **known, summary.count: summary.last}
    for (before, reached), (nth, time) in pairwise(sorted(times.items())):
        missing = even_times(reached, time, nth - before + 1)[1:-1].tolist()
        if missing:
            first = summary.first if before < 0 else missing[0]
            last = summary.last if nth == summary.count else missing[-1]
            yield EmptyRun(before + 1, first, max(first, last), len(missing))


def _detection(row: Row) -> JsonValue:
    found: dict[str, JsonValue] = {"label": row["label"]}
    if row["score"] is not None:
        found["score"] = row["score"]
    if row["frame_id"]:
        found["frame_id"] = row["frame_id"]
    if row["x"] is not None:
        found["position"] = {axis: row[axis] for axis in "xyz"}
    return found


def even_times(first: Ns, last: Ns, count: int) -> NDArray[np.int64]:
    """Returns so many times from a first to a last one, equally far apart."""
    return first + np.linspace(0, last - first, count).astype(np.int64)


class Tracks:
    """The robot's track in one bag: in the poses' own frame, and in the map where that is another.

    A vertex is there only where the track bends. So poses are as many, and as far apart, as the
    bag's messages were on average, each on the line between two vertices.

    Args:
        bag: the bag.
        topic: of the poses.
        rows: the vertices in order of time.
        map_frame: the frame of the map.
    """

    def __init__(
        self, bag: BagFile, topic: str, rows: Sequence[Row], map_frame: str | None
    ) -> None:
        [summary, *_] = bag.summary.of(topic)
        self._type = summary.type
        self._times = even_times(summary.first, summary.last, summary.count)
        by_frame: dict[str, list[Row]] = {}
        for row in rows:
            by_frame.setdefault(str(row["frame_id"]), []).append(row)
        self._map = by_frame.get(map_frame or "")
        self._map_frame = map_frame or ""
        self._own_frame = min(by_frame, key=lambda each: each == map_frame, default="")
        self._own = by_frame.get(self._own_frame, [])

    def poses(self, topic: str, window: TimeWindow) -> Sequence[Record]:
        """Returns the poses of a window, in the poses' own frame."""
        return [
            record(topic, self._type, time, _posed(self._own_frame, x, y, heading))
            for time, x, y, heading in self._at(self._own, window)
        ]

    def transforms(self, topic: str, window: TimeWindow) -> Sequence[Record]:
        """Returns the transforms of a window, from the poses' own frame to the map."""
        if self._map is None or self._own_frame == self._map_frame:
            return ()
        own = {time: (x, y, heading) for time, x, y, heading in self._at(self._own, window)}
        found: list[Record] = []
        for time, x, y, heading in self._at(self._map, window):
            if time not in own or math.isnan(heading) or math.isnan(own[time][2]):
                continue
            from_x, from_y, from_heading = own[time]
            turn = heading - from_heading
            cos, sin = math.cos(turn), math.sin(turn)
            shift = x - (cos * from_x - sin * from_y), y - (sin * from_x + cos * from_y)
            edge = _edge(self._map_frame, self._own_frame, time, shift, turn)
            found.append(record(topic, "tf2_msgs/msg/TFMessage", time, {"transforms": [edge]}))
        return found

    def _at(
        self, rows: Sequence[Row], window: TimeWindow
    ) -> Sequence[tuple[Ns, float, float, float]]:
        """Returns times of a window, x, y (m) and headings (rad) where a track has no gap."""
        wanted = self._times[(self._times >= window.start) & (self._times < window.stop)]
        if not rows or not len(wanted):
            return ()
        vertices = np.array([_ns(row["time_ns"]) for row in rows], np.int64)
        begins = np.array([bool(row["begins"]) for row in rows])
        after = np.searchsorted(vertices, wanted, side="left")
        inside = (after < len(vertices)) & (wanted >= vertices[0])
        exact = np.zeros(len(wanted), np.bool_)
        exact[inside] = vertices[after[inside]] == wanted[inside]
        inside[inside] &= exact[inside] | ~begins[after[inside]]
        times = wanted[inside]
        since = (times - vertices[0]).astype(np.float64)
        known = (vertices - vertices[0]).astype(np.float64)
        x, y = (np.interp(since, known, _column(rows, name)) for name in ("x", "y"))
        headings = np.interp(since, known, np.unwrap(_column(rows, "heading")))
        return [*zip(times.tolist(), x.tolist(), y.tolist(), headings.tolist(), strict=True)]


def _column(rows: Sequence[Row], name: str) -> NDArray[np.float64]:
    values = (row[name] for row in rows)
    return np.array([each if isinstance(each, int | float) else math.nan for each in values])


def _posed(frame: str, x: float, y: float, heading: float) -> JsonValue:
    pose: dict[str, JsonValue] = {"position": {"x": x, "y": y, "z": 0.0}}
    if not math.isnan(heading):
        pose["orientation"] = _turned(heading)
    return {"header": {"frame_id": frame}, "pose": {"pose": pose, **pose}}


def _turned(heading: float) -> JsonValue:
    return {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2), "w": math.cos(heading / 2)}


def _edge(parent: str, child: str, time: Ns, shift: tuple[float, float], turn: float) -> JsonValue:
    seconds, nanoseconds = divmod(time, 10**9)
    return {
        "header": {"frame_id": parent, "stamp": {"sec": seconds, "nanosec": nanoseconds}},
        "child_frame_id": child,
        "transform": {
            "translation": {"x": shift[0], "y": shift[1], "z": 0.0},
            "rotation": _turned(turn),
        },
    }


def _ns(value: JsonValue) -> Ns:
    return value if isinstance(value, int) else 0
