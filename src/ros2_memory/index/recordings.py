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
import threading
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple
from weakref import WeakKeyDictionary

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER, is_thinned
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BAG_KINDS
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.segment import Segment, folder_of
from ros2_memory.index.split_order import split_of, stem_of
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.model import BagFile, SetAside
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


def paths_named(root: str, name: str) -> re.Pattern[str]:
    """Returns what the paths of a recording match.

    Args:
        root: the bag directory.
        name: a path below it, of a folder, a bag, or the bags of one series (`run` for `run_0.mcap`
            and its like).
    """
    return re.compile(re.escape(f"{root.rstrip('/')}/{name.strip('/')}") + _OF_NAME)


class RecordingFilter:
    """Narrows snapshots of a bag directory to one recording, as `data.recording` does. Thread-safe.

    The bags of an unchanged segment are not looked at again.
    """

    def __init__(self, bag_dir: Path, name: str) -> None:
        self._is_named = paths_named(str(bag_dir), name).fullmatch
        self._lock = threading.Lock()
        self._known: WeakKeyDictionary[Segment, list[BagFile]] = WeakKeyDictionary()
        self._whole: Timeline | None = None
        self._narrowed = Timeline()

    def narrowed(self, snapshot: Snapshot) -> Snapshot:
        """Returns the part of a snapshot that is of the recording; it may be empty."""

        def of(files: tuple[SetAside, ...]) -> tuple[SetAside, ...]:
            return tuple(each for each in files if self._is_named(str(each.path)))

        timeline = self._timeline(snapshot.timeline)
        return replace(
            snapshot,
            timeline=timeline,
            active=of(snapshot.active),
            damaged=of(snapshot.damaged),
            unread=of(snapshot.unread),
            empty=tuple(each for each in snapshot.empty if self._is_named(str(each))),
            silent_topics=timeline.silent - timeline.types.keys(),
            metadata_folders=tuple(filter(self._is_named, snapshot.metadata_folders)),
        )

    def _timeline(self, whole: Timeline) -> Timeline:
        with self._lock:
            if whole is not self._whole:
                before = {bag.file: bag for bag in self._narrowed.bags}
                after = {bag.file: bag for each in whole.segments for bag in self._of(each)}
                removed = [bag for file, bag in before.items() if after.get(file) is not bag]
                added = [bag for file, bag in after.items() if before.get(file) is not bag]
                self._narrowed = self._narrowed.changed(removed, added)
                self._whole = whole
            return self._narrowed

    def _of(self, segment: Segment) -> list[BagFile]:
        if segment not in self._known:
            self._known[segment] = [bag for bag in segment.bags if self._is_named(bag.file)]
        return self._known[segment]


def recordings_of(snapshot: Snapshot) -> dict[str, list[BagFile]]:
    """Returns the bags of each recording, by its path: a folder, or that of a bag less its suffix.

    With `data.recording` each of these names, below the bag directory, is one recording.
    """
    loose = loose_bags(snapshot)
    found: dict[str, list[BagFile]] = {}
    for bag in snapshot.bags:
        found.setdefault(loose.get(bag.file) or folder_of(bag), []).append(bag)
    return found


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
    folders: dict[str, list[BagFile]] = {}
    whole = {*snapshot.metadata_folders}
    for bag in snapshot.bags:
        folder = folder_of(bag)
        if folder not in whole and not is_named_after_folder(bag.file):
            folders.setdefault(folder, []).append(bag)
    found: dict[str, str] = {}
    for bags in folders.values():
        series: dict[str, list[BagFile]] = {}
        for bag in bags:
            series.setdefault(_series_of(bag.file), []).append(bag)
        for name, members in series.items():
            is_one = _follow(members)
            found.update({bag.file: name if is_one else stem_of(bag.file) for bag in members})
    return found


def is_named_after_folder(file: str) -> bool:
    """Returns whether a bag is named as a split of the recording of its folder, or by a number."""
    folder, _, name = file.rpartition("/")
    return name.startswith(f"{folder.rpartition('/')[2]}_") or name.partition(".")[0].isdigit()


def _series_of(file: str) -> str:
    """Returns the path of a bag without its suffixes, and without its number where it has one."""
    split = split_of(file)
    return split[0][:-1] if split and split[0].endswith("_") else stem_of(file)


def _follow(bags: Sequence[BagFile]) -> bool:
    """Returns whether bags are numbered, and each ends before the next begins."""
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end))
    is_numbered = len(bags) == 1 or all(_series_of(bag.file) != stem_of(bag.file) for bag in bags)
    return is_numbered and all(
        one.end <= next_one.start + OUT_OF_ORDER_NS for one, next_one in pairwise(ordered)
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
        first, second = ("/".join(each.parts[-depth:]) for each in (self.first, self.second))
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
    return tuple(each for each in overlaps if not _took_over(each, joined_with))


def _long_overlaps(snapshot: Snapshot) -> tuple[Overlapping, ...]:
    spans, pairs = _sweep(snapshot)
    found = []
    for (one, other), (start, end, shared) in pairs.items():
        shorter = min(spans[one], spans[other])
        if shared > LONG_NS or (shared > SHORT_NS and 2 * shared >= shorter):
            found.append(Overlapping(Path(one), Path(other), start, end))
    return tuple(sorted(found, key=lambda each: each.start)[:_MAX_READ])


def _sweep(
    snapshot: Snapshot,
) -> tuple[dict[str, Ns], dict[tuple[str, str], tuple[Ns, Ns, Ns]]]:
    """Returns how long each recording is, and when and for how long two have a bag at once."""
    left_out, spans = snapshot.dating.misdated, dict[str, Ns]()
    loose = loose_bags(snapshot)
    pairs: dict[tuple[str, str], tuple[Ns, Ns, Ns]] = {}
    reach: dict[str, Ns] = {}
    for bag in snapshot.bags:
        if bag.file in left_out or is_thinned(bag.file):
            continue
        own, start, end = loose.get(bag.file) or folder_of(bag), bag.start, bag.end
        if _IN_MOMENTS in own:
            own = _recorded_folder(own)
        before = reach.get(own)
        if len(reach) > (before is not None):
            for other, until in [*reach.items()]:
                if other == own:
                    continue
                if until <= start:
                    del reach[other]
                    continue
                pair = (other, own) if other < own else (own, other)
                last = min(until, end)
                first, until_then, shared = pairs.get(pair, (start, start, 0))
                more = max(last - max(start, until_then), 0)
                pairs[pair] = (first, max(last, until_then), shared + more)
        spans[own] = spans.get(own, 0) + max(end - max(start, before or start), 0)
        reach[own] = end if before is None or end > before else before
    return spans, pairs


def _recorded_folder(folder: str) -> str:
    """Returns the folder of the recording that a folder in a saved moment has bags of."""
    found = _MOMENT.fullmatch(folder)
    return f"{found['bag_dir']}/{found['recording']}" if found else folder


def _took_over(pair: Overlapping, joined_with: Callable[[Path], tuple[str, ...]]) -> bool:
    """Returns whether a handover joins the two recordings."""
    one, other = pair.first, pair.second
    is_named = other.name in joined_with(one) or one.name in joined_with(other)
    return one.parent == other.parent and is_named
