"""Replies about things as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.text import shortened
from ros2_memory.tools.reply_json import (
    degrees,
    inside,
    moment,
    render,
    rounded,
    seconds,
    total,
    with_notes,
)
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Vector3
    from ros2_memory.tools.reply_size import JsonObject

_MOST_COMPARED: Final = 5
_MOST_STAYS: Final = (8, 5, 3, 2)
_PLACED: Final = ("place", "frame_id", "in", "also_in")
_SHORT: Final = ("label", "moves", "at_once", *_PLACED, "last_seen", "moved_times")
_MISSED: Final = "not_seen_where_expected"
_HOW: Final = "in short form; ask with label or where for their scores, states and moves"
_LONGEST: Final = 6_000
"""Characters of a reply; its lists are cut until it is no longer."""
_LONGEST_NAME: Final = 100
"""Characters of the text of an error."""
_LONGEST_LABEL: Final = 40


@render.register(results.Things)
def _things(answer: results.Things) -> JsonObject:
    """Returns the things, each with as many of its newest places as leave the reply short.

    Where that is not enough, what each is and where it was last, and only the things seen last.
    """
    reply: JsonObject = {}
    for most in _MOST_STAYS:
        reply = _listed(answer, [_thing(each, answer, most) for each in answer.things])
        if len(to_json_text(reply)) <= _LONGEST:
            return reply
    rows = [_shortly(each, answer) for each in answer.things]
    for count in range(len(rows), 0, -1):
        reply = _listed(
            answer, rows[:count], f"{count} of {answer.total} things are listed, {_HOW}"
        )
        if len(to_json_text(reply)) <= _LONGEST:
            break
    return reply


def _listed(answer: results.Things, rows: Sequence[JsonObject], *notes: str) -> JsonObject:
    reply: JsonObject = {
        "frame_id": answer.frame_id or None,
        "things": [*rows],
        **total(answer.total if answer.all_counted else None, answer.total),
        "labels": dict(answer.labels),
    }
    return with_notes(reply, (*notes, *answer.notes))


def _shortly(thing: results.Thing, answer: results.Things) -> JsonObject:
    """Returns what a thing is, where it was last, and whether it was missed there."""
    whole = _thing(thing, answer, 1)
    is_missed = thing.still_there is not None and thing.still_there.state == _MISSED
    keys = (*_SHORT, "still_there") if is_missed else _SHORT
    return {key: whole[key] for key in keys if key in whole}


def _thing(thing: results.Thing, answer: results.Things, most_stays: int) -> JsonObject:
    reply: JsonObject = {"label": thing.label}
    if thing.also_seen_as:
        reply["also_seen_as"] = [*thing.also_seen_as]
    if thing.misread_as:
        reply["misread_as"] = [*thing.misread_as]
    kind: JsonObject = {"moves": thing.moves or None, "at_once": thing.at_once}
    reply |= {key: each for key, each in kind.items() if each is not None}
    reply["place"] = _place(thing.place)
    reply["spread_m"] = rounded(thing.spread_m, 2)
    if thing.frame_id != answer.frame_id:
        reply["frame_id"] = thing.frame_id
    reply |= {
        **inside(thing.inside),
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
        reply["moved_times"] = len(thing.moved) - 1
        reply["moved"] = [_stay(each) for each in thing.moved[-most_stays:]]
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
        **inside(stay.inside),
        "times": stay.count,
    }


def _place(place: Vector3) -> JsonObject:
    return {name: rounded(part, 2) for name, part in zip("xyz", place, strict=True)}


@render.register(results.Comparison)
def _comparison(answer: results.Comparison) -> JsonObject:
    """Returns what differs; a part in which nothing does is left out, and long lists are cut."""
    reply: JsonObject = {}
    for most in range(_MOST_COMPARED, 0, -1):
        reply = with_notes(_compared(answer, most), answer.notes)
        if len(to_json_text(reply)) <= _LONGEST:
            break
    return reply


def _compared(answer: results.Comparison, most: int) -> JsonObject:
    """Returns what differs, with `most` of each kind and twice as many things that moved."""
    reply: JsonObject = {
        "duration_s": _pair(answer.lengths, 1),
        "recorded_s": _pair(answer.recorded, 1),
    }
    things, way = _compared_things(answer.things, most), _paths_apart(answer, most)
    frames = [answer.frame_id or None] * bool(things) + [answer.way_frame_id] * bool(way)
    if frames:
        reply["frame_id"] = frames[0]
    if frames[1:] and frames[0] != frames[1]:
        reply["way_frame_id"] = frames[1]
    reply["things"] = things
    reply["things_unchanged"] = answer.things.same
    if answer.way:
        reply["way"] = {name: _pair(pair, 2) for name, pair in answer.way}
    reply |= way
    for key, places, found in (
        ("minutes", 2, answer.places),
        ("errors", 0, answer.errors),
        ("silent_s", 0, answer.silences),
    ):
        if found:
            reply[key] = {
                shortened(name, _LONGEST_NAME): _pair(pair, places) for name, pair in found[:most]
            }
        if len(found) > most:
            reply[f"{key}_total"] = len(found)
    return reply


def _paths_apart(answer: results.Comparison, most: int) -> JsonObject:
    reply: JsonObject = {}
    _list(reply, "stood_at", [_standing(each) for each in answer.stood], most)
    far: JsonObject = {}
    for key, each in zip(("this", "with"), answer.farthest, strict=True):
        if each is not None:
            at = _point(each.place, each.inside)
            far[key] = {**at, "away_m": rounded(each.away_m, 1), "t": moment(each.time)}
    return {**reply, "farthest_apart": far} if far else reply


def _compared_things(things: results.ComparedThings, most: int) -> JsonObject:
    reply: JsonObject = {}
    for key, found, shown in (
        ("moved", things.moved, 2 * most),
        ("appeared", things.appeared, most),
        ("not_seen_where_expected", things.missed, most),
        ("not_looked_at", things.not_looked_at, most),
        ("not_comparable", things.not_comparable, most),
    ):
        _list(reply, key, [_compared_thing(each) for each in found], shown)
    _list(reply, "movers", [_compared_mover(each) for each in things.movers], most)
    return reply


def _list(reply: JsonObject, key: str, found: Sequence[JsonObject], most: int) -> None:
    """Adds the first of some, and how many there are where they are more."""
    if found:
        reply[key] = [*found[:most]]
    if len(found) > most:
        reply[f"{key}_total"] = len(found)


def _compared_mover(mover: results.ComparedMover) -> JsonObject:
    reply: JsonObject = {"label": shortened(mover.label, _LONGEST_LABEL)}
    for key, seen in (("was", mover.before), ("is", mover.after)):
        if seen is not None:
            reply[key] = {
                "times": seen.count,
                "at_once": seen.at_once,
                **_point(seen.place[:2], seen.inside),
                "last_seen": moment(seen.last),
            }
    return reply


def _standing(stood: results.StandstillPlace) -> JsonObject:
    reply = {**_point(stood.place, stood.inside), **_pair(stood.seconds, 0)}
    for key, since in zip(("this_since", "with_since"), stood.since, strict=True):
        if since is not None:
            reply[key] = moment(since)
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
    return _point(stay.place[:2], stay.inside)


def _point(place: tuple[float, float], places: Sequence[str]) -> JsonObject:
    x, y = place
    return {"x": rounded(x, 2), "y": rounded(y, 2), **inside(places)}


def _pair(pair: results.Pair, places: int) -> JsonObject:
    this, other = (None if each is None else rounded(each, places) for each in pair)
    return {"this": this, "with": other}
