"""Replies about things as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.text import shortened
from ros2_memory.tools.reply_json import degrees, moment, render, rounded, seconds, with_notes

if TYPE_CHECKING:
    from ros2_memory.core.model import Vector3
    from ros2_memory.tools.reply_size import JsonObject

_MOST_MOVED: Final = 10
_MOST_COMPARED: Final = 5
_LONGEST_NAME: Final = 100
"""Characters of the text of an error."""
_LONGEST_LABEL: Final = 40


@render.register(results.Things)
def _things(answer: results.Things) -> JsonObject:
    reply: JsonObject = {
        "frame_id": answer.frame_id or None,
        "things": [_thing(each, answer) for each in answer.things],
        "total": answer.total,
        "labels": dict(answer.labels),
    }
    return with_notes(reply, answer.notes)


def _thing(thing: results.Thing, answer: results.Things) -> JsonObject:
    reply: JsonObject = {"label": thing.label}
    if thing.also_seen_as:
        reply["also_seen_as"] = [*thing.also_seen_as]
    if thing.at_once is not None:
        reply["moves"] = True
        reply["at_once"] = thing.at_once
    reply["place"] = _place(thing.place)
    reply["spread_m"] = rounded(thing.spread_m, 2)
    if thing.frame_id != answer.frame_id:
        reply["frame_id"] = thing.frame_id
    if thing.inside is not None:
        reply["in"] = thing.inside
    reply |= {
        "first_seen": moment(thing.first),
        "last_seen": moment(thing.last),
        "ago_s": seconds(answer.now - thing.last),
        "count": thing.count,
    }
    if thing.best is not None and thing.median is not None:
        reply["score"] = {"best": rounded(thing.best, 3), "median": rounded(thing.median, 3)}
    if thing.robot is not None:
        x, y, yaw = thing.robot
        reply["seen_from"] = {"x": rounded(x, 2), "y": rounded(y, 2), "yaw_deg": degrees(yaw)}
    if thing.still_there is not None:
        reply["still_there"] = _still_there(thing.still_there)
    if thing.moved:
        reply["moved"] = [_stay(each) for each in thing.moved]
    return reply


def _still_there(known: results.StillThere) -> JsonObject:
    looks: JsonObject = {"looks": known.looks} if known.looks else {}
    return {known.state: moment(known.at), **looks}


def _stay(stay: results.ThingStay) -> JsonObject:
    x, y, _ = stay.place
    return {
        "from": moment(stay.start),
        "to": moment(stay.end),
        "place": {"x": rounded(x, 2), "y": rounded(y, 2)},
        **({} if stay.inside is None else {"in": stay.inside}),
        "times": stay.count,
    }


def _place(place: Vector3) -> JsonObject:
    return {name: rounded(part, 2) for name, part in zip("xyz", place, strict=True)}


@render.register(results.Comparison)
def _comparison(answer: results.Comparison) -> JsonObject:
    """Returns what differs; a part in which nothing does is left out."""
    reply: JsonObject = {
        "duration_s": _pair(answer.lengths, 1),
        "recorded_s": _pair(answer.recorded, 1),
    }
    things = _compared_things(answer)
    if things:
        reply["frame_id"] = answer.frame_id or None
    reply["things"] = things
    reply["things_unchanged"] = answer.things.same
    if answer.way:
        reply["way"] = {name: _pair(pair, 2) for name, pair in answer.way}
    for key, places, found in (
        ("minutes", 1, answer.places),
        ("errors", 0, answer.errors),
        ("silent_s", 0, answer.silences),
    ):
        if found:
            shown = found[:_MOST_COMPARED]
            reply[key] = {
                shortened(name, _LONGEST_NAME): _pair(pair, places) for name, pair in shown
            }
        if len(found) > _MOST_COMPARED:
            reply[f"{key}_total"] = len(found)
    return with_notes(reply, answer.notes)


def _compared_things(answer: results.Comparison) -> JsonObject:
    things = answer.things
    reply: JsonObject = {}
    for key, found, most in (
        ("moved", things.moved, _MOST_MOVED),
        ("appeared", things.appeared, _MOST_COMPARED),
        ("not_seen_where_expected", things.missed, _MOST_COMPARED),
        ("not_looked_at", things.not_looked_at, _MOST_COMPARED),
    ):
        if found:
            reply[key] = [_compared_thing(each) for each in found[:most]]
        if len(found) > most:
            reply[f"{key}_total"] = len(found)
    return reply


def _compared_thing(thing: results.ComparedThing) -> JsonObject:
    reply: JsonObject = {"label": shortened(thing.label, _LONGEST_LABEL)}
    if thing.before is not None:
        reply["was"] = {**_at(thing.before), "last_seen": moment(thing.before.end)}
    if thing.after is not None:
        reply["is"] = {**_at(thing.after), "first_seen": moment(thing.after.start)}
    if thing.missed is not None:
        reply |= {"missed_by": moment(thing.missed), "looks": thing.looks}
    return reply


def _at(stay: results.ThingStay) -> JsonObject:
    x, y, _ = stay.place
    inside: JsonObject = {} if stay.inside is None else {"in": stay.inside}
    return {"x": rounded(x, 2), "y": rounded(y, 2), **inside}


def _pair(pair: results.Pair, places: int) -> JsonObject:
    this, other = (None if each is None else rounded(each, places) for each in pair)
    return {"this": this, "with": other}
