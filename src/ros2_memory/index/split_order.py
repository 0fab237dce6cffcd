"""The splits of a recording in the order in which they were written, whatever their times say.

`ros2 bag record` names its files after the folder and counts them (`rec_3.mcap`). That count is the
only order that a clock cannot spoil. So it tells where the clock stepped back, and which splits
lie on both sides of one that cannot be read.
"""

from __future__ import annotations

from itertools import chain, pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from ros2_memory.bag_dir.layout import COMPRESSED
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns

Bags: TypeAlias = "Callable[[Sequence[int]], Iterable[BagFile]]"

Series: TypeAlias = str
"""The path of a bag file up to its count: what the files of one recording share."""


class Split(NamedTuple):
    """A bag with its count in its series."""

    number: int
    bag: BagFile


class Neighbours(NamedTuple):
    """The end of the split before and the start of the one after (inclusive); None without one."""

    before: Ns | None = None
    after: Ns | None = None


class StepBack(NamedTuple):
    """A clock that was set back while a recording ran: `after` begins `by` before `before` ends.

    Both are one bag where that was while it was being written.
    """

    before: BagFile
    after: BagFile
    by: Ns


class SplitRange(NamedTuple):
    """A series among some bags: its first and last split by count, and the steps between."""

    first: Split
    last: Split
    steps: tuple[StepBack, ...]


def place_of(file: str) -> tuple[Series, int] | None:
    """The series of a bag file and its count there; None where its name has no count."""
    stem = file.removesuffix(COMPRESSED)
    stem = stem[: stem.rfind(".")]
    series = stem.rstrip("0123456789")
    return None if series == stem else (series, int(stem[len(series) :]))


def is_recording(series: Series) -> bool:
    """Whether files are called as `ros2 bag record` calls the splits of one recording."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def split_ranges_of(bags: Iterable[BagFile]) -> dict[Series, SplitRange]:
    """The course of each series among these bags."""
    series: dict[Series, list[Split]] = {}
    for bag in bags:
        place = place_of(bag.file)
        if place is not None:
            series.setdefault(place[0], []).append(Split(place[1], bag))
    return {each: _course(each, splits) for each, splits in series.items()}


def steps_of(parts: Sequence[Mapping[Series, SplitRange]], bags: Bags) -> list[StepBack]:
    """Where the clock stepped back, from the courses of all parts of a history in order.

    `bags` gives all bags of some parts; it is asked only where those of a series do not follow each
    other.
    """
    found: dict[Series, list[int]] = {}
    for number, part in enumerate(parts):
        for series in part:
            if is_recording(series):
                found.setdefault(series, []).append(number)
    steps: list[StepBack] = []
    for series, numbers in found.items():
        courses = [parts[number][series] for number in numbers]
        if all(a.last.number < b.first.number for a, b in pairwise(courses)):
            steps.extend(chain.from_iterable(course.steps for course in courses))
            for a, b in pairwise(courses):
                steps.extend(_steps((a.last, b.first)))
        else:
            steps.extend(_steps(in_series(series, bags(numbers))))
    return steps


def in_series(series: Series, bags: Iterable[BagFile]) -> list[Split]:
    """The bags of a series, by their count."""
    places = ((place_of(bag.file), bag) for bag in bags)
    splits = [Split(place[1], bag) for place, bag in places if place and place[0] == series]
    return sorted(splits, key=_by_count)


def neighbours(file: str, parts: Sequence[Mapping[Series, SplitRange]], bags: Bags) -> Neighbours:
    """What lies on both sides of a file in its series, as near as there is something.

    `bags` gives all bags of some parts; it is asked only for those that the file's count falls in.
    """
    place = place_of(file)
    if place is None:
        return Neighbours()
    series, number = place
    splits: list[Split] = []
    for at, part in enumerate(parts):
        course = part.get(series)
        if course is not None:
            inside = course.first.number < number < course.last.number
            splits += in_series(series, bags([at])) if inside else (course.first, course.last)
    before = max((each for each in splits if each.number < number), key=_by_count, default=None)
    after = min((each for each in splits if each.number > number), key=_by_count, default=None)
    return Neighbours(before and before.bag.end, after and after.bag.start)


def _course(series: Series, splits: list[Split]) -> SplitRange:
    splits.sort(key=_by_count)
    steps = _steps(splits) if is_recording(series) else []
    return SplitRange(splits[0], splits[-1], tuple(steps))


def _by_count(split: Split) -> int:
    return split.number


def _steps(splits: Iterable[Split]) -> list[StepBack]:
    return [
        StepBack(a.bag, b.bag, a.bag.end - b.bag.start)
        for a, b in pairwise(splits)
        if a.number < b.number and a.bag.end - b.bag.start > OUT_OF_ORDER_NS
    ]
