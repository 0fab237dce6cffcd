"""Questions about things: how many there are, where they are, where they were before."""

from __future__ import annotations

from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Final

from tests.home import replies
from tests.home.camera import PERSON
from tests.home.flat import FRONT_DOOR
from tests.home.instances import point_of
from tests.home.judging import Answer, Expected, Names, Number, Order, Time, Words, YesNo
from tests.home.questions import Asked, Question, ask
from tests.home.things import NEVER_SEEN, Place
from tests.home.world import VISION

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.model import JsonValue
    from tests.home.replies import Row
    from tests.home.truth import PlaceOfThing, ThingTruth

_WITHIN_M: Final = 0.4
_PEOPLE: Final = frozenset({PERSON})


def questions(asked: Asked) -> list[Question]:
    """Returns them."""
    return [
        *_how_many(asked),
        *_where(asked),
        *_what_is_at(asked),
        *_moved(asked),
        *_changes(asked),
        *_when_seen(asked),
    ]


def _one(found: Sequence[Row]) -> Row:
    return replies.first(replies.things(found[0]))


def _count(found: Sequence[Row]) -> Answer:
    listed = replies.things(found[0])
    return {"count": found[0].get("total", len(listed))}


def _how_many(asked: Asked) -> list[Question]:
    words = {
        "chair": "How many chairs are there in the flat?",
        "plant": "How many plants do we have?",
        "mug": "How many mugs are there? I do not mean cups.",
        "book": "How many books are there, by what you were at least 60 % sure of? No notebooks.",
    }
    sure: dict[str, dict[str, JsonValue]] = {"book": {"min_score": 0.6}}
    return [
        Question(
            f"count-{label}",
            "counting",
            text,
            {"count": Number(len(asked.truth.of(label)))},
            ask("find_things", label=label, **sure.get(label, {})),
            _count,
        )
        for label, text in words.items()
    ]


def _room(found: Sequence[Row]) -> Answer:
    return {"room": replies.place(_one(found))}


def _where(asked: Asked) -> list[Question]:
    words = {
        "phone": "Where is my phone? Not the headphones.",
        "headphones": "In which room are the headphones?",
        "television": "Which room has a tv?",
        "bottle": "Where is the bottle now?",
    }
    found = [
        Question(
            f"where-{label}",
            "spatial",
            text,
            {"room": Words((_now(asked.thing(label)).room,))},
            ask("find_things", label="tv" if label == "television" else label),
            _room,
        )
        for label, text in words.items()
    ]
    chair = _now(asked.truth.of("chair")[-1])
    rooms = frozenset(_now(thing).room for thing in asked.truth.of("plant"))
    return [
        *found,
        Question(
            "chair-bedroom",
            "spatial",
            "Where in the bedroom, in metres of the map, is the chair?",
            {"x": Number(chair.x, _WITHIN_M), "y": Number(chair.y, _WITHIN_M)},
            ask("find_things", label="chair", where=chair.room),
            _point,
        ),
        Question(
            "plant-rooms",
            "spatial",
            "Which rooms have plants?",
            {"rooms": Names(rooms)},
            ask("find_things", label="plant"),
            lambda found: {"rooms": [replies.place(each) for each in replies.things(found[0])]},
        ),
    ]


def _point(found: Sequence[Row]) -> Answer:
    x, y = point_of(_one(found))
    return {"x": x, "y": y}


def _now(thing: ThingTruth) -> Place:
    """Returns where a thing was last seen."""
    place = thing.known()[-1].place
    if place is None:
        raise ValueError(f"{thing.label} was never seen")
    return place


def _what_is_at(asked: Asked) -> list[Question]:
    def labels(found: Sequence[Row]) -> Answer:
        return {"labels": [replies.text(each, "label") for each in replies.things(found[0])]}

    def standing(room: str) -> Names:
        there = frozenset(thing.label for thing in asked.truth.things if _known(thing) == room)
        once = frozenset(
            thing.label
            for thing in asked.truth.things
            if any(stay.place is not None and stay.place.room == room for stay in thing.stays)
        )
        return Names(there, once | _PEOPLE)

    near_door = frozenset(
        thing.label
        for thing in asked.truth.things
        for stay in thing.known()[-1:]
        if stay.place is not None
        and (stay.place.x - FRONT_DOOR[0]) ** 2 + (stay.place.y - FRONT_DOOR[1]) ** 2 <= 1.0
    )
    never = {"count": Number(0)}
    return [
        Question(
            "in-bathroom",
            "spatial",
            "What things are in the bathroom?",
            {"labels": standing("bathroom")},
            ask("find_things", where="bathroom"),
            labels,
        ),
        Question(
            "in-study",
            "spatial",
            "What did you see in the study, as far as it is still there?",
            {"labels": standing("study")},
            ask("find_things", where="study"),
            labels,
        ),
        Question(
            "at-door",
            "spatial",
            "What lies at the front door?",
            {"labels": Names(near_door, _PEOPLE)},
            ask("find_things", where="front door"),
            labels,
        ),
        Question(
            "no-dog",
            "counting",
            "How many dogs live here?",
            never,
            ask("find_things", label="dog"),
            _count,
        ),
        Question(
            "never-seen",
            "counting",
            f"How often did you see an {NEVER_SEEN}?",
            never,
            ask("find_matches", topic=VISION.topic, condition_type="contains", value=NEVER_SEEN),
            lambda found: {"count": len(replies.rows(found[0], "sightings"))},
        ),
    ]


def _known(thing: ThingTruth) -> str:
    stays = thing.known()
    return stays[-1].place.room if stays and stays[-1].place is not None else ""


def _moved(asked: Asked) -> list[Question]:
    def read(found: Sequence[Row], *, before: bool) -> Answer:
        thing = _one(found)
        listed = replies.stays(thing)
        answer: dict[str, JsonValue] = {
            "room": replies.place(listed[-1]),
            "since": replies.time(listed[-1], *replies.SINCE),
        }
        if before and len(listed) > 1:
            answer["before"] = replies.place(listed[-2])
        return answer

    found = []
    words = {
        "mug": "Where is my mug, since when, and where was it before?",
        "remote": "Where is the remote now, when did it get there, and from where?",
        "book": "Where is the book, since when, and in which room was it before that?",
        "keys": "Where are my keys, and since when?",
    }
    for label, text in words.items():
        stays = asked.thing(label).known()
        truth: dict[str, Expected] = {
            "room": Words((_room_of(stays[-1]),)),
            "since": asked.since(stays),
        }
        if len(stays) > 1 and label != "keys":
            truth["before"] = Words((_room_of(stays[-2]),))
        read_it = partial(read, before="before" in truth)
        found.append(
            Question(
                f"moved-{label}", "change", text, truth, ask("find_things", label=label), read_it
            )
        )
    mug, ball = asked.thing("mug").known(), asked.thing("ball").known()
    found += [
        Question(
            "mug-places",
            "change",
            "In which rooms has the mug been, in order?",
            {"rooms": Order(_without_repeats(map(_room_of, mug)))},
            ask("find_things", label="mug"),
            lambda found: {
                "rooms": [*_without_repeats(map(replies.place, replies.stays(_one(found))))]
            },
        ),
        Question(
            "ball-moves",
            "counting",
            "How often was the ball put somewhere else?",
            {"moves": Number(len(ball) - 1)},
            ask("find_things", label="ball"),
            lambda found: {"moves": len(replies.stays(_one(found))) - 1},
        ),
    ]
    return found


def _without_repeats(rooms: Iterable[str]) -> tuple[str, ...]:
    """Returns rooms in order: a thing that is moved within one is in it once."""
    return tuple(room for room, _ in groupby(rooms))


def _room_of(stay: PlaceOfThing) -> str:
    return "" if stay.place is None else stay.place.room


def _changes(asked: Asked) -> list[Question]:
    morning = (asked.day(asked.last - 1), asked.day(asked.last - 1, 9.0))
    today = (asked.day(asked.last, 12.2), asked.day(asked.last + 1))
    window: dict[str, JsonValue] = {
        "start": today[0],
        "end": today[1],
        "with_start": morning[0],
        "with_end": morning[1],
    }
    found = []
    for slug, text, room in (
        ("living", "What changed in the living room since yesterday morning?", "living room"),
        ("study", "What is different in the study from yesterday morning?", "study"),
        ("flat", "Which things stand elsewhere than yesterday morning?", None),
    ):
        given: dict[str, JsonValue] = {**window, "where": room} if room else {**window}
        changed, maybe = _changed(asked, morning, today, room)
        found.append(
            Question(
                f"changed-{slug}",
                "change",
                text,
                {"labels": Names(changed, maybe | _PEOPLE)},
                ask("compare", **given),
                _compared,
            )
        )
    sofa = Question(
        "sofa-still",
        "change",
        "Is the sofa still where it was?",
        {"still_there": YesNo(value=True)},
        ask("find_things", label="sofa"),
        lambda found: {
            "still_there": "not_seen_where_expected"
            not in replies.row(replies.get(_one(found), "still_there"))
        },
    )
    return [*found, sofa]


def _compared(found: Sequence[Row]) -> Answer:
    part = found[0].get("things", found[0])
    listed = replies.row(part)
    labels: list[str] = []
    for name in ("moved", "appeared", "not_seen_where_expected"):
        among = listed.get(name, [])
        if isinstance(among, list):
            labels += [replies.text(replies.row(each), "label") for each in among]
    return {"labels": [*labels]}


def _changed(
    asked: Asked, before: tuple[float, float], after: tuple[float, float], room: str | None
) -> tuple[frozenset[str], frozenset[str]]:
    """Returns the labels that were seen elsewhere than before, and those that may be."""
    changed, maybe = set(), set()
    for thing in asked.truth.things:
        was, now = _seen_in(thing, before), _seen_in(thing, after)
        rooms = {_room_of(stay) for stay in thing.stays if stay.stop > before[0]}
        if len(thing.stays) > 1 and (room is None or room in rooms):
            maybe.add(thing.label)
        if was is None or now is None or was.place == now.place:
            continue
        if room is None or room in {_room_of(was), _room_of(now)}:
            changed.add(thing.label)
    return frozenset(changed), frozenset(maybe)


def _seen_in(thing: ThingTruth, window: tuple[float, float]) -> PlaceOfThing | None:
    """Returns where a thing was last seen in a window."""
    seen = [
        stay
        for stay in thing.known(window[1])
        if (stay.sight.last_detected or 0.0) >= window[0]
        and sum(a <= window[1] and b >= window[0] for a, b in stay.sight.in_view) > 0
    ]
    return seen[-1] if seen else None


def _when_seen(asked: Asked) -> list[Question]:
    bottle, backpack = asked.thing("bottle").known(), asked.thing("backpack").known()
    chair = asked.truth.of("chair")[-1].known()
    last = backpack[-1].sight.last_detected or 0.0
    return [
        Question(
            "bottle-since",
            "change",
            "Since when has the bottle been where it is?",
            {"since": asked.since(bottle)},
            ask("find_things", label="bottle"),
            lambda found: {"since": replies.time(replies.stays(_one(found))[-1], *replies.SINCE)},
        ),
        Question(
            "chair-brought",
            "change",
            "When did the chair come into the bedroom?",
            {"since": asked.since(chair)},
            ask("find_things", label="chair", where="bedroom"),
            lambda found: {"since": replies.time(replies.stays(_one(found))[-1], *replies.SINCE)},
        ),
        Question(
            "backpack-last",
            "temporal",
            "When and in which room did you last see the backpack?",
            {
                "seen": Time(last - asked.split_s, last + asked.split_s),
                "room": Words((_room_of(backpack[-1]),)),
            },
            ask("find_things", label="backpack"),
            lambda found: {
                "seen": replies.time(_one(found), "last_seen"),
                "room": replies.place(_one(found)),
            },
        ),
        Question(
            "phone-first-today",
            "temporal",
            "When did you first see my phone today? Any spelling, but not the headphones.",
            {"seen": _first_today(asked, "phone")},
            ask("find_things", label="phone", **asked.today),
            lambda found: {"seen": replies.time(_one(found), "first_seen")},
        ),
    ]


def _first_today(asked: Asked, label: str) -> Time:
    """Returns when a thing was first in view today, with two minutes for missed detections."""
    start = asked.day(asked.last)
    first = min(
        a
        for thing in asked.truth.of(label)
        for stay in thing.stays
        for a, _ in stay.sight.in_view
        if a >= start
    )
    return Time(first - 1.0, first + 2 * asked.split_s)
