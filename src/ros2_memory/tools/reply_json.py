"""Answers as JSON values: field names, units, rounding.

Timestamps are Unix seconds, rounded up to whole microseconds so that one fed back finds its own
message; metres and metres per second to 1e-4, degrees to 1e-2, quaternions to 1e-6. What is not a
finite number is null. `notes` is there only where there is something to say.
"""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory import results
from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.timebase import Ns, unix_rounded_up
from ros2_memory.history.driven_path import length_notes
from ros2_memory.tools.figures import (
    degrees,
    local,
    metres,
    moment,
    rounded,
    seconds,
    with_notes,
)
from ros2_memory.tools.reply_size import to_json_text, without_constant_zeros

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.trajectory import Trajectory
    from ros2_memory.core.model import Geodetic, JsonValue, Quaternion, SetAside
    from ros2_memory.tools.reply_size import JsonObject

Answer: TypeAlias = (
    tuple[results.TopicRow, ...]
    | results.DataTimeRange
    | results.TopicValue
    | results.TopicRange
    | results.Position
    | results.Velocity
    | results.TransformAt
    | results.Frames
    | results.Match
    | results.ValueWhen
    | results.TrajectorySummary
)

ZEROS_SHOWN_BELOW_CHARS: Final = 4000
"""A range shorter than this keeps its constant zeros: there is room, and whole values read best."""

FINE_PATH_M: Final = 0.05 + 1e-9
"""The deviation that a drawn path is expected to have; a coarser one is worth a note."""

_LONGEST_REST_CHARS: Final = 200
"""What the row takes that stands for those left out, whatever its numbers."""
_NEWEST_LISTED: Final = 20
_MOST_ZEROS_NAMED: Final = 20


@singledispatch
def shown(answer: object, _bag_dir: Path) -> JsonValue:
    """What a reply shows of an answer; files are named relative to the bag directory.

    Raises:
        TypeError: the value is none of `Answer`.
    """
    raise TypeError(f"{type(answer).__name__} is not an answer")


@shown.register(tuple)
def _topics(answer: tuple[results.TopicRow, ...], _bag_dir: Path) -> JsonValue:
    return [_topic_row(row) for row in answer]


def fit_topics(rows: Sequence[results.TopicRow], max_chars: int) -> str:
    """The list of topics as JSON text of at most `max_chars` characters: always a list of rows.

    Where it would be longer, the busiest topics come first, and the last row stands for all that
    are left out, with their first and last time and the sum of their counts. `max_chars` must be
    at least 500.
    """
    text = to_json_text([_topic_row(row) for row in rows])
    if len(text) <= max_chars:
        return text
    spare = max_chars - _LONGEST_REST_CHARS
    told: list[JsonValue] = []
    rest: list[results.TopicRow] = []
    for row in sorted(rows, key=lambda row: -row.count):
        one = _topic_row(row)
        size = len(to_json_text(one)) + 1
        if size <= spare and not rest:
            told.append(one)
            spare -= size
        else:
            rest.append(row)
    others = results.TopicRow(
        f"({len(rest)} more: use pattern)",
        "",
        min(row.first for row in rest),
        max(row.last for row in rest),
        sum(row.count for row in rest),
    )
    return to_json_text([*told, _topic_row(others)])


@shown.register(results.DataTimeRange)
def _time_range(answer: results.DataTimeRange, bag_dir: Path) -> JsonObject:
    notes = list(answer.notes)
    gaps: list[JsonValue] = [
        {
            "start": unix_rounded_up(gap.start),
            "end": unix_rounded_up(gap.end),
            "duration_s": seconds(gap.end - gap.start),
        }
        for gap in answer.gaps
    ]
    lists: dict[str, list[JsonValue]] = {
        "gaps": gaps,
        "active": _files(answer.active, bag_dir),
        "damaged": _files(answer.damaged, bag_dir),
        "incomplete": _files(answer.incomplete, bag_dir),
        "unread": _files(answer.unread, bag_dir),
        "clock_faults": _files(answer.clock_faults, bag_dir),
        "undecodable": [
            {"topic": each.topic, "type": each.type, "reason": each.reason}
            for each in answer.undecodable
        ],
    }
    for name, rows in lists.items():
        if len(rows) > _NEWEST_LISTED:
            notes.append(f"{name}: the last {_NEWEST_LISTED} of {len(rows)} are listed")
    reply: JsonObject = {
        "earliest": moment(answer.earliest),
        "latest": moment(answer.latest),
        "earliest_local": local(answer.earliest),
        "latest_local": local(answer.latest),
        "now": moment(answer.now),
        "now_local": local(answer.now),
        "bags": answer.bags,
    }
    for name, rows in lists.items():
        reply[name] = rows[-_NEWEST_LISTED:]
        if len(rows) > _NEWEST_LISTED:
            reply[f"{name}_count"] = len(rows)
    reply["silent_topics"] = answer.silent_topics
    return with_notes(reply, notes)


def _files(files: Sequence[SetAside], bag_dir: Path) -> list[JsonValue]:
    return [{"file": file_name(file.path, bag_dir), "reason": file.reason} for file in files]


def file_name(path: Path | str, bag_dir: Path) -> str:
    """A bag as the operator finds it below the bag directory; never a path of the machine."""
    bag = Path(path)
    return str(bag.relative_to(bag_dir)) if bag.is_relative_to(bag_dir) else bag.name


def _topic_row(row: results.TopicRow) -> JsonObject:
    return {
        "topic": row.topic,
        "type": row.type,
        "first_ts": unix_rounded_up(row.first),
        "last_ts": unix_rounded_up(row.last),
        "count": row.count,
    }


@shown.register(results.TopicValue)
def _topic_value(answer: results.TopicValue, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "topic": answer.topic,
        "type": answer.type,
        "timestamp": unix_rounded_up(answer.sample.time),
        "value": answer.sample.value,
    }
    if answer.latched:
        reply["latched"] = True
    return _finished(reply, answer.age, answer.notes)


@shown.register(results.TopicRange)
def _topic_range(answer: results.TopicRange, _bag_dir: Path) -> JsonObject:
    reply = _range_of(answer, [sample.value for sample in answer.samples], answer.notes)
    if len(to_json_text(reply)) <= ZEROS_SHOWN_BELOW_CHARS:
        return reply
    values, zeros = without_constant_zeros([sample.value for sample in answer.samples])
    if not zeros:
        return reply
    more = len(zeros) - _MOST_ZEROS_NAMED
    named = ", ".join(zeros[:_MOST_ZEROS_NAMED]) + (f" and {more} more" if more > 0 else "")
    note = f"0 in every sample and left out: {named}"
    return _range_of(answer, values, (*answer.notes, note))


def _range_of(
    answer: results.TopicRange, values: Sequence[JsonValue], notes: Sequence[str]
) -> JsonObject:
    samples: list[JsonValue] = [
        {"timestamp": unix_rounded_up(sample.time), "value": value}
        for sample, value in zip(answer.samples, values, strict=True)
    ]
    reply: JsonObject = {
        "topic": answer.topic,
        "type": answer.type,
        "total": answer.total,
        "samples": samples,
    }
    if answer.extremes:
        reply["extremes"] = {each.field: _extremes(each) for each in answer.extremes}
    return with_notes(reply, notes)


def _extremes(extremes: results.Extremes) -> JsonObject:
    return {
        "min": rounded(extremes.least, 6),
        "min_at": unix_rounded_up(extremes.least_at),
        "max": rounded(extremes.most, 6),
        "max_at": unix_rounded_up(extremes.most_at),
    }


@shown.register(results.Position)
def _position(answer: results.Position, _bag_dir: Path) -> JsonObject:
    pose = answer.pose
    unit = None if pose.orientation is None else normalised(pose.orientation)
    reply: JsonObject = {
        **metres(pose.position),
        "yaw_deg": degrees(None if unit is None else yaw(unit)),
        **({} if answer.geodetic is None else _geodetic(answer.geodetic)),
        "timestamp": unix_rounded_up(answer.time),
        "topic": answer.topic,
        "frame_id": pose.frame_id or None,
    }
    return _finished(reply, answer.age, answer.notes)


def _geodetic(place: Geodetic) -> JsonObject:
    return {
        "latitude": rounded(place.latitude, 8),
        "longitude": rounded(place.longitude, 8),
        "altitude": rounded(place.altitude, 4),
    }


@shown.register(results.Velocity)
def _velocity(answer: results.Velocity, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "linear": metres(answer.twist.linear),
        "angular": metres(answer.twist.angular),
        "timestamp": unix_rounded_up(answer.time),
        "topic": answer.topic,
        "frame_id": answer.twist.frame_id or None,
    }
    return _finished(reply, answer.age, answer.notes)


@shown.register(results.TransformAt)
def _transform(answer: results.TransformAt, _bag_dir: Path) -> JsonObject:
    rotation = _upright(answer.transform.rotation)
    reply: JsonObject = {
        "translation": metres(answer.transform.translation),
        "rotation": {name: rounded(part, 6) for name, part in zip("xyzw", rotation, strict=True)},
        "yaw_deg": degrees(yaw(rotation)),
        "timestamp": unix_rounded_up(answer.time),
        "parent": answer.parent,
        "child": answer.child,
        "clock": answer.clock,
    }
    return _finished(reply, answer.age, answer.notes)


@shown.register(results.Frames)
def _frames(answer: results.Frames, _bag_dir: Path) -> JsonObject:
    edges = sorted(answer.edges, key=lambda edge: (edge.parent, edge.child))
    names: list[JsonValue] = [
        *sorted({name for edge in edges for name in (edge.parent, edge.child)})
    ]
    reply: JsonObject = {
        "frames": names,
        "transforms": [
            {"parent": edge.parent, "child": edge.child, "static": edge.static} for edge in edges
        ],
    }
    return with_notes(reply, answer.notes)


@shown.register(results.Match)
def _match(answer: results.Match, _bag_dir: Path) -> JsonObject | None:
    if answer.found is None:
        return _no_match(answer.notes)
    found = answer.found
    reply: JsonObject = {
        "timestamp": unix_rounded_up(found.sample.time),
        "value": found.sample.value,
        "topic": found.topic,
        "type": found.type,
    }
    return _finished(reply, found.age, _once(found.notes, answer.notes))


@shown.register(results.ValueWhen)
def _value_when(answer: results.ValueWhen, _bag_dir: Path) -> JsonObject | None:
    matched, held = answer.matched, answer.value
    if matched is None:
        return _no_match(answer.notes)
    reply: JsonObject = {
        "timestamp": unix_rounded_up(matched.sample.time),
        "matched": matched.sample.value,
        "value": None if held is None else held.sample.value,
        "value_timestamp": None if held is None else unix_rounded_up(held.sample.time),
        "condition_topic": matched.topic,
        "value_topic": None if held is None else held.topic,
    }
    if held is not None and held.latched:
        reply |= {"value_latched": True, "value_age_s": seconds(held.age or 0)}
    notes = _once(matched.notes, () if held is None else held.notes, answer.notes)
    return _finished(reply, matched.age, notes)


def _no_match(notes: Sequence[str]) -> JsonObject | None:
    """`null` after a complete search; a search that could not look everywhere says so instead."""
    return with_notes({"timestamp": None, "value": None}, notes) if notes else None


@shown.register(results.TrajectorySummary)
def _trajectory(answer: results.TrajectorySummary, _bag_dir: Path) -> JsonObject:
    way = answer.trajectory
    known = way.is_known
    reply: JsonObject = {
        "distance_m": rounded(way.distance_m, 4) if known else None,
        "avg_speed": rounded(way.avg_speed, 4) if known else None,
        "max_speed": rounded(way.max_speed, 4) if known else None,
        "duration_s": rounded(way.duration_s, 3) if known else None,
        "waypoints": [
            {
                "timestamp": unix_rounded_up(point.time),
                **metres(point.position),
                "yaw_deg": degrees(point.yaw_rad),
                **({"jump": True} if point.jump else {}),
            }
            for point in way.waypoints
        ],
        "topic": answer.topic,
        "frame_id": answer.frame_id or None,
        "start": unix_rounded_up(answer.start),
        "end": unix_rounded_up(answer.end),
        "poses": way.poses,
        **({"path_sum_m": rounded(way.path_sum_m, 4)} if way.is_noisy else {}),
        **({"gap_m": rounded(way.gap_m, 4)} if way.gaps else {}),
    }
    return with_notes(reply, (*answer.notes, *_notes_of_way(way)))


def _notes_of_way(way: Trajectory) -> Iterator[str]:
    yield from length_notes(way)
    if way.jumps:
        drawn = sum(point.jump for point in way.waypoints)
        if drawn:
            longest = "the longest lead" if drawn < way.jumps else "each leads"
            yield f"of the jumps {longest} to a waypoint with jump: true; no way was driven there"
    if way.poses and way.max_speed_from == "positions":
        yield "max_speed is measured from positions: the messages state no speed"
    # Beyond what the rounding of both may come to.
    if way.avg_speed > way.max_speed + 0.01:
        yield (
            "avg_speed, by the positions, is above max_speed, which the messages state: "
            "one of the two is wrong"
        )
    if way.waypoint_error_m > FINE_PATH_M:
        yield f"the path lies within {way.waypoint_error_m:.2f} m of the waypoints' line"


def _finished(reply: JsonObject, age: Ns | None, notes: Sequence[str]) -> JsonObject:
    aged = reply if age is None else {**reply, "age_s": seconds(age)}
    return with_notes(aged, notes)


def _once(*notes: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(note for some in notes for note in some))


def _upright(rotation: Quaternion) -> Quaternion:
    """Of the two quaternions of one rotation the one with w >= 0."""
    x, y, z, w = rotation
    return (-x, -y, -z, -w) if w < 0 else rotation
