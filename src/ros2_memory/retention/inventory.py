"""Lists what this program put into the bag directory, and which of it may be deleted.

The index knows the bags. Retention also needs to know which recordings are the recorder's own,
which files go with the last bag of a recording, which must not be deleted, and which are hard links
of one another. What did not change is not looked at again, since a week has 60,000 bags.
"""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.layout import (
    DELETED_FILE,
    LOCK_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    ROS_LOG_DIR,
    has_own_name,
    is_carried,
    is_thinned,
    other_form,
    split_number,
)
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import known_identity
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns, Span
from ros2_memory.index.file_state import FileState
from ros2_memory.index.segment import TopicTotals
from ros2_memory.retention.delete import sidecar_bytes, size_of
from ros2_memory.retention.policy import DirContents, StoredBag, StoredFile

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from ros2_memory.core.bag_summary import TopicSummary
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.bag_table import KnownBags
    from ros2_memory.index.scan import Stamp
    from ros2_memory.index.snapshot import Snapshot


class Foreign(NamedTuple):
    """The bags that the recorder did not make, which retention neither counts nor deletes.

    `files` are the bags that answer queries, and `bag_bytes` is their size. `total_bytes` also has
    the bags that cannot be read; of these, `active` may still grow.
    """

    files: frozenset[str]
    bag_bytes: int
    total_bytes: int
    active: tuple[Path, ...]


class ForeignBags:
    """Measures the foreign bags of one bag directory. Thread-safe.

    It lists them again only if the index or the list of the recorder's recordings changed, and
    always measures those that may still grow.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._own = OwnRecordings(bag_dir)
        self._measured: tuple[tuple[object, ...], Foreign | None] = ((), None)

    def measured(self, snapshot: Snapshot, recording: Collection[str]) -> Foreign | None:
        """Returns the foreign bags, or None if no recorder has listed its own recordings yet.

        `recording` are the recordings that the recorder's heartbeat names.
        """
        try:
            if not self._own.exists():
                return None
        except OSError:
            return None
        set_aside = (snapshot.active, snapshot.damaged, snapshot.unread)
        key = (snapshot.timeline, *set_aside, self._own.stamp, tuple(recording))
        key_before, foreign = self._measured
        if foreign is None or key_before != key:
            foreign = self._measure(snapshot, frozenset(recording))
            self._measured = key, foreign
        active_bytes = sum(map(size_of, foreign.active))
        return foreign._replace(total_bytes=foreign.total_bytes + active_bytes)

    def _measure(self, snapshot: Snapshot, recording: frozenset[str]) -> Foreign:
        """Returns the foreign bags; `total_bytes` is without those that are active."""
        judge = cache(partial(self._judge, recording=recording))

        def is_foreign(file: str) -> bool:
            folder, _, name = file.rpartition("/")
            return not judge(folder)(name)

        bags = {
            bag.file: bag.size
            for segment in snapshot.timeline.segments
            for bag in segment.bags
            if is_foreign(bag.file)
        }
        bag_bytes = total_bytes = sum(bags.values())
        for aside in (*snapshot.damaged, *snapshot.unread):
            if is_foreign(str(aside.path)):
                total_bytes += size_of(aside.path)
        active = tuple(
            aside.path
            for aside in snapshot.active
            if not aside.answers and is_foreign(str(aside.path))
        )
        return Foreign(frozenset(bags), bag_bytes, total_bytes, active)

    def _judge(self, folder: str, recording: frozenset[str]) -> Callable[[str], bool]:
        """Returns a function that says whether a bag file of a directory counts in the budget."""
        name, identity = self._own.name_of(folder), known_identity(folder)
        is_new = name in recording and not self._own.lists(name, identity)
        if is_new or name.partition("/")[0] == MOMENTS_FOLDER:
            return lambda _: True
        return self._own.judge(name, identity)


OWN_FOLDERS: Final = (".episodic", ROS_LOG_DIR)
"""Data derived from bags, and the logs of `ros2`."""
COMPLETE_AFTER_NS: Final[Ns] = 120 * NS_PER_S
"""A directory that has not changed for so long is complete."""
_UNDATED: Final = (MAX_NS, MIN_NS)
_CLOSED: Final = frozenset({FileState.CLOSED, FileState.EMPTY})
"""States of bags that may be deleted."""
_LEFT_OPEN: Final = frozenset({FileState.INCOMPLETE, FileState.HELD_BACK})
"""States of bags that may be deleted unless the heartbeat names their recording. Bags that are held
back may, too, else a disk too full to cut them would stay full."""


class _Fate(Enum):
    """What becomes of a bag: who deletes it, and what counts it."""

    MAY_GO = auto()
    STAYS = auto()
    SAVED = auto()  # a file of a moment: moments are counted by themselves
    FOREIGN = auto()
    IGNORED = auto()  # it stays, and counts nowhere


class _Folder(NamedTuple):
    """A recording's directory: its device, and the bytes that go with its last bag."""

    mtime_ns: Ns
    device: int
    size: int


@dataclass(eq=False, repr=False)
class Inventory:
    """The contents of one bag directory. Not thread-safe.

    Args:
        static_topics: topics that are latched whatever their publishers declare.
        own: the recorder's recordings; only the size of other bags is counted. None: all bags may
            be deleted.
    """

    root: Path
    static_topics: Collection[str]
    own: OwnRecordings | None

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self._device: int | None = None
        self._settled_bags: dict[str, StoredBag] = {}
        self._folders: dict[str, _Folder] = {}

    def contents(
        self, known: KnownBags, *, deleted: Collection[str], remaining: Collection[str]
    ) -> DirContents:
        """Returns the bags that may be deleted, and the size of everything else.

        A bag that is being written must not be deleted, nor one that cannot be read: its age is
        unknown. A bag that a crash left open may, unless the recorder named it last. Bags whose
        disk has been unmounted are left out.

        Raises:
            OSError: the bag directory or the list of the recorder's own recordings cannot be read.
        """
        self._drop_other_device()
        judge = None
        if self.own is not None:
            self.own.names()  # reads the list anew, or fails
            judge = cache(self.own.judge_of)
        saved = self._saved_sizes(known)
        bags: list[StoredBag] = []
        recordings: set[str] = set()
        sizes = Counter[_Fate]()
        for state, bag in chain(self._changing(known), self._settled(known)):
            if bag.path in deleted:
                continue
            folder, _, name = bag.path.rpartition("/")
            is_own = judge is None or judge(folder)(name)
            fate = self._fate_of(bag, state, known, is_own=is_own)
            if fate is _Fate.MAY_GO and bag.path not in remaining:
                bags.append(bag)
            else:
                sizes[fate] += sum(file.size for file in bag.files if file.inode not in saved)
            if fate is not _Fate.FOREIGN:
                recordings.add(bag.recording)
        beside = sum(self._folder_of(name, known.now).size for name in recordings)
        state_bytes = state_bytes_in(self.root)
        return DirContents(
            bags,
            known.now,
            state_bytes + beside + sizes[_Fate.MAY_GO] + sizes[_Fate.STAYS],
            saved=saved,
            foreign_bytes=sizes[_Fate.FOREIGN],
            state_bytes=state_bytes,
        )

    def _fate_of(
        self, bag: StoredBag, state: FileState, known: KnownBags, *, is_own: bool
    ) -> _Fate:
        if bag.path in known.tree.saved:
            return _Fate.SAVED
        is_named = bag.recording in known.named
        # A split is listed moments after it appears.
        is_new = is_named and split_number(bag.recording, bag.path.rpartition("/")[2]) is not None
        if not is_own and not is_new:
            return _Fate.FOREIGN
        if is_own and _may_be_deleted(state, bag.path, is_named=is_named):
            return _Fate.MAY_GO
        return _Fate.STAYS if self._counts(state, bag) else _Fate.IGNORED

    def _drop_other_device(self) -> None:
        """Forgets bags and folders if the disk came back under another device number."""
        device = self.root.stat().st_dev
        if device != self._device:
            self._device, self._settled_bags, self._folders = device, {}, {}

    def _saved_sizes(self, known: KnownBags) -> dict[tuple[int, int], int]:
        """Returns the sizes of the files of moments, by device and inode number."""
        device = self.root.stat().st_dev
        with suppress(OSError):
            device = (self.root / MOMENTS_FOLDER).stat().st_dev
        return {(device, stamp.inode): stamp.size for stamp in known.tree.saved.values()}

    def _changing(self, known: KnownBags) -> Iterator[tuple[FileState, StoredBag]]:
        """Yields the few bags that may still change: the index has a note on each."""
        for path, classification in known.counted.items():
            if known.tree.is_away(path):
                continue
            bag = self._stored(path, classification.bag, known.files[path].stamp, known.now)
            other = other_form(path)
            if other in known.hidden:
                stamp = known.files[other].stamp
                bag = bag._replace(second=StoredFile((bag.device, stamp.inode), stamp.size))
            yield classification.state, bag

    def _settled(self, known: KnownBags) -> Iterator[tuple[FileState, StoredBag]]:
        """Yields the closed bags that change no more; most are known from the last call."""
        before, self._settled_bags = self._settled_bags, {}
        new: dict[str, Stamp] = {}
        for path, stamp in known.tree.stamps:
            if path in known.files or known.tree.is_away(path):
                continue
            stored = before.get(path)
            of_file = (stamp.inode, stamp.size, stamp.mtime_ns)
            if stored and (stored.inode, stored.size, stored.written) == of_file:
                self._settled_bags[path] = stored
            else:
                new[path] = stamp
        for bag in known.timeline.bags_named(new):
            stamp = new[bag.file]._replace(size=bag.size, mtime_ns=bag.mtime_ns)
            self._settled_bags[bag.file] = self._stored(bag.file, bag, stamp, known.now)
        if before.keys() - self._settled_bags.keys():
            left = {bag.recording for bag in self._settled_bags.values()}
            self._folders = {name: self._folders[name] for name in self._folders.keys() & left}
        for stored in self._settled_bags.values():
            yield FileState.CLOSED, stored

    def _stored(self, path: str, bag: BagFile | None, stamp: Stamp, now: Ns) -> StoredBag:
        recording = sys.intern(path.rpartition("/")[0][len(str(self.root)) + 1 :])
        span = _UNDATED if bag is None else self._dating_span(bag)
        device = self._folder_of(recording, now).device
        return StoredBag(path, recording, *span, stamp.mtime_ns, device, stamp.inode, stamp.size)

    def _counts(self, state: FileState, bag: StoredBag) -> bool:
        """Whether a bag that is kept counts among the other bytes."""
        if state is FileState.DAMAGED:
            # Where all bags may be deleted, only its name shows whether the recorder made it.
            return self.own is not None or has_own_name(Path(bag.recording).name)
        return state is not FileState.UNREAD

    def _dating_span(self, bag: BagFile) -> Span:
        """Returns the log times of the first and last message that dates a bag (inclusive)."""
        dating = [topic for topic in bag.summary.topics if not self._is_received_again(topic)]
        if not dating:
            return _UNDATED
        start, end = min(topic.first for topic in dating), max(topic.last for topic in dating)
        # Where equal, the bag's own objects, which take no more memory.
        return bag.start if start == bag.start else start, bag.end if end == bag.end else end

    def _is_received_again(self, topic: TopicSummary) -> bool:
        """Whether each recording may receive all of a topic's messages in a bag again."""
        if topic.topic in self.static_topics:
            return True
        return topic.latched and TopicTotals(topic.first, topic.last, topic.count).is_rare

    def _folder_of(self, recording: str, now: Ns) -> _Folder:
        folder, path = self._folders.get(recording), self.root / recording
        try:
            status = path.stat()
        except OSError:
            return _Folder(0, device=-1, size=0)
        if folder is None or folder.mtime_ns != status.st_mtime_ns:
            folder = _Folder(status.st_mtime_ns, status.st_dev, sidecar_bytes(path))
            # metadata.yaml is created first and written some moments later.
            if abs(now - status.st_mtime_ns) >= COMPLETE_AFTER_NS:
                self._folders[recording] = folder
        return folder


def state_bytes_in(bag_dir: Path) -> int:
    """Returns the bytes of the files beside the bags: state files, columns and logs."""
    paths = [bag_dir / name for name in (*OWN_FILES, LOCK_FILE)]
    moments = _entries(bag_dir / MOMENTS_FOLDER)
    paths += (moment / MOMENT_FILE for moment in moments if not moment.is_symlink())
    for folder in OWN_FOLDERS:
        paths += _entries(bag_dir / folder)
    # Deleting bags makes that list longer.
    return sum(size_of(path) for path in paths if path != bag_dir / DELETED_FILE)


def _entries(folder: Path) -> list[Path]:
    """Returns the entries of a folder; none if it is a link or cannot be listed."""
    with suppress(OSError):
        return [] if folder.is_symlink() else [*folder.iterdir()]
    return []


def _may_be_deleted(state: FileState, path: str, *, is_named: bool) -> bool:
    """Whether a bag may be deleted by its state; `is_named`: the heartbeat names its recording."""
    if is_thinned(path):
        return False
    if state in _CLOSED:
        return not is_carried(path)
    return state in _LEFT_OPEN and not is_named
