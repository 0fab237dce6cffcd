"""Recording a world's replies, asking it again, and choosing a sample of its calls."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Final

from tests.oracle.replies.asking import Asked, Call, still_time
from tests.oracle.replies.calls import Calls, Facts
from tests.oracle.replies.comparison import Comparison
from tests.oracle.replies.fixture import Record, Replied
from tests.oracle.replies.worlds import WORLDS, ReplyWorld

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping


_SAMPLE_SEED: Final = "sample 2"
_SLOW: Final = frozenset({"plot plot", "parquet export", "cli info", "cli forget"})
"""Ways that take long: of each, one call in a kind of worlds is enough for a sample."""


@contextmanager
def made(world: ReplyWorld) -> Iterator[Path]:
    """A folder with the bags of a world in `bags`, in which time stands still."""
    with tempfile.TemporaryDirectory(prefix="replies-") as place:
        folder = Path(place).resolve()
        with still_time(folder / "cache"):
            world.make(folder / "bags")
            yield folder


def record(world: ReplyWorld, comparison: Comparison) -> Record:
    """Draws calls, and returns their replies; differences with a store are collected.

    With a store, ways that take long are not asked: they show what tools reply.
    """
    with made(world) as folder:
        looked = Asked(folder, world.settings, {}, stored=False)
        facts = Facts(looked, Random(f"places {world.name}"))
        looked.stop()
        drawn = Calls(facts, Random(f"calls {world.name}"), shows_messages=world.shows_messages)
        found = Record(world.name, world.settings, facts.places)
        calls = [*drawn.drawn(world.calls), *(Call("tool", *given) for given in world.also)]
        found.replies = [Replied(*answered) for answered in asked_all(folder, found, calls)]
        quick = [replied for replied in found.replies if replied.call.what not in _SLOW]
        calls = [replied.call for replied in quick]
        again = asked_all(folder, found, calls, stored=True)
        for replied, (call, reply) in zip(quick, again, strict=True):
            if not comparison.compare(world.name, call, replied.reply, reply):
                replied.stored = reply
    return found


def asked_all(
    folder: Path, record: Record, calls: Collection[Call], *, stored: bool = False
) -> Iterator[tuple[Call, object]]:
    """Yields the reply to each call."""
    asked = Asked(folder, record.settings, record.places, stored=stored)
    try:
        for call in calls:
            yield call, asked.answer(call)
    finally:
        asked.stop()


def compare(
    world: ReplyWorld,
    record: Record,
    comparison: Comparison,
    *,
    stored: bool = False,
    chosen: Collection[int] | None = None,
) -> int:
    """Asks what was recorded again; `chosen` are numbers of calls. Returns how many were asked."""
    replies = record.replies
    asked = replies if chosen is None else [replies[number] for number in sorted(chosen)]
    with made(world) as folder:
        again = asked_all(folder, record, [row.call for row in asked], stored=stored)
        for row, (call, reply) in zip(asked, again, strict=True):
            noted = stored and row.stored is not None
            comparison.compare(world.name, call, row.stored if noted else row.reply, reply)
    return len(asked)


def sample(records: Mapping[str, Record], for_each_world: int) -> dict[str, set[int]]:
    """Chooses calls: in each kind of worlds one of each way and tool, and some of each world.

    Of worlds in which calls take long, only questions about one moment.

    Args:
        records: by world.
        for_each_world: how many calls that take no long each world has at least.
    """
    draw = Random(_SAMPLE_SEED)
    chosen: dict[str, set[int]] = {name: set() for name in records}
    whats: dict[tuple[str, str], list[tuple[str, int]]] = defaultdict(list)
    for name, record in records.items():
        quick = []
        for number, replied in enumerate(record.replies):
            is_quick = replied.call.what not in _SLOW
            if WORLDS[name].is_slow:
                is_quick = replied.call.name.startswith("get_")
            else:
                whats[WORLDS[name].kind, replied.call.what].append((name, number))
            if is_quick:
                quick.append(number)
        chosen[name].update(draw.sample(quick, min(for_each_world, len(quick))))
    for (_, what), places in whats.items():
        taken = [place for place in places if place[1] in chosen[place[0]]]
        if what in _SLOW or not taken:
            name, number = draw.choice(places)
            chosen[name].add(number)
    return chosen
