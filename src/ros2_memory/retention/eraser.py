"""Deletes messages by rewriting their bags, and all files that name or repeat them.

What goes is written down first (`bag_dir.state_files`), so that an interrupted erasure can
be finished. Then for each bag: its messages leave the sidecar; the bag is rewritten beside
itself, read back, compared and flushed; and the new file takes the name of the old one, wherever a
hard link in a moment has it. It is done when no name of the old one is left.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.handover_file import (
    MessageList,
    handover_to_change,
    message_id,
    read_handover,
    write_handover,
)
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import (
    HANDOVER_FILE,
    THINNED_FILE,
    bag_kind,
    is_carried,
    is_derived,
    is_kept_apart,
)
from ros2_memory.bag_dir.state_files import (
    ERASING,
    THINNED,
    Erased,
    Erasure,
    Loss,
    Thinned,
    append_losses,
    read_losses,
)
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.core.model import COMPRESSED, UNMARKED_KINDS, TimeWindow
from ros2_memory.core.spans import overlaps_any
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index.file_state import reason_unread
from ros2_memory.retention.delete import new_file_beside, repair_name
from ros2_memory.retention.repair import (
    Identity,
    correct_metadata_files,
    delete_file,
    open_files,
    open_folder,
    reason_of,
    replace_file,
    rewrite_without,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.spans import Spans
    from ros2_memory.storage.base import BagReader, BagWriter

_FOREIGN: Final = "this recorder did not make it; `ros2-memory adopt` takes its folder"
Ids = dict[str, set[str]]
_Window = tuple[str, int, int]


@dataclass(slots=True)
class Holder:
    """A bag file with messages that go.

    Attributes:
        paths: all its names in the bag directory that may be changed.
        counts: how many messages go, by topic.
        windows: the same by topic and window, without copies that count in another recording.
        ids: the ids of the messages in sidecars, by topic; only of topics that a sidecar lists.
    """

    paths: tuple[Path, ...]
    inode: Identity
    counts: Counter[str] = field(default_factory=Counter)
    windows: Counter[_Window] = field(default_factory=Counter)
    ids: Ids = field(default_factory=dict)


class Survey(NamedTuple):
    """The bags with messages that go, and a line with the reason for each bag that is kept."""

    holders: tuple[Holder, ...]
    kept: tuple[str, ...]

    @property
    def counts(self) -> Counter[str]:
        """How many messages go, by topic."""
        return sum((holder.counts for holder in self.holders), Counter[str]())


class ErasureResult(NamedTuple):
    """A line with the reason for each file that keeps messages, and notes on what was done."""

    kept: tuple[str, ...]
    notes: tuple[str, ...]


class _KeptBagError(Exception):
    """A bag must not be rewritten; the text is the reason."""


@dataclass(eq=False, repr=False)
class Eraser:
    """Takes messages out of the bags of one bag directory.

    Args:
        reader: reads files as they are, also what does not count in answers.
        own: the recordings that may be changed; None: all.
        written: files that are being written, and the window of their messages; None: unknown.
        recorder: why only a recorder may change some files; None if none runs or can begin to.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    own: OwnRecordings | None
    _: KW_ONLY
    written: Mapping[Path, TimeWindow | None]
    recorder: str | None

    def topics(self) -> frozenset[str]:
        """Returns the topics of all bags that can be read, also of bags that do not count."""
        topics: set[str] = set()
        for paths in self._paths_by_inode().values():
            with suppress(BagError):
                topics.update(channel.topic for channel in self.reader.channels(paths[0]))
        return frozenset(topics)

    def survey(self, erasure: Erasure) -> Survey:
        """Returns which bags have messages that go; changes nothing."""
        holders: list[Holder] = []
        kept: list[str] = []
        for inode, paths in sorted(self._paths_by_inode().items(), key=itemgetter(1)):
            try:
                holder = self._holder_in(erasure, paths, inode)
            except _KeptBagError as error:
                kept.append(f"{self._relative(paths[0])}: {error}")
            except (BagError, OSError) as error:
                if any(map(self._may_change, paths)):
                    reason = f"its contents are unknown: {reason_of(error)}"
                    kept.append(f"{self._relative(paths[0])}: {reason}")
            else:
                if holder is not None:
                    holders.append(holder)
                    foreign = [path for path in paths if path not in holder.paths]
                    kept += [f"{self._relative(path)}: {_FOREIGN}" for path in foreign]
        return Survey(tuple(holders), tuple(kept))

    def _holder_in(self, erasure: Erasure, paths: Sequence[Path], inode: Identity) -> Holder | None:
        """Returns what of a file goes, or None if it has no message that goes.

        Raises:
            _KeptBagError: it has, or may have, but must not be rewritten.
            BagError: it cannot be read.
            OSError: it has gone.
        """
        path = paths[0]
        if not self.reader.reads(path):
            raise _KeptBagError(reason_unread(path))
        if path in self.written:
            span = self.written[path]
            if span is not None and span.start >= erasure.windows[-1][1]:
                return None
            raise _KeptBagError("it is being written; forget again when it is closed")
        if not path.lstat().st_size:
            return None
        summary = self.reader.summarize(path)
        topics = [topic for topic in erasure.topics if _may_have_messages(summary, topic, erasure)]
        holder = self._read_holder(erasure, topics, paths, inode)
        if not holder.counts:
            return None
        if reason := self._reason_to_keep(paths, inode, summary):
            raise _KeptBagError(reason)
        return holder

    def erase(
        self, erasure: Erasure, survey: Survey, forgotten: Callable[[Erasure], None]
    ) -> ErasureResult:
        """Takes the messages out, durably; returns where some stay, and why.

        Args:
            erasure: which messages go; `files` are set if an earlier attempt was interrupted.
            survey: which bags have such messages now.
            forgotten: deletes the messages from everything derived from the files. It may raise an
                `EpisodicError`, and then the erasure counts as not finished.

        Raises:
            OSError: what goes cannot be written down; nothing is changed then.
        """
        if not erasure.files:
            erasure = self._with_files(erasure, survey)
        ERASING.write(self.bag_dir, erasure)
        kept: list[str] = []
        linked: list[str] = []
        for holder in survey.holders:
            try:
                if line := self._erase_in(holder, erasure):
                    # Another attempt takes nothing out of links elsewhere, as a backup has them.
                    can_retry = any(map(self._may_change, self._paths_of(holder.inode)))
                    (kept if can_retry else linked).append(line)
            except (EpisodicError, OSError) as error:
                kept.append(f"{self._relative(holder.paths[0])}: {reason_of(error)}")
        recordings = {(self.bag_dir / name).parent for name in erasure.files}
        notes = correct_metadata_files(self.bag_dir, recordings, self.reader)
        try:
            self._delete_leftovers(erasure)
            self.forget_thinned([*erasure.windows], erasure.topics)
            forgotten(erasure)
            self._report_losses(erasure)
            if not kept:
                ERASING.remove(self.bag_dir)
        except (EpisodicError, OSError) as error:
            kept.append(reason_of(error))
        return ErasureResult((*kept, *linked), tuple(notes))

    def _with_files(self, erasure: Erasure, survey: Survey) -> Erasure:
        """Returns an erasure with the files that have its messages, and how many these are."""
        windows = Counter[_Window]()
        for holder in survey.holders:
            windows.update(holder.windows)
        counts = tuple(Erased(*key, count) for key, count in sorted(windows.items()) if count)
        paths = chain.from_iterable(holder.paths for holder in survey.holders)
        return replace(erasure, files=tuple(map(self._relative, paths)), counts=counts)

    def _delete_leftovers(self, erasure: Erasure) -> None:
        """Deletes the new files that an interrupted erasure left beside the bags."""
        for name in erasure.files:
            path = self.bag_dir / name
            with (
                suppress(FileNotFoundError, NotADirectoryError),
                directories.opened(self.bag_dir, path.parent) as folder,
            ):
                os.unlink(repair_name(path.name), dir_fd=folder)

    def _report_losses(self, erasure: Erasure) -> None:
        """Has answers report the messages as lost; an earlier attempt may have done so."""
        known = {*read_losses(self.bag_dir, MIN_NS, MAX_NS)}
        losses = (
            Loss(gone.topic, gone.start, gone.stop, gone.count, "forgotten")
            for gone in erasure.counts
        )
        append_losses(self.bag_dir, [loss for loss in losses if loss not in known])

    def forget_thinned(self, spans: Spans, topics: Collection[str] | None = None) -> None:
        """Deletes what the memory of deleted bags has of spans; of some topics, their silences.

        Raises:
            BagError: the file is damaged, or a recorder runs, which alone may write it.
            OSError: the file cannot be read or written.
        """
        try:
            thinned = THINNED.read(self.bag_dir) or Thinned()
        except ValueError as error:
            raise BagError(THINNED_FILE, f"it is damaged, delete it: {error}") from error
        left = thinned.without(spans, topics)
        if left != thinned:
            if self.recorder is not None:
                raise BagError(THINNED_FILE, _recorder_refuses(self.recorder))
            THINNED.write(self.bag_dir, left)

    def _paths_of(self, inode: Identity) -> Sequence[Path]:
        return self._paths_by_inode().get(inode, ())

    def _paths_by_inode(self) -> dict[Identity, list[Path]]:
        """Returns the paths of every bag file by device and inode, the recorded one first."""
        by_inode: defaultdict[Identity, list[Path]] = defaultdict(list)
        for folder, entries in directories.walk(self.bag_dir):
            for entry in entries:
                with suppress(OSError):
                    if bag_kind(entry.name) and entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        by_inode[status.st_dev, status.st_ino].append(Path(folder, entry.name))
        for paths in by_inode.values():
            paths.sort(key=lambda path: (is_kept_apart(self._relative(path)), path))
        return dict(by_inode)

    def _reason_to_keep(
        self, paths: Sequence[Path], inode: Identity, summary: BagSummary
    ) -> str | None:
        path, reason = paths[0], None
        if not any(map(self._may_change, paths)):
            reason = _FOREIGN
        elif path.name.endswith(COMPRESSED):
            reason = "it is compressed as a whole; decompress it (zstd -d --rm), and forget again"
        elif not self.reader.is_finished(path) or not summary.complete:
            reason = "a crash left it open; ros2-memory recover closes it"
        # Nothing in a file of such a format shows whether its writer is done.
        elif path.suffix in UNMARKED_KINDS and inode in open_files():
            reason = "a program has it open; close that, and forget again"
        elif summary.notes:
            reason = f"it cannot be rewritten completely: {'; '.join(summary.notes)}"
        elif is_derived(path) and self.recorder is not None:
            reason = _recorder_refuses(self.recorder)
        return reason

    def _may_change(self, path: Path) -> bool:
        return self.own is None or self.own.owns_bag(path)

    def _read_holder(
        self, erasure: Erasure, topics: Sequence[str], paths: Sequence[Path], inode: Identity
    ) -> Holder:
        """Reads which messages of a file go."""
        holder = Holder(tuple(path for path in paths if self._may_change(path)), inode)
        listed_topics = set[str]()  # topics with messages in a sidecar
        for path in holder.paths:
            handover = read_handover(path.parent).handover
            for message_list in (handover.also_counts, handover.counts_elsewhere):
                listed_topics.update(message_list.get(path.name, ()))
        all_windows = TimeWindow(erasure.windows[0][0], erasure.windows[-1][1])
        rule = read_handover(paths[0].parent).handover.rule(paths[0].name)
        for topic in topics:
            span = TimeWindow.everything() if topic in erasure.latched else all_windows
            for record in self.reader.records(paths[0], (topic,), span):
                window = erasure.window_of(topic, record.log_time, record.publish_time)
                if window is not None:
                    holder.counts[topic] += 1
                    holder.windows[topic, *window] += rule is None or rule.counts(record)
                    if topic in listed_topics:
                        identity = message_id(record.publish_time, record.payload)
                        holder.ids.setdefault(topic, set()).add(identity)
        return holder

    def _erase_in(self, holder: Holder, erasure: Erasure) -> str | None:
        """Rewrites one file under all its names; returns a line if the old one has names left.

        Raises:
            EpisodicError: the file cannot be rewritten, or is another one now.
            OSError: the file cannot be rewritten.
        """
        for path in holder.paths:
            self._clear_sidecar(path, holder.ids)
        path = holder.paths[0]
        with path.open("rb") as old:
            before = os.fstat(old.fileno())
            if (before.st_dev, before.st_ino) != holder.inode:
                raise BagError(str(path), "it is another file now; forget again")
            with rewrite_without(
                self.bag_dir, path, before, self.writer, takes=erasure.takes, expected=holder.counts
            ) as new:
                for other in holder.paths[1:]:
                    self._replace_link(new, other, before)
            if os.fstat(old.fileno()).st_nlink:
                # A recorder may have kept the old file in a moment meanwhile.
                for late in filter(self._may_change, self._paths_of(holder.inode)):
                    self._replace_link(path, late, before)
            left = os.fstat(old.fileno()).st_nlink
        if left:
            links = counted(left, "more hard link", "more hard links")
            return f"{self._relative(path)}: all of it is still in {links} of it"
        if is_carried(path) and self.reader.summarize(path).empty:
            delete_file(path)
        return None

    def _replace_link(self, new: Path, path: Path, before: os.stat_result) -> None:
        """Puts a new file in place of one name of the old one."""
        with open_folder(self.bag_dir, path) as here, new_file_beside(here) as name:
            os.link(new, name, follow_symlinks=False)
            replace_file(name, here, before)

    def _clear_sidecar(self, path: Path, ids: Ids) -> None:
        """Takes messages of a file out of the sidecar in its folder.

        The sidecar's mtime stays, since what counts of the recording's other files does, too.

        Raises:
            EpisodicError: the sidecar's recorder still writes it, or it is damaged.
            OSError: the sidecar cannot be read or written.
        """
        folder = path.parent
        target = folder / HANDOVER_FILE
        if not target.is_file() or target.is_symlink():
            return
        with directories.opened(self.bag_dir, folder):
            before = target.stat()
            handover = handover_to_change(folder)
            also = _without_messages(handover.also_counts, path.name, ids)
            elsewhere = _without_messages(handover.counts_elsewhere, path.name, ids)
            if (also, elsewhere) == (handover.also_counts, handover.counts_elsewhere):
                return
            written = read_heartbeat(self.bag_dir).recordings
            if self._relative(folder) in written:
                raise BagError(str(target), "its recorder still writes it; forget again later")
            write_handover(folder, replace(handover, also_counts=also, counts_elsewhere=elsewhere))
            os.utime(target, ns=(before.st_atime_ns, before.st_mtime_ns))

    def _relative(self, path: Path) -> str:
        return os.path.relpath(path, self.bag_dir)


def _may_have_messages(summary: BagSummary, topic: str, erasure: Erasure) -> bool:
    """Whether a bag may have messages of a topic that go; latched ones go at any log time."""
    totals = summary.of(topic)
    if topic in erasure.latched:
        return bool(totals)
    return any(overlaps_any(erasure.windows, total.first, total.last) for total in totals)


def _without_messages(message_list: MessageList, file: str, ids: Ids) -> MessageList:
    """Returns a list of a sidecar without the messages of a file that have the ids."""
    left = {}
    for topic, messages in message_list.get(file, {}).items():
        if others := tuple(id_ for id_ in messages if id_ not in ids.get(topic, ())):
            left[topic] = others
    without_file = {name: topics for name, topics in message_list.items() if name != file}
    return {**without_file, file: left} if left else without_file


def _recorder_refuses(reason: str) -> str:
    return (
        f"only the recorder may change it while it runs: {reason}; stop the recorder, and forget "
        "again"
    )
