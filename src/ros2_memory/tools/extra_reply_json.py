"""The answers of `results` as JSON values; names, units and rounding are those of `shapes`.

Whatever has a time also says how long before now that was, so that nobody has to subtract.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.timebase import unix_rounded_up
from ros2_memory.tools.figures import (
    degrees,
    metres,
    moment,
    rounded,
    seconds,
    with_notes,
)
from ros2_memory.tools.reply_json import shown

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import Pose
    from ros2_memory.core.timebase import Ns
    from ros2_memory.tools.reply_size import JsonObject


__all__ = ["robot", "shown"]

_MOST_TOPICS: Final = 10


@shown.register(results.Sightings)
def _sightings(answer: results.Sightings, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "sightings": [_sighting(each, answer.now) for each in answer.sightings],
        "total": answer.total,
        "searched_from": moment(answer.start),
        "searched_to": moment(answer.end),
    }
    if answer.more:
        reply["more"] = True
    return with_notes(reply, answer.notes)


def _sighting(sighting: results.Sighting, now: Ns) -> JsonObject:
    reply: JsonObject = {
        "topic": sighting.topic,
        "first_seen": unix_rounded_up(sighting.first),
        "last_seen": unix_rounded_up(sighting.last),
        "duration_s": seconds(sighting.last - sighting.first),
        "ago_s": seconds(now - sighting.last),
        "count": sighting.messages,
        "robot": None if sighting.robot is None else robot(sighting.robot),
    }
    if sighting.thing is not None:
        spot = sighting.thing
        reply["place"] = {**metres(spot.position), "frame_id": spot.frame_id or None}
    if not sighting.begun:
        reply["began_earlier"] = True
    return reply


@shown.register(results.Recap)
def _recap(answer: results.Recap, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "start": moment(answer.start),
        "end": moment(answer.end),
        "duration_s": seconds(answer.end - answer.start),
        "distance_m": None if answer.distance_m is None else rounded(answer.distance_m, 3),
        "max_speed": None if answer.max_speed is None else rounded(answer.max_speed, 3),
        "stood_s": None if answer.stood is None else seconds(answer.stood),
        "shortest_stop_s": seconds(answer.shortest_stop),
        "frame_id": answer.frame_id or None,
        "events": [_event(each, answer.now) for each in answer.events],
    }
    if answer.throughout:
        reply["seen_throughout"] = [*answer.throughout]
    reply["counts"] = dict(answer.counts)
    if answer.path_sum_m is not None:
        reply["path_sum_m"] = rounded(answer.path_sum_m, 3)
    if answer.gap_m is not None:
        reply["gap_m"] = rounded(answer.gap_m, 3)
    return with_notes(reply, answer.notes)


def _event(event: results.Event, now: Ns) -> JsonObject:
    shown_event: JsonObject = {
        "timestamp": moment(event.start),
        "ago_s": round(seconds(now - event.start), 1),
        "text": event.text,
    }
    if event.end is not None:
        shown_event["duration_s"] = round(seconds(event.end - event.start), 3)
    if event.goes_on:
        shown_event["goes_on"] = True
    return shown_event


@shown.register(results.Visits)
def _visits(answer: results.Visits, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "frame_id": answer.frame_id or None,
        "x": answer.x,
        "y": answer.y,
        "radius_m": answer.radius_m,
        "there_now": any(each.departed is None for each in answer.visits),
        "visits": [_visit(each, answer.now) for each in answer.visits],
        "total": answer.total,
    }
    if answer.more:
        reply["more"] = True
    return with_notes(reply, answer.notes)


def _visit(visit: results.Visit, now: Ns) -> JsonObject:
    reply: JsonObject = {
        "arrived": moment(visit.arrived),
        "departed": moment(visit.departed),
        "duration_s": seconds(visit.duration),
        "closest_m": rounded(visit.closest_m, 3),
        "closest_at": moment(visit.closest_at),
        "ago_s": 0.0 if visit.departed is None else seconds(now - visit.departed),
    }
    if visit.restarts:
        reply["restarts_since"] = visit.restarts
    return reply


@shown.register(results.TypeFields)
def _type_fields(answer: results.TypeFields, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {
        "type": answer.type,
        "topics": [*answer.topics],
        "fields": dict(answer.fields),
    }
    return with_notes(reply, answer.notes)


@shown.register(results.Status)
def _status(answer: results.Status, _bag_dir: Path) -> JsonObject:
    latest = answer.latest
    reply: JsonObject = {
        "trust": "; ".join(answer.problems) or "nothing is known to be missing",
        "recorder": answer.recorder,
        "recorder_alive": answer.live,
        "restarts": answer.restarts,
        "now": moment(answer.now),
        "earliest": moment(answer.earliest),
        "latest": moment(latest),
        "newest_age_s": None if latest is None else seconds(answer.now - latest),
        "fell_silent": [
            {
                "topic": each.topic,
                "last_ts": moment(each.last),
                "ago_s": seconds(answer.now - each.last),
            }
            for each in answer.fell_silent[:_MOST_TOPICS]
        ],
        "never_heard": [*answer.never_heard[:_MOST_TOPICS]],
        "missing": [*answer.missing[:_MOST_TOPICS]],
        "damaged": answer.damaged,
        "incomplete": answer.incomplete,
        "unread": answer.unread,
        "budget": _budget(answer),
    }
    counts = {
        "fell_silent": len(answer.fell_silent),
        "never_heard": len(answer.never_heard),
        "missing": len(answer.missing),
    }
    reply |= {f"{name}_count": n for name, n in counts.items() if n > _MOST_TOPICS}
    return with_notes(reply, answer.notes)


def _budget(answer: results.Status) -> JsonObject:
    """Gigabytes, and for how many days they last: what is older is deleted then.

    `foreign_gb` is what bags take that the recorder did not make; the others leave it out.
    """
    budget, gigabyte = answer.budget, 1e9
    most, per_day = budget.most, budget.per_day
    shown_budget: JsonObject = {
        "used_gb": round(budget.used / gigabyte, 3),
        "max_gb": None if most is None else round(most / gigabyte, 3),
        "foreign_gb": None if budget.foreign is None else round(budget.foreign / gigabyte, 3),
        "growth_gb_per_day": None if per_day is None else round(per_day / gigabyte, 3),
    }
    if most is not None and per_day:
        shown_budget["full_in_days"] = round(max(most - budget.used, 0) / per_day, 2)
        kept = most / per_day
        aged = kept if budget.max_age is None else seconds(budget.max_age) / 86_400
        shown_budget["keeps_days"] = round(min(kept, aged), 2)
    return shown_budget


@shown.register(results.Remembered)
def _remembered(answer: results.Remembered, _bag_dir: Path) -> JsonObject:
    return {
        "moment": answer.moment,
        "label": answer.label,
        "start": moment(answer.start),
        "end": moment(answer.end),
        "bags": answer.bags,
        "pending": answer.pending,
    }


@shown.register(results.KeptMoments)
def _kept_moments(answer: results.KeptMoments, _bag_dir: Path) -> JsonObject:
    reply: JsonObject = {"moments": [_kept(each, answer.now) for each in answer.moments]}
    if answer.more:
        reply["more"] = answer.more
    return reply


def _kept(kept: results.KeptMoment, now: Ns) -> JsonObject:
    shown_moment: JsonObject = {
        "moment": kept.moment,
        "label": kept.label,
        "start": moment(kept.start),
        "end": moment(kept.end),
        "ago_s": seconds(now - kept.end),
        "bags": kept.bags,
        "size_gb": round(kept.size / 1e9, 6),
        "complete": not (kept.pending or kept.missing),
    }
    if kept.pending:
        shown_moment["pending"] = True
    return with_notes(shown_moment, kept.missing)


def robot(pose: Pose) -> JsonObject:
    """Where the robot was, and how it stood."""
    unit = None if pose.orientation is None else normalised(pose.orientation)
    return {
        **metres(pose.position),
        "yaw_deg": degrees(None if unit is None else yaw(unit)),
        "frame_id": pose.frame_id or None,
    }
