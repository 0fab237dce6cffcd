"""Saves moments: hard links in `moments/`, which retention never deletes.

Somebody asked for a moment, or a rule fired (see `triggers`). What each rule may take is set aside,
so that none takes what belongs to another, or to those who ask.

The recorder alone does this, while nothing is deleted. A crash between two steps does no harm: a
moment's file marks it as pending before its first link is made, and a request stays in the
queue until it is answered. What a moment needs and whether it fits are decided by pure functions.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.layout import HANDOVER_FILE, MOMENT_FILE, is_carried
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
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, iso_local
from ros2_memory.retention.delete import size_of
from ros2_memory.retention.policy import GB

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.bag_dir.moment_file import SaveRequest
    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.index.snapshot import Snapshot

REPAIRED_WITHIN_NS: Final[Ns] = 600 * NS_PER_S
"""For so long a moment waits for a bag that a crash left open: its repair makes another file."""
LONGEST_WAIT_NS: Final[Ns] = 2 * 3600 * NS_PER_S
"""No split stays open for longer, unless another program writes it, or clocks differ."""

SHORTEST_HOLE_NS: Final[Ns] = 2 * NS_PER_S
"""A shorter time without a bag is not worth a sentence."""

_SHARE: Final = "retention.max_moments_gb"
_OWN_FOLDER: Final = re.compile(r"\d{8}T\d{6}Z-[a-z0-9-]+(_\d+)?")

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


class NeededBags(NamedTuple):
    """The bags of a moment that can be kept now, in order of time; `waits`: more may come."""

    bags: tuple[BagFile, ...]
    waits: bool


def window_of(start: Ns, end: Ns) -> TimeWindow:
    """Returns the window of a moment from `start` to `end`, both included."""
    return TimeWindow(start, min(end + 1, MAX_NS))


def needed_bags(
    window: TimeWindow,
    asked: Ns,
    bags: Iterable[BagFile],
    open_files: Iterable[TimeWindow | None],
    now: Ns,
) -> NeededBags:
    """Chooses the bags that a moment needs.

    Args:
        window: when the moment was.
        asked: when it was asked for.
        bags: those that answer queries.
        open_files: when what is still being written may have been recorded; None if unknown.
        now: the present time.
    """
    waits = now < window.stop or any(_may_overlap(each, window) for each in open_files)
    ready = []
    for bag in bags:
        if not window.overlaps(bag.start, bag.end) or is_carried(bag.file):
            continue
        unfinished = bag.state is BagState.INCOMPLETE and bag.file.endswith(".mcap")
        if unfinished and now - asked < REPAIRED_WITHIN_NS:
            waits = True
        else:
            ready.append(bag)
    return NeededBags(tuple(ready), waits and abs(now - asked) < LONGEST_WAIT_NS)


def fitting(
    files: Iterable[tuple[int, int]], stored: Mapping[int, int], share: int
) -> dict[int, int]:
    """Adds files in their order to those that moments store, as long as the share has room.

    Args:
        files: inodes and sizes (bytes).
        stored: what moments store, by inode, in bytes.
        share: how many bytes they may store.
    """
    taken = dict(stored)
    total = sum(taken.values())
    for inode, size in files:
        if inode not in taken and total + size <= share:
            taken[inode] = size
            total += size
    return taken


def no_room(
    files: Iterable[tuple[int, int]],
    stored: Mapping[int, int],
    share: int,
    expected: int = 0,
    key: str = _SHARE,
) -> str | None:
    """Describes why a moment is refused for want of room; None if all of its files fit.

    `files`, `stored` and `share` as for `fitting`; `expected` are the bytes of open files, `key`
    names the setting that limits them.
    """
    used = sum(stored.values())
    new = {inode: size for inode, size in files if inode not in stored}
    more = sum(new.values()) + expected
    if used + more <= share:
        return None
    return (
        f"moments may take {share / GB:.3g} GB, {used / GB:.3g} GB of that are "
        f"used, and this one takes {more / GB:.3g} GB more; delete folders in moments/ of the bag "
        f"directory, raise {key}, or ask for fewer seconds"
    )


def unrecorded(window: TimeWindow, bags: Iterable[BagFile]) -> tuple[str, ...]:
    """Returns a sentence on each part of a window that no bag reaches into."""
    sentences = []
    reached = window.start
    for start, end in (*sorted((bag.start, bag.end) for bag in bags), (window.stop, window.stop)):
        if start - reached > SHORTEST_HOLE_NS:
            hole = f"{iso_local(reached)} to {iso_local(start)}"
            sentences.append(f"nothing is recorded from {hole}")
        reached = max(reached, end)
    return tuple(sentences)


class MomentKeeper:
    """The moments of one bag directory. Not thread-safe, except for `has_work`.

    Args:
        bag_dir: the bag directory.
        share_bytes: how much of the budget moments may take.
        clock: the wall clock.
        own: lists what is linked.
        rule_bytes: how much of that is set aside for each rule.
    """

    def __init__(
        self,
        bag_dir: Path,
        share_bytes: int,
        clock: Clock,
        own: OwnRecordings,
        rule_bytes: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self._bag_dir = bag_dir
        self._share = share_bytes
        self._rule_bytes = rule_bytes
        self._clock = clock
        self._own = own
        self._queue = RequestQueue(bag_dir)
        self._links = HardLinks(bag_dir)
        # Until the first call of `keep` shows that nothing is pending.
        self._waiting = True

    def open(self) -> None:
        """Makes the folder of requests, so that a server may be given access to it alone."""
        self._queue.open()

    def has_work(self) -> bool:
        """Whether a request or a pending moment waits; also before the first call of `keep`."""
        return self._waiting or self._queue.has_requests()

    def keep(self, snapshot: Snapshot) -> None:
        """Answers requests and continues pending moments. Nothing may be deleted meanwhile.

        Raises:
            OSError: the folders cannot be listed or written to; the next call tries again.
        """
        self._remove_unbegun()
        now = self._clock.now()
        stored = {each.folder.name: each for each in stored_moments_in(self._bag_dir)}
        for name, moment in stored.items():
            if moment.moment.pending:
                stored[name] = self._advance(moment, stored, snapshot)
        numbers = {each.moment.request.number: each for each in stored.values()}
        for request in self._queue.take(now) if self._queue.has_requests() else ():
            known = numbers.get(request.number)
            outcome = _outcome_of(known) if known else self._grant(request, stored, snapshot)
            self._queue.answer(request, outcome)
        self._waiting = any(each.moment.pending for each in stored.values())

    def keep_for_rule(
        self, request: SaveRequest, rule: str, matches: int, snapshot: Snapshot
    ) -> str | None:
        """Begins the moment of a rule, or extends it; returns why nothing of it is kept, or None.

        The same request changes nothing the second time. Nothing may be deleted meanwhile.

        Raises:
            OSError: it cannot be stored; the same request may be made again.
        """
        self._remove_unbegun()
        stored = {each.folder.name: each for each in stored_moments_in(self._bag_dir)}
        wanted = SavedMoment(request, rule=rule, matches=matches)
        for each in stored.values():
            known = each.moment
            if known.request.number != request.number:
                continue
            if known.matches < matches or known.request.end < request.end:
                write_saved_moment(each.folder, replace(wanted, missing=known.missing))
                extended = StoredMoment(
                    each.folder, replace(wanted, missing=known.missing), each.files
                )
                self._advance(extended, stored, snapshot)
                self._waiting = True
            return None
        need = self._needed(request, snapshot)
        refused = self._refusal(wanted, need, stored, snapshot)
        if refused is None:
            moment = self._begin(wanted, need)
            self._waiting = True
            _log.info("moment_kept", folder=moment.folder.name, bags=len(moment.files), rule=rule)
        return refused

    def update_sidecars(self) -> None:
        """Links the sidecars of recordings again that were rewritten; a fault is reported.

        Which messages of a bag count is decided when its recording is over, which may be later.
        """
        moments = moments_of(self._bag_dir)
        if moments.is_symlink():
            return
        for root, _ in directories.walk(moments):
            recording = self._links.recorded_as(root)
            try:
                if recording != root:
                    _link_sidecar(Path(recording), Path(root))
            except OSError as error:
                _log.error("moment_not_followed", path=root, reason=str(error))

    def _grant(
        self, request: SaveRequest, stored: dict[str, StoredMoment], snapshot: Snapshot
    ) -> Outcome:
        """Begins a moment and adds it to `stored`, or refuses it."""
        need = self._needed(request, snapshot)
        refused = self._refusal(SavedMoment(request), need, stored, snapshot)
        if refused is None:
            try:
                moment = self._begin(SavedMoment(request), need)
            except OSError as error:
                refused = (
                    f"the bags cannot be saved in {moments_of(self._bag_dir)} by hard links: "
                    f"{error.strerror or error}"
                )
            else:
                stored[moment.folder.name] = moment
                _log.info("moment_kept", folder=moment.folder.name, bags=len(moment.files))
                return _outcome_of(moment)
        _log.warning("moment_refused", label=request.label, reason=refused)
        return Outcome(refused=refused)

    def _refusal(
        self,
        moment: SavedMoment,
        need: NeededBags,
        stored: dict[str, StoredMoment],
        snapshot: Snapshot,
    ) -> str | None:
        group = self._group(moment, stored)
        most = MAX_MOMENTS // (1 + len(self._rule_bytes))
        if len(group) >= most:
            return (
                f"there are {len(group)} moments, the maximum; delete folders in "
                "moments/ of the bag directory"
            )
        if not need.bags and not need.waits:
            return "nothing was recorded then: ask for a time at which something was"
        files = filter(None, (_file_of(bag.path) for bag in need.bags))
        expected = self._open_bytes(moment.request, snapshot) if need.waits else 0
        share, key = self._share_of(moment)
        return no_room(files, _all_files(group), share, expected, key)

    def _group(self, moment: SavedMoment, stored: Mapping[str, StoredMoment]) -> list[StoredMoment]:
        """Returns the moments that share a limit with one: of its rule, or of no configured one."""
        rule = moment.rule if moment.rule in self._rule_bytes else None
        return [
            each
            for each in stored.values()
            if (each.moment.rule if each.moment.rule in self._rule_bytes else None) == rule
        ]

    def _share_of(self, moment: SavedMoment) -> tuple[int, str]:
        """Returns how much such moments may take together, in bytes, and the key that sets it."""
        if moment.rule is not None and moment.rule in self._rule_bytes:
            return self._rule_bytes[moment.rule], f"max_gb of the rule {moment.rule}"
        return max(self._share - sum(self._rule_bytes.values()), 0), _SHARE

    def _begin(self, begun: SavedMoment, need: NeededBags) -> StoredMoment:
        folder = make_moment_folder(self._bag_dir, begun.request)
        try:
            write_saved_moment(folder, begun)
            missing, files = self._link(folder, need.bags, None)
            missing = (*missing, *_holes(begun, need))
            moment = replace(begun, pending=need.waits, missing=missing)
            if moment != begun:
                write_saved_moment(folder, moment)
        except OSError:
            directories.remove(folder)
            raise
        flush(folder.parent)
        return StoredMoment(folder, moment, files)

    def _advance(
        self, stored: StoredMoment, all_stored: Mapping[str, StoredMoment], snapshot: Snapshot
    ) -> StoredMoment:
        """Continues a pending moment; its file lists what cannot be kept."""
        before = stored.moment
        need = self._needed(before.request, snapshot)
        share, key = self._share_of(before)
        files = _all_files(self._group(before, all_stored))
        try:
            missing, linked = self._link(stored.folder, need.bags, (files, share, key))
        except OSError as error:
            missing, linked = (f"not all can be saved: {error.strerror or error}",), {}
        missing = tuple(dict.fromkeys((*before.missing, *missing, *_holes(before, need))))
        after = replace(before, pending=need.waits, missing=missing)
        files_now = {**stored.files, **linked}
        if after != before:
            try:
                write_saved_moment(stored.folder, after)
            except OSError as error:
                _log.error("moment_not_written", folder=str(stored.folder), reason=str(error))
                return StoredMoment(stored.folder, before, files_now)
            if not after.pending:
                _log.info("moment_complete", folder=stored.folder.name, missing=list(missing))
        return StoredMoment(stored.folder, after, files_now)

    def _needed(self, moment: SaveRequest, snapshot: Snapshot) -> NeededBags:
        window = window_of(moment.start, moment.end)
        open_files = [snapshot.unread_spans[aside] for aside in snapshot.active]
        bags = snapshot.timeline.overlapping(window)
        return needed_bags(window, moment.asked, bags, open_files, self._clock.now())

    def _open_bytes(self, request: SaveRequest, snapshot: Snapshot) -> int:
        """Returns the present size of the open files that may belong to the moment, in bytes."""
        window = window_of(request.start, request.end)
        return sum(
            size_of(aside.path)
            for aside in snapshot.active
            if _may_overlap(snapshot.unread_spans[aside], window)
        )

    def _link(
        self,
        folder: Path,
        bags: Sequence[BagFile],
        limit: tuple[Mapping[int, int], int, str] | None,
    ) -> tuple[tuple[str, ...], dict[int, int]]:
        """Links bags into a moment's folder.

        Returns why some could not be linked, and the sizes of the links by inode. `limit`, where
        there is one, is what moments that share it store, how much they may, and what says so.

        Raises:
            OSError: a link cannot be made.
        """
        missing: dict[str, None] = {}
        linked: dict[int, int] = {}
        files = [_file_of(bag.path) for bag in bags]
        allowed = None if limit is None else fitting(filter(None, files), limit[0], limit[1])
        linking: defaultdict[Path, list[tuple[Path, tuple[int, int]]]] = defaultdict(list)
        for bag, file in zip(bags, files, strict=True):
            name = os.path.relpath(self._links.recorded_as(bag.file), self._bag_dir)
            target = folder / name
            if file is None:
                # `forget` deletes in another process, since the index was made.
                if not target.exists():
                    missing[_gone(name)] = None
            elif limit is not None and allowed is not None and file[0] not in allowed:
                missing[_used_up(limit[2])] = None
            else:
                linking[target.parent].append((bag.path, file))
        for parent, here in linking.items():
            directories.make(self._bag_dir, parent)
            # Listed first, so that `forget`, in another process, knows whose the new links are.
            free = (
                each.name for each, file in here if _file_of(parent / each.name) in {None, file}
            )
            self._own.hold(parent, free)
            for recorded, file in here:
                target = parent / recorded.name
                if _link_bag(recorded, target, file[0]):
                    linked.update((file,))
                    _link_sidecar(recorded.parent, parent)
                else:
                    missing[_gone(str(target.relative_to(folder)))] = None
            flush(parent)
        return tuple(missing), linked

    def _remove_unbegun(self) -> None:
        """Removes files of a moment that a crash interrupted before it started."""
        with suppress(OSError):
            for folder in moments_of(self._bag_dir).iterdir():
                if _OWN_FOLDER.fullmatch(folder.name) and not (folder / MOMENT_FILE).exists():
                    (folder / f".{MOMENT_FILE}.tmp").unlink(missing_ok=True)
                    with suppress(OSError):
                        folder.rmdir()


def _may_overlap(recorded: TimeWindow | None, window: TimeWindow) -> bool:
    """Whether what was recorded in one window may lie in the other; yes if unknown."""
    return recorded is None or (recorded.start < window.stop and window.start < recorded.stop)


def _file_of(path: Path) -> tuple[int, int] | None:
    """Returns inode and size (bytes) of a file; None where it has gone."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_size


def _gone(name: str) -> str:
    return f"{name} is missing, or another file has its name"


def _used_up(key: str) -> str:
    what = f"the share of moments ({key})" if key == _SHARE else key
    return f"{what} was used up: only part of the moment is saved"


def _holes(moment: SavedMoment, need: NeededBags) -> tuple[str, ...]:
    """Returns what was never recorded of a rule's moment for which no bag is to come."""
    if moment.rule is None or need.waits:
        return ()
    return unrecorded(window_of(moment.request.start, moment.request.end), need.bags)


def _all_files(moments: Iterable[StoredMoment]) -> dict[int, int]:
    """Returns the sizes of all files in moments by inode, so that each counts once."""
    return {inode: size for each in moments for inode, size in each.files.items()}


def _outcome_of(stored: StoredMoment) -> Outcome:
    return Outcome(stored.folder.name, len(stored.files), stored.moment.pending)


def _link_bag(bag: Path, target: Path, inode: int) -> bool:
    """Links a bag; returns whether its file now has the second name, too.

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
    """Links a recording's sidecar, replacing an earlier one.

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
