"""Questions about things: how many there are, where they are, where they were before."""

from collections.abc import Iterable, Iterator
from itertools import chain, groupby
from typing import Any

from tests.home.asking import Asked, Names, Question, Row, between, near, since, stays
from tests.home.camera import PERSON
from tests.home.flat import FRONT_DOOR
from tests.home.things import NEVER_SEEN
from tests.home.truth import PlaceOfThing, ThingTruth
from tests.home.world import VISION

_WITHIN_M = 0.4
_PEOPLE = frozenset({PERSON})


def about_things(asked: Asked) -> Iterator[Question]:
    """Yields them."""
    return chain(
        _how_many(asked), _where(asked), _what_is_at(asked), _moved(asked), _changes(asked),
        _when_seen(asked),
    )  # fmt: skip


def _one(reply: Row) -> Any:
    return reply["things"][0]


def _labels(reply: Row) -> list[str]:
    return [thing["label"] for thing in reply["things"]]


def _rooms(reply: Row) -> list[str]:
    return _without_repeats(stay["in"] for stay in stays(_one(reply)))


def _since(reply: Row) -> float:
    return since(stays(_one(reply))[-1])


def _without_repeats(rooms: Iterable[str]) -> list[str]:
    """Returns rooms in order: a thing that is moved within one is in it once."""
    return [room for room, _ in groupby(rooms)]


def _room_of(stay: PlaceOfThing) -> str:
    return "" if stay.place is None else stay.place.room


def _last_room(thing: ThingTruth) -> str:
    """Returns the room in which a thing was last seen."""
    return "".join(map(_room_of, thing.known()[-1:]))


def _how_many(asked: Asked) -> Iterator[Question]:
    for label, text, sure in (
        ("chair", "How many chairs are there in the flat?", {}),
        ("plant", "How many plants do we have?", {}),
        ("mug", "How many mugs are there? I do not mean cups.", {}),
        (
            "book",
            "How many books are there, by what you were at least 60 % sure of? No notebooks.",
            {"min_score": 0.6},
        ),
    ):
        there = [(len(asked.truth.of(label)), "total")]
        yield Question(text, "find_things", {"label": label, **sure}, there)
    yield Question("How many dogs live here?", "find_things", {"label": "dog"}, [(0, "total")])
    yield Question(
        f"How often did you see an {NEVER_SEEN}?",
        "find_matches",
        {"topic": VISION.topic, "condition_type": "contains", "value": NEVER_SEEN},
        [([], "sightings")],
    )


def _where(asked: Asked) -> Iterator[Question]:
    for label, called, text in (
        ("phone", "phone", "Where is my phone? Not the headphones."),
        ("headphones", "headphones", "In which room are the headphones?"),
        ("television", "tv", "Which room has a tv?"),
        ("bottle", "bottle", "Where is the bottle now?"),
    ):
        room = _last_room(asked.thing(label))
        yield Question(text, "find_things", {"label": called}, [(room, "things.0.in")])
    chair = asked.truth.of("chair")[-1].known()[-1].place
    assert chair is not None
    yield Question(
        "Where in the bedroom, in metres of the map, is the chair?",
        "find_things",
        {"label": "chair", "where": chair.room},
        [
            (near(chair.x, _WITHIN_M), "things.0.place.x"),
            (near(chair.y, _WITHIN_M), "things.0.place.y"),
        ],
    )
    rooms = Names(frozenset(map(_last_room, asked.truth.of("plant"))))
    yield Question(
        "Which rooms have plants?",
        "find_things",
        {"label": "plant"},
        [(rooms, lambda reply: [thing["in"] for thing in reply["things"]])],
    )


def _what_is_at(asked: Asked) -> Iterator[Question]:
    things = asked.truth.things
    for room, text in (
        ("bathroom", "What things are in the bathroom?"),
        ("study", "What did you see in the study, as far as it is still there?"),
    ):
        there = frozenset(thing.label for thing in things if _last_room(thing) == room)
        once = frozenset(thing.label for thing in things if room in map(_room_of, thing.stays))
        names = Names(there, once | _PEOPLE)
        yield Question(text, "find_things", {"where": room}, [(names, _labels)])
    near_door = frozenset(
        thing.label
        for thing in things
        for stay in thing.known()[-1:]
        if stay.place is not None
        and (stay.place.x - FRONT_DOOR[0]) ** 2 + (stay.place.y - FRONT_DOOR[1]) ** 2 <= 1.0
    )
    yield Question(
        "What lies at the front door?",
        "find_things",
        {"where": "front door"},
        [(Names(near_door, _PEOPLE), _labels)],
    )


def _moved(asked: Asked) -> Iterator[Question]:
    for label, text, is_before_asked in (
        ("mug", "Where is my mug, since when, and where was it before?", True),
        ("remote", "Where is the remote now, when did it get there, and from where?", True),
        ("book", "Where is the book, since when, and in which room was it before that?", True),
        ("keys", "Where are my keys, and since when?", False),
    ):
        known = asked.thing(label).known()
        before = known[-2:-1] if is_before_asked else []
        yield Question(
            text,
            "find_things",
            {"label": label},
            [
                (_room_of(known[-1]), lambda reply: stays(_one(reply))[-1]["in"]),
                (asked.since(known), _since),
                *[(_room_of(stay), lambda reply: stays(_one(reply))[-2]["in"]) for stay in before],
            ],
        )
    mug, ball = asked.thing("mug").known(), asked.thing("ball").known()
    yield Question(
        "In which rooms has the mug been, in order?",
        "find_things",
        {"label": "mug"},
        [(_without_repeats(map(_room_of, mug)), _rooms)],
    )
    yield Question(
        "How often was the ball put somewhere else?",
        "find_things",
        {"label": "ball"},
        [(len(ball), lambda reply: len(stays(_one(reply))))],
    )


def _changes(asked: Asked) -> Iterator[Question]:
    morning = (asked.day(asked.last - 1), asked.day(asked.last - 1, 9.0))
    today = (asked.day(asked.last, 12.2), asked.day(asked.last + 1))
    window = dict(zip(("start", "end", "with_start", "with_end"), today + morning, strict=True))
    for text, where in (
        ("What changed in the living room since yesterday morning?", {"where": "living room"}),
        ("What is different in the study from yesterday morning?", {"where": "study"}),
        ("Which things stand elsewhere than yesterday morning?", {}),
    ):
        names = _changed(asked, morning, today, where.get("where"))
        yield Question(text, "compare", {**window, **where}, [(names, _differing)])
    yield Question(
        "Is the sofa still where it was?",
        "find_things",
        {"label": "sofa"},
        [(True, lambda reply: "not_seen_where_expected" not in _one(reply)["still_there"])],
    )


def _differing(reply: Row) -> list[str]:
    kinds = ("moved", "appeared", "not_seen_where_expected")
    return [thing["label"] for kind in kinds for thing in reply["things"].get(kind, ())]


def _changed(
    asked: Asked, before: tuple[float, float], after: tuple[float, float], room: str | None
) -> Names:
    """Returns the labels that were seen elsewhere than before, and those that may be."""
    changed, maybe = set(), set(_PEOPLE)
    for thing in asked.truth.things:
        was, now = _seen_in(thing, before), _seen_in(thing, after)
        rooms = {_room_of(stay) for stay in thing.stays if stay.stop > before[0]}
        if len(thing.stays) > 1 and (room is None or room in rooms):
            maybe.add(thing.label)
        if was is None or now is None or was.place == now.place:
            continue
        if room is None or room in {_room_of(was), _room_of(now)}:
            changed.add(thing.label)
    return Names(frozenset(changed), frozenset(maybe))


def _seen_in(thing: ThingTruth, window: tuple[float, float]) -> PlaceOfThing | None:
    """Returns where a thing was last seen in a window."""
    seen = [
        stay
        for stay in thing.known(window[1])
        if (stay.sight.last_detected or 0.0) >= window[0]
        and any(a <= window[1] and b >= window[0] for a, b in stay.sight.in_view)
    ]
    return seen[-1] if seen else None


def _when_seen(asked: Asked) -> Iterator[Question]:
    split_s = asked.world.scale.split_s
    yield Question(
        "Since when has the bottle been where it is?",
        "find_things",
        {"label": "bottle"},
        [(asked.since(asked.thing("bottle").known()), _since)],
    )
    yield Question(
        "When did the chair come into the bedroom?",
        "find_things",
        {"label": "chair", "where": "bedroom"},
        [(asked.since(asked.truth.of("chair")[-1].known()), _since)],
    )
    backpack = asked.thing("backpack").known()[-1]
    yield Question(
        "When and in which room did you last see the backpack?",
        "find_things",
        {"label": "backpack"},
        [
            (
                near(backpack.sight.last_detected or 0.0, split_s),
                "things.0.last_seen",
            ),
            (_room_of(backpack), "things.0.in"),
        ],
    )
    first = min(
        a
        for thing in asked.truth.of("phone")
        for stay in thing.stays
        for a, _ in stay.sight.in_view
        if a >= asked.day(asked.last)
    )
    yield Question(
        "When did you first see my phone today? Any spelling, but not the headphones.",
        "find_things",
        {"label": "phone", **asked.today},
        # With two splits for missed detections.
        [(between(first - 1.0, first + 2 * split_s), "things.0.first_seen")],
    )
