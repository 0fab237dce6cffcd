"""The splits of a recording in the order in which they were written, whatever their times are.

`ros2 bag record` names its files after the folder and numbers them (`rec_3.mcap`). Those numbers
are the only order that a clock cannot spoil: they show where the clock was set back, and which
splits lie on both sides of one that cannot be read.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.model import COMPRESSED
from ros2_memory.core.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.core.arrays import Ints
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

Series: TypeAlias = str
"""The path of a bag file without its number: what the files of one recording share."""


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
    numbers: Ints


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


def steps_of(timeline: Timeline) -> list[StepBack]:
    """Returns where the clock was set back between two splits of a recording that follow.

    Those that are damaged are passed over: their times may be, too.
    """
    position_of: dict[Series, int] = {}
    all_series, all_numbers = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for rows in (segment.bags for segment in timeline.segments):
        stems, positions, numbers = rows.names
        of_stems = [
            position_of.setdefault(series, len(position_of)) if is_recording(series) else -1
            for series, *_ in stems
        ]
        is_damaged = rows.with_schema(attrgetter("is_damaged"))
        all_series.append(np.where(is_damaged, -1, np.array(of_stems)[positions]))
        all_numbers.append(numbers)
    series, numbers = np.concatenate(all_series), np.concatenate(all_numbers)
    bags, starts, ends = timeline.bags, timeline.starts, timeline.ends
    order = np.lexsort((numbers, series))
    before, after = order[:-1], order[1:]
    is_next = (series[before] == series[after]) & (series[after] >= 0)
    is_next &= (numbers[before] >= 0) & (numbers[before] < numbers[after])
    begins = np.minimum(starts[after], MAX_NS - OUT_OF_ORDER_NS)
    is_late = is_next & (ends[before] > begins + OUT_OF_ORDER_NS)
    return [
        StepBack(bags[earlier], bags[later], int(ends[earlier]) - int(starts[later]))
        for earlier, later in zip(before[is_late].tolist(), after[is_late].tolist(), strict=True)
    ]


def neighbours(file: str, segments: Iterable[Segment]) -> Neighbours:
    """Returns the nearest splits on both sides of a file in its series."""
    name = split_of(file)
    if name is None:
        return Neighbours()
    lower: list[tuple[int, Ns]] = []
    higher: list[tuple[int, Ns]] = []
    for bags in (segment.bags for segment in segments):
        stems, positions, numbers = bags.names
        is_of_series = np.array([stem.series == name.series for stem in stems])[positions]
        rows = np.flatnonzero(is_of_series & (numbers >= 0))
        rows = rows[np.argsort(numbers[rows], kind="stable")]
        before = rows[numbers[rows] < name.number][-1:]
        after = rows[numbers[rows] > name.number][:1]
        lower += zip(numbers[before].tolist(), bags.ends[before].tolist(), strict=True)
        higher += zip(numbers[after].tolist(), bags.starts[after].tolist(), strict=True)
    return Neighbours(max(lower)[1] if lower else None, min(higher)[1] if higher else None)
