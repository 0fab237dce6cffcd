"""Replies about topics as JSON: what was recorded, when a condition held, what happened."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.text import listed, shortened
from ros2_memory.core.timebase import Ns, unix_from_ns, unix_rounded_up
from ros2_memory.tools.reply_json import (
    ROBOT_NAME,
    LocalTimes,
    inside,
    metres,
    moment,
    planar_pose,
    render,
    rounded,
    seconds,
    total,
    with_notes,
)
from ros2_memory.tools.reply_size import to_json_text, without_constant_zeros

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.tools.reply_size import JsonObject

ZEROS_SHOWN_BELOW_CHARS: Final = 4000
"""A range shorter than this keeps its constant zeros: there is room, and whole values read best."""

_LONGEST_LAST_ROW_CHARS: Final = 200
"""Characters of the row that sums up those left out, whatever its numbers."""
MOST_MATCHED: Final = 5
LONGEST_MATCHED: Final = 200
"""Texts that matched in one message, and characters of each."""
_MAX_ZEROS_NAMED: Final = 20


def fit_topics(
    rows: Sequence[results.TopicRow], max_chars: int, robot_name: str | None = None
) -> str:
    """Returns the list of topics as JSON text of at most `max_chars` characters.

    Each row has the name of the robot, if there is one.

    It is always a list of rows. Where it would be longer, the busiest topics come first, and the
    last row sums up those left out: their first and last time and all their messages. `max_chars`
    must be at least 500.
    """
    name: JsonObject = {} if robot_name is None else {ROBOT_NAME: robot_name}
    text = to_json_text([name | topic_row(row) for row in rows])
    if len(text) <= max_chars:
        return text
    busiest = sorted(rows, key=lambda row: -row.count)
    shown: list[JsonValue] = [name | topic_row(row) for row in busiest]
    sizes = accumulate(len(to_json_text(row)) + 1 for row in shown)
    longest = _LONGEST_LAST_ROW_CHARS + len(to_json_text(name))
    fitting = sum(size <= max_chars - longest for size in sizes)
    rest = busiest[fitting:]
    others = results.TopicRow(
        f"({len(rest)} more: use pattern)",
        "",
        min(row.first for row in rest),
        max(row.last for row in rest),
        sum(row.count for row in rest),
    )
    return to_json_text([*shown[:fitting], name | topic_row(others)])


def topic_row(row: results.TopicRow) -> JsonObject:
    """Returns the row of a topic in the list of all."""
    return {
        "topic": row.topic,
        "type": row.type,
        "first_ts": unix_rounded_up(row.first),
        "last_ts": unix_rounded_up(row.last),
        "count": row.count,
    }


@render.register(results.TopicValue)
def _topic_value(answer: results.TopicValue) -> JsonObject:
    reply: JsonObject = {
        "topic": answer.topic,
        "type": answer.type,
        "timestamp": unix_rounded_up(answer.sample.time),
        "value": answer.sample.value,
    }
    return with_notes(reply, answer.notes, answer.age, latched=answer.latched)


@render.register(results.TopicRange)
def _topic_range(answer: results.TopicRange) -> JsonObject:
    if answer.fields:
        return _columns(answer)
    reply = _range_of(answer, [sample.value for sample in answer.samples], answer.notes)
    if len(to_json_text(reply)) <= ZEROS_SHOWN_BELOW_CHARS:
        return reply
    values, zeros = without_constant_zeros([sample.value for sample in answer.samples])
    if not zeros:
        return reply
    note = f"0 in every sample and left out: {listed(zeros, at_most=_MAX_ZEROS_NAMED)}"
    return _range_of(answer, values, (*answer.notes, note))


def _range_of(
    answer: results.TopicRange, values: Sequence[JsonValue], notes: Sequence[str]
) -> JsonObject:
    reply: JsonObject = {
        "topic": answer.topic,
        "type": answer.type,
        "total": answer.total,
        "samples": [
            {"timestamp": unix_rounded_up(sample.time), "value": value}
            for sample, value in zip(answer.samples, values, strict=True)
        ],
    }
    return with_notes(reply, notes)


def _columns(answer: results.TopicRange) -> JsonObject:
    """Returns a range with a row for each sample: its time, and a cell for each field.

    A field that holds an object becomes a column for each of its parts; a cell is null where a
    sample has no such part.
    """
    cells = [
        dict(_cells("", sample.value) if isinstance(sample.value, dict) else ())
        for sample in answer.samples
    ]
    columns = [*dict.fromkeys(name for each in cells for name in each)]
    reply: JsonObject = {
        "topic": answer.topic,
        "type": answer.type,
        "total": answer.total,
        "fields": ["timestamp", *columns],
        "rows": [
            [unix_rounded_up(sample.time), *(each.get(name) for name in columns)]
            for sample, each in zip(answer.samples, cells, strict=True)
        ],
    }
    if answer.extremes:
        local = LocalTimes(answer.samples[0].time, answer.samples[-1].time)
        reply["extremes"] = {each.field: _extremes(each, local) for each in answer.extremes}
    return with_notes(reply, answer.notes)


def _cells(path: str, value: JsonValue) -> Iterator[tuple[str, JsonValue]]:
    """Yields the parts of a value that are no objects with parts, by their dot-paths."""
    if not isinstance(value, dict) or not value:
        yield path, value
        return
    for name, part in value.items():
        yield from _cells(f"{path}.{name}" if path else name, part)


def _extremes(extremes: results.Extremes, local: LocalTimes) -> JsonObject:
    at_least, at_most = local.of(extremes.least_at), local.of(extremes.most_at)
    return {
        "min": rounded(extremes.least, 6),
        "min_at": unix_rounded_up(extremes.least_at),
        "max": rounded(extremes.most, 6),
        "max_at": unix_rounded_up(extremes.most_at),
        **{f"min_{key}": text for key, text in at_least.items()},
        **{f"max_{key}": text for key, text in at_most.items()},
    }


@render.register(results.TypeFields)
def _type_fields(answer: results.TypeFields) -> JsonObject:
    reply: JsonObject = {
        "type": answer.type,
        "topics": [*answer.topics],
        "fields": dict(answer.fields),
    }
    return with_notes(reply, answer.notes)


@render.register(results.Match)
def _match(answer: results.Match) -> JsonObject | None:
    if answer.found is None:
        return _no_match(answer.notes)
    found = answer.found
    reply: JsonObject = {
        "timestamp": unix_rounded_up(found.sample.time),
        **LocalTimes(found.sample.time, found.sample.time + (found.age or 0)).of(found.sample.time),
        "value": found.sample.value,
        "topic": found.topic,
        "type": found.type,
    }
    if found.frame_id:
        reply["frame_id"] = found.frame_id
    return with_notes(reply, _distinct(found.notes, answer.notes), found.age)


@render.register(results.ValueWhen)
def _value_when(answer: results.ValueWhen) -> JsonObject | None:
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
    if matched.frame_id:
        reply["matched_frame_id"] = matched.frame_id
    if held is not None and held.frame_id:
        reply["frame_id"] = held.frame_id
    if held is not None and held.latched:
        reply |= {"value_latched": True, "value_age_s": seconds(held.age or 0)}
    notes = _distinct(matched.notes, () if held is None else held.notes, answer.notes)
    return with_notes(reply, notes, matched.age)


def _no_match(notes: Sequence[str]) -> JsonObject | None:
    """Returns None after a complete search, and the notes after one that could not read all."""
    return with_notes({"timestamp": None, "value": None}, notes) if notes else None


def _distinct(*notes: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(note for some in notes for note in some))


@render.register(results.Sightings)
def _sightings(answer: results.Sightings) -> JsonObject:
    oldest = min((each.first for each in answer.sightings), default=answer.start)
    local = LocalTimes(oldest, answer.now)
    reply: JsonObject = {
        "sightings": [_sighting(each, answer.now, local) for each in answer.sightings],
        **total(answer.total, len(answer.sightings)),
        "searched_from": moment(answer.start),
        "searched_to": moment(answer.end),
        **local.of(answer.start, answer.end),
    }
    return with_notes(reply, answer.notes, more=answer.more)


def _sighting(sighting: results.Sighting, now: Ns, local: LocalTimes) -> JsonObject:
    robot = sighting.robot
    reply: JsonObject = {
        "topic": sighting.topic,
        "first_seen": unix_rounded_up(sighting.first),
        "last_seen": unix_rounded_up(sighting.last),
        **local.of(sighting.first, sighting.last),
        "duration_s": seconds(sighting.last - sighting.first - sighting.skipped),
        "ago_s": seconds(now - sighting.last),
        **({"count": sighting.messages} if sighting.messages else {}),
        "robot": None
        if robot is None
        else {
            "at": "first_seen" if sighting.robot_at_first else "last_seen",
            **planar_pose(robot),
            "frame_id": robot.frame_id or None,
        },
    }
    if sighting.matched:
        reply["matched"] = [
            shortened(each, LONGEST_MATCHED) for each in sighting.matched[:MOST_MATCHED]
        ]
        if len(sighting.matched) > MOST_MATCHED:
            reply["matched_count"] = len(sighting.matched)
    if sighting.value is not None:
        reply["value"] = sighting.value
    if sighting.thing is not None:
        spot = sighting.thing
        reply["place"] = {**metres(spot.position), "frame_id": spot.frame_id or None}
    if sighting.score is not None:
        reply["score"] = rounded(sighting.score, 3)
    return with_notes(reply, (), began_earlier=not sighting.begun)


@render.register(results.Recap)
def _recap(answer: results.Recap) -> JsonObject:
    local = LocalTimes(answer.start, answer.end)
    reply: JsonObject = {
        "start": moment(answer.start),
        "end": moment(answer.end),
        **LocalTimes(answer.start, answer.now).of(answer.start, answer.end),
        "duration_s": seconds(answer.end - answer.start - answer.skipped),
        "distance_m": None if answer.distance_m is None else rounded(answer.distance_m, 3),
        "max_speed": None if answer.max_speed is None else rounded(answer.max_speed, 3),
        "stood_s": None if answer.stood is None else seconds(answer.stood),
        "shortest_stop_s": seconds(answer.shortest_stop),
        **_there(answer),
        "frame_id": answer.frame_id or None,
        "events": [_event(each, answer.now, local) for each in answer.events],
    }
    if answer.throughout:
        reply["seen_throughout"] = [*answer.throughout]
    reply["counts"] = dict(answer.counts)
    if answer.path_sum_m is not None:
        reply["path_sum_m"] = rounded(answer.path_sum_m, 3)
    if answer.gap_m is not None:
        reply["gap_m"] = rounded(answer.gap_m, 3)
    return with_notes(reply, answer.notes)


def _there(answer: results.Recap) -> JsonObject:
    if answer.where is None:
        return {}
    return {"where": answer.where, "visits": answer.visits, "inside_s": seconds(answer.inside)}


def _event(event: results.Event, now: Ns, local: LocalTimes) -> JsonObject:
    reply: JsonObject = {
        "timestamp": moment(event.start),
        **local.of(event.start, event.end),
        "ago_s": round(seconds(now - event.start), 1),
        "text": event.text,
    }
    if event.end is not None:
        reply["duration_s"] = seconds(event.end - event.start - event.skipped)
    reply |= inside(event.places)
    if event.score is not None:
        reply["score"] = rounded(event.score, 4)
    if event.before:
        reply["before"] = _changes(event.before)
    return with_notes(reply, (), goes_on=event.goes_on)


def _changes(changes: Sequence[results.PastChange]) -> list[JsonValue]:
    return [{"text": each.text, "s_before": round(seconds(each.before), 1)} for each in changes]


@render.register(results.Before)
def _before(answer: results.Before) -> JsonObject:
    reply: JsonObject = {
        "around": round(unix_from_ns(answer.at), 6),
        "seconds_before": seconds(answer.length),
        "before": _changes(answer.changes),
    }
    if answer.more:
        reply["more"] = answer.more
    reply["after"] = [
        {"text": each.text, "s_after": round(seconds(-each.before), 1)} for each in answer.after
    ]
    reply["looked_at"] = [*answer.looked_at]
    reply["recorded_topics"] = answer.recorded
    if answer.robot is not None:
        robot = {**planar_pose(answer.robot), "frame_id": answer.robot.frame_id or None}
        if answer.speed_mps is not None:
            robot["speed_mps"] = rounded(answer.speed_mps, 3)
        reply["robot"] = robot
    reply["state"] = dict(answer.state)
    return with_notes(reply, answer.notes)
