"""Alike things with an id beside their label: whether the ids last, and what they then tell."""

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from random import Random
from typing import Any, Final, TypeAlias

import pytest

from tests.support.bags import Msg, text, write_splits
from tests.support.memories import asked, each_way, memory_of
from tests.unit.things.test_find import BEGIN, NAMED, S, scene

SLOTS: Final = [(2.0, 2.0 * nth) for nth in range(10)]
SESSION_S: Final = 1000
STOP_S: Final = 4

Stock: TypeAlias = Mapping[int, str]
"""Which pallet stands in which slot."""
Ids: TypeAlias = Callable[[int, str], str]
"""The id that a detector gives to a pallet in a session."""


def toured(session: int, stock: Stock, *detectors: Ids) -> list[Msg]:
    """What the robot sees, and its poses, while it stands before one slot after the other."""
    messages: list[Msg] = []
    for stop, (x, y) in enumerate(SLOTS):
        pallet = stock.get(stop)
        for step in range(STOP_S):
            at_s = session * SESSION_S + stop * STOP_S + step
            at = BEGIN * S + at_s * S
            messages += scene(at_s, (0.0, y, 0.0), ())[:-1]
            for number, id_of in enumerate(detectors):
                found = []
                if pallet is not None:
                    place = {"x": x, "y": 0.0, "z": 0.5}
                    seen = {"label": "pallet", "score": 0.9, "position": place}
                    found = [{**seen, "id": id_of(session, pallet)}]
                said = {"frame_id": "base_link", "objects": found}
                messages.append(text(at + 1, json.dumps(said), f"/detector{number}"))
    return messages


def lasting(session: int, pallet: str) -> str:
    return pallet


def absent(session: int, pallet: str) -> str:
    return ""


def counting(random: Random) -> Ids:
    """A tracker's: it counts from 1 in each session, in the order in which it first sees them."""
    ids: dict[tuple[int, str], str] = {}
    order = [count(1) for _ in range(100)]
    shuffled = [random.sample(range(1, 9), 8) for _ in range(100)]

    def id_of(session: int, pallet: str) -> str:
        nth = next(order[session]) if (session, pallet) not in ids else 0
        return ids.setdefault((session, pallet), str(shuffled[session][(nth - 1) % 8]))

    return id_of


def kind_of_thing(session: int, pallet: str) -> str:
    """The number of the class, which some detectors call an id."""
    return "17"


def recorded(bag_dir: Path, stocks: Sequence[Stock], *detectors: Ids) -> Path:
    for session, stock in enumerate(stocks):
        messages = toured(session, stock, *detectors)
        write_splits(bag_dir, messages, split_s=30.0, name=f"rec{session}")
    return bag_dir


def drawn_stocks(random: Random) -> Sequence[Stock]:
    """Two sessions with the same pallets in the same slots, then one in which some went round."""
    pallets = [f"PAL-{random.randrange(10**6):06}" for _ in range(8)]
    slots = random.sample(range(len(SLOTS)), len(pallets))
    before = dict(zip(slots, pallets, strict=True))
    going = random.sample(slots, 3)
    after = dict(before)
    for slot, next_slot in zip(going, [*going[1:], *going[:1]], strict=True):
        after[next_slot] = before[slot]
    free = next(slot for slot in range(len(SLOTS)) if slot not in before)
    after[free] = after.pop(next(slot for slot in slots if slot not in going))
    return [before, before, after]


def ask(bag_dir: Path, tool: str, *, recalls: bool = False, **given: object) -> Any:
    return asked(memory_of(bag_dir, limits=NAMED, recalls=recalls), tool, **given)


def compared(bag_dir: Path, *, recalls: bool = False) -> Any:
    start = BEGIN + 2 * SESSION_S
    earlier = {"with_start": BEGIN, "with_end": start - 500}
    return ask(bag_dir, "compare", recalls=recalls, start=start, end=start + 500, **earlier)


def slot_at(place: Any) -> int:
    slot: int = round(place["y"] / 2.0)
    return slot


def slots_of(stock: Stock) -> dict[str, int]:
    return {pallet: slot for slot, pallet in stock.items()}


@each_way
@pytest.mark.parametrize(("seed", "detectors"), [(0, (lasting,)), (1, (lasting, absent))])
def test_things_with_ids_that_last_are_recognised_by_them(
    tmp_path: Path, seed: int, detectors: Sequence[Ids], recalls: bool
) -> None:
    stocks = drawn_stocks(Random(seed))
    recorded(tmp_path, stocks, *detectors)
    before, after = slots_of(stocks[0]), slots_of(stocks[-1])
    reply = compared(tmp_path, recalls=recalls)
    moved = {
        thing["id"]: (slot_at(thing["was"]), slot_at(thing["is"]))
        for thing in reply["things"].pop("moved")
    }
    assert moved == {
        pallet: (slot, after[pallet]) for pallet, slot in before.items() if after[pallet] != slot
    }
    assert (reply["things"], reply["things_unchanged"]) == ({}, 4)
    assert not [note for note in reply.get("notes", ()) if "is a guess" in note]
    found = ask(tmp_path, "find_things", recalls=recalls)
    assert {thing["id"]: slot_at(thing["place"]) for thing in found["things"]} == after
    assert (found["total"], found["labels"]) == (8, {"pallet": 8})
    [pallet, *_] = before
    asked_for = ask(tmp_path, "find_things", label=pallet.lower(), recalls=recalls)
    assert [thing["id"] for thing in asked_for["things"]] == [pallet]
    assert "notes" not in asked_for


@pytest.mark.parametrize(("seed", "several"), [(0, False), (1, True)])
def test_ids_that_do_not_last_tell_nothing(tmp_path: Path, seed: int, several: bool) -> None:
    stocks = drawn_stocks(Random(seed))
    without = recorded(tmp_path / "without", stocks, *[absent] * (1 + several))
    for name, id_of in (("kind", kind_of_thing), ("tracker", None)):
        drawn = [id_of or counting(Random(nth)) for nth in range(1 + several)]
        given = recorded(tmp_path / name, stocks, *drawn)
        assert compared(given) == compared(without)
        assert ask(given, "find_things") == ask(without, "find_things")
