"""Replies about motion as JSON: poses, velocities, transforms, paths, visits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.geometry import yaw
from ros2_memory.core.timebase import Ns, unix_from_ns, unix_rounded_up
from ros2_memory.history.driven_path import length_notes
from ros2_memory.tools.reply_json import (
    LocalTimes,
    degrees,
    metres,
    moment,
    planar_pose,
    render,
    rounded,
    seconds,
    total,
    with_notes,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.motion.trajectory import Trajectory, Waypoint
    from ros2_memory.core.model import Geodetic, JsonValue
    from ros2_memory.tools.reply_size import JsonObject

FINE_PATH_M: Final = 0.05 + 1e-9
"""The deviation that a simplified path is expected to have; a larger one is noted."""


@render.register(results.Position)
def _position(answer: results.Position) -> JsonObject:
    reply: JsonObject = {
        **planar_pose(answer.pose),
        **({} if answer.geodetic is None else _geodetic(answer.geodetic)),
        "timestamp": unix_rounded_up(answer.time),
        "topic": answer.topic,
        "frame_id": answer.pose.frame_id or None,
    }
    return with_notes(reply, answer.notes, answer.age)


def _geodetic(position: Geodetic) -> JsonObject:
    return {
        "latitude": rounded(position.latitude, 8),
        "longitude": rounded(position.longitude, 8),
        "altitude": rounded(position.altitude, 4),
    }


@render.register(results.Velocity)
def _velocity(answer: results.Velocity) -> JsonObject:
    reply: JsonObject = {
        "linear": metres(answer.twist.linear),
        "angular": metres(answer.twist.angular),
        "timestamp": unix_rounded_up(answer.time),
        "topic": answer.topic,
        "frame_id": answer.twist.frame_id or None,
    }
    return with_notes(reply, answer.notes, answer.age)


@render.register(results.TransformAt)
def _transform(answer: results.TransformAt) -> JsonObject:
    x, y, z, w = answer.transform.rotation
    # Of the two quaternions of one rotation, the one with w >= 0.
    rotation = (-x, -y, -z, -w) if w < 0 else (x, y, z, w)
    reply: JsonObject = {
        "translation": metres(answer.transform.translation),
        "rotation": {name: rounded(part, 6) for name, part in zip("xyzw", rotation, strict=True)},
        "yaw_deg": degrees(yaw(rotation)),
        "timestamp": unix_rounded_up(answer.time),
        "parent": answer.parent,
        "child": answer.child,
        "clock": answer.clock,
    }
    return with_notes(reply, answer.notes, answer.age)


@render.register(results.Frames)
def _frames(answer: results.Frames) -> JsonObject:
    edges = sorted(answer.edges, key=lambda edge: (edge.parent, edge.child))
    reply: JsonObject = {
        "frames": [*sorted({name for edge in edges for name in (edge.parent, edge.child)})],
        "transforms": [
            {"parent": edge.parent, "child": edge.child, "static": edge.static} for edge in edges
        ],
    }
    return with_notes(reply, answer.notes)


@render.register(results.TrajectorySummary)
def _trajectory(answer: results.TrajectorySummary) -> JsonObject:
    path = answer.trajectory
    known = path.is_known
    duration_s = path.totals.duration_s - unix_from_ns(answer.skipped)
    recorded_s = duration_s - unix_from_ns(answer.unrecorded)
    reply: JsonObject = {
        "distance_m": rounded(path.totals.distance_m, 4) if known else None,
        "avg_speed": rounded(path.avg_speed, 4) if known else None,
        "max_speed": rounded(path.max_speed, 4) if known else None,
        "duration_s": rounded(duration_s, 3) if known else None,
        **({"recorded_s": rounded(recorded_s, 3)} if known and answer.unrecorded else {}),
        "waypoints": _waypoints(path.waypoints, "jump"),
        "topic": answer.topic,
        "frame_id": answer.frame_id or None,
        "start": unix_rounded_up(answer.start),
        "end": unix_rounded_up(answer.end),
        **LocalTimes(answer.start, answer.end).of(answer.start, answer.end),
        "poses": path.poses,
        **({"path_sum_m": rounded(path.totals.path_sum_m, 4)} if path.is_noisy else {}),
        **({"gap_m": rounded(path.totals.gap_m, 4)} if path.totals.gaps else {}),
    }
    return with_notes(reply, (*answer.notes, *_path_notes(path)))


@render.register(results.DrivenInside)
def _driven_inside(answer: results.DrivenInside) -> JsonObject:
    lasted = seconds(answer.duration)
    reply: JsonObject = {
        "where": answer.where,
        "distance_m": rounded(answer.distance_m, 4),
        "avg_speed": rounded(answer.distance_m / lasted if lasted else 0.0, 4),
        "max_speed": rounded(answer.max_speed, 4),
        "duration_s": lasted,
        "visits": answer.visits,
        "start": moment(answer.start),
        "end": moment(answer.end),
        **LocalTimes(answer.start, answer.end).of(answer.start, answer.end),
        "waypoints": _waypoints(answer.waypoints, "entered"),
        "topic": answer.topic,
        "frame_id": answer.frame_id or None,
    }
    return with_notes(reply, answer.notes)


def _waypoints(waypoints: Sequence[Waypoint], mark: str) -> list[JsonValue]:
    """Returns waypoints; `mark` is the key of those that no drawn way leads to."""
    return [
        {
            "timestamp": unix_rounded_up(point.time),
            **metres(point.position),
            "yaw_deg": degrees(point.yaw_rad),
            **({mark: True} if point.jump else {}),
        }
        for point in waypoints
    ]


def _path_notes(path: Trajectory) -> Iterator[str]:
    yield from length_notes(path)
    if path.totals.jumps:
        drawn = sum(point.jump for point in path.waypoints)
        if drawn:
            longest = "the longest lead" if drawn < path.totals.jumps else "each leads"
            yield (
                f"of the jumps {longest} to a waypoint with jump: true; "
                "that distance was not driven"
            )
    if path.poses and path.max_speed_from == "positions":
        yield "max_speed is measured from positions: the messages have no speed"
    # By more than the rounding of both.
    if path.avg_speed > path.max_speed + 0.01:
        yield (
            "avg_speed, by the positions, is above max_speed of the messages: "
            "one of the two is wrong"
        )
    if path.waypoint_error_m > FINE_PATH_M:
        yield f"the path is within {path.waypoint_error_m:.2f} m of the waypoints' line"


@render.register(results.Visits)
def _visits(answer: results.Visits) -> JsonObject:
    frame: JsonObject = {"frame_id": answer.frame_id or None}
    if answer.places is not None:
        places: JsonObject = {**frame, "places": [_place_visits(each) for each in answer.places]}
        return with_notes(places, answer.notes)
    circle: JsonObject = {"x": answer.x, "y": answer.y, "radius_m": answer.radius_m}
    known = (at for each in answer.visits for at in (each.arrived, each.departed) if at is not None)
    local = LocalTimes(min(known, default=None), answer.now)
    reply: JsonObject = {
        **frame,
        **({} if answer.where is None else {"where": answer.where}),
        **({} if answer.radius_m is None else circle),
        "there_now": any(each.departed is None for each in answer.visits),
        "visits": [_visit(each, answer.now, local) for each in answer.visits],
        **total(answer.total if answer.all_counted else None, answer.total),
        **({} if answer.entries is None else {"entries": answer.entries, "exits": answer.exits}),
        "minutes": _minutes(answer.duration),
    }
    return with_notes(reply, answer.notes, more=answer.more)


def _place_visits(place: results.PlaceVisits) -> JsonObject:
    seen = {"first_entry": moment(place.first), "last_exit": moment(place.last)}
    return {
        "place": place.place,
        "minutes": _minutes(place.duration),
        "entries": place.entries,
        "exits": place.exits,
        **{name: at for name, at in seen.items() if at is not None},
    }


def _minutes(duration: Ns) -> float:
    return round(duration / 60e9, 2)


def _closest(visit: results.Visit) -> JsonObject:
    return {
        "closest_m": rounded(visit.closest_m or 0.0, 3),
        "closest_at": moment(visit.closest_at),
    }


def _visit(visit: results.Visit, now: Ns, local: LocalTimes) -> JsonObject:
    reply: JsonObject = {
        "arrived": moment(visit.arrived),
        "departed": moment(visit.departed),
        **local.of(visit.arrived, visit.departed),
        "duration_s": seconds(visit.duration),
        **({} if visit.closest_m is None else _closest(visit)),
        "ago_s": 0.0 if visit.departed is None else seconds(now - visit.departed),
    }
    for name in ("already_inside", "still_inside"):
        if getattr(visit, name):
            reply[name] = True
    if visit.restarts:
        reply["restarts_since"] = visit.restarts
    return reply
