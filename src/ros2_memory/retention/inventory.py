"""What lies in the bag directory because of this program, and which of it may be deleted.

The index knows the bags; here stands what retention weighs besides: which recordings are its
recorder's own, what goes with the last bag of a recording, what nothing may delete, and which files
are two names of one. Worked out for what changed since the last time, since a week is 60,000 bags.
"""

from __future__ import annotations

import stat
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.directory_identity import identity_of
from ros2_memory.bag_dir.layout import (
    LOCK_FILE,
    MOMENT_FILE,
    MOMENTS_FOLDER,
    OWN_FILES,
    ROS_LOG_DIR,
    has_own_name,
    is_carried,
    other_form,
)
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.file_state import FileState
from ros2_memory.index.pace import Pace, is_rare
from ros2_memory.index.segment import Stated
from ros2_memory.retention.delete import beside_bags
from ros2_memory.retention.policy import RetentionStock, Span, StoredBag, StoredFile

if TYPE_CHECKING:
    from collections.abc import Collection

    from ros2_memory.bag_dir.directory_identity import Identity
    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.bag_summary import TopicSummary
    from ros2_memory.index.bag_table import KnownBags
    from ros2_memory.index.file_state import Classification
    from ros2_memory.index.scan import Stamp

OWN_FOLDERS: Final = (".episodic", ROS_LOG_DIR)
"""What is derived from bags, and what `ros2` logs."""
SETTLED_NS: Final[Ns] = 120 * NS_PER_S
"""A directory that changed longer ago holds what it will hold."""
_BLOCK: Final = 4096
_WHOLE: Final = frozenset({FileState.CLOSED, FileState.EMPTY})


class _Deletable(Enum):
    """What may become of a bag."""

    MAY_GO = auto()
    MAY_GO_UNNAMED = auto()  # where the recorder does not name its recording
    STAYS = auto()
    DAMAGED = auto()  # stays, and counts where the recorder made it
    FROM_ELSEWHERE = auto()  # stays, and does not count
    KEPT = auto()  # in a moment: stays, and counts with the others there


class _Entry(NamedTuple):
    """A bag, and what it was made from."""

    verdict: Classification
    stamp: Stamp
    bag: StoredBag
    fate: _Deletable


class _Folder(NamedTuple):
    """A recording's directory: its device, and the size of what goes with its last bag.

    `identity` is that of the directory itself, as of `ctime_ns`.
    """

    mtime_ns: Ns
    settled: bool
    device: int
    size: int
    ctime_ns: Ns = 0
    identity: Identity | None = None


class Inventory:
    """The stock of one bag directory. Not for several threads at once.

    `static_topics` are latched whatever their publishers say. Of bags that are not among the
    recorder's `own` only the size is told; all bags are weighed where None.
    """

    def __init__(
        self,
        root: Path,
        static_topics: Collection[str] = (),
        own: OwnRecordings | None = None,
    ) -> None:
        self._root = root
        self._own = own
        self._static_topics = frozenset(static_topics)
        self._entries: dict[str, _Entry] = {}
        self._folders: dict[str, _Folder] = {}

    def stock(
        self, known: KnownBags, *, gone: Collection[str] = (), staying: Collection[str] = ()
    ) -> RetentionStock:
        """The bags that may be deleted, and the size of everything else.

        A bag that is being written may not, nor one that cannot be read: it says nothing of its
        age. Whole bags may that were left open by a crash, unless the recorder named them last.

        Args:
            known: what the index knows.
            gone: bags that have been deleted since.
            staying: bags that cannot be deleted.

        Raises:
            OSError: it cannot be read which recordings are the recorder's own.
        """
        bags: list[StoredBag] = []
        others = self._own_bytes()
        occupied: set[str] = set()
        foreign: set[StoredFile] = set()
        named = {str(self._root / name) for name in known.named}
        owned: dict[str, bool] = {}
        if self._own is not None:
            self._own.names()
        entries, files = self._entries, known.files
        for path, verdict in known.counted.items():
            if path in gone:
                continue
            entry = entries.get(path)
            if (
                entry is None
                or entry.verdict is not verdict
                or entry.stamp is not files[path].stamp
            ):
                entry = entries[path] = self._entered(path, verdict, known)
            fate, bag = entry.fate, entry.bag
            own = owned.get(bag.recording)
            if own is None:
                own = owned[bag.recording] = self._is_own(bag.recording, known.now)
            # One that has just been begun is listed with its directory some moments later.
            ours = own or bag.recording in named or is_carried(Path(path))
            if not ours and fate is not _Deletable.KEPT:
                foreign.update(bag.files)
                continue
            unnamed = fate is _Deletable.MAY_GO_UNNAMED and bag.recording not in named
            if own and (fate is _Deletable.MAY_GO or unnamed) and path not in staying:
                bags.append(bag)
            else:
                occupied.add(bag.recording)
                if fate is not _Deletable.KEPT and not self._is_from_elsewhere(fate, bag):
                    others += sum(file.size for file in bag.files)
        self._forget(known)
        emptied = {bag.recording for bag in bags} - occupied - named - {str(self._root)}
        sidecars = {each: self._folder(each, known.now).size for each in emptied}
        occupied.update(bag.recording for bag in bags)
        others += sum(self._folder(each, known.now).size for each in occupied - emptied)
        elsewhere = sum({file.inode: file.size for file in foreign}.values())
        kept = self._kept(known)
        return RetentionStock(bags, known.now, sidecars, others, kept=kept, foreign_bytes=elsewhere)

    def _is_own(self, recording: str, now: Ns) -> bool:
        if self._own is None:
            return True
        name = self._own.name_of(recording)
        return self._own.lists(name, self._folder(recording, now).identity)

    def _is_from_elsewhere(self, fate: _Deletable, bag: StoredBag) -> bool:
        """Whether a bag that stays does not count: where all are weighed, its name has to tell."""
        if fate is _Deletable.DAMAGED:
            return self._own is None and not has_own_name(Path(bag.recording).name)
        return fate is _Deletable.FROM_ELSEWHERE

    def _entered(self, path: str, verdict: Classification, known: KnownBags) -> _Entry:
        bag = self._stored(path, verdict, known)
        fate = _Deletable.KEPT if path in known.kept else _fate(verdict, bag)
        return _Entry(verdict, known.files[path].stamp, bag, fate)

    def _kept(self, known: KnownBags) -> tuple[StoredFile, ...]:
        """The files of moments, each once."""
        if not known.kept:
            return ()
        try:
            device = (self._root / MOMENTS_FOLDER).stat().st_dev
        except OSError:
            device = -1
        stamps = {known.files[path].stamp.inode: known.files[path].stamp for path in known.kept}
        return tuple(
            StoredFile((device, inode), stamp.size, _on_disk(stamp.size))
            for inode, stamp in stamps.items()
        )

    def _stored(self, path: str, verdict: Classification, known: KnownBags) -> StoredBag:
        recording = str(known.files[path].path.parent)
        device = self._folder(recording, known.now).device
        other = other_form(path)
        forms = (path, other) if other in known.hidden and other in known.files else (path,)
        stamps = [known.files[form].stamp for form in forms]
        files = (
            StoredFile((device, each.inode), each.size, _on_disk(each.size)) for each in stamps
        )
        return StoredBag(path, recording, self._span(verdict), stamps[0].mtime_ns, tuple(files))

    def _span(self, verdict: Classification) -> Span | None:
        if verdict.bag is None:
            return None
        said = [
            (topic.first, topic.last)
            for topic in verdict.bag.summary.topics
            if not self._is_received_again(topic)
        ]
        if not said:
            return None
        return Span(min(first for first, _ in said), max(last for _, last in said))

    def _is_received_again(self, topic: TopicSummary) -> bool:
        """Whether all that a bag holds of a topic may be what each recording receives again."""
        pace = Pace(Stated(topic.first, topic.last, topic.count), topic.first, topic.last)
        rare = topic.latched and is_rare(pace)
        return rare or topic.topic in self._static_topics

    def _folder(self, path: str, now: Ns) -> _Folder:
        known = self._folders.get(path)
        try:
            status = Path(path).stat()
        except OSError:
            return _Folder(0, settled=False, device=-1, size=0)
        if known is None or not known.settled or known.mtime_ns != status.st_mtime_ns:
            # metadata.yaml is made, and written some moments later.
            since = abs(now - status.st_mtime_ns)
            size = beside_bags(Path(path))
            known = _Folder(status.st_mtime_ns, since >= SETTLED_NS, status.st_dev, size)
            self._folders[path] = known
        if known.ctime_ns != status.st_ctime_ns or known.identity is None:
            identity = None
            if self._own is not None:
                with suppress(OSError):
                    identity = identity_of(path)
            known = known._replace(ctime_ns=status.st_ctime_ns, identity=identity)
            self._folders[path] = known
        return known

    def _forget(self, known: KnownBags) -> None:
        if len(self._entries) > len(known.counted):
            for path in self._entries.keys() - known.counted.keys():
                del self._entries[path]
            recordings = {entry.bag.recording for entry in self._entries.values()}
            for path in self._folders.keys() - recordings:
                del self._folders[path]

    def _own_bytes(self) -> int:
        """The size of what this program keeps beside the recordings."""
        own = [self._root / name for name in (*OWN_FILES, LOCK_FILE)]
        with suppress(OSError):
            own += (self._root / MOMENTS_FOLDER).glob(f"*/{MOMENT_FILE}")
        for folder in OWN_FOLDERS:
            with suppress(OSError):
                own += (self._root / folder).iterdir()
        size = 0
        for path in own:
            with suppress(OSError):
                status = path.lstat()
                size += status.st_size if stat.S_ISREG(status.st_mode) else 0
        return size


def _fate(verdict: Classification, bag: StoredBag) -> _Deletable:
    path = Path(bag.path)
    if verdict.standing is FileState.INCOMPLETE:
        return _Deletable.MAY_GO_UNNAMED
    if verdict.standing in _WHOLE:
        return _Deletable.STAYS if is_carried(path) else _Deletable.MAY_GO
    if verdict.standing is FileState.DAMAGED:
        return _Deletable.DAMAGED
    return _Deletable.FROM_ELSEWHERE if verdict.standing is FileState.UNREAD else _Deletable.STAYS


def _on_disk(size: int) -> int:
    return -(-size // _BLOCK) * _BLOCK
