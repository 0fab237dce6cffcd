"""Asking a world again what was recorded of it, and choosing a sample of its calls."""

import tempfile
from collections import defaultdict
from collections.abc import Collection, Mapping
from pathlib import Path
from random import Random
from typing import Any, Final

from tests.oracle.replies.asking import Asked, still_time
from tests.oracle.replies.comparison import differences
from tests.oracle.replies.fixture import Record, Replied
from tests.oracle.replies.worlds import WORLDS, ReplyWorld

_SAMPLE_SEED: Final = "sample 2"
_SLOW: Final = frozenset({"plot plot", "parquet export", "cli info", "cli forget"})
"""Ways that take long: of each, one call in a kind of worlds is enough for a sample."""


def renew(world: ReplyWorld, record: Record) -> None:
    """Writes what is replied today; with a store, ways that take long are not asked."""
    for row, reply in zip(record.replies, answers(world, record, record.replies), strict=True):
        row.reply, row.stored = reply, None
    quick = [row for row in record.replies if row.call.what not in _SLOW]
    for row, reply in zip(quick, answers(world, record, quick, stored=True), strict=True):
        if differences(row.call, row.reply, reply):
            row.stored = reply
    record.write()


def answers(
    world: ReplyWorld, record: Record, rows: Collection[Replied], *, stored: bool = False
) -> list[Any]:
    """The replies of today, in a folder of the world's bags in which time stands still."""
    with tempfile.TemporaryDirectory(prefix="replies-") as place:
        folder = Path(place).resolve()
        with still_time(folder / "cache"):
            world.make(folder / "bags")
            asked = Asked(folder, record.settings, record.places, stored=stored)
            try:
                return [asked.answer(row.call) for row in rows]
            finally:
                asked.stop()


def compare(
    world: ReplyWorld,
    record: Record,
    *,
    stored: bool = False,
    chosen: Collection[int] | None = None,
) -> list[str]:
    """Asks again what was recorded; `chosen` are numbers of calls. Returns what differs."""
    replies = record.replies
    rows = replies if chosen is None else [replies[number] for number in sorted(chosen)]
    found = []
    for row, reply in zip(rows, answers(world, record, rows, stored=stored), strict=True):
        noted = stored and row.stored is not None
        found += differences(row.call, row.stored if noted else row.reply, reply)
    return found


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
