"""The splits of a recording in the order in which they were written, whatever their times are.

`ros2 bag record` names its files after the folder and numbers them (`rec_3.mcap`). Those numbers
are the only order that a clock cannot spoil: they show where the clock was set back, and which
splits lie on both sides of one that cannot be read.
"""

from __future__ import annotations

from itertools import chain, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.model import COMPRESSED

if TYPE_CHECKING:
    from collections.abc import Iterable

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


def is_recording(series: Series) -> bool:
    """Returns whether files are named as `ros2 bag record` names the splits of a recording."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def split_ranges_of(bags: Iterable[BagFile]) -> dict[Series, SplitRange]:
    """Returns the range of each series among these bags."""
    ranges: dict[Series, SplitRange] = {}
    for series, splits in _by_series(bags).items():
        steps = _steps_between(splits) if is_recording(series) else []
        ranges[series] = SplitRange(splits[0], splits[-1], tuple(steps))
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
            for earlier, later in pairs:
                steps.extend(_steps_between((earlier.last, later.first)))
        else:
            bags = chain.from_iterable(segment.bags for segment in holding)
            steps.extend(_steps_between(_by_series(bags)[series]))
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
            splits += _by_series(segment.bags)[series] if is_inside else (first, last)
    lower = (split for split in splits if split.number < number)
    higher = (split for split in splits if split.number > number)
    before = max(lower, key=_BY_NUMBER, default=None)
    after = min(higher, key=_BY_NUMBER, default=None)
    return Neighbours(before and before.bag.end, after and after.bag.start)


def _by_series(bags: Iterable[BagFile]) -> dict[Series, list[Split]]:
    """Returns the splits of each series among these bags, by number."""
    by_series: dict[Series, list[Split]] = {}
    for bag in bags:
        name = split_of(bag.file)
        if name is not None:
            by_series.setdefault(name.series, []).append(Split(name.number, bag))
    for splits in by_series.values():
        splits.sort(key=_BY_NUMBER)
    return by_series


def _steps_between(splits: Iterable[Split]) -> list[StepBack]:
    return [
        StepBack(earlier.bag, later.bag, earlier.bag.end - later.bag.start)
        for earlier, later in pairwise(splits)
        if earlier.number < later.number and earlier.bag.end - later.bag.start > OUT_OF_ORDER_NS
    ]
