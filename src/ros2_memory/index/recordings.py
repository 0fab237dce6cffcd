"""Which bags are of one recording, and which recordings overlap in time.

A recording is mostly a folder. Bags that somebody copied into one folder are of several: each file
is a recording of its own, and so are files that `ros2 bag record` numbered (`run_0.mcap`,
`run_1.mcap`) and that follow each other.

Recordings that were copied into one folder, two robots' for instance, answer as one memory. Where
one recording took over from another they overlap too: that is written down in `handover.json`,
each message counts once, and there is nothing to report.
"""

from __future__ import annotations

import re
from functools import partial
from heapq import nlargest
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BAG_KINDS
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.split_order import split_of, stem_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.bag_rows import BagRows
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.snapshot import Snapshot

_OF_NAME: Final = rf"(?:/.*|(?:_\d+)?(?:{'|'.join(map(re.escape, BAG_KINDS))}))?"
"""What may follow the name of a recording in a path: what is in its folder, or a bag's suffix."""

LONG_NS: Final[Ns] = 30 * NS_PER_S
"""No handover takes longer; a shorter overlap counts where it is half of a recording."""
SHORT_NS: Final[Ns] = NS_PER_S
_IN_MOMENTS: Final = f"/{MOMENTS_FOLDER}/"
_MOMENT: Final = re.compile(rf"(?P<bag_dir>.*){_IN_MOMENTS}\d{{8}}T\d{{6}}Z[^/]*/(?P<recording>.+)")
_MAX_READ: Final = 200
"""How many pairs are checked for a handover; each costs two files."""
_OVERLAPS: Final[Key[tuple[Overlapping, ...]]] = Key()
"""Of a timeline: its pairs, but for their handovers."""


def paths_named(path: str) -> re.Pattern[str]:
    """Returns what the paths of a recording match.

    `path` is that of a folder, a bag, or the bags of one series (`run` for `run_0.mcap` and its
    like).
    """
    return re.compile(re.escape(path) + _OF_NAME)


def recordings_of(
    snapshot: Snapshot, is_wanted: Callable[[SummarySchema], object] = lambda _: True
) -> dict[str, list[BagFile]]:
    """Returns the bags of each recording, by its path: a folder, or that of a bag less its suffix.

    With `data.recording` each of these names, below the bag directory, is one recording. Only the
    bags with a schema that `is_wanted`.
    """
    recordings: dict[str, list[BagFile]] = {}
    for bags, paths in _with_recordings(snapshot, snapshot.timeline.recorded_segments):
        rows = np.flatnonzero(bags.with_schema(is_wanted))
        for row, bag in zip(rows.tolist(), bags.at(rows), strict=True):
            recordings.setdefault(paths[row], []).append(bag)
    return recordings


def _with_recordings(
    snapshot: Snapshot, segments: Iterable[Segment]
) -> Iterator[tuple[BagRows, Sequence[str]]]:
    """Yields the bags of segments, and of each one the path of its recording."""
    loose = loose_bags(snapshot)
    for bags in (segment.bags for segment in segments):
        paths = [bags.folders[nth] for nth in bags.folder_of.tolist()]
        if loose:
            paths = [*map(loose.get, bags.files(), paths)]
        yield bags, paths


def name_of(path: str, bags: Sequence[BagFile], root: str) -> str:
    """Returns the name, below the bag directory `root`, under which a recording is found.

    `path` and `bags` are an item of `recordings_of`.
    """
    if path != root:
        return path.removeprefix(f"{root}/")
    # Its bags lie in the folder itself.
    name = stem_of(bags[0].file).removeprefix(f"{root}/")
    return name if len(bags) == 1 else name.rpartition("_")[0]


def loose_bags(snapshot: Snapshot) -> dict[str, str]:
    """Returns the recording of each bag that lies loose in a folder, by path of the bag.

    A folder with a metadata.yaml is one recording, and so is one whose bags are
    named after it, or with a number alone.
    """
    series: dict[str, list[BagFile]] = {}
    whole = {*snapshot.metadata_folders}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        # Those of one stem are alike in this.
        positions = bags.names.positions
        firsts = bags.files(np.unique(positions, return_index=True)[1])
        are_loose = [
            file.rpartition("/")[0] not in whole and not is_named_after_folder(file)
            for file in firsts
        ]
        for bag in bags.at(np.array(are_loose)[positions]):
            series.setdefault(_series_of(bag.file), []).append(bag)
    recordings: dict[str, str] = {}
    for name, members in series.items():
        are_splits = _are_splits(members)
        recordings |= {bag.file: name if are_splits else stem_of(bag.file) for bag in members}
    return recordings


def is_named_after_folder(file: str) -> bool:
    """Returns whether a bag is named as a split of the recording of its folder, or by a number."""
    folder, _, name = file.rpartition("/")
    return name.startswith(f"{folder.rpartition('/')[2]}_") or name.partition(".")[0].isdigit()


def _series_of(file: str) -> str:
    """Returns the path of a bag without its suffixes, and without its number where it has one."""
    name = split_of(file)
    return name.series[:-1] if name and name.series.endswith("_") else stem_of(file)


def _are_splits(bags: Sequence[BagFile]) -> bool:
    """Returns whether bags are numbered, and each ends before the next begins."""
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end))
    is_numbered = len(bags) == 1 or all(_series_of(bag.file) != stem_of(bag.file) for bag in bags)
    return is_numbered and all(
        bag.end <= next_bag.start + OUT_OF_ORDER_NS for bag, next_bag in pairwise(ordered)
    )


class Overlapping(NamedTuple):
    """Two recordings, by their paths, and when (log times, inclusive) they overlap."""

    first: Path
    second: Path
    start: Ns
    end: Ns

    @property
    def names(self) -> tuple[str, str]:
        """The names of the two, with those of their parents where these are equal."""
        depth = 1 if self.first.name != self.second.name else 2
        first, second = ("/".join(path.parts[-depth:]) for path in (self.first, self.second))
        return first, second


def overlapping_recordings(
    snapshot: Snapshot, joined_with: Callable[[Path], tuple[str, ...]]
) -> tuple[Overlapping, ...]:
    """Returns the pairs of recordings that overlap and that no handover joins, in order of time.

    `joined_with` returns the names of recordings that handovers join with one.
    Thinned days and bags that a wrong clock dated are left out. Those in a saved moment count with
    the recording that they were saved from.
    """
    overlaps = snapshot.timeline.memo.of(_OVERLAPS, partial(_long_overlaps, snapshot))
    return tuple(pair for pair in overlaps if not _took_over(pair, joined_with))


def _long_overlaps(snapshot: Snapshot) -> tuple[Overlapping, ...]:
    """Returns the pairs that share most time, in order of time, also those of handovers."""
    lengths, overlaps = _sweep(snapshot)
    pairs = []
    for (first, second), overlap in overlaps.items():
        shorter = min(lengths[first], lengths[second])
        shared = overlap.shared
        if shared > LONG_NS or (shared > SHORT_NS and 2 * shared >= shorter):
            pair = Overlapping(Path(first), Path(second), overlap.start, overlap.end)
            pairs.append((shared, pair))
    longest = nlargest(_MAX_READ, pairs, key=itemgetter(0))
    return tuple(sorted((pair for _, pair in longest), key=lambda pair: pair.start))


class _Overlap(NamedTuple):
    """When two recordings have bags at once: first and last log time, and how much between them."""

    start: Ns
    end: Ns
    shared: Ns

    def extended(self, start: Ns, end: Ns) -> _Overlap:
        """Returns it with a time that begins later; a part of that may be in it already."""
        more = max(end - max(start, self.end), 0)
        return _Overlap(self.start, max(end, self.end), self.shared + more)


def _sweep(snapshot: Snapshot) -> tuple[dict[str, Ns], dict[tuple[str, str], _Overlap]]:
    """Returns how long each recording is, and where two of them have bags at once."""
    lengths: dict[str, Ns] = {}
    overlaps: dict[tuple[str, str], _Overlap] = {}
    ends: dict[str, Ns] = {}  # of the recordings that may last into the next bag
    bags_of_segments = (
        zip(paths, bags.starts.tolist(), bags.ends.tolist(), strict=True)
        for bags, paths in _with_recordings(snapshot, snapshot.whole_segments)
    )
    for path, start, end in chain.from_iterable(bags_of_segments):
        recording = _recorded_folder(path) if _IN_MOMENTS in path else path
        for other in [name for name in ends if name != recording]:
            if ends[other] <= start:
                del ends[other]
                continue
            pair = (min(other, recording), max(other, recording))
            overlap = overlaps.get(pair, _Overlap(start, start, 0))
            overlaps[pair] = overlap.extended(start, min(ends[other], end))
        before = ends.get(recording)
        added = end - max(start, before or start)
        lengths[recording] = lengths.get(recording, 0) + max(added, 0)
        ends[recording] = max(before or end, end)
    return lengths, overlaps


def _recorded_folder(folder: str) -> str:
    """Returns the folder of the recording that a folder in a saved moment has bags of."""
    match = _MOMENT.fullmatch(folder)
    return f"{match['bag_dir']}/{match['recording']}" if match else folder


def _took_over(pair: Overlapping, joined_with: Callable[[Path], tuple[str, ...]]) -> bool:
    """Returns whether a handover joins the two recordings."""
    first, second = pair.first, pair.second
    is_named = second.name in joined_with(first) or first.name in joined_with(second)
    return first.parent == second.parent and is_named
