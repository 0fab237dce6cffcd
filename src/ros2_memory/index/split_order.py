"""The splits of a recording in the order in which they were written, whatever their times are.

`ros2 bag record` names its files after the folder and numbers them (`rec_3.mcap`). Those numbers
are the only order that a clock cannot spoil: they show where the clock was set back, and which
splits lie on both sides of one that cannot be read.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import chain, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.model import COMPRESSED
from ros2_memory.core.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Segment

Series: TypeAlias = str
"""The path of a bag file without its number: what the files of one recording share."""


class Split(NamedTuple):
    """A bag with its number in its series."""

    number: int
    bag: BagFile


class Neighbours(NamedTuple):
    """The end of the split before and the start of the one after (inclusive); None without one."""

    before: Ns | None = None
    after: Ns | None = None


class StepBack(NamedTuple):
    """A clock that was set back while a recording ran: `after` begins `by` before `before` ends.

    Both are one bag where that happened while it was being written.
    """

    before: BagFile
    after: BagFile
    by: Ns


class SplitRange(NamedTuple):
    """A series within a segment: its first and last split by number, and the steps between."""

    first: Split
    last: Split
    steps: tuple[StepBack, ...]


class SplitName(NamedTuple):
    """What the name of a bag file says: its series, and its number there."""

    series: Series
    number: int


class SplitNames(NamedTuple):
    """What the names of some bags say.

    Attributes:
        series: the different ones, in order of the bags; of a name without a number the path.
        positions: for each bag, where its series is among these.
        numbers: of the bags in their series, or their ranks; -1 where the name has none.
    """

    series: Sequence[Series]
    positions: NDArray[np.int64]
    numbers: NDArray[np.int64]


_BY_NUMBER: Final = attrgetter("number")


def stem_of(file: str) -> str:
    """Returns the path of a bag without its suffixes."""
    stem = file.removesuffix(COMPRESSED)
    return stem[: stem.rfind(".")]


def split_of(file: str) -> SplitName | None:
    """Returns the series of a bag file and its number there; None where its name has no number."""
    stem = stem_of(file)
    series = stem.rstrip("0123456789")
    return None if series == stem else SplitName(series, int(stem[len(series) :]))


def split_names_of(files: Iterable[str]) -> SplitNames:
    """Returns what the names of bags say, which are paths."""
    position_of: dict[Series, int] = {}
    rows: list[tuple[int, int]] = []
    following, position, series, number, suffix = "", 0, "", 0, ""
    for file in files:
        # Mostly the bag after one is the next split.
        if file == following:
            number += 1
        else:
            series, number = split_of(file) or (file, -1)
            suffix = file[len(stem_of(file)) :]
            position = position_of.setdefault(series, len(position_of))
        rows.append((position, number))
        following = f"{series}{number + 1}{suffix}"
    if max([number for _, number in rows], default=0) > MAX_NS:
        # A date with microseconds has 20 digits.
        known = sorted({-1, *(number for _, number in rows)})
        rows = [(position, bisect_left(known, number) - 1) for position, number in rows]
    positions, numbers = np.array(rows, np.int64).reshape(-1, 2).T
    return SplitNames([*position_of], positions, numbers)


def is_recording(series: Series) -> bool:
    """Returns whether files are named as `ros2 bag record` names the splits of a recording."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def split_ranges_of(segment: Segment) -> dict[Series, SplitRange]:
    """Returns the range of each series among the bags of a segment."""
    bags, (all_series, positions, numbers) = segment.bags, segment.split_names
    order = np.lexsort((numbers, positions))
    order = order[numbers[order] >= 0]
    # Few splits begin before the one before them has ended.
    late = np.flatnonzero(bags.ends[order[:-1]] > bags.starts[order[1:]])
    edges = np.searchsorted(positions[order], np.arange(len(all_series) + 1))
    late_edges = np.searchsorted(late, edges).tolist()

    # Ranks stand for numbers of which one is beyond 64 bits.
    highest = int(numbers.argmax())
    name = split_of(bags[highest].file)
    are_ranks = name is not None and name.number != numbers[highest]

    spans = [
        (series, begin, end, late[slice(*among)].tolist() if is_recording(series) else [])
        for series, (begin, end), among in zip(
            all_series, pairwise(edges.tolist()), pairwise(late_edges), strict=True
        )
        if begin < end
    ]
    looked_at = {at for _, begin, end, lates in spans for at in (begin, end - 1, *lates)}
    looked_at |= {at + 1 for at in looked_at if at + 1 < len(order)}
    rows = order[[*looked_at]].tolist()
    made = {
        at: Split(int(numbers[row]), bag)
        for at, row, bag in zip(looked_at, rows, bags.at(rows), strict=True)
    }

    def split(series: Series, at: int) -> Split:
        number, bag = made[at]
        return Split(int(stem_of(bag.file).removeprefix(series)) if are_ranks else number, bag)

    ranges: dict[Series, SplitRange] = {}
    for series, begin, end, lates in spans:
        pairs = [(split(series, at), split(series, at + 1)) for at in lates if at + 1 < end]
        first, last = split(series, begin), split(series, end - 1)
        ranges[series] = SplitRange(first, last, tuple(_steps_of(pairs)))
    return ranges


def steps_of(segments: Iterable[Segment]) -> list[StepBack]:
    """Returns where the clock was set back, from the ranges of all segments in order.

    All bags are looked at only of series whose ranges do not follow each other.
    """
    by_series: dict[Series, list[Segment]] = {}
    for segment in segments:
        for series in filter(is_recording, segment.split_ranges):
            by_series.setdefault(series, []).append(segment)
    steps: list[StepBack] = []
    for series, holding in by_series.items():
        ranges = [segment.split_ranges[series] for segment in holding]
        pairs = [*pairwise(ranges)]
        if all(earlier.last.number < later.first.number for earlier, later in pairs):
            steps.extend(chain.from_iterable(split_range.steps for split_range in ranges))
            steps.extend(_steps_of((earlier.last, later.first) for earlier, later in pairs))
        else:
            bags = chain.from_iterable(segment.bags for segment in holding)
            steps.extend(_steps_of(pairwise(_splits_of(series, bags))))
    return steps


def neighbours(file: str, segments: Iterable[Segment]) -> Neighbours:
    """Returns the nearest splits on both sides of a file in its series."""
    name = split_of(file)
    if name is None:
        return Neighbours()
    series, number = name
    splits: list[Split] = []
    for segment in segments:
        split_range = segment.split_ranges.get(series)
        if split_range is not None:
            first, last, _ = split_range
            is_inside = first.number < number < last.number
            splits += _splits_of(series, segment.bags) if is_inside else (first, last)
    lower = (split for split in splits if split.number < number)
    higher = (split for split in splits if split.number > number)
    before = max(lower, key=_BY_NUMBER, default=None)
    after = min(higher, key=_BY_NUMBER, default=None)
    return Neighbours(before and before.bag.end, after and after.bag.start)


def _splits_of(series: Series, bags: Iterable[BagFile]) -> list[Split]:
    """Returns the splits of a series among these bags, by number."""
    named = ((split_of(bag.file), bag) for bag in bags if bag.file.startswith(series))
    splits = [Split(name.number, bag) for name, bag in named if name and name.series == series]
    return sorted(splits, key=_BY_NUMBER)


def _steps_of(pairs: Iterable[tuple[Split, Split]]) -> Iterator[StepBack]:
    """Yields where the clock was set back between two splits that follow each other."""
    for earlier, later in pairs:
        by = earlier.bag.end - later.bag.start
        if earlier.number < later.number and by > OUT_OF_ORDER_NS:
            yield StepBack(earlier.bag, later.bag, by)
