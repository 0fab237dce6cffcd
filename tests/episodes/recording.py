"""Writes the bags of a month: a recording a day, in splits of six hours, with a battery beside."""

from __future__ import annotations

from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Final

from tests.episodes.world import DAYS, US_PER_S, day_start, month
from tests.support.bags import Msg, make, text, write_mcap

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

BATTERY: Final = "/battery"
_SPLIT_NS: Final = 6 * 3600 * 10**9
_BATTERY_NS: Final = 60 * 10**9


def write_month(seed: int, folder: Path) -> None:
    """Writes the bags of a seed's month into a folder."""
    rows = [text(said.at * 1000, said.text, said.topic) for said in month(seed).messages]
    # Where the robot works past midnight, that is of the recording of the day before.
    edges = [(day_start(day) + 3 * 3600 * US_PER_S) * 1000 for day in range(DAYS + 1)]
    for day, (begin, end) in enumerate(pairwise(edges)):
        of_day = [row for row in rows if begin <= row.log_time < end]
        _write_day(folder / f"day_{day:02}", of_day)


def _write_day(folder: Path, rows: Sequence[Msg]) -> None:
    both = sorted([*rows, *_battery(rows[0].log_time, rows[-1].log_time)], key=_at)
    splits = groupby(both, key=lambda row: (row.log_time - both[0].log_time) // _SPLIT_NS)
    for nth, (_, split) in enumerate(splits):
        write_mcap(folder / f"{folder.name}_{nth}.mcap", split)


def _battery(first: int, last: int) -> Iterator[Msg]:
    for at in range(first, last, _BATTERY_NS):
        body = make("std_msgs/msg/Float32", data=0.5)
        yield Msg(BATTERY, "std_msgs/msg/Float32", at, body)


def _at(row: Msg) -> int:
    return row.log_time
