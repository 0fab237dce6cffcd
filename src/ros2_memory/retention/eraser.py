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

from ros2_memory.bag_dir.durable_write import flush
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
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.index.file_state import reason_unread
from ros2_memory.retention.delete import beside, repair_name
from ros2_memory.retention.repair import (
    Identity,
    metadata_corrected,
    open_files,
    opened_folder,
    reason_of,
    replace_file,
    rewritten,
)
from ros2_memory.storage.base import BagReader, BagWriter, Closing

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.bag_summary import BagSummary

_FOREIGN: Final = "this recorder did not make it; `ros2-memory adopt` takes its folder"
Ids = dict[str, set[str]]
_Window = tuple[str, int, int]


@dataclass(slots=True)
class Holder:
    """A bag file that holds messages which go.

    Attributes:
        paths: all its names in the bag directory that may be changed.
        counts: the messages that go, by topic.
        windows: likewise, by topic and window.
        ids: what identifies those of them in sidecars that one may list, by topic.
    """

    paths: tuple[Path, ...]
    inode: Identity
    counts: Counter[str] = field(default_factory=Counter)
    windows: Counter[_Window] = field(default_factory=Counter)
    ids: Ids = field(default_factory=dict)


class Survey(NamedTuple):
    """Which bags hold messages that go, and a line with the reason for each that is kept."""

    holders: tuple[Holder, ...]
    kept: tuple[str, ...]

    @property
    def counts(self) -> Counter[str]:
        """The messages that go, by topic."""
        return sum((holder.counts for holder in self.holders), Counter[str]())


class Kept(NamedTuple):
    """A line for each thing of which something stays, and other lines on what was done."""

    kept: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(eq=False, repr=False)
class Eraser:
    """Takes messages out of the bags of one bag directory.

    Args:
        reader: reads files as they are, also what does not count in answers.
        own: the recordings that may be changed; None: all.
        written: files that are still being written, and what they may hold; None: unknown.
        recorder: why a recorder holds the directory; None where none does, nor can begin to.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    own: OwnRecordings | None
    _: KW_ONLY
    written: Mapping[Path, TimeWindow | None]
    recorder: str | None

    def topics(self) -> frozenset[str]:
        """Returns the topics of all bags that can be read; of those that do not count too."""
        topics: set[str] = set()
        for paths in self._paths_by_inode().values():
            with suppress(BagError):
                topics.update(channel.topic for channel in self.reader.channels(paths[0]))
        return frozenset(topics)

    def survey(self, erasure: Erasure) -> Survey:
        """Returns which bags hold messages that go; changes nothing."""
        holders: list[Holder] = []
        kept: list[str] = []
        for inode, paths in sorted(self._paths_by_inode().items(), key=itemgetter(1)):
            try:
                judged = self._holder_or_reason(erasure, paths, inode)
            except (BagError, OSError) as error:
                if not any(map(self._may_change, paths)):
                    continue
                judged = f"its contents are unknown: {reason_of(error)}"
            if isinstance(judged, str):
                kept.append(f"{self._relative(paths[0])}: {judged}")
            elif judged is not None:
                holders.append(judged)
                foreign = [path for path in paths if path not in judged.paths]
                kept.extend(f"{self._relative(path)}: {_FOREIGN}" for path in foreign)
        return Survey(tuple(holders), tuple(kept))

    def _holder_or_reason(
        self, erasure: Erasure, paths: Sequence[Path], inode: Identity
    ) -> Holder | str | None:
        """Returns what of a file goes; why it is kept; or None where it holds nothing that goes.

        Raises:
            BagError: it cannot be read.
            OSError: it has gone.
        """
        if not self.reader.reads(paths[0]):
            return reason_unread(paths[0])
        if paths[0] in self.written:
            span = self.written[paths[0]]
            if span is not None and span.start >= erasure.windows[-1][1]:
                return None
            return "it is being written; forget again when it is closed"
        if not paths[0].lstat().st_size:
            return None
        summary = self.reader.summarize(paths[0])
        topics = [
            topic
            for topic in erasure.topics
            if any(
                topic in erasure.latched or (start <= total.last and total.first < stop)
                for total in summary.of(topic)
                for start, stop in erasure.windows
            )
        ]
        holder = self._read_holder(erasure, topics, paths, inode)
        if not holder.counts:
            return None
        return self._reason_to_keep(paths, inode, summary) or holder

    def erase(self, erasure: Erasure, survey: Survey, forgotten: Callable[[Erasure], None]) -> Kept:
        """Takes the messages out, durably; returns what of them stays, and why.

        Args:
            erasure: which; where it was interrupted, with its files.
            survey: what holds them now.
            forgotten: has everything derived from the files forget them. It may raise an
                `EpisodicError`, and then the erasure counts as not finished.

        Raises:
            OSError: what goes cannot be written down; nothing is changed then.
        """
        if not erasure.files:
            windows = sum((holder.windows for holder in survey.holders), Counter[_Window]())
            counts = tuple(Erased(*key, count) for key, count in sorted(windows.items()))
            paths = chain.from_iterable(holder.paths for holder in survey.holders)
            erasure = replace(erasure, files=tuple(map(self._relative, paths)), counts=counts)
        ERASING.write(self.bag_dir, erasure)
        kept: list[str] = []
        linked: list[str] = []
        for holder in survey.holders:
            try:
                if line := self._erase_in(holder, erasure):
                    again = any(map(self._may_change, self._paths_by_inode().get(holder.inode, ())))
                    (kept if again else linked).append(line)
            except (EpisodicError, OSError) as error:
                kept.append(f"{self._relative(holder.paths[0])}: {reason_of(error)}")
        bags = [self.bag_dir / name for name in erasure.files]
        recordings = {path.parent for path in bags}
        notes = [*metadata_corrected(self.bag_dir, recordings, self.reader)]
        try:
            for path in bags:  # what an interrupted erasure left beside them
                with (
                    suppress(FileNotFoundError, NotADirectoryError),
                    directories.opened(self.bag_dir, path.parent) as folder,
                ):
                    os.unlink(repair_name(path.name), dir_fd=folder)
            self._forget_silences(erasure)
            forgotten(erasure)
            # Answers report them as lost.
            known = read_losses(self.bag_dir, MIN_NS, MAX_NS)
            losses = (
                Loss(gone.topic, gone.start, gone.stop, gone.count, "forgotten")
                for gone in erasure.counts
            )
            append_losses(self.bag_dir, [loss for loss in losses if loss not in known])
            # Another attempt takes nothing out of links elsewhere, as a backup has them.
            if not kept:
                ERASING.remove(self.bag_dir)
        except (EpisodicError, OSError) as error:
            kept.append(reason_of(error))
        return Kept((*kept, *linked), tuple(notes))

    def _forget_silences(self, erasure: Erasure) -> None:
        """Takes the silences of topics in the windows out of what is known of deleted bags.

        Raises:
            BagError: a recorder runs, which alone may write it then.
            OSError: it cannot be read or written.
        """
        try:
            thinned = THINNED.read(self.bag_dir) or Thinned()
        except ValueError as error:
            raise BagError(THINNED_FILE, f"it is damaged, delete it: {error}") from error
        left = tuple(
            silence
            for silence in thinned.silences
            if silence[0] not in erasure.topics
            or not any(start <= silence[2] and silence[1] < stop for start, stop in erasure.windows)
        )
        if left != thinned.silences:
            if self.recorder is not None:
                raise BagError(THINNED_FILE, _recorder_refuses(self.recorder))
            THINNED.write(self.bag_dir, replace(thinned, silences=left))

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
        elif self.reader.closing(path) is Closing.OPEN or not summary.complete:
            reason = "a crash left it open; ros2-memory recover closes it"
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
        listed = set[str]()  # the topics of which a sidecar lists messages
        for path in holder.paths:
            handover = read_handover(path.parent).handover
            for message_list in (handover.also_counts, handover.counts_elsewhere):
                listed.update(message_list.get(path.name, ()))
        all_windows = TimeWindow(erasure.windows[0][0], erasure.windows[-1][1])
        for topic in topics:
            span = TimeWindow.everything() if topic in erasure.latched else all_windows
            for record in self.reader.records(paths[0], (topic,), span):
                window = erasure.window_of(topic, record.log_time, record.publish_time)
                if window is not None:
                    holder.counts[topic] += 1
                    holder.windows[topic, *window] += 1
                    if topic in listed:
                        identity = message_id(record.publish_time, record.payload)
                        holder.ids.setdefault(topic, set()).add(identity)
        return holder

    def _erase_in(self, holder: Holder, erasure: Erasure) -> str | None:
        """Rewrites one file, under all its names; returns a line where other names are left.

        Raises:
            EpisodicError: it cannot be rewritten.
            OSError: likewise, or it is another file now.
        """
        for path in holder.paths:
            self._clear_sidecar(path, holder.ids)
        path = holder.paths[0]
        with path.open("rb") as old:
            before = os.fstat(old.fileno())
            if (before.st_dev, before.st_ino) != holder.inode:
                raise BagError(str(path), "it is another file now; forget again")
            with rewritten(
                self.bag_dir,
                path,
                before,
                self.writer,
                takes=erasure.takes,
                expected=holder.counts,
            ) as new:
                for other in holder.paths[1:]:
                    self._replace_link(new, other, holder.inode)
            if os.fstat(old.fileno()).st_nlink:
                # A recorder may have kept the old file in a moment meanwhile.
                for late in filter(self._may_change, self._paths_by_inode().get(holder.inode, ())):
                    self._replace_link(path, late, holder.inode)
            left = os.fstat(old.fileno()).st_nlink
        if left:
            links = counted(left, "more hard link", "more hard links")
            return f"{self._relative(path)}: all of it is still in {links} of it"
        if is_carried(path) and self.reader.summarize(path).empty:
            path.unlink()
            flush(path.parent)
        return None

    def _replace_link(self, new: Path, path: Path, inode: Identity) -> None:
        """Puts a new file in place of one name of the old one."""
        with opened_folder(self.bag_dir, path) as here, beside(here) as name:
            os.link(new, name, follow_symlinks=False)
            replace_file(name, here, inode)

    def _clear_sidecar(self, path: Path, ids: Ids) -> None:
        """Takes messages of a file out of the sidecar in its folder.

        Its time stays: what counts of the other files stays, too.

        Raises:
            EpisodicError: it cannot be changed.
            OSError: likewise.
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
            if self.own is None or self.own.name_of(folder) in written:
                raise BagError(str(target), "its recorder still writes it; forget again later")
            write_handover(folder, replace(handover, also_counts=also, counts_elsewhere=elsewhere))
            os.utime(target, ns=(before.st_atime_ns, before.st_mtime_ns))

    def _relative(self, path: Path) -> str:
        return os.path.relpath(path, self.bag_dir)


def _without_messages(listed: MessageList, file: str, ids: Ids) -> MessageList:
    """Returns lists of a sidecar without messages of a file."""
    topics = {
        topic: tuple(message for message in messages if message not in ids.get(topic, ()))
        for topic, messages in listed.get(file, {}).items()
    }
    left = {topic: messages for topic, messages in topics.items() if messages}
    others = {name: by_topic for name, by_topic in listed.items() if name != file}
    return {**others, file: left} if left else others


def _recorder_refuses(reason: str) -> str:
    return (
        f"only the recorder may change it while it runs: {reason}; stop the recorder, and forget "
        "again"
    )
