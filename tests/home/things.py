"""What stands in the flat: fixed things, things that people move, and how a detector names them.

Things of one label are at least 1 m apart. Near-names (mug and cup, phone and headphones, book and
notebook) are different things; spellings (Mug, coffee mug, mugs) are one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tests.home.flat import room_at

HOUR = 3600.0
DAY = 86400.0


class Place(NamedTuple):
    """Where a thing stands: a name for people, and the point (m, in `map`)."""

    name: str
    x: float
    y: float
    z: float = 0.7

    @property
    def room(self) -> str:
        """Returns the room that it lies in."""
        return room_at(self.x, self.y) or ""


class Stay(NamedTuple):
    """A thing stands at `place` in `[start, stop)`; `place` is None while it is out of the flat."""

    start: float
    stop: float
    place: Place | None


@dataclass(frozen=True)
class Thing:
    """One object: its label, and all its stays in order, without a gap."""

    name: str
    label: str
    stays: tuple[Stay, ...]

    def at(self, t: float) -> Place | None:
        """Returns where it stands at a moment; None while it is out of the flat."""
        return next((stay.place for stay in reversed(self.stays) if stay.start <= t), None)


LABELS: Mapping[str, tuple[str, ...]] = {
    "mug": ("coffee mug",),
    "television": ("tv",),
    "plant": ("potted plant",),
    "phone": ("cell phone",),
    "remote": ("remote control",),
}
"""Declared spellings of a label, as `labels.yaml` has them."""
PLURALS: Mapping[str, str] = {"mug": "mugs", "chair": "chairs", "plant": "plants"}
"""How the detector writes a label in the plural, now and then, where there is but one."""
NEAR_NAMES: Mapping[str, str] = {
    "mug": "cup",
    "cup": "mug",
    "phone": "headphones",
    "headphones": "phone",
    "book": "notebook",
    "notebook": "book",
}
"""Which label the detector confuses with which."""
NONSENSE = ("dog", "knife", "teddy bear", "skateboard", "suitcase")
"""Labels of things that are not in the flat."""
NEVER_SEEN = "umbrella stand"
"""A label that no detection has."""

SURFACES = (
    Place("kitchen counter", 3.9, 8.3, 0.9),
    Place("coffee table", 2.4, 2.3, 0.4),
    Place("arm of the sofa", 2.0, 0.6, 0.5),
    Place("television stand", 3.5, 4.5, 0.5),
    Place("armchair", 0.5, 2.4, 0.4),
    Place("hall shelf", 5.3, 4.0, 1.0),
    Place("hall bench", 6.6, 6.1, 0.4),
    Place("bedside table", 8.5, 8.4, 0.5),
    Place("far bedside table", 10.7, 8.4, 0.5),
    Place("foot of the bed", 9.4, 5.9, 0.4),
    Place("desk", 9.9, 4.5, 0.7),
    Place("window sill of the study", 11.5, 3.6, 0.9),
    Place("bathroom shelf", 10.4, 0.4, 0.9),
    Place("edge of the bath", 9.4, 1.7, 0.5),
)
"""Where movable things are put down; no two nearer than 0.7 m to each other."""

_FIXED = (
    ("dining chair", "chair", 0.8, 6.2, 0.5),
    ("other dining chair", "chair", 2.1, 5.9, 0.5),
    ("desk chair", "chair", 10.7, 3.1, 0.5),
    ("living room plant", "plant", 0.5, 4.5, 0.6),
    ("bookshelf plant", "plant", 1.9, 4.6, 0.6),
    ("study plant", "plant", 11.4, 2.4, 0.6),
    ("west lamp", "lamp", 7.5, 8.6, 1.2),
    ("east lamp", "lamp", 11.5, 8.6, 1.2),
    ("dining table", "table", 1.5, 7.0, 0.7),
    ("sofa", "sofa", 0.9, 0.9, 0.4),
    ("television", "television", 4.6, 4.5, 0.9),
    ("fridge", "fridge", 4.7, 8.6, 0.9),
    ("bed", "bed", 9.6, 8.3, 0.4),
    ("toilet", "toilet", 11.2, 1.0, 0.4),
    ("shoes", "shoes", 6.7, 8.7, 0.1),
    ("cup", "cup", 2.8, 8.6, 0.9),
    ("headphones", "headphones", 8.1, 2.4, 0.8),
    ("notebook", "notebook", 8.0, 4.7, 0.8),
    ("clock", "clock", 6.8, 4.6, 1.8),
)
_CHAIR = (Place("dining table", 0.8, 7.9, 0.5), Place("bedroom", 11.0, 6.0, 0.5))
"""Where the chair stands that is moved once."""
_MOVABLE = ("mug", "phone", "keys", "remote", "book", "backpack", "ball", "bottle")
_OUT = (8.25 * HOUR, 17.2 * HOUR)
"""The backpack is out of the flat between these times of every day."""


@dataclass
class _Hand:
    """Moves things about: no surface ever holds two."""

    chance: np.random.Generator
    stays: dict[str, list[tuple[float, Place | None]]] = field(default_factory=dict)

    def put(self, label: str, t: float) -> None:
        taken = {history[-1][1] for history in self.stays.values()}
        # A home that a thing was taken from is kept for it: the backpack comes back.
        free = [place for place in SURFACES if place not in taken]
        there = free[int(self.chance.integers(len(free)))]
        self.stays.setdefault(label, []).append((t, there))

    def move(self, label: str, t: float) -> None:
        history = self.stays[label]
        here = history[-1][1]
        taken = {other[-1][1] for other in self.stays.values()}
        free = [
            place
            for place in SURFACES
            if place not in taken
            and (here is None or abs(place.x - here.x) + abs(place.y - here.y) > 1.5)
        ]
        if free:
            history.append((t, free[int(self.chance.integers(len(free)))]))


def things_of(days: int, chance: np.random.Generator, blind: tuple[float, float]) -> list[Thing]:
    """Returns all things with their stays over so many days.

    `blind`: the time in which the detector is silent; the keys are moved in it.
    """
    end = days * DAY
    things = [
        Thing(name, label, (Stay(0.0, end, Place(name, x, y, z)),))
        for name, label, x, y, z in _FIXED
    ]
    hand = _Hand(chance)
    for label in _MOVABLE:
        hand.put(label, 0.0)
    for t, label in _moves(days, chance, blind):
        if label == "backpack":
            hand.stays[label].append((t, None))
        elif label == "backpack returns":
            hand.move("backpack", t)
        else:
            hand.move(label, t)
    for label, history in hand.stays.items():
        things.append(Thing(label, label, _stays(history, end)))
    moved = (days // 2) * DAY + 11.9 * HOUR
    chair: list[tuple[float, Place | None]] = [(0.0, _CHAIR[0]), (moved, _CHAIR[1])]
    things.append(Thing("moved chair", "chair", _stays(chair, end)))
    return things


def _moves(
    days: int, chance: np.random.Generator, blind: tuple[float, float]
) -> list[tuple[float, str]]:
    """Returns when which thing is moved, in order."""
    moves = [(sum(blind) / 2, "keys")]
    for day in range(days):
        start = day * DAY
        moves += [(start + _OUT[0], "backpack"), (start + _OUT[1], "backpack returns")]
        for label in _MOVABLE:
            hour = float(chance.uniform(8.6, 19.4))
            wanted = chance.random() < 0.45
            # On the last day some things are moved for certain: owners ask about them.
            certain = day == days - 1 and label in {"mug", "remote", "book"}
            if label not in {"backpack", "keys"} and (wanted or certain):
                moves.append((start + hour * HOUR, label))
    return sorted(moves)


def _stays(history: list[tuple[float, Place | None]], end: float) -> tuple[Stay, ...]:
    stops = [t for t, _ in history[1:]] + [end]
    return tuple(
        Stay(start, stop, place) for (start, place), stop in zip(history, stops, strict=True)
    )
