"""Keeps what was asked to be kept: hard links in `moments/`, which retention never deletes.

The recorder alone does this, while nothing is deleted. Whatever stops it between two steps, the
next look finds on the disk how far it came: a moment says that it is pending before its first link
is made, and a wish is there until it was answered.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.layout import HANDOVER_FILE, MOMENT_FILE
from ros2_memory.bag_dir.moment_file import (
    MAX_MOMENTS,
    SavedMoment,
    StoredMoment,
    make_moment_folder,
    moments_of,
    stored_moments_in,
    write_saved_moment,
)
from ros2_memory.bag_dir.request_queue import Outcome, RequestQueue
from ros2_memory.core import directories
from ros2_memory.retention.moment_plan import (
    Weight,
    admitted,
    fitting,
    needed,
    no_room,
    window_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.bag_dir.moment_file import SaveRequest
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Clock
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.moment_plan import Needed

_FULL: Final = "the share of moments (retention.max_moments_gb) was used up: not all of it is kept"
_OWN_FOLDER: Final = re.compile(r"\d{8}T\d{6}Z-[a-z0-9-]+(_\d+)?")

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


class MomentKeeper:
    """The moments of one bag directory. Not for several threads at once, but for `has_work`.

    Args:
        bag_dir: the bag directory.
        share_bytes: what moments may take of its budget.
        clock: the wall clock.
    """

    def __init__(self, bag_dir: Path, share_bytes: int, clock: Clock) -> None:
        self._bag_dir = bag_dir
        self._share = share_bytes
        self._clock = clock
        self._mailbox = RequestQueue(bag_dir)
        self._names = HardLinks(bag_dir)
        self._looked = False
        self._waiting = False

    def open(self) -> None:
        """Makes the folder of wishes, so that a server may be let into it alone."""
        self._mailbox.open()

    def has_work(self) -> bool:
        """Whether somebody asks, or a moment waits for bags; also before the first look."""
        return not self._looked or self._waiting or self._mailbox.has_requests()

    def keep(self, snapshot: Snapshot) -> None:
        """Does what is asked, and goes on with what is pending. Nothing may be deleted meanwhile.

        Raises:
            OSError: the folders cannot be listed or written to; the next look tries again.
        """
        if not self._looked:
            self._clean()
        now = self._clock.now()
        book = {held.folder.name: held for held in stored_moments_in(self._bag_dir)}
        for name, held in book.items():
            if held.moment.pending:
                book[name] = self._advance(held, _all_files(book), snapshot)
        numbers = {held.moment.number: held for held in book.values()}
        for wish in self._mailbox.take(now) if self._mailbox.has_requests() else ():
            known = numbers.get(wish.number)
            done = _outcome_of(known) if known else self._grant(wish, book, snapshot)
            self._mailbox.answer(wish, done)
        self._waiting = any(held.moment.pending for held in book.values())
        self._looked = True

    def follow(self) -> None:
        """Links the sidecars of recordings that were written anew; a fault is reported.

        What of a bag counts is decided when its recording is over, which may be later.
        """
        moments = moments_of(self._bag_dir)
        if moments.is_symlink():
            return
        for root, _ in directories.walk(moments):
            recording = self._names.recorded_as(root)
            try:
                if recording != root:
                    _link_sidecar(Path(recording), Path(root))
            except OSError as error:
                _log.error("moment_not_followed", path=root, reason=str(error))

    def _grant(
        self, wish: SaveRequest, book: dict[str, StoredMoment], snapshot: Snapshot
    ) -> Outcome:
        """Begins a moment, which is then in the book, or says why not."""
        need = self._needed(wish, snapshot)
        refused = self._refusal(wish, need, book, snapshot)
        if refused is None:
            try:
                held = self._begin(wish, need)
            except OSError as error:
                refused = (
                    f"the bags cannot be kept in {moments_of(self._bag_dir)} by hard links: "
                    f"{error.strerror or error}"
                )
            else:
                book[held.folder.name] = held
                _log.info("moment_kept", folder=held.folder.name, bags=len(held.files))
                return _outcome_of(held)
        _log.warning("moment_refused", label=wish.label, reason=refused)
        return Outcome(refused=refused)

    def _refusal(
        self, wish: SaveRequest, need: Needed, book: dict[str, StoredMoment], snapshot: Snapshot
    ) -> str | None:
        if len(book) >= MAX_MOMENTS:
            return (
                f"there are {len(book)} moments, which is as many as are kept; delete folders in "
                "moments/ of the bag directory"
            )
        if not need.bags and not need.waits:
            return "nothing was recorded then: ask for a time of which the memory knows"
        held = _all_files(book)
        weights = [weight for bag in need.bags for weight in _weighed(bag)]
        expected = self._open_bytes(wish, snapshot) if need.waits else 0
        if admitted(weights, held, self._share, expected) is None:
            new = {each.inode: each.size for each in weights if each.inode not in held}
            return no_room(held, sum(new.values()) + expected, self._share)
        return None

    def _begin(self, wish: SaveRequest, need: Needed) -> StoredMoment:
        folder = make_moment_folder(self._bag_dir, wish)
        try:
            write_saved_moment(folder, SavedMoment.of(wish))
            missing, files = self._link(folder, need.bags, None)
            keepsake = replace(SavedMoment.of(wish), pending=need.waits, missing=missing)
            if keepsake != SavedMoment.of(wish):
                write_saved_moment(folder, keepsake)
        except OSError:
            directories.remove(folder)
            raise
        flush(folder.parent)
        return StoredMoment(folder, keepsake, files)

    def _advance(
        self, held: StoredMoment, files: dict[int, int], snapshot: Snapshot
    ) -> StoredMoment:
        """Goes on with a moment; what of it cannot be kept it says in its file."""
        before = held.moment
        need = self._needed(before, snapshot)
        try:
            missing, linked = self._link(held.folder, need.bags, files)
        except OSError as error:
            missing, linked = (f"not all can be kept: {error.strerror or error}",), {}
        said = (*before.missing, *(each for each in missing if each not in before.missing))
        after = replace(before, pending=need.waits, missing=said)
        files_now = {**held.files, **linked}
        if after == before:
            return StoredMoment(held.folder, before, files_now)
        try:
            write_saved_moment(held.folder, after)
        except OSError as error:
            _log.error("moment_not_written", folder=str(held.folder), reason=str(error))
            return StoredMoment(held.folder, before, files_now)
        if not after.pending:
            _log.info("moment_complete", folder=held.folder.name, missing=list(said))
        return StoredMoment(held.folder, after, files_now)

    def _needed(self, what: SaveRequest | SavedMoment, snapshot: Snapshot) -> Needed:
        window = window_of(what.start, what.end)
        open_files = [snapshot.places[aside] for aside in snapshot.active]
        bags = snapshot.overlapping(window)
        return needed(window, what.asked, bags, open_files, self._clock.now())

    def _open_bytes(self, wish: SaveRequest, snapshot: Snapshot) -> int:
        """What of the moment is being written, as far as it has come."""
        window, size = window_of(wish.start, wish.end), 0
        for aside in snapshot.active:
            place = snapshot.places[aside]
            if place is None or (place.start < window.stop and window.start < place.stop):
                with suppress(OSError):
                    size += aside.path.lstat().st_size
        return size

    def _link(
        self, folder: Path, bags: Sequence[BagFile], files: dict[int, int] | None
    ) -> tuple[tuple[str, ...], dict[int, int]]:
        """Links bags into a moment's folder; what could not be, and the links by inode.

        `files` are what moments hold, where the share is to be minded.

        Raises:
            OSError: a link cannot be made.
        """
        missing: dict[str, None] = {}
        linked: dict[int, int] = {}
        weights = {bag.file: _weighed(bag) for bag in bags}
        every = [weight for each in weights.values() for weight in each]
        allowed = None if files is None else fitting(every, files, self._share)
        touched: set[Path] = set()
        for bag in bags:
            name = os.path.relpath(self._names.recorded_as(bag.file), self._bag_dir)
            target = folder / name
            if not weights[bag.file] and not target.exists():
                # `forget` deletes in another process, since the index was made.
                missing[_gone(name)] = None
            for inode, size in weights[bag.file]:
                if allowed is not None and inode not in allowed:
                    missing[_FULL] = None
                    continue
                directories.make(self._bag_dir, target.parent)
                if not _link_bag(bag.path, target, inode):
                    missing[_gone(name)] = None
                    continue
                linked[inode] = size
                if target.parent not in touched:
                    touched.add(target.parent)
                    _link_sidecar(bag.path.parent, target.parent)
        for parent in touched:
            flush(parent)
        return tuple(missing), linked

    def _clean(self) -> None:
        """Removes what a crash left of a moment that had not begun."""
        with suppress(OSError):
            for folder in moments_of(self._bag_dir).iterdir():
                if _OWN_FOLDER.fullmatch(folder.name) and not (folder / MOMENT_FILE).exists():
                    (folder / f".{MOMENT_FILE}.tmp").unlink(missing_ok=True)
                    with suppress(OSError):
                        folder.rmdir()


def _weighed(bag: BagFile) -> tuple[Weight, ...]:
    """The file of a bag; none where it has gone."""
    try:
        status = bag.path.lstat()
    except FileNotFoundError:
        return ()
    return (Weight(status.st_ino, status.st_size),)


def _gone(name: str) -> str:
    return f"{name} has gone, or another file of that name is kept"


def _all_files(book: dict[str, StoredMoment]) -> dict[int, int]:
    """What all moments hold, each file once."""
    return {inode: size for held in book.values() for inode, size in held.files.items()}


def _outcome_of(held: StoredMoment) -> Outcome:
    keepsake = held.moment
    return Outcome(held.folder.name, len(held.files), keepsake.pending)


def _link_bag(bag: Path, target: Path, inode: int) -> bool:
    """Whether the file is there under its second name, too.

    Raises:
        OSError: the link cannot be made.
    """
    try:
        os.link(bag, target, follow_symlinks=False)
    except (FileNotFoundError, FileExistsError):
        with suppress(FileNotFoundError):
            return target.lstat().st_ino == inode
        return False
    return True


def _link_sidecar(recording: Path, folder: Path) -> None:
    """Links a recording's sidecar, in the place of an earlier one.

    Raises:
        OSError: it cannot be linked.
    """
    source, target = recording / HANDOVER_FILE, folder / HANDOVER_FILE
    beside = folder / f".{HANDOVER_FILE}.tmp"
    with suppress(FileNotFoundError):
        if not source.exists() or (target.exists() and source.samefile(target)):
            return
        beside.unlink(missing_ok=True)
        os.link(source, beside, follow_symlinks=False)
        beside.replace(target)
    beside.unlink(missing_ok=True)
