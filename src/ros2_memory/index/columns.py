"""The numbers in the summaries of many bags, column by column: a question looks at few of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile, TimeWindow


class Alike(NamedTuple):
    """Bags of one shape: where they lie in their run, and their numbers by bag and topic."""

    shape: SummarySchema
    at: NDArray[np.intp]
    numbers: NDArray[np.int64]


class Column(NamedTuple):
    """What the bags of a run hold of one topic, in bag order, one row for each of its types."""

    at: NDArray[np.intp]
    firsts: NDArray[np.int64]
    lasts: NDArray[np.int64]
    places: NDArray[np.intp]


def all_alike(bags: Sequence[BagFile]) -> tuple[Alike, ...]:
    """Bags by their shape."""
    places: dict[int, list[int]] = {}
    for place, bag in enumerate(bags):
        places.setdefault(id(bag.summary.shape), []).append(place)
    return tuple(_alike([bags[place] for place in at], at) for at in places.values())


def _alike(bags: Sequence[BagFile], at: Sequence[int]) -> Alike:
    shape = bags[0].summary.shape
    packed = b"".join([bag.summary.numbers for bag in bags])
    numbers = np.frombuffer(packed, "<i8").reshape(len(bags), len(shape.topics), 3)
    return Alike(shape, np.array(at, np.intp), numbers)


def column_of(alike: Iterable[Alike], topic: str) -> Column | None:
    """What bags hold of a topic; None where they hold nothing."""
    columns = [
        Column(
            at,
            numbers[:, place, 1],
            numbers[:, place, 2],
            np.broadcast_to(np.intp(place), at.shape),
        )
        for shape, at, numbers in alike
        for place in shape.places.get(topic, ())
    ]
    if len(columns) < 2:
        return columns[0] if columns else None
    at = np.concatenate([each.at for each in columns])
    places = np.concatenate([each.places for each in columns])
    order = np.lexsort((places, at))
    return Column(
        at[order],
        np.concatenate([each.firsts for each in columns])[order],
        np.concatenate([each.lasts for each in columns])[order],
        places[order],
    )


def rows_in(column: Column, window: TimeWindow | None) -> NDArray[np.intp]:
    """The rows that may hold something of a window, or all."""
    if window is None:
        return np.arange(len(column.at))
    return np.flatnonzero((column.firsts < window.stop) & (column.lasts >= window.start))
