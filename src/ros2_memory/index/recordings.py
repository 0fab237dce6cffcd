"""Which bags are of one recording, and which recordings overlap in time.

Most recordings are a folder. Where somebody copied bags of several recordings into one folder, each
file is a recording. Files that `ros2 bag record` numbered (`run_0.mcap`, `run_1.mcap`), and that
follow each other in time, are one recording together.

Recordings in one bag directory answer as one memory, even if they are of two robots: overlaps show
that. A recording that took over from another overlaps it as well. But `handover.json` says so, each
message counts once, and there is nothing to report.
"""

from __future__ import annotations

import re
from functools import partial
from heapq import nlargest
from itertools import pairwise
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

LONG_NS: Final[Ns] = 30 * NS_PER_S
"""A longer overlap always counts: no handover takes that long."""
SHORT_NS: Final[Ns] = NS_PER_S
"""A longer overlap counts if it is at least half of the shorter recording."""
_IN_MOMENTS: Final = f"/{MOMENTS_FOLDER}/"
_MOMENT: Final = re.compile(rf"(?P<bag_dir>.*){_IN_MOMENTS}\d{{8}}T\d{{6}}Z[^/]*/(?P<recording>.+)")
_MAX_READ: Final = 200
"""How many pairs are checked for a handover; each check reads two files."""
_OVERLAPS: Final[Key[tuple[Overlapping, ...]]] = Key()
"""Of a timeline: the pairs that overlap for long, including handovers."""
_BESIDE_OTHERS: Final[Key[dict[tuple[str, ...], dict[str, str]]]] = Key()
"""Of a timeline: `loose_bags_beside_others`, by the folders with a metadata.yaml."""


def paths_named(path: str) -> re.Pattern[str]:
    """Returns a pattern for the paths of a recording and of the files in it.

    `path` is a folder, a bag with or without its suffix, or a series of bags (`run` for
    `run_0.mcap`, `run_1.mcap`).
    """
    suffixes = "|".join(map(re.escape, BAG_KINDS))
    return re.compile(rf"{re.escape(path)}(?:/.*|(?:_\d+)?(?:{suffixes}))?")


def recordings_of(
    snapshot: Snapshot, is_wanted: Callable[[SummarySchema], object] = lambda _: True
) -> dict[str, list[BagFile]]:
    """Returns the bags of each recording whose schema is wanted.

    The key is the path of the recording: a folder, or a bag without its suffix. `data.recording`
    takes this path, relative to the bag directory.
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
    """Yields the bags of each segment, and for each bag the path of its recording."""
    loose = loose_bags(snapshot)
    for bags in (segment.bags for segment in segments):
        paths = [bags.folders[nth] for nth in bags.folder_of.tolist()]
        if loose:
            paths = [*map(loose.get, bags.files(), paths)]
        yield bags, paths


def name_of(path: str, bags: Sequence[BagFile], root: str) -> str:
    """Returns the name by which `data.recording` selects a recording of the bag directory `root`.

    `path` and `bags` are an item of `recordings_of`.
    """
    if path != root:
        return path.removeprefix(f"{root}/")
    # The bag directory itself is the recording: its bags name it.
    name = stem_of(bags[0].file).removeprefix(f"{root}/")
    return name if len(bags) == 1 else name.rpartition("_")[0]


def loose_bags(snapshot: Snapshot) -> dict[str, str]:
    """Returns by path the recording of each bag whose folder is not one recording.

    A folder is one recording if it has a metadata.yaml, or if its bags are named after it, or just
    by a number.
    """
    series: dict[str, list[BagFile]] = {}
    whole = {*snapshot.metadata_folders}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        # All bags of a stem are loose, or none is: one of each is looked at.
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


def loose_bags_beside_others(snapshot: Snapshot) -> dict[str, str]:
    """Returns by path the recording of each loose bag beside bags of another recording."""
    known, folders = snapshot.timeline.memo.of(_BESIDE_OTHERS, dict), snapshot.metadata_folders
    if folders not in known:
        known[folders] = _find_beside_others(snapshot)
    return known[folders]


def _find_beside_others(snapshot: Snapshot) -> dict[str, str]:
    loose = loose_bags(snapshot)
    if not loose:
        return loose
    recordings: dict[str, set[str]] = {}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        for file in bags.files():
            folder = file.rpartition("/")[0]
            recordings.setdefault(folder, set()).add(loose.get(file, folder))
    return {
        file: name for file, name in loose.items() if len(recordings[file.rpartition("/")[0]]) > 1
    }


def is_named_after_folder(file: str) -> bool:
    """Returns whether a bag has the name of its folder and a number, or just a number."""
    folder, _, name = file.rpartition("/")
    return name.startswith(f"{folder.rpartition('/')[2]}_") or name.partition(".")[0].isdigit()


def _series_of(file: str) -> str:
    """Returns the path of a bag without its suffixes and its number."""
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
    """Two recordings, and the log times (inclusive) between which they overlap."""

    first: Path
    second: Path
    start: Ns
    end: Ns

    @property
    def names(self) -> tuple[str, str]:
        """The names of the two, with their parents' names if the two are equal."""
        depth = 1 if self.first.name != self.second.name else 2
        first, second = ("/".join(path.parts[-depth:]) for path in (self.first, self.second))
        return first, second


def overlapping_recordings(
    snapshot: Snapshot, joined_with: Callable[[Path], tuple[str, ...]]
) -> tuple[Overlapping, ...]:
    """Returns the pairs of recordings that overlap without a handover, in order of time.

    `joined_with` returns the names of the recordings that handovers join with one. Thinned days and
    bags that a wrong clock dated are left out. A bag in a saved moment counts for the recording
    that it was saved from.
    """
    overlaps = snapshot.timeline.memo.of(_OVERLAPS, partial(_long_overlaps, snapshot))
    return tuple(pair for pair in overlaps if not _is_handover(pair, joined_with))


def _long_overlaps(snapshot: Snapshot) -> tuple[Overlapping, ...]:
    """Returns the pairs that overlap for long, in order of time; the longest if there are many."""
    lengths, overlaps = _overlaps_of(snapshot)
    shared: dict[Overlapping, Ns] = {}
    for (first, second), overlap in overlaps.items():
        shorter = min(lengths[first], lengths[second])
        is_half = 2 * overlap.shared >= shorter
        if overlap.shared > LONG_NS or (overlap.shared > SHORT_NS and is_half):
            pair = Overlapping(Path(first), Path(second), overlap.start, overlap.end)
            shared[pair] = overlap.shared
    longest = nlargest(_MAX_READ, shared, key=shared.__getitem__)
    return tuple(sorted(longest, key=lambda pair: pair.start))


class _Overlap(NamedTuple):
    """When two recordings have bags at once.

    Attributes:
        start: the first log time.
        end: the last log time.
        shared: how much of the time between is shared (ns).
    """

    start: Ns
    end: Ns
    shared: Ns

    def extended(self, start: Ns, end: Ns) -> _Overlap:
        """Returns the overlap with one more span, which does not begin before `self.start`."""
        more = max(end - max(start, self.end), 0)
        return _Overlap(self.start, max(end, self.end), self.shared + more)


def _overlaps_of(snapshot: Snapshot) -> tuple[dict[str, Ns], dict[tuple[str, str], _Overlap]]:
    """Returns by path the length (ns) of each recording, and by pair of paths their overlap."""
    lengths: dict[str, Ns] = {}
    overlaps: dict[tuple[str, str], _Overlap] = {}
    ends: dict[str, Ns] = {}  # when recordings end that may overlap the next bag
    for recording, start, end in _recorded_spans(snapshot):
        for other in [name for name in ends if name != recording]:
            if ends[other] <= start:
                del ends[other]
                continue
            pair = (min(other, recording), max(other, recording))
            overlap = overlaps.get(pair, _Overlap(start, start, 0))
            overlaps[pair] = overlap.extended(start, min(ends[other], end))
        before = ends.get(recording, start)
        lengths[recording] = lengths.get(recording, 0) + max(end - max(start, before), 0)
        ends[recording] = max(before, end)
    return lengths, overlaps


def _recorded_spans(snapshot: Snapshot) -> Iterator[tuple[str, Ns, Ns]]:
    """Yields the recording of each bag, and its first and last log time."""
    for bags, paths in _with_recordings(snapshot, snapshot.whole_segments):
        for path, start, end in zip(paths, bags.starts.tolist(), bags.ends.tolist(), strict=True):
            yield _saved_from(path) if _IN_MOMENTS in path else path, start, end


def _saved_from(folder: str) -> str:
    """Returns the path of the recording from which a folder of a saved moment was saved."""
    match = _MOMENT.fullmatch(folder)
    return f"{match['bag_dir']}/{match['recording']}" if match else folder


def _is_handover(pair: Overlapping, joined_with: Callable[[Path], tuple[str, ...]]) -> bool:
    """Returns whether a handover joins the two recordings."""
    first, second = pair.first, pair.second
    is_named = second.name in joined_with(first) or first.name in joined_with(second)
    return first.parent == second.parent and is_named
