"""The splits of a recording in the order in which they were written, whatever their times are.

`ros2 bag record` names its files after the folder and numbers them (`rec_3.mcap`). The numbers are
the only order that a clock cannot spoil: they show where the clock was set back, and which splits
lie around an unreadable one.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.model import COMPRESSED
from ros2_memory.core.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

Series: TypeAlias = str
"""The path of a bag file without its number and suffixes: all splits of a recording share it."""


class Neighbours(NamedTuple):
    """The splits around a file: the last log time before it and the first after it, if known."""

    before: Ns | None = None
    after: Ns | None = None


class StepBack(NamedTuple):
    """A clock that was set back during a recording: `after` begins `by` before `before` ends.

    If the clock was set back within a bag, both are that bag.
    """

    before: BagFile
    after: BagFile
    by: Ns


class SplitName(NamedTuple):
    """The series of a bag file, and its number in the series."""

    series: Series
    number: int


class Stem(NamedTuple):
    """What the paths of splits share: the series, zeros before the number, and the suffixes."""

    series: Series
    zeros: str
    suffix: str


class SplitNames(NamedTuple):
    """The paths of many bags, in little memory.

    Attributes:
        stems: the different stems.
        positions: for each bag, the index of its stem.
        numbers: for each bag, its number in the series; -1 if its name has none.
    """

    stems: Sequence[Stem]
    positions: NDArray[np.uint16]
    numbers: Ints


def stem_of(file: str) -> str:
    """Returns the path of a bag without its suffixes."""
    path = file.removesuffix(COMPRESSED)
    stem, dot, suffix = path.rpartition(".")
    return stem if dot and "/" not in suffix else path


def split_of(file: str) -> SplitName | None:
    """Returns the series of a bag file and its number; None if its name has no number."""
    stem = stem_of(file)
    series = stem.rstrip("0123456789")
    return None if series == stem else SplitName(series, int(stem[len(series) :]))


def split_names_of(files: Iterable[str]) -> SplitNames:
    """Returns the paths of bags split into stems and numbers."""
    position_of: dict[Stem, int] = {}
    positions, numbers = list[int](), list[int]()
    following, position, number, stem = "", 0, 0, Stem("", "", "")
    for file in files:
        # Mostly the next bag is the next split: then there is nothing to parse.
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
    # A date with microseconds is a number of 20 digits: too many for 64 bits.
    dtype = np.int64 if max(numbers, default=0) <= MAX_NS else object
    return SplitNames([*position_of], np.array(positions, np.uint16), np.array(numbers, dtype))


def is_recording(series: Series) -> bool:
    """Returns whether a series is named as `ros2 bag record` names splits: after its folder."""
    folder, _, prefix = series.rpartition("/")
    return prefix == f"{folder.rpartition('/')[2]}_"


def steps_of(timeline: Timeline) -> list[StepBack]:
    """Returns where the clock was set back between two consecutive splits of a recording.

    Damaged bags are passed over: their times may be wrong.
    """
    bags, starts, ends = timeline.bags, timeline.starts, timeline.ends
    order, apart = _in_series(timeline)
    before, after = order[:-1], order[1:]
    begins = np.minimum(starts[after], MAX_NS - OUT_OF_ORDER_NS)
    is_late = (apart > 0) & (ends[before] > begins + OUT_OF_ORDER_NS)
    return [
        StepBack(bags[earlier], bags[later], int(ends[earlier]) - int(starts[later]))
        for earlier, later in zip(before[is_late].tolist(), after[is_late].tolist(), strict=True)
    ]


def splits_before_set_ahead(
    timeline: Timeline, set_ahead: Mapping[BagFile, Ns], far: Ns
) -> dict[BagFile, Ns]:
    """Returns the splits from before a recording's clock was set ahead, with how far that was (ns).

    Args:
        timeline: the bags.
        set_ahead: the bags in which the clock was set, with how far (ns).
        far: the clock was also set where the next split begins so much later (ns).
    """
    starts, ends = timeline.starts, np.maximum(timeline.ends, 0)
    bags, (order, apart) = timeline.bags, _in_series(timeline)
    before, after = order[:-1], order[1:]
    is_next = apart == 1
    run = np.concatenate(([0], np.cumsum(~is_next)))
    places = np.flatnonzero(is_next & (starts[after] - ends[before] >= far)).tolist()
    steps = [(place, int(starts[after[place]]) - int(ends[before[place]])) for place in places]
    for bag, by in set_ahead.items():
        rows = np.flatnonzero((starts == bag.start) & (ends == max(bag.end, 0))).tolist()
        steps += [
            (int(np.flatnonzero(order == row)[0]) - 1, by) for row in rows if bags[row] == bag
        ]
    found: dict[BagFile, Ns] = {}
    for place, by in steps:
        following = place + 1
        first = int(np.searchsorted(run, run[following]))
        found |= {bags[row]: by for row in order[first:following].tolist()}
    return found


def _in_series(timeline: Timeline) -> tuple[Ints, Ints]:
    """Returns the bags in the order of their series, and how far apart their numbers are there.

    The second has a number for each two neighbours: 0 if they are not two splits of one series, or
    if one of them is damaged.
    """
    code_of: dict[Series, int] = {}
    codes, numbers = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for bags in (segment.bags for segment in timeline.segments):
        code_of_stem = [
            code_of.setdefault(stem.series, len(code_of)) if is_recording(stem.series) else -1
            for stem in bags.names.stems
        ]
        is_damaged = bags.with_schema(attrgetter("is_damaged"))
        codes.append(np.where(is_damaged, -1, np.array(code_of_stem)[bags.names.positions]))
        numbers.append(bags.names.numbers)
    series, number = np.concatenate(codes), np.concatenate(numbers)
    order = np.lexsort((number, series))
    before, after = order[:-1], order[1:]
    are_splits = (series[before] == series[after]) & (series[after] >= 0) & (number[before] >= 0)
    return order, np.where(are_splits, number[after] - number[before], 0)


def neighbours(file: str, segments: Iterable[Segment]) -> Neighbours:
    """Returns the nearest splits on both sides of a file in its series."""
    name = split_of(file)
    if name is None:
        return Neighbours()
    before: list[tuple[int, Ns]] = []  # number and end of the nearest split of each segment
    after: list[tuple[int, Ns]] = []  # number and start
    for bags in (segment.bags for segment in segments):
        stems, positions, numbers = bags.names
        is_of_series = np.array([stem.series == name.series for stem in stems])[positions]
        rows = np.flatnonzero(is_of_series & (numbers >= 0))
        rows = rows[np.argsort(numbers[rows], kind="stable")]
        lower, higher = rows[numbers[rows] < name.number], rows[numbers[rows] > name.number]
        if lower.size:
            before.append((int(numbers[lower[-1]]), int(bags.ends[lower[-1]])))
        if higher.size:
            after.append((int(numbers[higher[0]]), int(bags.starts[higher[0]])))
    _, end = max(before, default=(0, None))
    _, start = min(after, default=(0, None))
    return Neighbours(end, start)
