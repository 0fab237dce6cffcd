"""Saves moments: hard links in `moments/`, which retention never deletes.

Somebody asked for a moment, or a rule fired (see `triggers`). Each rule has a share of the bytes of
its own, so that no rule uses up the share of another, or of those who ask.

The recorder alone does this, while nothing is deleted. A crash between two steps does no harm: a
moment's file marks it as pending before its first link is made, and a request stays in the
queue until it is answered. What a moment needs and whether it fits are decided by pure functions.
"""

from __future__ import annotations

import os
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.layout import HANDOVER_FILE, MOMENTS_FOLDER, is_derived, recorded_as
from ros2_memory.bag_dir.moment_file import (
    MAX_MOMENTS,
    Outcome,
    RequestQueue,
    SavedMoment,
    SaveRequest,
    StoredMoment,
    StoredMoments,
    make_moment_folder,
    stored_moments_in,
    write_saved_moment,
)
from ros2_memory.core import directories
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP, BagFile, BagState, TimeWindow
from ros2_memory.core.spans import overlaps_any, united, without
from ros2_memory.core.timebase import MAX_NS, NS_PER_HOUR, NS_PER_S, Clock, Ns, iso_local
from ros2_memory.retention.delete import size_of
from ros2_memory.retention.policy import GB

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.index.snapshot import Snapshot

REPAIRED_WITHIN_NS: Final[Ns] = 600 * NS_PER_S
"""How long a moment waits for a bag that a crash left open: its repair makes another file."""
LONGEST_WAIT_NS: Final[Ns] = 2 * NS_PER_HOUR
"""How long a moment waits for open splits, and for links that the disk refuses. No split is open
for longer, unless another program writes it, or clocks differ."""
SHORTEST_HOLE_NS: Final[Ns] = 2 * NS_PER_S
"""A shorter time without a bag is not worth a sentence."""

_SHARE: Final = "retention.max_moments_gb"

_log = get_logger(__name__)


class NeededBags(NamedTuple):
    """The bags of a moment that can be kept now, in order of time; `waits`: more may come.

    `open_files` may belong to the moment, too, once they are closed.
    """

    window: TimeWindow
    bags: tuple[BagFile, ...]
    waits: bool
    open_files: tuple[Path, ...]


def needed_bags(moment: SaveRequest, snapshot: Snapshot, now: Ns) -> NeededBags:
    """Chooses the bags that a moment needs, whose window includes both of its ends."""
    window = TimeWindow(moment.start, min(moment.end + 1, MAX_NS))
    open_files = tuple(
        aside.path
        for aside in snapshot.active
        if _may_overlap(snapshot.unread_spans[aside], window)
    )
    waits = now < window.stop or bool(open_files)
    ready = []
    for bag in snapshot.timeline.overlapping(window):
        if not bag.reaches_into(window) or is_derived(bag.file):
            continue
        unfinished = bag.state is BagState.INCOMPLETE and bag.file.endswith(MCAP)
        if unfinished and now - moment.asked < REPAIRED_WITHIN_NS:
            waits = True
        else:
            ready.append(bag)
    waits = waits and abs(now - moment.asked) < LONGEST_WAIT_NS
    return NeededBags(window, tuple(ready), waits, open_files)


@dataclass(slots=True)
class Share:
    """The bytes that the moments of one rule, or those that were asked for, may take together.

    Attributes:
        most: how many bytes.
        key: the setting that limits them.
        stored: the sizes of the files that they have, by inode; `used` is their sum.
    """

    most: int
    key: str = _SHARE
    stored: dict[int, int] = field(default_factory=dict)
    used: int = field(init=False)

    def __post_init__(self) -> None:
        self.used = sum(self.stored.values())

    def take(self, inode: int, size: int) -> bool:
        """Adds a file if there is room for it; returns whether it is among those stored."""
        if inode not in self.stored and self.used + size <= self.most:
            self.stored[inode] = size
            self.used += size
        return inode in self.stored

    def refusal(self, files: Iterable[tuple[int, int]], expected: int = 0) -> str | None:
        """Describes why a moment is refused for want of room; None if all of its files fit.

        `files` are inodes and sizes (bytes), `expected` the bytes of open files.
        """
        used = self.used
        new = {inode: size for inode, size in files if inode not in self.stored}
        more = sum(new.values()) + expected
        if used + more <= self.most:
            return None
        return (
            f"moments may take {self.most / GB:.3g} GB, {used / GB:.3g} GB of that are "
            f"used, and this one takes {more / GB:.3g} GB more; delete folders in moments/ of the "
            f"bag directory, raise {self.key}, or ask for fewer seconds"
        )

    @property
    def exhausted(self) -> str:
        """The sentence for a moment that had room only in part."""
        what = f"the share of moments ({_SHARE})" if self.key == _SHARE else self.key
        return f"{what} was used up: only part of the moment is saved"


def unrecorded(window: TimeWindow, bags: Iterable[BagFile]) -> tuple[str, ...]:
    """Returns a sentence for each part of a window in which no bag has messages."""
    recorded = united((bag.start, bag.end) for bag in bags)
    return tuple(
        f"nothing is recorded from {iso_local(start)} to {iso_local(stop)}"
        for start, stop in without([(window.start, window.stop)], recorded)
        if stop - start > SHORTEST_HOLE_NS
    )


class Refusal(NamedTuple):
    """Why a moment is not saved: its kind, which lasts while the numbers of the sentence change."""

    kind: str
    sentence: str


@dataclass(eq=False, repr=False)
class MomentKeeper:
    """The moments of one bag directory. Not thread-safe, except for `has_work`.

    Args:
        share_bytes: how much of the budget moments may take.
        rule_bytes: how much of that is set aside for each rule.
    """

    bag_dir: Path
    share_bytes: int
    clock: Clock
    own: OwnRecordings
    rule_bytes: Mapping[str, int]

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self._queue = RequestQueue(self.bag_dir)
        self._faulty: set[Path] = set()  # moments that cannot be read, or of which no link is made
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
        now, stored = self.clock.now(), stored_moments_in(self.bag_dir)
        for unreadable in stored.unreadable.values():
            self._report(unreadable.folder, unreadable.problem)
        for name, moment in stored.readable.items():
            if moment.moment.pending:
                stored.readable[name] = self._continue_moment(moment, stored, snapshot)
        for request in self._queue.take(now) if self._queue.has_requests() else ():
            self._queue.answer(request.number, self._answer_to(request, stored, snapshot))
        self._waiting = any(moment.moment.pending for moment in stored.readable.values())

    def _answer_to(
        self, request: SaveRequest, stored: StoredMoments, snapshot: Snapshot
    ) -> Outcome:
        """Returns the outcome of a request. A new moment begins, and is added to `stored`."""
        try:
            moment = _moment_of(request, stored) or self._begin_moment(
                SavedMoment(request), stored, snapshot
            )
        except OSError as error:
            folder = self.bag_dir / MOMENTS_FOLDER
            refused = f"the bags cannot be saved in {folder}: {error.strerror or error}"
        else:
            if not isinstance(moment, Refusal):
                stored.readable[moment.folder.name] = moment
                return Outcome(moment.folder.name, len(moment.files), moment.moment.pending)
            refused = moment.sentence
        _log.warning("moment_refused", label=request.label, reason=refused)
        return Outcome(refused=refused)

    def keep_for_rule(
        self, request: SaveRequest, rule: str, matches: int, snapshot: Snapshot
    ) -> Refusal | None:
        """Begins the moment of a rule, or extends it; returns why nothing of it is kept, or None.

        The same request changes nothing the second time. Nothing may be deleted meanwhile.

        Raises:
            OSError: it cannot be stored; the same request may be made again.
        """
        stored = stored_moments_in(self.bag_dir)
        wanted = SavedMoment(request, rule=rule, matches=matches)
        known = _moment_of(request, stored)
        if known is None:
            begun = self._begin_moment(wanted, stored, snapshot)
            if isinstance(begun, Refusal):
                return begun
            self._waiting = True
        elif known.moment.matches < matches or known.moment.request.end < request.end:
            extended = known._replace(moment=replace(wanted, missing=known.moment.missing))
            write_saved_moment(extended.folder, extended.moment)
            self._continue_moment(extended, stored, snapshot)
            self._waiting = True
        return None

    def relink_sidecars(self) -> None:
        """Links sidecars that were rewritten into the moments again; a fault is reported.

        Which messages of a bag count is decided when its recording is over. That may be after the
        moment was saved.
        """
        moments = self.bag_dir / MOMENTS_FOLDER
        if moments.is_symlink():
            return
        for root, _ in directories.walk(moments):
            recording = recorded_as(self.bag_dir, root)
            try:
                if recording != root:
                    _link_sidecar(Path(recording), Path(root))
            except OSError as error:
                _log.error("moment_not_followed", path=root, reason=str(error))

    def _begin_moment(
        self, wanted: SavedMoment, stored: StoredMoments, snapshot: Snapshot
    ) -> StoredMoment | Refusal:
        """Begins a moment beside the `stored` ones, or returns why it is refused.

        Raises:
            OSError: it cannot be written; nothing of it is left.
        """
        need = needed_bags(wanted.request, snapshot, self.clock.now())
        share = self._share_to_begin(wanted, need, stored, snapshot)
        if isinstance(share, Refusal):
            return share
        folder = make_moment_folder(self.bag_dir, wanted.request)
        try:
            write_saved_moment(folder, wanted)
            links = self._link_bags(folder, need.bags, share)
            moment = _with_links(StoredMoment(folder, wanted, {}), need, links)
            if moment.moment != wanted:
                write_saved_moment(folder, moment.moment)
            flush(folder.parent)
        except OSError:
            directories.remove(folder)
            self.own.forget(folder)
            raise
        rule = {} if wanted.rule is None else {"rule": wanted.rule}
        _log.info("moment_kept", folder=folder.name, bags=len(moment.files), **rule)
        return moment

    def _share_to_begin(
        self,
        wanted: SavedMoment,
        need: NeededBags,
        stored: StoredMoments,
        snapshot: Snapshot,
    ) -> Share | Refusal:
        """Returns the share that a new moment belongs to.

        It is refused if there are too many moments, no bags, or too few bytes for it.
        """
        group = self._group(wanted, stored)
        if len(group) >= MAX_MOMENTS // (1 + len(self.rule_bytes)):
            return Refusal(
                "number",
                f"there are {len(group)} moments, the maximum; delete folders in "
                "moments/ of the bag directory",
            )
        if not need.bags and not need.waits:
            thinned = snapshot.timeline.thinned_times
            if overlaps_any(thinned, need.window.start, need.window.stop - 1):
                reason = "the bags of that time were deleted, and memory/ has what stayed of them"
                return Refusal("deleted", reason)
            reason = "nothing was recorded then: ask for a time at which something was"
            return Refusal("unrecorded", reason)
        share = self._share_of(wanted, stored)
        files = filter(None, (_file_of(bag.path) for bag in need.bags))
        if refused := share.refusal(files, sum(map(size_of, need.open_files))):
            return Refusal("share", refused)
        return share

    def _continue_moment(
        self, before: StoredMoment, stored: StoredMoments, snapshot: Snapshot
    ) -> StoredMoment:
        """Continues a pending moment; its file lists what cannot be kept.

        If the disk refuses a link, for example because it is full, the moment waits.
        """
        need = needed_bags(before.moment.request, snapshot, self.clock.now())
        share = self._share_of(before.moment, stored)
        try:
            links = self._link_bags(before.folder, need.bags, share)
        except OSError as error:
            reason = error.strerror or str(error)
            if abs(self.clock.now() - before.moment.request.asked) < LONGEST_WAIT_NS:
                self._report(before.folder, reason)
                return before
            links = _Links([f"not all can be saved: {reason}"])
        if not need.waits:
            names = (os.path.relpath(path, self.bag_dir) for path in need.open_files)
            links.missing += [f"{name} was still being written, or held back" for name in names]
        after = _with_links(before, need, links)
        self._faulty.discard(before.folder)
        if after.moment != before.moment:
            try:
                write_saved_moment(after.folder, after.moment)
            except OSError as error:
                _log.error("moment_not_written", folder=str(after.folder), reason=str(error))
                return after._replace(moment=before.moment)
            if not after.moment.pending:
                missing = list(after.moment.missing)
                _log.info("moment_complete", folder=after.folder.name, missing=missing)
        return after

    def _report(self, folder: Path, reason: str) -> None:
        """Logs the fault of a moment once."""
        if folder not in self._faulty:
            _log.error("moment_not_followed", path=str(folder), reason=reason)
            self._faulty.add(folder)

    def _group(self, moment: SavedMoment, stored: StoredMoments) -> list[Mapping[int, int]]:
        """Returns the files of each moment that shares a limit with one.

        These are the moments of its rule, or of no known rule, as those that cannot be read.
        """
        rule = self._rule_of(moment)
        files = [
            other.files for other in stored.readable.values() if self._rule_of(other.moment) == rule
        ]
        if rule is None:
            files += [unreadable.files for unreadable in stored.unreadable.values()]
        return files

    def _rule_of(self, moment: SavedMoment) -> str | None:
        return moment.rule if moment.rule in self.rule_bytes else None

    def _share_of(self, moment: SavedMoment, stored: StoredMoments) -> Share:
        """Returns the share of a moment, with the files of the stored moments that use it."""
        files: dict[int, int] = {}
        for of_one in self._group(moment, stored):
            files.update(of_one)
        rule = self._rule_of(moment)
        if rule is not None:
            return Share(self.rule_bytes[rule], f"max_gb of the rule {rule}", files)
        return Share(max(self.share_bytes - sum(self.rule_bytes.values()), 0), _SHARE, files)

    def _link_bags(self, folder: Path, bags: Sequence[BagFile], share: Share) -> _Links:
        """Links bags into a moment's folder, as far as the share has room for them.

        Raises:
            OSError: a link cannot be made.
        """
        links = _Links()
        by_folder: defaultdict[Path, list[_WantedLink]] = defaultdict(list)
        for bag in bags:
            name = os.path.relpath(recorded_as(self.bag_dir, bag.file), self.bag_dir)
            target, file = folder / name, _file_of(bag.path)
            if file is None:
                # `forget` has deleted it, in another process, since the index was made.
                if not target.exists():
                    links.missing.append(_missing_sentence(name))
            elif share.take(*file):
                by_folder[target.parent].append(_WantedLink(bag.path, name, target, file))
            else:
                links.missing.append(share.exhausted)
        for parent, wanted in by_folder.items():
            directories.make(self.bag_dir, parent)
            # Listed first, so that `forget`, in another process, knows whose the new links are.
            free = [
                link.target.name for link in wanted if _file_of(link.target) in {None, link.file}
            ]
            self.own.add_bags(parent, free)
            for bag_path, name, target, file in wanted:
                if _link_bag(bag_path, target, file.inode):
                    links.sizes[file.inode] = file.size
                    _link_sidecar(bag_path.parent, parent)
                else:
                    links.missing.append(_missing_sentence(name))
            flush(parent)
        return links


def _may_overlap(recorded: TimeWindow | None, window: TimeWindow) -> bool:
    """Whether messages of a window may lie in another one; yes if the first is unknown."""
    return recorded is None or not recorded.intersect(window).empty


class _BagInode(NamedTuple):
    """A file by its inode, with its size in bytes."""

    inode: int
    size: int


class _WantedLink(NamedTuple):
    """A hard link to make: the bag, its path below the bag directory, and the path of the link."""

    bag: Path
    name: str
    target: Path
    file: _BagInode


@dataclass(slots=True)
class _Links:
    """A sentence for each bag that could not be linked, and the sizes of the links by inode."""

    missing: list[str] = field(default_factory=list)
    sizes: dict[int, int] = field(default_factory=dict)


def _file_of(path: Path) -> _BagInode | None:
    """Returns inode and size of a file; None if it has gone."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    return _BagInode(status.st_ino, status.st_size)


def _missing_sentence(name: str) -> str:
    return f"{name} is missing, or another file has its name"


def _moment_of(request: SaveRequest, stored: StoredMoments) -> StoredMoment | None:
    """Returns the moment that a request has already."""
    for moment in stored.readable.values():
        if moment.moment.request.number == request.number:
            return moment
    return None


def _with_links(before: StoredMoment, need: NeededBags, links: _Links) -> StoredMoment:
    """Returns a moment with new links, and with a sentence on each bag or time that it lacks."""
    moment = before.moment
    sentences = [*moment.missing, *links.missing]
    # Complete moments of rules also name the times in which nothing was recorded.
    if moment.rule is not None and not need.waits:
        sentences += unrecorded(need.window, need.bags)
    missing = tuple(dict.fromkeys(sentences))
    after = replace(moment, pending=need.waits, missing=missing)
    return StoredMoment(before.folder, after, {**before.files, **links.sizes})


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
    except OSError as error:
        raise OSError(error.errno, f"no hard link can be made: {error.strerror}") from error
    return True


def _link_sidecar(recording: Path, folder: Path) -> None:
    """Links a recording's sidecar into a folder of a moment, in place of an earlier one.

    Raises:
        OSError: the link cannot be made.
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
