"""Replies about things as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory import results
from ros2_memory.tools.reply_json import degrees, moment, render, rounded, seconds, with_notes

if TYPE_CHECKING:
    from ros2_memory.core.model import Vector3
    from ros2_memory.tools.reply_size import JsonObject


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
