"""How a bag file stands: closed, still being written, left open by a crash, or unreadable.

The file says of itself whether its writer has finished. Where it does not say so, either a
recorder still writes it or a crash left it:

    open      live heartbeat  names the recording                -> active, however still it lies
    open      live heartbeat  names others only                  -> left open by a crash
    open      no heartbeat    grew within the last three splits  -> active
    open      no heartbeat    lay still for longer               -> left open by a crash

A file "grew" when its mtime says so, or when two scans saw it grow. An mtime in the future says
nothing (the clock was set back), so there only what was seen counts.

Where nothing is recorded (`recorder=none`) an mtime alone is no evidence, since a copy has that of
its copying: the file is active only where two scans saw it grow, or where its newest message is no
more than three splits older than its mtime, as in the recording of another program. Where no
message can be read yet the mtime decides. A recording of simulated times counts as left open by a
crash until it was seen to grow.

A `.db3` has no closing mark: between two transactions of its recorder it looks finished. One that
grew within the last three splits is active unless the `metadata.yaml` beside it, which a recorder
writes last, mentions it, or a live heartbeat names other recordings only. A `.zstd` is written
after the bag in it was closed; it is open until its last frame is whole.

Where a scan includes active files an active `.mcap` is a bag as well as set aside: what of it is
whole answers. Bytes of such a file never change once they are there. Of a `.db3` they do: it is
read as a file that nobody writes, and read meanwhile its pages would contradict each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import open_plain
from ros2_memory.bag_dir.layout import bag_kind
from ros2_memory.bag_dir.metadata_yaml import parse_listing
from ros2_memory.core.errors import BagError, BagUnreachableError, BagVanishedError
from ros2_memory.core.model import BagFile, BagState, BagSummary, SetAside
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.scan import YOUNG_NS, settled
from ros2_memory.storage.base import Closing

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.index.scan import Stamp
    from ros2_memory.storage.base import BagReader

RETRY_NS: Final[Ns] = 600 * NS_PER_S
"""After this long an unreadable file is tried again: the fault may have been the machine's."""
RETRY_SOON_NS: Final[Ns] = 5 * NS_PER_S
"""The same where it certainly was: a disk that failed, or too many open files."""

_ACTIVE = "still being written"
_ANSWERS = "still being written: its complete chunks answer"
_NO_MESSAGE = (
    "it ends before its first message: its recorder was killed before any reached the disk"
)
_METADATA_LIMIT: Final = 1 << 26


class FileState(IntEnum):
    """What a file is to the index. Of two forms of one bag the higher standing answers."""

    UNREAD = 0
    DAMAGED = 1
    ACTIVE = 2
    INCOMPLETE = 3
    EMPTY = 4
    CLOSED = 5


@dataclass(frozen=True, slots=True)
class Classification:
    """How one file stands: as a bag, set aside with a reason, or without a message.

    Both a bag and set aside is only an active file that answers. `silent` are the topics that a bag
    without a message declares.
    """

    standing: FileState
    bag: BagFile | None = None
    aside: SetAside | None = None
    silent: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ScanContext:
    """What one scan knows besides the files themselves.

    `open_recordings` are those that a live heartbeat names; None without a live heartbeat.
    `include_active`: what is whole of a file that is still being written answers. `trusts_mtime`:
    a young mtime shows that a file is being written, and not only that it was copied.
    """

    root: Path
    now: Ns
    three_splits: Ns
    open_recordings: frozenset[str] | None = None
    include_active: bool = False
    trusts_mtime: bool = True
    _finished: dict[Path, frozenset[str]] = field(default_factory=dict)

    def may_be_recorded(self, path: Path) -> bool:
        """Whether no live heartbeat says that this file's recording is over."""
        return self.open_recordings is None or self.names(path)

    def names(self, path: Path) -> bool:
        """Whether a live heartbeat names this file's recording."""
        recording = path.parent.relative_to(self.root).as_posix()
        return self.open_recordings is not None and recording in self.open_recordings

    def is_finished(self, path: Path) -> bool:
        """Whether the metadata.yaml beside the file mentions it."""
        folder = path.parent
        if folder not in self._finished:
            self._finished[folder] = files_in_metadata(folder / "metadata.yaml")
        return path.name in self._finished[folder]


class KnownFile(NamedTuple):
    """A closed file as it looked when it was read, and what it held then.

    `start` and `end` are log times (inclusive); 0 where it holds no message.
    """

    size: int
    mtime_ns: Ns
    sidecar_ns: Ns
    summary: BagSummary
    start: Ns
    end: Ns

    def looks_like(self, stamp: Stamp) -> bool:
        """Whether a file still looks as it did."""
        return (self.size, self.mtime_ns, self.sidecar_ns) == (
            stamp.size,
            stamp.mtime_ns,
            stamp.sidecar_ns,
        )


@dataclass(slots=True)
class FileNotes:
    """What is known of one bag file, from outside and, as far as it was read, from inside."""

    path: Path
    kind: str
    stamp: Stamp
    seen_at: Ns
    trusted: bool
    grew_at: Ns | None = None
    closing: Closing | None = None
    summary: BagSummary | None = None
    fault: str | None = None
    passing: bool = False

    @classmethod
    def first(cls, path: Path, stamp: Stamp, now: Ns) -> FileNotes:
        """The notes of a bag file that was not known before."""
        return cls(path, bag_kind(path.name) or "", stamp, now, settled(stamp.mtime_ns, now))

    def recall(self, summary: BagSummary) -> None:
        """Takes in what was found earlier in a closed file that looked just like this one."""
        self.closing, self.summary = Closing.CLOSED, summary

    def look(self, stamp: Stamp, now: Ns) -> bool:
        """Takes in how the file looks at this scan, and forgets what may not hold any more.

        Gives whether anything had to be forgotten.
        """
        if stamp.inode != self.stamp.inode:
            self.grew_at = None  # another file under the same name
        elif stamp.size > self.stamp.size or (self.grew_at is not None and self.grew_at > now):
            self.grew_at = now  # also anew after the clock was set back
        outdated = self._outdated(stamp, now)
        if outdated:
            self.closing, self.summary, self.fault = None, None, None
            self.passing = False
            self.seen_at = now
        self.stamp = stamp
        self.trusted = settled(stamp.mtime_ns, now)
        return outdated

    def grew_lately(self, scene: ScanContext) -> bool:
        """Whether the file grew within the last three splits."""
        age = scene.now - self.stamp.mtime_ns
        return self.was_seen_growing(scene) or -YOUNG_NS < age <= scene.three_splits

    def was_seen_growing(self, scene: ScanContext) -> bool:
        """Whether two scans saw the file grow, within the last three splits."""
        return self.grew_at is not None and scene.now - self.grew_at <= scene.three_splits

    def must_be_watched(self, verdict: Classification, scene: ScanContext) -> bool:
        """Whether the next scan must look at the file though its directory did not change."""
        if verdict.standing is FileState.UNREAD:
            return False
        return (
            not self.trusted
            or verdict.standing in {FileState.ACTIVE, FileState.DAMAGED}
            or self.closing is Closing.OPEN
            or (self.kind == ".db3" and scene.now - self.stamp.mtime_ns <= scene.three_splits)
        )

    def _outdated(self, stamp: Stamp, now: Ns) -> bool:
        before = self.stamp
        if not self.trusted or (stamp.size, stamp.mtime_ns, stamp.sidecar_ns) != (
            before.size,
            before.mtime_ns,
            before.sidecar_ns,
        ):
            return True
        # Permissions change only the ctime.
        patience = RETRY_SOON_NS if self.passing else RETRY_NS
        return self.fault is not None and (
            stamp.ctime_ns != before.ctime_ns or abs(now - self.seen_at) >= patience
        )


def classify(notes: FileNotes, reader: BagReader, scene: ScanContext) -> Classification:
    """How the file stands; reads of it only what the notes do not have.

    Raises:
        BagVanishedError: the file is not there any more.
    """
    if not reader.reads(notes.path):
        return _aside(FileState.UNREAD, notes, _not_read(notes))
    try:
        if notes.closing is None and notes.fault is None:
            # An open MCAP is 0 bytes until its first chunk is full.
            empty = notes.stamp.size == 0
            notes.closing = Closing.OPEN if empty else reader.closing(notes.path)
        if _is_active(notes, scene) and not _is_copy(notes, reader, scene):
            return _active(notes, reader, scene)
        if notes.summary is None and notes.fault is None:
            notes.summary = reader.summarize(notes.path)
    except BagVanishedError:
        raise
    except BagError as error:
        notes.fault, notes.passing = error.reason, isinstance(error, BagUnreachableError)
    if notes.summary is None:
        return _aside(FileState.DAMAGED, notes, notes.fault or "it cannot be read")
    return _readable(notes, notes.summary)


def files_in_metadata(path: Path) -> frozenset[str]:
    """Returns the bag files that a metadata.yaml lists; none where it cannot be read."""
    try:
        with open_plain(path) as stream:
            text = stream.read(_METADATA_LIMIT).decode("utf-8", errors="replace")
    except (OSError, ValueError):
        return frozenset()
    return frozenset(parse_listing(text).names)


def _is_active(notes: FileNotes, scene: ScanContext) -> bool:
    if notes.closing is Closing.OPEN:
        if scene.open_recordings is not None:
            return scene.names(notes.path)
        return notes.grew_lately(scene)
    return (
        notes.closing is Closing.CLOSED
        and notes.kind == ".db3"
        and scene.may_be_recorded(notes.path)
        and notes.grew_lately(scene)
        and not scene.is_finished(notes.path)
    )


def _is_copy(notes: FileNotes, reader: BagReader, scene: ScanContext) -> bool:
    """Whether a file looks as being written for no other reason than when it was copied.

    Raises:
        BagVanishedError: the file is not there any more.
    """
    if scene.trusts_mtime or scene.open_recordings is not None or notes.was_seen_growing(scene):
        return False
    if notes.summary is None and notes.stamp.size:
        try:
            notes.summary = reader.summarize(notes.path)
        except BagVanishedError:
            raise
        except BagError:
            return False
    if notes.summary is None or notes.summary.empty:
        return False
    return abs(notes.stamp.mtime_ns - notes.summary.end) > scene.three_splits


def _active(notes: FileNotes, reader: BagReader, scene: ScanContext) -> Classification:
    """An active file; as a bag, too, as far as it can be one.

    Raises:
        BagVanishedError: the file is not there any more.
    """
    aside = SetAside(notes.path, _ACTIVE)
    if not scene.include_active or notes.kind != ".mcap":
        return Classification(FileState.ACTIVE, aside=aside)
    nothing_yet = Classification(FileState.ACTIVE, aside=replace(aside, answers=True))
    if notes.stamp.size == 0:
        return nothing_yet
    if notes.summary is None:
        try:
            notes.summary = reader.summarize(notes.path)
        except BagVanishedError:
            raise
        except BagError:
            # The file may be about to be one. If it is none, that is found when it stays so.
            return Classification(FileState.ACTIVE, aside=aside)
    summary = notes.summary
    if not summary.complete:
        # The first note tells how the file ends; it goes on.
        summary = summary.replaced(notes=summary.notes[1:])
    if summary.empty:
        return nothing_yet
    bag = _bag(notes, BagState.ACTIVE, summary)
    return Classification(
        FileState.ACTIVE, bag, SetAside(notes.path, _ANSWERS, answers=True, until=bag.end)
    )


def _readable(notes: FileNotes, summary: BagSummary) -> Classification:
    closed = notes.closing is Closing.CLOSED and summary.complete
    if summary.empty:
        if closed and not summary.notes:
            return Classification(FileState.EMPTY, silent=summary.silent)
        if closed:
            return _aside(FileState.DAMAGED, notes, "; ".join(summary.notes))
        return _aside(FileState.DAMAGED, notes, _NO_MESSAGE)
    bag = _bag(notes, BagState.CLOSED if closed else BagState.INCOMPLETE, summary)
    return Classification(FileState.CLOSED if closed else FileState.INCOMPLETE, bag=bag)


def _bag(notes: FileNotes, state: BagState, summary: BagSummary) -> BagFile:
    stamp = notes.stamp
    return BagFile(
        str(notes.path),
        stamp.size,
        stamp.mtime_ns,
        state,
        summary,
        summary.start,
        summary.end,
        stamp.sidecar_ns,
    )


def _aside(standing: FileState, notes: FileNotes, reason: str) -> Classification:
    return Classification(standing, aside=SetAside(notes.path, reason, notes.stamp.mtime_ns))


def _not_read(notes: FileNotes) -> str:
    if not notes.path.name.endswith(notes.kind):
        return f"the name of a bag file must end in {notes.kind}, in lower case: rename it"
    return f"this storage does not read {notes.kind} files: choose storage=rosbag2, which does"
