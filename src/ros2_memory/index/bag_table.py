"""The files of a bag directory: scans it again and again, and classifies what has changed.

One bag may lie there in two forms, `x.mcap` and its compressed `x.mcap.zstd`, of which one counts.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.bag_dir.layout import other_form
from ros2_memory.bag_dir.state_files import read_superseded
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import COMPRESSED, PLAIN_KINDS
from ros2_memory.index.copied_files import alike_among, is_copy
from ros2_memory.index.file_state import Classification, FileNotes, FileState, ScanContext, classify
from ros2_memory.index.scan import BAG_DIR_SETTING, YOUNG_NS, ScanResult, Stamp, Tree, settled
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader

PATROL: Final = 256
"""Closed files checked in each scan, in turn: one overwritten in place changes no directory."""

Unchanged: TypeAlias = "dict[str, tuple[BagFile, int, Ns]]"
"""By path, the bag, the inode and the ctime of closed files that do not change any more, or not
since their columns were stored.

Those are most of a week, so no more is kept of them. Should a file change, the notes on it are made
as if it had been read, and it is classified again.
"""


@dataclass(frozen=True, slots=True)
class KnownBags:
    """What the index holds about the bag directory, by path.

    Attributes:
        counted: classifications of files, of all forms and links of a bag only the one that counts.
            Those in `unchanged` are left out.
        hidden: files whose other form counts.
        files: notes on all files.
        named: recordings that the last heartbeat names as being written.
        now: when the directory was scanned.
        saved: all files in saved moments, whether they count there or not.
        unchanged: closed bags of which only rows are kept; each counts.
    """

    counted: Mapping[str, Classification]
    hidden: Collection[str]
    files: Mapping[str, FileNotes]
    named: Collection[str]
    now: Ns
    saved: Mapping[str, Stamp] = field(default_factory=dict)
    unchanged: Unchanged = field(default_factory=dict)


class TableChange(NamedTuple):
    """What a scan found changed: bags that left the table and bags that came.

    `is_new`: whether anything has changed, even if no bag. The first scan changes everything.
    """

    removed: list[BagFile]
    added: list[BagFile]
    is_new: bool


class BagTable:
    """The known files of one bag directory. Not for several threads at once.

    Args:
        bag_dir: the directory.
        reader: reads its bags.
        known: returns those of some paths that are closed files which were read earlier, by path:
            they are not read again while they are unchanged.
        only: the name of the one recording that counts; see `scan.Tree`.
        packs: whether the summaries of bags that will not change are packed.
        setting: the one that names the directory, for sentences.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        *,
        known: Callable[[Iterable[str]], Mapping[str, BagFile]] | None,
        only: Sequence[str] = (),
        packs: bool = False,
        setting: str = BAG_DIR_SETTING,
    ) -> None:
        self._packs = packs
        self._reader = reader
        self._known = known
        self._bag_dir = bag_dir
        self._tree = Tree(bag_dir, only, setting=setting)
        self._unchanged: Unchanged = {}
        self._files: dict[str, FileNotes] = {}
        self._classified: dict[str, Classification] = {}
        self._counted: dict[str, Classification] = {}
        self._hidden: set[str] = set()
        self._watched: set[str] = set()
        self._patrol: list[str] = []
        self._scanned: ScanResult | None = None
        self._timeline = Timeline()
        self._compared: dict[tuple[BagFile, BagFile], bool] = {}

    def update(self, context: ScanContext, *, patrolling: bool) -> TableChange:
        """Scans for what may have changed; `patrolling` also checks some of what did not.

        Where it raises, some of what the scan has found is lost: then a new table is needed.
        """
        patrol = self._next_patrol() if patrolling else ()
        scanned = self._tree.scan(context.now, [*self._watched, *patrol])
        self._reactivate_changed(scanned, context)
        is_first = not (self._files or self._unchanged)
        known = self._known(scanned.stamps) if self._known is not None and is_first else {}
        unchanged = self._take_known(scanned.stamps, known, context)
        changed = self._drop(scanned.gone) | self._examine(
            scanned.stamps, known, context, unchanged if is_first else None
        )
        hidden_before = frozenset(self._hidden)
        removed, counted = self._update_counted(changed | hidden_before, context)
        changed |= hidden_before - self._hidden
        added = [*_by_start(unchanged), *counted]
        self._timeline = self._timeline.changed(removed, added)
        self._keep_rows_of_settled(context)
        is_new = bool(changed or unchanged) or not scanned.is_like(self._scanned)
        # Without the stamps, of which the first scan has one for each file.
        self._scanned = replace(scanned, stamps={}, gone=set())
        return TableChange(removed, added, is_new)

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
        days = {name: self._bag_named(name) for name in superseded.days}
        whole = {
            name
            for name, day in days.items()
            if day is not None and (day.size, day.mtime_ns) == superseded.days[name]
        }
        names = (name for name, day in superseded.bags.items() if day in whole)
        return filter(None, map(self._bag_named, names))

    def _bag_named(self, name: str) -> BagFile | None:
        """Returns the bag at a path below the bag directory, if that answers."""
        path = str(self._bag_dir / name)
        if path in self._unchanged:
            return self._unchanged[path][0]
        classification = self._counted.get(path)
        return None if classification is None else classification.bag

    def known(self, named: Collection[str], now: Ns) -> KnownBags:
        """Returns what retention considers; `named` are recordings that are being written."""
        return KnownBags(
            self._counted,
            self._hidden,
            self._files,
            named,
            now,
            self._tree.saved,
            self._unchanged,
        )

    def _next_patrol(self) -> list[str]:
        if not self._patrol:
            self._patrol = [*self._files, *self._unchanged]
        following = self._patrol[-PATROL:]
        del self._patrol[-PATROL:]
        return [path for path in following if path in self._files or path in self._unchanged]

    def _reactivate_changed(self, scanned: ScanResult, context: ScanContext) -> None:
        """Reactivates files that have gone, changed, or got another form."""
        if not self._unchanged:
            return
        for path, stamp in [*scanned.stamps.items()]:
            before = self._stamp(path)
            if before and settled(stamp.mtime_ns, context.now) and stamp == before:
                del scanned.stamps[path]
            else:
                self._reactivate(path, context)
                self._reactivate(other_form(path), context)
        for path in scanned.gone:
            self._reactivate(path, context)

    def _reactivate(self, path: str, context: ScanContext) -> None:
        """Makes of an unchanged file what would be known had it been read."""
        stamp = self._stamp(path)
        if stamp is not None:
            bag, *_ = self._unchanged.pop(path)
            notes = self._files[path] = FileNotes.first(path, stamp, context.now)
            notes.restore(bag.summary)
            classification = Classification(FileState.CLOSED, bag)
            self._classified[path] = self._counted[path] = classification

    def _stamp(self, path: str) -> Stamp | None:
        """Returns the stamp of an unchanged file; None for any other."""
        bag, inode, ctime = self._unchanged.get(path, (None, 0, 0))
        return bag and Stamp(bag.size, bag.mtime_ns, ctime, inode, bag.sidecar_ns)

    def _drop(self, paths: Iterable[str]) -> set[str]:
        """Drops the state of files; returns those that were classified."""
        forgotten = set()
        for path in paths:
            self._watched.discard(path)
            self._files.pop(path, None)
            if self._classified.pop(path, None) is not None:
                forgotten.add(path)
        return forgotten

    def _keep_rows_of_settled(self, context: ScanContext) -> None:
        """Keeps no more than a row of bags that will not change."""
        for path in [*self._files]:
            classification = self._counted.get(path)
            if classification is not None and self._is_settled(path, classification, context):
                self._add_unchanged(path, classification)
                del self._classified[path], self._counted[path]

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

    def _add_unchanged(self, path: str, classification: Classification) -> None:
        if classification.bag is not None:
            if self._packs:
                classification.bag.summary.pack()
            stamp = self._files.pop(path).stamp
            self._unchanged[path] = classification.bag, stamp.inode, stamp.ctime_ns

    def _take_known(
        self, stamps: dict[str, Stamp], known: Mapping[str, BagFile], context: ScanContext
    ) -> list[BagFile]:
        """Takes those files out of `stamps` that need no look, and returns their bags.

        They are as they were when they were read, have messages and an end, and are not young.
        """
        if not known:
            return []
        last = context.now - max(context.three_splits, YOUNG_NS)
        kinds = tuple(kind for kind in PLAIN_KINDS if self._reader.reads(Path(f"bag{kind}")))
        compressed = {path for path in stamps if path.endswith(COMPRESSED)}
        bags = []
        for path, bag in known.items():
            stamp = stamps.get(path)
            if (
                stamp is not None
                and stamp.is_of(bag)
                and stamp.mtime_ns < last
                and path.endswith(kinds)
                and (schema := bag.summary.schema).complete
                and schema.topics
                and not (compressed and other_form(path) in compressed)
            ):
                self._unchanged[bag.file] = bag, stamp.inode, stamp.ctime_ns
                bags.append(bag)
                del stamps[path]
        return bags

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
                self._tree.distrust(path)
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
                self._add_unchanged(path, classification)
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
        if known is not None and notes.trusted and stamp.is_of(known):
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


def _by_start(bags: list[BagFile]) -> list[BagFile]:
    """Returns bags by start; by numpy, since sorting what is sorted takes no time later."""
    starts = np.array([bag.start for bag in bags], np.int64)
    return [bags[row] for row in np.argsort(starts, kind="stable").tolist()]
