"""The files of a bag directory: scans it again and again, and classifies what has changed.

One bag may lie there in two forms, `x.mcap` and its compressed `x.mcap.zstd`, of which one counts.
So does one of bags that somebody copied beside themselves, `run_0 (copy).mcap` beside `run_0.mcap`:
messages of one folder are no copies of each other, so all would count twice.
"""

from __future__ import annotations

import os
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
from ros2_memory.index.scan import BAG_DIR_SETTING, YOUNG_NS, ScanResult, Stamp, Tree
from ros2_memory.index.segment import Segment
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.bag_rows import BagRows
    from ros2_memory.storage.base import BagReader

_BLOCK_BYTES: Final = 64 << 10
_BLOCKS: Final = 16


@dataclass(frozen=True, slots=True)
class KnownBags:
    """What the index holds about the bag directory, by path.

    Attributes:
        counted: classifications of files, of all forms and links of a bag only the one that counts.
        hidden: files whose other form counts.
        files: notes on files. There are neither notes on closed files that do not change any more,
            or not since their columns were stored, nor classifications of them.
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

    @property
    def saved(self) -> Mapping[str, Stamp]:
        """All files in saved moments, whether they count there or not."""
        return self.tree.saved


class TableChange(NamedTuple):
    """What a scan found changed: bags that left the table and bags that came.

    `is_new`: whether anything has changed, even if no bag. The first scan changes everything.
    """

    removed: Sequence[BagFile]
    added: Sequence[BagFile]
    is_new: bool


class BagTable:
    """The known files of one bag directory. Not for several threads at once.

    Of closed files that do not change any more, which are most of a week, only their bags and their
    stamps are kept. Should one change, the notes on it are made as if it had been read, and it is
    classified again.

    Args:
        bag_dir: the directory.
        reader: reads its bags.
        known: returns closed files which were read earlier, in order of time: they are not read
            again while they are unchanged.
        only: the name of the one recording that counts; see `scan.Tree`.
        setting: the one that names the directory, for sentences.
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
        self._compared: dict[tuple[BagFile, BagFile], bool] = {}

    def update(self, context: ScanContext, *, patrolling: bool) -> TableChange:
        """Scans for what may have changed; `patrolling` also checks some of what did not.

        Where it raises, some of what the scan has found is lost: then a new table is needed.
        """
        before = self._timeline
        scanned = self._tree.scan(context.now, self._watched, patrolling=patrolling)
        self._reactivate_changed(scanned, context)
        is_first = not (self._files or self._timeline.segments)
        known = self._take_known(scanned.stamps, context) if is_first else {}
        unchanged: list[BagFile] | None = [] if is_first else None
        changed = self._drop(scanned.gone) | self._examine(
            scanned.stamps, known, context, unchanged
        )
        hidden_before = frozenset(self._hidden)
        removed, counted = self._update_counted(changed | hidden_before, context)
        changed |= hidden_before - self._hidden
        added: Sequence[BagFile] = [*(unchanged or ()), *counted]
        self._timeline = self._timeline.changed(removed, added)
        self._drop_settled(context)
        is_new = bool(changed) or self._timeline is not before
        is_new |= not scanned.is_like(self._scanned)
        # Without the stamps, of which the first scan has one for each file.
        self._scanned = replace(scanned, stamps={}, before={}, gone=set())
        return TableChange(removed, self._timeline.bags if is_first else added, is_new)

    def snapshot(self, now: Ns) -> Snapshot:
        """Returns what is known since the last scan."""
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
        """Returns the bags that are copies of others in their folder; compares each once."""
        compared, self._compared = self._compared, {}
        for pair in alike_among(self._timeline):
            with suppress(OSError):
                self._compared[pair] = compared[pair] if pair in compared else is_copy(*pair)
        return tuple(bag for (_, bag), is_same in self._compared.items() if is_same)

    def _superseded(self) -> Iterable[BagFile]:
        """Returns the bags in whose place thinned days answer."""
        superseded = read_superseded(self._bag_dir)
        days = {str(self._bag_dir / name): name for name in superseded.days}
        whole = {
            days[day.file]
            for day in self._timeline.named(days)
            if (day.size, day.mtime_ns) == superseded.days[days[day.file]]
        }
        names = [name for name, day in superseded.bags.items() if day in whole]
        return self._timeline.named({str(self._bag_dir / name) for name in names})

    def known(self, named: Collection[str], now: Ns) -> KnownBags:
        """Returns what retention considers; `named` are recordings that are being written."""
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
        """Notes what is known of files that have gone, changed, or got another form."""
        new = [path for path in scanned.stamps if path not in self._files]
        paths = {*new, *map(other_form, new), *scanned.gone} - self._files.keys()
        for bag in self._timeline.named(paths):
            path = bag.file
            before = scanned.before.get(path) or self._tree.stamp(path)
            notes = self._files[path] = FileNotes.first(path, before, context.now)
            notes.restore(bag.summary)
            classification = Classification(FileState.CLOSED, bag)
            self._classified[path] = self._counted[path] = classification

    def _drop(self, paths: Iterable[str]) -> set[str]:
        """Drops the state of files; returns those that were classified."""
        forgotten = set()
        for path in paths:
            self._watched.discard(path)
            self._files.pop(path, None)
            if self._classified.pop(path, None) is not None:
                forgotten.add(path)
        return forgotten

    def _drop_settled(self, context: ScanContext) -> None:
        """Drops what is known of files that will not change, but for their bags and stamps."""
        for path in [*self._files]:
            classification = self._counted.get(path)
            if classification is not None and self._is_settled(path, classification, context):
                del self._files[path], self._classified[path], self._counted[path]

    def _is_settled(self, path: str, classification: Classification, context: ScanContext) -> bool:
        """Returns whether a bag is closed and old, and has no other form or link."""
        notes = self._files[path]
        return (
            classification.state is FileState.CLOSED
            and classification.bag is not None
            and classification.aside is None
            and notes.trusted
            # A compressed bag may lie beside the file it was made from.
            and notes.kind in PLAIN_KINDS
            and notes.stamp.mtime_ns < context.now - max(context.three_splits, YOUNG_NS)
            and path not in self._watched
            and other_form(path) not in self._files
        )

    def _take_known(self, stamps: dict[str, Stamp], context: ScanContext) -> dict[str, BagFile]:
        """Takes those files out of `stamps` that need no look, and has the timeline hold them.

        They are as they were when they were read, have messages and an end, and are not young.
        Returns the other ones that are as they were, by path.
        """
        last = context.now - max(context.three_splits, YOUNG_NS)
        kinds = tuple(kind for kind in PLAIN_KINDS if self._reader.reads(Path(f"bag{kind}")))
        compressed = {path for path in stamps if path.endswith(COMPRESSED)}
        others: dict[str, BagFile] = {}
        segments: list[Segment] = []
        for bags in self._known():
            are_whole = bags.with_schema(lambda schema: schema.complete and schema.topics)
            for row, (path, content) in enumerate(
                zip(bags.files(), map(tuple, bags.contents.tolist()), strict=True)
            ):
                stamp = stamps.get(path)
                if stamp is None or stamp.content != content:
                    are_whole[row] = False
                elif (
                    not are_whole[row]
                    or stamp.mtime_ns >= last
                    or not path.endswith(kinds)
                    or (compressed and other_form(path) in compressed)
                ):
                    are_whole[row] = False
                    others[path] = bags[row]
                else:
                    del stamps[path]
            taken = bags.some(are_whole)
            if taken is not None:
                segments.append(Segment(taken))
        if segments:
            self._timeline = Timeline(segments)
        return others

    def _examine(
        self,
        stamps: Mapping[str, Stamp],
        known: Mapping[str, BagFile],
        context: ScanContext,
        unchanged: list[BagFile] | None,
    ) -> set[str]:
        """Classifies files; returns those whose classification changed.

        New ones that will not change are added to `unchanged` instead, if there is such a list: a
        first scan of a week would otherwise hold all that is known of each file at once. Those that
        are `known` are not read.
        """
        changed = set()
        for path, stamp in stamps.items():
            if not self._is_to_be_classified(path, stamp, known.get(path), context):
                continue
            notes = self._files[path]
            try:
                classification = classify(notes, self._reader, context)
            except BagVanishedError:
                self._tree.lose(path)
                changed |= self._drop([path])
                continue
            if notes.must_be_watched(classification, context):
                self._watched.add(path)
            else:
                self._watched.discard(path)
            if (
                unchanged is not None
                and other_form(path) not in stamps
                and self._is_settled(path, classification, context)
                and classification.bag is not None
            ):
                unchanged.append(classification.bag)
                del self._files[path]
            elif classification != self._classified.get(path):
                self._classified[path] = classification
                changed.add(path)
        return changed

    def _is_to_be_classified(
        self, path: str, stamp: Stamp, known: BagFile | None, context: ScanContext
    ) -> bool:
        """Notes how a file is now; returns whether it is new, has changed, or is watched."""
        notes = self._files.get(path)
        if notes is not None:
            return notes.update(stamp, context.now) or path in self._watched
        notes = self._files[path] = FileNotes.first(path, stamp, context.now)
        if known is not None and notes.trusted:
            notes.restore(known.summary)
        return True

    def _update_counted(
        self, changed: Iterable[str], context: ScanContext
    ) -> tuple[list[BagFile], list[BagFile]]:
        """Updates which files count; returns the bags that left and those that came."""
        removed, added = [], []
        paths = {form for path in changed for form in (path, other_form(path))}
        for path in paths:
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
        """Returns a file's classification; None if there is none, or another file counts.

        While a split is compressed `x.mcap` and `x.mcap.zstd` both lie there: one bag, twice. Two
        complete ones that have been there for three splits are kept on purpose: both count.
        """
        self._hidden.discard(path)
        classification, other = self._classified.get(path), self._classified.get(other_form(path))
        if classification is None or other is None or classification.state > other.state:
            return classification
        forms = (self._files.get(form) for form in (path, other_form(path)))
        is_kept = not any(notes is not None and notes.grew_lately(context) for notes in forms)
        if is_kept and classification.state is FileState.UNREAD:
            return classification
        if classification.state == other.state and (
            (is_kept and classification.state is FileState.CLOSED) or not path.endswith(COMPRESSED)
        ):
            return classification
        self._hidden.add(path)
        return None


def _sorted_by_path(asides: Iterable[SetAside]) -> tuple[SetAside, ...]:
    return tuple(sorted(asides, key=lambda aside: aside.path))


def alike_among(timeline: Timeline) -> Iterator[tuple[BagFile, BagFile]]:
    """Yields bags with the folder, size and summary of one with a shorter name, behind that one."""
    starts = timeline.starts
    is_same = starts[1:] == starts[:-1]
    are_suspects = np.append(is_same, False) | np.append(False, is_same)
    edges = np.cumsum([len(segment.bags) for segment in timeline.segments])
    of_segments = zip(timeline.segments, np.split(are_suspects, edges), strict=False)
    suspects = chain.from_iterable(segment.bags.at(rows) for segment, rows in of_segments)
    originals: dict[tuple[Path, int, int, int], BagFile] = {}
    for bag in sorted(suspects, key=lambda bag: (len(bag.file), bag.file)):
        original = originals.setdefault((bag.recording, bag.size, bag.start, bag.end), bag)
        if original is not bag and original.summary == bag.summary:
            yield original, bag


def is_copy(original: BagFile, bag: BagFile) -> bool:
    """Returns whether two bags of one size are the same bytes, as blocks all over them show.

    Runs of a simulation may have the same times and sizes.

    Raises:
        OSError: one of them cannot be read.
    """
    return _blocks(original) == _blocks(bag)


def _blocks(bag: BagFile) -> list[bytes]:
    step = max(bag.size // _BLOCKS, _BLOCK_BYTES)
    places = (*range(0, bag.size, step), max(bag.size - _BLOCK_BYTES, 0))
    file = os.open(bag.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        return [os.pread(file, _BLOCK_BYTES, place) for place in places]
    finally:
        os.close(file)
