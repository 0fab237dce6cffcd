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


_BY_NUMBER: Final = attrgetter("number")


def stem_of(file: str) -> str:
    """Returns the path of a bag without its suffixes."""
    stem = file.removesuffix(COMPRESSED)
    return stem[: stem.rfind(".")]


def split_of(file: str) -> tuple[Series, int] | None:
    """Returns the series of a bag file and its number there; None where its name has no number."""
    stem = stem_of(file)
    series = stem.rstrip("0123456789")
    return None if series == stem else (series, int(stem[len(series) :]))


def is_recording(series: Series) -> bool:
    """Returns whether files are named as `ros2 bag record` names the splits of a recording."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def split_ranges_of(bags: Iterable[BagFile]) -> dict[Series, SplitRange]:
    """Returns the range of each series among these bags."""
    ranges: dict[Series, SplitRange] = {}
    for series, splits in _by_series(bags).items():
        steps = _steps(splits) if is_recording(series) else []
        ranges[series] = SplitRange(splits[0], splits[-1], tuple(steps))
    return ranges


def steps_of(segments: Iterable[Segment]) -> list[StepBack]:
    """Returns where the clock was set back, from the ranges of all segments in order.

    All bags are looked at only of series whose ranges do not follow each other.
    """
    found: dict[Series, list[Segment]] = {}
    for segment in segments:
        for series in segment.split_ranges:
            if is_recording(series):
                found.setdefault(series, []).append(segment)
    steps: list[StepBack] = []
    for series, holding in found.items():
        ranges_of_series = [segment.split_ranges[series] for segment in holding]
        if all(a.last.number < b.first.number for a, b in pairwise(ranges_of_series)):
            steps.extend(chain.from_iterable(each.steps for each in ranges_of_series))
            for a, b in pairwise(ranges_of_series):
                steps.extend(_steps((a.last, b.first)))
        else:
            bags = chain.from_iterable(segment.bags for segment in holding)
            steps.extend(_steps(_by_series(bags)[series]))
    return steps


def neighbours(file: str, segments: Iterable[Segment]) -> Neighbours:
    """Returns the nearest splits on both sides of a file in its series."""
    split = split_of(file)
    if split is None:
        return Neighbours()
    series, number = split
    splits: list[Split] = []
    for segment in segments:
        known = segment.split_ranges.get(series)
        if known is not None:
            is_inside = known.first.number < number < known.last.number
            splits += _by_series(segment.bags)[series] if is_inside else known[:2]
    before = max((each for each in splits if each.number < number), key=_BY_NUMBER, default=None)
    after = min((each for each in splits if each.number > number), key=_BY_NUMBER, default=None)
    return Neighbours(before and before.bag.end, after and after.bag.start)


def _by_series(bags: Iterable[BagFile]) -> dict[Series, list[Split]]:
    """Returns the splits of each series among these bags, by number."""
    found: dict[Series, list[Split]] = {}
    for bag in bags:
        split = split_of(bag.file)
        if split is not None:
            found.setdefault(split[0], []).append(Split(split[1], bag))
    for splits in found.values():
        splits.sort(key=_BY_NUMBER)
    return found


def _steps(splits: Iterable[Split]) -> list[StepBack]:
    return [
        StepBack(a.bag, b.bag, a.bag.end - b.bag.start)
        for a, b in pairwise(splits)
        if a.number < b.number and a.bag.end - b.bag.start > OUT_OF_ORDER_NS
    ]
