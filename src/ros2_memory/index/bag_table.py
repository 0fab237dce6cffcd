"""The table of a bag directory's files: scanned again and again, classified where they changed.

A bag may lie there in two forms, `x.mcap` and its compressed `x.mcap.zstd`: one of them counts.
Somebody may also have copied a bag beside itself, `run_0 (copy).mcap` beside `run_0.mcap`. One of
the two counts: within a folder, messages are not compared, so all of them would count twice.
"""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.bag_dir.layout import other_form
from ros2_memory.bag_dir.state_files import read_superseded
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import COMPRESSED, PLAIN_KINDS
from ros2_memory.index.file_state import Classification, FileNotes, FileState, ScanContext, classify
from ros2_memory.index.scan import BAG_DIR_SETTING, UNSEEN, ScanResult, Stamp, Tree
from ros2_memory.index.segment import Segment
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.split_order import is_recording, split_of
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.bag_rows import BagRows, Bags
    from ros2_memory.storage.base import BagReader

_BLOCK_BYTES: Final = 64 << 10
"""Size of the blocks by which bags are compared."""
_BLOCKS: Final = 16
"""About how many blocks of a bag are compared."""


@dataclass(frozen=True, slots=True)
class KnownBags:
    """What the index knows about the bag directory.

    `counted` and `files` lack settled files: closed bags that will not change any more. `timeline`
    has their bags.

    Attributes:
        counted: by path, the classification of each file that counts.
        hidden: paths of files whose other form counts.
        files: by path, the notes on a file.
        named: recordings that the last heartbeat names as being written.
        now: when the directory was scanned.
        tree: the stamps of all files.
        timeline: the bags of all files.
    """

    counted: Mapping[str, Classification]
    hidden: Collection[str]
    files: Mapping[str, FileNotes]
    named: Collection[str]
    now: Ns
    tree: Tree
    timeline: Timeline


class TableChange(NamedTuple):
    """What one scan changed. The first scan adds all bags.

    Attributes:
        removed: bags that left the table.
        added: bags that came.
        is_new: whether anything changed, bags or other files.
    """

    removed: Sequence[BagFile]
    added: Bags | Sequence[BagFile]
    is_new: bool


class BagTable:
    """The known files of one bag directory. Not thread-safe.

    Most files of a week are settled: closed, and old enough not to change any more. The table keeps
    only their bags and stamps. If one changes after all, its notes are made anew from its bag, and
    it is classified again.

    Args:
        bag_dir: the directory.
        reader: reads its bags.
        known: returns closed bags that were read earlier, in order of time. They are not read
            again while their files are unchanged.
        only: the name of the one recording that counts; see `scan.Tree`.
        setting: the setting that names the directory, for error messages.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        *,
        known: Callable[[], Iterable[BagRows]] = list,
        only: Sequence[str] = (),
        setting: str = BAG_DIR_SETTING,
    ) -> None:
        self._reader = reader
        self._known = known
        self._bag_dir = bag_dir
        self._tree = Tree(bag_dir, only, setting=setting)
        self._files: dict[str, FileNotes] = {}
        self._classified: dict[str, Classification] = {}
        self._counted: dict[str, Classification] = {}
        self._hidden: set[str] = set()
        self._watched: set[str] = set()
        self._scanned: ScanResult | None = None
        self._timeline = Timeline()
        self._digests: dict[BagFile, bytes] = {}

    def update(self, context: ScanContext, *, patrolling: bool) -> TableChange:
        """Scans the directory and classifies the files that may have changed.

        With `patrolling`, some files that look unchanged are checked too. An exception leaves the
        table incomplete: make a new one.
        """
        before = self._timeline
        scanned = self._tree.scan(context.now, self._watched, patrolling=patrolling)
        self._reactivate_changed(scanned, context)
        is_first = not (self._files or self._timeline.segments)
        gone = self._drop(scanned.gone)
        changed, settled = self._classify_changed(scanned, context, is_first=is_first)
        changed |= gone
        hidden_before = frozenset(self._hidden)
        removed, counted = self._update_counted(changed | hidden_before, context)
        changed |= hidden_before - self._hidden
        added: Sequence[BagFile] = [*settled, *counted]
        self._timeline = self._timeline.changed(removed, added)
        self._drop_settled(context)
        is_new = bool(changed) or self._timeline is not before
        is_new |= not scanned.is_like(self._scanned)
        # The first scan has a stamp for each file: too much to keep.
        self._scanned = replace(scanned, stamps={}, gone=set())
        return TableChange(removed, self._timeline.bags if is_first else added, is_new)

    def snapshot(self, now: Ns) -> Snapshot:
        """Returns the directory as the last scan saw it."""
        copies = self._copies()
        left_out = {bag.file: bag for bag in (*copies, *self._superseded())}
        timeline = self._timeline.changed(left_out.values(), ())
        scanned = self._scanned or ScanResult()
        aside: dict[FileState, list[SetAside]] = {}
        silent = set(timeline.silent)
        empty: list[Path] = []
        for path, classification in self._counted.items():
            if classification.aside is not None:
                aside.setdefault(classification.state, []).append(classification.aside)
            elif classification.bag is None:
                empty.append(Path(path))
                silent.update(classification.silent)
        return Snapshot(
            timeline=timeline,
            active=_sorted_by_path(
                [*aside.get(FileState.ACTIVE, ()), *aside.get(FileState.HELD_BACK, ())]
            ),
            damaged=_sorted_by_path([*aside.get(FileState.DAMAGED, ()), *scanned.damaged]),
            unread=_sorted_by_path([*aside.get(FileState.UNREAD, ()), *scanned.links]),
            empty=tuple(sorted(empty)),
            silent_topics=frozenset(silent - timeline.types.keys()),
            scanned_at=now,
            problem=scanned.problem,
            metadata_folders=tuple(sorted(scanned.metadata_folders)),
            copies=copies,
        )

    def _copies(self) -> tuple[BagFile, ...]:
        """Returns the bags that are copies of others in their folder; reads each suspect once."""
        known, self._digests = self._digests, {}
        copies: list[BagFile] = []
        for alike in alike_bags(self._timeline):
            originals: set[bytes] = set()
            for bag in alike:
                with suppress(OSError):
                    digest = self._digests[bag] = known.get(bag) or digest_of(bag)
                    if digest in originals:
                        copies.append(bag)
                    originals.add(digest)
        return tuple(copies)

    def _superseded(self) -> Iterable[BagFile]:
        """Returns the bags that thinned days replace.

        A day that has another size or mtime than was noted is not finished, and replaces nothing.
        """
        superseded = read_superseded(self._bag_dir)
        day_of = {str(self._bag_dir / name): name for name in superseded.days}
        finished = {
            day_of[bag.file]
            for bag in self._timeline.bags_named(day_of)
            if (bag.size, bag.mtime_ns) == superseded.days[day_of[bag.file]]
        }
        replaced = [name for name, day in superseded.bags.items() if day in finished]
        return self._timeline.bags_named({str(self._bag_dir / name) for name in replaced})

    def known(self, named: Collection[str], now: Ns) -> KnownBags:
        """Returns what retention decides by; `named` recordings are being written."""
        return KnownBags(
            self._counted,
            self._hidden,
            self._files,
            named,
            now,
            self._tree,
            self._timeline,
        )

    def _reactivate_changed(self, scanned: ScanResult, context: ScanContext) -> None:
        """Makes notes again on settled files that have gone, changed, or got another form."""
        new = [path for path in scanned.stamps if path not in self._files]
        paths = {*new, *map(other_form, new), *scanned.gone} - self._files.keys()
        for bag in self._timeline.bags_named(paths):
            path = bag.file
            # A file that has changed is read again, whatever its stamp is.
            before = UNSEEN if path in scanned.stamps else self._tree.stamp(path)
            notes = self._files[path] = FileNotes.first(path, before, context.now)
            notes.restore(bag.summary)
            classification = Classification(FileState.CLOSED, bag)
            self._classified[path] = self._counted[path] = classification

    def _drop(self, paths: Iterable[str]) -> set[str]:
        """Drops the notes on files; returns the files that had been classified."""
        classified = set()
        for path in paths:
            self._watched.discard(path)
            self._files.pop(path, None)
            if self._classified.pop(path, None) is not None:
                classified.add(path)
        return classified

    def _drop_settled(self, context: ScanContext) -> None:
        """Drops the notes on settled files: their bags and stamps stay."""
        for path in [*self._files]:
            classification = self._counted.get(path)
            if classification is not None and self._is_settled(path, classification, context):
                del self._files[path], self._classified[path], self._counted[path]

    def _is_settled(self, path: str, classification: Classification, context: ScanContext) -> bool:
        """Returns whether a bag is closed and old, and has no other form."""
        notes = self._files[path]
        return (
            classification.state is FileState.CLOSED
            and classification.bag is not None
            and classification.aside is None
            and notes.trusted
            # A compressed bag may lie beside the file it was made from.
            and notes.kind in PLAIN_KINDS
            # Or in the future: a robot without a battery-backed clock starts in 1970.
            and abs(context.now - notes.stamp.mtime_ns) > context.settling_ns
            and path not in self._watched
            and other_form(path) not in self._files
        )

    def _load_known(self, stamps: dict[str, Stamp], context: ScanContext) -> dict[str, BagFile]:
        """Starts the timeline with the known bags that are settled, and removes their `stamps`.

        Returns by path the other known bags whose files are unchanged.
        """
        kinds = tuple(kind for kind in PLAIN_KINDS if self._reader.reads(Path(f"bag{kind}")))
        compressed = {path for path in stamps if path.endswith(COMPRESSED)}
        others: dict[str, BagFile] = {}
        segments: list[Segment] = []
        for bags in self._known():
            are_settled = bags.with_schema(lambda schema: schema.complete and schema.topics)
            for row, (path, content) in enumerate(
                zip(bags.files(), map(tuple, bags.contents.tolist()), strict=True)
            ):
                stamp = stamps.get(path, UNSEEN)
                is_same = stamp.content == content
                are_settled[row] &= (
                    is_same
                    and context.now - stamp.mtime_ns > context.settling_ns
                    and path.endswith(kinds)
                    and not (compressed and other_form(path) in compressed)
                )
                if are_settled[row]:
                    del stamps[path]
                elif is_same:
                    others[path] = bags[row]
            settled = bags.select(are_settled)
            if settled is not None:
                segments.append(Segment(settled))
        if segments:
            self._timeline = Timeline(segments)
        return others

    def _classify_changed(
        self, scanned: ScanResult, context: ScanContext, *, is_first: bool
    ) -> tuple[set[str], list[BagFile]]:
        """Classifies files; returns those whose classification changed.

        On the first scan, settled bags are returned apart: the table must not hold the notes on all
        files of a week at once.
        """
        known = self._load_known(scanned.stamps, context) if is_first else {}
        changed: set[str] = set()
        settled: list[BagFile] = []
        for path, stamp in scanned.stamps.items():
            if not self._needs_classification(path, stamp, known.get(path), context):
                continue
            classification = self._classify(path, context)
            if classification != self._classified.get(path):
                changed.add(path)
            if classification is None:
                self._drop([path])
            elif (
                is_first
                and classification.bag is not None
                and other_form(path) not in scanned.stamps
                and self._is_settled(path, classification, context)
            ):
                settled.append(classification.bag)
                changed.discard(path)
                del self._files[path]
            else:
                self._classified[path] = classification
        return changed, settled

    def _classify(self, path: str, context: ScanContext) -> Classification | None:
        """Classifies a file and decides whether the next scan looks at it again.

        Returns None if the file has vanished.
        """
        notes = self._files[path]
        try:
            classification = classify(notes, self._reader, context)
        except BagVanishedError:
            self._tree.lose(path)
            return None
        if notes.must_be_watched(classification, context):
            self._watched.add(path)
        else:
            self._watched.discard(path)
        return classification

    def _needs_classification(
        self, path: str, stamp: Stamp, known: BagFile | None, context: ScanContext
    ) -> bool:
        """Updates the notes on a file; returns whether it is new, has changed, or is watched.

        The summary of a `known` bag is not read again.
        """
        notes = self._files.get(path)
        if notes is not None:
            return notes.update(stamp, context.now) or path in self._watched
        notes = self._files[path] = FileNotes.first(path, stamp, context.now)
        if known is not None and notes.trusted:
            notes.restore(known.summary)
        return True

    def _update_counted(
        self, changed: Collection[str], context: ScanContext
    ) -> tuple[list[BagFile], list[BagFile]]:
        """Updates which files count; returns the bags that left and the bags that came."""
        removed, added = [], []
        for path in {*changed, *map(other_form, changed)}:
            before, after = self._counted.pop(path, None), self._counted_form(path, context)
            if after is not None:
                self._counted[path] = after
            if before == after:
                continue
            if before is not None and before.bag is not None:
                removed.append(before.bag)
            if after is not None and after.bag is not None:
                added.append(after.bag)
        return removed, added

    def _counted_form(self, path: str, context: ScanContext) -> Classification | None:
        """Returns a file's classification; None if it has none, or if its other form counts.

        While a split is being compressed, `x.mcap` and `x.mcap.zstd` are one bag, twice, and stay
        so if the recorder is killed. If others are both complete and have not grown for three
        splits, somebody keeps both: both count.
        """
        self._hidden.discard(path)
        classification, other = self._classified.get(path), self._classified.get(other_form(path))
        if classification is None or other is None or classification.state > other.state:
            return classification
        forms = (self._files.get(form) for form in (path, other_form(path)))
        is_kept = not any(notes is not None and notes.grew_lately(context) for notes in forms)
        if is_kept and classification.state is FileState.UNREAD:
            return classification
        name = split_of(path)
        both_count = is_kept and not (name and is_recording(name.series))
        if classification.state == other.state and (
            (both_count and classification.state is FileState.CLOSED)
            or not path.endswith(COMPRESSED)
        ):
            return classification
        self._hidden.add(path)
        return None


def _sorted_by_path(asides: Iterable[SetAside]) -> tuple[SetAside, ...]:
    return tuple(sorted(asides, key=lambda aside: aside.path))


def alike_bags(timeline: Timeline, *, anywhere: bool = False) -> Iterator[list[BagFile]]:
    """Yields the bags that have one size and one summary, the shortest name first.

    They are those of one folder, or `anywhere`.
    """
    starts = timeline.starts
    is_same = starts[1:] == starts[:-1]
    are_suspects = np.append(is_same, False) | np.append(False, is_same)
    edges = np.cumsum([len(segment.bags) for segment in timeline.segments])
    of_segments = zip(timeline.segments, np.split(are_suspects, edges), strict=False)
    suspects = chain.from_iterable(segment.bags.at(rows) for segment, rows in of_segments)
    alike: defaultdict[tuple[Path | None, int, BagSummary], list[BagFile]] = defaultdict(list)
    for bag in sorted(suspects, key=lambda bag: (len(bag.file), bag.file)):
        alike[None if anywhere else bag.recording, bag.size, bag.summary].append(bag)
    return (bags for bags in alike.values() if len(bags) > 1)


def digest_of(bag: BagFile) -> bytes:
    """Returns a digest of blocks spread over a bag.

    Equal times and sizes prove nothing: two runs of a simulation may have them.

    Raises:
        OSError: it cannot be read.
    """
    step = max(bag.size // _BLOCKS, _BLOCK_BYTES)
    offsets = (*range(0, bag.size, step), max(bag.size - _BLOCK_BYTES, 0))
    digest = hashlib.blake2b()
    file = os.open(bag.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        for offset in offsets:
            digest.update(os.pread(file, _BLOCK_BYTES, offset))
    finally:
        os.close(file)
    return digest.digest()
