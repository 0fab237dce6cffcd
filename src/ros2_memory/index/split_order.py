"""The splits of a recording in the order in which they were written, whatever their times are.

`ros2 bag record` names its files after the folder and numbers them (`rec_3.mcap`). Those numbers
are the only order that a clock cannot spoil: they show where the clock was set back, and which
splits lie on both sides of one that cannot be read.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import chain, pairwise, repeat
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
    from ros2_memory.index.bag_rows import BagRows
    from ros2_memory.index.segment import Segment

Series: TypeAlias = str
"""The path of a bag file without its number: what the files of one recording share."""


class Split(NamedTuple):
    """A bag with its number in its series: a row of some bags, and its first and last log time."""

    number: int
    start: Ns
    end: Ns
    row: int
    bags: BagRows

    @property
    def bag(self) -> BagFile:
        """The bag, which is made when it is asked for."""
        return self.bags[self.row]


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


class Stem(NamedTuple):
    """What the paths of bags share: their series, zeros before the number, and the suffixes."""

    series: Series
    zeros: str
    suffix: str


class SplitNames(NamedTuple):
    """The paths of some bags.

    Attributes:
        stems: the different ones, in order of the bags.
        positions: for each bag, where its stem is among these.
        numbers: of the bags in their series; -1 where the name has none.
    """

    stems: Sequence[Stem]
    positions: NDArray[np.uint16]
    numbers: NDArray[np.int64]


_BY_NUMBER: Final = attrgetter("number")


def stem_of(file: str) -> str:
    """Returns the path of a bag without its suffixes."""
    path = file.removesuffix(COMPRESSED)
    stem, dot, suffix = path.rpartition(".")
    return stem if dot and "/" not in suffix else path


def split_of(file: str) -> SplitName | None:
    """Returns the series of a bag file and its number there; None where its name has no number."""
    stem = stem_of(file)
    series = stem.rstrip("0123456789")
    return None if series == stem else SplitName(series, int(stem[len(series) :]))


def split_names_of(files: Iterable[str]) -> SplitNames:
    """Returns what the names of bags say, which are paths."""
    position_of: dict[Stem, int] = {}
    positions, numbers = list[int](), list[int]()
    following, position, number, stem = "", 0, 0, Stem("", "", "")
    for file in files:
        # Mostly the bag after one is the next split.
        if file == following:
            number += 1
        else:
            path = stem_of(file)
            series, number = split_of(file) or (path, -1)
            zeros = path[len(series) :].removesuffix(str(number))
            stem = Stem(series, zeros, file[len(path) :])
            position = position_of.setdefault(stem, len(position_of))
        positions.append(position)
        numbers.append(number)
        following = f"{stem.series}{stem.zeros}{number + 1}{stem.suffix}"
    # A date with microseconds has 20 digits.
    dtype = np.int64 if max(numbers, default=0) <= MAX_NS else object
    return SplitNames([*position_of], np.array(positions, np.uint16), np.array(numbers, dtype))


def is_recording(series: Series) -> bool:
    """Returns whether files are named as `ros2 bag record` names the splits of a recording."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def split_ranges_of(bags: BagRows) -> dict[Series, SplitRange]:
    """Returns the range of each series among some bags."""
    position_of: dict[Series, int] = {}
    of_stems = [position_of.setdefault(stem.series, len(position_of)) for stem in bags.names.stems]
    positions, numbers = np.array(of_stems)[bags.names.positions], bags.names.numbers
    order = np.lexsort((numbers, positions))
    order = order[numbers[order] >= 0]
    edges = np.searchsorted(positions[order], np.arange(len(position_of) + 1))
    # Few splits begin before the one before them has ended.
    before, after = order[:-1], order[1:]
    late = (bags.ends[before] > bags.starts[after]) & (positions[before] == positions[after])
    pairs: dict[int, list[tuple[Split, Split]]] = defaultdict(list)
    for earlier, later in zip(_splits(bags, before[late]), _splits(bags, after[late]), strict=True):
        pairs[int(positions[later.row])].append((earlier, later))
    there = np.flatnonzero(np.diff(edges))
    firsts, lasts = (_splits(bags, order[at]) for at in (edges[there], edges[there + 1] - 1))
    all_series = [*position_of]
    return {
        all_series[at]: SplitRange(first, last, tuple(_steps_of(pairs[at])))
        for at, first, last in zip(there.tolist(), firsts, lasts, strict=True)
    }


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
            splits = chain.from_iterable(_splits_of(series, segment.bags) for segment in holding)
            steps.extend(_steps_of(pairwise(sorted(splits, key=_BY_NUMBER))))
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
    return Neighbours(before and before.end, after and after.start)


def _splits_of(series: Series, bags: BagRows) -> Iterator[Split]:
    """Yields the splits of a series among these bags."""
    stems, positions, numbers = bags.names
    is_of = np.array([stem.series == series for stem in stems])
    return _splits(bags, np.flatnonzero(is_of[positions] & (numbers >= 0)))


def _splits(bags: BagRows, rows: NDArray[np.intp]) -> Iterator[Split]:
    """Yields the splits in some rows of bags."""
    of_bags = bags.names.numbers, bags.starts, bags.ends
    return map(Split, *(of[rows].tolist() for of in of_bags), rows.tolist(), repeat(bags))


def _steps_of(pairs: Iterable[tuple[Split, Split]]) -> Iterator[StepBack]:
    """Yields where the clock was set back between two splits that follow each other."""
    for earlier, later in pairs:
        by = earlier.end - later.start
        if earlier.number < later.number and by > OUT_OF_ORDER_NS:
            yield StepBack(earlier.bag, later.bag, by)
