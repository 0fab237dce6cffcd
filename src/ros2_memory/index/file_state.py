"""The state of a bag file: closed, still being written, left open by a crash, or unreadable.

The file itself shows whether its writer has finished. Where it does not, either a recorder is still
writing it or a crash left it open:

    open      live heartbeat  names the recording                -> active, however long unchanged
    open      live heartbeat  names only others                  -> left open by a crash
    open      no heartbeat    grew within the last three splits  -> active
    open      no heartbeat    has not grown for longer           -> left open by a crash

A file grew if its mtime says so, or if two scans saw it grow. An mtime in the future says nothing
(the clock was set back): then only the scans count.

With `recorder=none` an mtime alone is no evidence: a copied file has the time of its copying. Such
a file is active if two scans saw it grow, or if its newest message is at most three splits older
than its mtime, as when another program records. If no message can be read yet, the mtime decides. A
recording of simulated times counts as left open by a crash until two scans saw it grow.

A `.db3` has no closing mark: between two transactions it looks finished. If it grew within the last
three splits it is active, unless the `metadata.yaml` beside it lists it (a recorder writes that
last), or a live heartbeat names only other recordings. A `.zstd` is written after its bag was
closed, and is open until its last frame is complete.

A split that the recorder holds back until it is screened (`bag_dir.state_files`) counts as active,
whatever its state, and never answers.

If a scan includes active files, an active `.mcap` is both a bag and set aside: its complete chunks
answer, since their bytes never change. A `.db3` does not answer: its pages change while it is
written, and a read meanwhile would find them in contradiction.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind
from ros2_memory.bag_dir.metadata_yaml import read_listing
from ros2_memory.bag_dir.state_files import Withheld, read_withheld
from ros2_memory.core.errors import BagError, BagUnreachableError, BagVanishedError
from ros2_memory.core.model import MCAP, UNMARKED_KINDS, BagFile, BagState, SetAside
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.index.scan import YOUNG_NS, Stamp, settled

if TYPE_CHECKING:
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader

RETRY_NS: Final[Ns] = 600 * NS_PER_S
"""An unreadable file is tried again after this time: the machine may have been at fault."""
RETRY_SOON_NS: Final[Ns] = 5 * NS_PER_S
"""The same if the machine certainly was at fault: a failed disk, or too many open files."""

_ACTIVE = "still being written"
HELD_BACK: Final = "not served yet: recording.exclude_when has still to be applied"
_ANSWERS = "still being written: its complete chunks are read"
_NO_MESSAGE = "a crash left it open, and no message in it counts"
_RECOVER = "; ros2-memory recover closes it"


class FileState(IntEnum):
    """What a file is to the index. Of two forms of one bag the higher state counts."""

    UNREAD = 0
    DAMAGED = 1
    ACTIVE = 2
    INCOMPLETE = 3
    EMPTY = 4
    CLOSED = 5
    HELD_BACK = 6


_WATCHED: Final = frozenset({FileState.ACTIVE, FileState.DAMAGED, FileState.HELD_BACK})


@dataclass(frozen=True, slots=True)
class Classification:
    """What one file is: a bag, or set aside with a reason, or a bag without messages.

    Attributes:
        state: its state.
        bag: the bag, if it answers.
        aside: why the file is set aside. Only an active file that answers has both.
        silent: the topics that a bag without messages declares.
    """

    state: FileState
    bag: BagFile | None = None
    aside: SetAside | None = None
    silent: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScanContext:
    """What one scan knows besides the files themselves.

    Attributes:
        root: the bag directory.
        now: the time of the scan.
        three_splits: how long three splits take.
        open_recordings: the recordings that a live heartbeat names; None without one.
        include_active: whether the complete chunks of an active file answer.
        trusts_mtime: whether a young mtime shows that a file is being written, not copied.
    """

    root: Path
    now: Ns
    three_splits: Ns
    open_recordings: frozenset[str] | None = None
    include_active: bool = False
    trusts_mtime: bool = True
    _listed: dict[Path, frozenset[str]] = field(default_factory=dict)

    @property
    def settling_ns(self) -> Ns:
        """How long a closed file may still change after its last change."""
        return max(self.three_splits, YOUNG_NS)

    @cached_property
    def withheld(self) -> Withheld:
        """What the recorder has not released yet.

        Read after the directory is listed, so it covers every file that the listing found.
        """
        return read_withheld(self.root)

    def names(self, path: Path) -> bool:
        """Returns whether a live heartbeat names this file's recording."""
        recording = path.parent.relative_to(self.root).as_posix()
        return self.open_recordings is not None and recording in self.open_recordings

    def lists(self, path: Path) -> bool:
        """Returns whether the metadata.yaml beside a file lists it."""
        folder = path.parent
        if folder not in self._listed:
            self._listed[folder] = frozenset()
            with suppress(OSError, ValueError):
                self._listed[folder] = frozenset(read_listing(folder / METADATA_FILE).names)
        return path.name in self._listed[folder]


@dataclass(slots=True)
class FileNotes:
    """What the scans have learned about one bag file.

    Attributes:
        file: its path as a string, to save memory.
        kind: its suffix, one of `core.model.BAG_KINDS`.
        stamp: its stat result.
        seen_at: when a scan first saw this stat result.
        trusted: whether a later change would show in its mtime.
        grew_at: when a scan last saw it grow.
        is_finished: whether its writer has finished; None if not read yet.
        summary: its content; None if not read yet.
        fault: why it cannot be read.
        is_transient: whether the machine may be at fault, not the file.
    """

    file: str
    kind: str
    stamp: Stamp
    seen_at: Ns
    trusted: bool
    grew_at: Ns | None = None
    is_finished: bool | None = None
    summary: BagSummary | None = None
    fault: str | None = None
    is_transient: bool = False

    @classmethod
    def first(cls, file: str, stamp: Stamp, now: Ns) -> FileNotes:
        """Returns the notes on a bag file that no scan saw before."""
        return cls(file, bag_kind(file) or "", stamp, now, settled(stamp.mtime_ns, now))

    @property
    def path(self) -> Path:
        """The path of the file."""
        return Path(self.file)

    def restore(self, summary: BagSummary) -> None:
        """Sets the content of a file that was read earlier and has not changed."""
        self.summary = summary
        if summary.complete:  # else a recorder may still have it open
            self.is_finished = True

    def update(self, stamp: Stamp, now: Ns) -> bool:
        """Notes a new stat result; returns whether the file has to be read again."""
        if stamp.inode != self.stamp.inode:
            self.grew_at = None  # another file under the same name
        elif stamp.size > self.stamp.size or (self.grew_at is not None and self.grew_at > now):
            # A time after now: the clock was set back since.
            self.grew_at = now
        patience = RETRY_SOON_NS if self.is_transient else RETRY_NS
        is_retried = self.fault is not None and abs(now - self.seen_at) >= patience
        # The ctime counts too: a file may have the size and mtime of the one that it replaced.
        is_outdated = is_retried or not self.trusted or stamp != self.stamp
        if is_outdated:
            self.is_finished, self.summary, self.fault = None, None, None
            self.is_transient = False
            self.seen_at = now
        self.stamp = stamp
        self.trusted = settled(stamp.mtime_ns, now)
        return is_outdated

    def grew_lately(self, context: ScanContext) -> bool:
        """Returns whether the file grew within the last three splits."""
        age = context.now - self.stamp.mtime_ns
        return self.was_seen_growing(context) or -YOUNG_NS < age <= context.three_splits

    def was_seen_growing(self, context: ScanContext) -> bool:
        """Returns whether a scan saw the file grow within the last three splits."""
        return self.grew_at is not None and context.now - self.grew_at <= context.three_splits

    def must_be_watched(self, classification: Classification, context: ScanContext) -> bool:
        """Returns whether the next scan must look at the file even if its directory is the same."""
        if classification.state is FileState.UNREAD:
            return False
        return (
            not self.trusted
            or classification.state in _WATCHED
            or self.is_finished is False
            or (
                self.kind in UNMARKED_KINDS
                and context.now - self.stamp.mtime_ns <= context.three_splits
            )
        )


def classify(notes: FileNotes, reader: BagReader, context: ScanContext) -> Classification:
    """Returns what a file is. Reads what the notes lack, and adds it to them.

    Raises:
        BagVanishedError: the file does not exist any more.
    """
    if not reader.reads(notes.path):
        return _set_aside(FileState.UNREAD, notes, reason_unread(notes.path))
    if context.withheld.holds(notes.path.parent.name, notes.path.name):
        return Classification(FileState.HELD_BACK, aside=SetAside(notes.path, HELD_BACK))
    try:
        if notes.is_finished is None and notes.fault is None:
            # An open MCAP is 0 bytes until its first chunk is full.
            notes.is_finished = notes.stamp.size > 0 and reader.is_finished(notes.path)
        if _is_active(notes, context) and not _is_young_copy(notes, reader, context):
            return _classify_active(notes, reader, context)
        if notes.summary is None and notes.fault is None:
            notes.summary = reader.summarize(notes.path)
    except BagVanishedError:
        raise
    except BagError as error:
        notes.fault, notes.is_transient = error.reason, isinstance(error, BagUnreachableError)
    if notes.summary is None:
        return _set_aside(FileState.DAMAGED, notes, notes.fault or "it cannot be read")
    return _classify_readable(notes, notes.summary)


def reason_unread(path: Path) -> str:
    """Returns why the storage does not read a bag file, and what to do about it."""
    kind = bag_kind(path.name) or ""
    if not path.name.endswith(kind):
        return f"the name of a bag file must end in {kind}, in lower case: rename it"
    return f"this storage does not read {kind} files: choose storage=rosbag2, which does"


def _is_active(notes: FileNotes, context: ScanContext) -> bool:
    if notes.is_finished is False:
        if context.open_recordings is not None:
            return context.names(notes.path)
        return notes.grew_lately(context)
    return (
        notes.is_finished is True
        and notes.kind in UNMARKED_KINDS
        and (context.open_recordings is None or context.names(notes.path))
        and notes.grew_lately(context)
        and not context.lists(notes.path)
    )


def _is_young_copy(notes: FileNotes, reader: BagReader, context: ScanContext) -> bool:
    """Returns whether a file has a young mtime only because it was copied.

    Raises:
        BagVanishedError: the file does not exist any more.
    """
    if context.trusts_mtime or context.open_recordings is not None:
        return False
    if notes.was_seen_growing(context):
        return False
    summary = _summary_so_far(notes, reader)
    if summary is None or summary.empty:
        return False
    return abs(notes.stamp.mtime_ns - summary.end) > context.three_splits


def _classify_active(notes: FileNotes, reader: BagReader, context: ScanContext) -> Classification:
    """Returns what an active file is: set aside, and a bag as well if its chunks answer.

    Raises:
        BagVanishedError: the file does not exist any more.
    """
    is_growing = notes.was_seen_growing(context) or context.names(notes.path)
    aside = SetAside(notes.path, _ACTIVE, growing=is_growing)
    if not context.include_active or notes.kind != MCAP:
        return Classification(FileState.ACTIVE, aside=aside)
    summary = _summary_so_far(notes, reader)
    if summary is None and notes.stamp.size:
        # It cannot be read now, but may be a bag once it is closed.
        return Classification(FileState.ACTIVE, aside=aside)
    if summary is None or summary.empty:
        return Classification(FileState.ACTIVE, aside=replace(aside, answers=True))
    if not summary.complete:
        # The first note says that the file ends early: this one is still growing.
        summary = summary.with_notes(summary.notes[1:])
    bag = _bag_file(notes, BagState.ACTIVE, summary)
    answering = replace(aside, reason=_ANSWERS, answers=True, until=bag.end)
    return Classification(FileState.ACTIVE, bag, answering)


def _summary_so_far(notes: FileNotes, reader: BagReader) -> BagSummary | None:
    """Returns the summary of a file that may be growing; None if nothing can be read of it.

    Raises:
        BagVanishedError: the file does not exist any more.
    """
    if notes.summary is None and notes.stamp.size:
        try:
            notes.summary = reader.summarize(notes.path)
        except BagVanishedError:
            raise
        except BagError:
            return None
    return notes.summary


def _classify_readable(notes: FileNotes, summary: BagSummary) -> Classification:
    is_closed = notes.is_finished and summary.complete
    if summary.empty:
        if is_closed and not summary.notes:
            return Classification(FileState.EMPTY, silent=summary.schema.silent)
        if is_closed:
            return _set_aside(FileState.DAMAGED, notes, "; ".join(summary.notes))
        closes = _RECOVER if notes.kind == MCAP else ""
        return _set_aside(FileState.DAMAGED, notes, _NO_MESSAGE + closes)
    bag = _bag_file(notes, BagState.CLOSED if is_closed else BagState.INCOMPLETE, summary)
    return Classification(FileState.CLOSED if is_closed else FileState.INCOMPLETE, bag=bag)


def _bag_file(notes: FileNotes, state: BagState, summary: BagSummary) -> BagFile:
    stamp = notes.stamp
    return BagFile(
        notes.file,
        stamp.size,
        stamp.mtime_ns,
        state,
        summary,
        summary.start,
        summary.end,
        stamp.sidecar_ns,
    )


def _set_aside(state: FileState, notes: FileNotes, reason: str) -> Classification:
    return Classification(state, aside=SetAside(notes.path, reason, notes.stamp.mtime_ns))
