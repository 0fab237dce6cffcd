"""Cuts topics with a shorter life (`retention.topics`) out of bags that stay.

A bag is old enough for it by the same clocks as for `retention.max_age_h` (see `policy`). It is
rewritten beside itself, read back and compared, as `forget` does it; the new file takes its name.
What goes is written down before it does (`expired.json`), so that answers say why it is not there.

Nothing goes of latched topics, which hold until the next message, nor of bags that moments have.
Nor is a bag touched that a rule may need, or that must be shipped first. A bag that is in a lake
stays shipped: its receipt is written again with the new size.
"""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from itertools import groupby, takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import ERASING_FILE, EXPIRED_FILE
from ros2_memory.bag_dir.metadata_yaml import why_not_corrected
from ros2_memory.bag_dir.state_files import EXPIRED, SHIPPED, Expired, Loss, Receipt, read_receipts
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP
from ros2_memory.core.text import match_topics
from ros2_memory.core.timebase import Ns, ms_since
from ros2_memory.retention.disk import free_bytes
from ros2_memory.retention.policy import DirContents, RetentionLimits, bags_older_than
from ros2_memory.retention.repair import UnflushedError, rewrite_without

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader, BagWriter

SLICE_S: Final = 1.0
"""How long one pass cuts, but for the bag that it has begun: meanwhile nothing is deleted."""
PATIENCE_S: Final = 3600.0
"""How long cutting waits for a quiet minute: a robot may be busy all day."""

_log = get_logger(__name__)


class TopicAge(NamedTuple):
    """How old messages may become of the topics that a name or glob matches."""

    topics: str
    max_age_ns: Ns


class TopicCut(NamedTuple):
    """The topics that go from one bag."""

    bag: BagFile
    topics: frozenset[str]


@dataclass(eq=False, repr=False)
class TopicCutter:
    """Cuts topics out of the bags of one bag directory, some in each pass. Not thread-safe.

    Args:
        bag_dir: the bag directory, whose lock the caller holds.
        topic_ages: the topics with a shorter life.
        static_topics: topics that are latched whatever their publishers declare.
        reader: reads files as they are, also what does not count in answers.
        writer: rewrites bags.
        is_quiet: whether the machine has time for it.
        measure_free: measures what the disk has left, in bytes.
        monotonic: a clock that never steps, in seconds.
    """

    bag_dir: Path
    topic_ages: Sequence[TopicAge]
    reader: BagReader
    writer: BagWriter
    _: KW_ONLY
    static_topics: Collection[str]
    is_quiet: Callable[[], bool]
    measure_free: Callable[[Path], int] = free_bytes
    monotonic: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self._done: dict[str, tuple[Ns, frozenset[str]]] = {}
        self._waits_since_s: float | None = None

    def cut(self, contents: DirContents, limits: RetentionLimits, snapshot: Snapshot) -> int:
        """Cuts what is too old until `SLICE_S` is over; returns how many bags were cut.

        Nothing is cut while messages are being forgotten, while the machine is busy (for
        `PATIENCE_S` at most), or where the new file beside the old one would leave less than
        `limits.min_free_bytes` of the disk free. A bag that cannot be cut is reported once, and
        stays as it is until it changes.

        Raises:
            OSError: the free space cannot be measured, or the receipts of `ship` not be read.
        """
        cuts = self._plan(contents, limits, snapshot)
        done = self._done
        waiting = [cut for cut in cuts if done.get(cut.bag.file) != (cut.bag.mtime_ns, cut.topics)]
        self._done = {cut.bag.file: done[cut.bag.file] for cut in cuts if cut.bag.file in done}
        if (self.bag_dir / ERASING_FILE).exists() or not self._may_begin(waiting):
            return 0
        begun = time.perf_counter_ns()
        until_s = self.monotonic() + SLICE_S
        receipts = read_receipts(self.bag_dir)
        gone = list[Counter[str]]()

        def may_go_on(cut: TopicCut) -> bool:
            free = self.measure_free(self.bag_dir)
            return self.monotonic() < until_s and free - cut.bag.size >= limits.min_free_bytes

        for recording, of_recording in groupby(waiting, key=lambda cut: cut.bag.recording):
            before = len(gone)
            try:
                for cut in takewhile(may_go_on, of_recording):
                    gone += filter(None, [self._cut_or_report(cut, receipts)])
            finally:
                # Before the next recording, so that a kill leaves at most one behind its bags.
                if len(gone) > before and (reason := why_not_corrected(recording, self.reader)):
                    _log.warning("metadata_not_corrected", recording=recording.name, reason=reason)
        if gone:
            messages = dict(sum(gone, Counter[str]()))
            ms = ms_since(begun)
            _log.info("topics_cut", bags=len(gone), messages=messages, duration_ms=ms)
        return len(gone)

    def _plan(
        self, contents: DirContents, limits: RetentionLimits, snapshot: Snapshot
    ) -> list[TopicCut]:
        """Returns which topics are too old in which bags, the oldest bag first.

        A bag may have no message of them. Messages that count in another recording go, too, and the
        index does not show those.
        """
        timeline = snapshot.timeline
        not_saved = {
            bag.path
            for bag in contents.bags
            if contents.saved.keys().isdisjoint(file.inode for file in bag.files)
        }
        going: defaultdict[str, set[str]] = defaultdict(set)
        for topic_age in self.topic_ages:
            topics = [
                topic
                for topic in match_topics(timeline.topics(), topic_age.topics)
                if topic not in self.static_topics and not timeline.is_transient_state(topic)
            ]
            if topics:
                aged = bags_older_than(contents, limits, topic_age.max_age_ns)
                for path in not_saved & aged.by_clock(synchronised=contents.synchronised):
                    going[path].update(topics)
        return [
            TopicCut(bag, frozenset(going[bag.file]))
            for bag in snapshot.bags
            if bag.file in going and bag.path.suffix == MCAP
        ]

    def _may_begin(self, waiting: Sequence[TopicCut]) -> bool:
        """Whether bags wait, and the machine is quiet, or was busy for `PATIENCE_S`."""
        now_s = self.monotonic()
        if not waiting or self.is_quiet():
            self._waits_since_s = None
            return bool(waiting)
        if self._waits_since_s is None:
            self._waits_since_s = now_s
            reason = f"the machine is busy: waiting for a quiet minute, {PATIENCE_S:.0f} s at most"
            _log.info("topics_wait", reason=reason)
        return now_s - self._waits_since_s >= PATIENCE_S

    def _cut_or_report(self, cut: TopicCut, receipts: Mapping[str, Receipt]) -> Counter[str]:
        """Cuts a bag, or reports why it cannot be cut; returns how many messages went, by topic.

        A bag from which nothing went is not looked at again until it changes.
        """
        gone = Counter[str]()
        try:
            gone = self._cut_bag(cut, receipts)
        except (EpisodicError, OSError) as error:
            _log.error("topics_not_cut", path=cut.bag.file, reason=str(error))
        if not gone:
            self._done[cut.bag.file] = cut.bag.mtime_ns, cut.topics
        return gone

    def _cut_bag(self, cut: TopicCut, receipts: Mapping[str, Receipt]) -> Counter[str]:
        """Cuts one bag; returns how many messages went, by topic.

        Raises:
            EpisodicError: the bag cannot be rewritten; nothing is changed.
            OSError: the same.
        """
        path = cut.bag.path
        before = path.lstat()
        gone = Counter[str]()
        for topic in self.reader.summarize(path).topics:
            if topic.topic in cut.topics:
                gone[topic.topic] += topic.count
        if not gone:
            return gone
        # Without the copies of messages that count in another recording.
        losses = [
            Loss(topic.topic, topic.first, topic.last + 1, topic.count, "expired")
            for topic in BagDirReader(self.reader, self.bag_dir).summarize(path).topics
            if topic.topic in cut.topics
        ]
        bag = os.path.relpath(path, self.bag_dir)
        expired = self._read_expired()
        receipt = receipts.get(bag)
        if receipt is not None and receipt.size != before.st_size:
            receipt = None  # the bag has changed since it was shipped
        try:
            EXPIRED.write(self.bag_dir, expired.then(bag, losses))
            with rewrite_without(
                self.bag_dir,
                path,
                before,
                self.writer,
                takes=lambda name, _logged, _published: name in cut.topics,
                expected=gone,
            ) as new:
                # Before the bag is smaller: else `ship` would take what went out of the lake, too.
                if receipt is not None:
                    shipped = replace(receipt, size=new.stat().st_size)
                    SHIPPED.append(self.bag_dir, [shipped])
        except UnflushedError as error:
            _log.warning("topics_cut_unflushed", path=bag, reason=str(error))
        except (EpisodicError, OSError):
            EXPIRED.write(self.bag_dir, expired)
            if receipt is not None:
                with suppress(OSError):
                    SHIPPED.append(self.bag_dir, [receipt])
            raise
        return gone

    def _read_expired(self) -> Expired:
        """Returns what expired before; a damaged file counts as empty, and is replaced."""
        try:
            return EXPIRED.read(self.bag_dir) or Expired()
        except ValueError as error:
            damaged = str(self.bag_dir / EXPIRED_FILE)
            _log.warning("expired_list_damaged", path=damaged, reason=str(error))
            return Expired()


def is_quiet() -> bool:
    """Returns whether fewer programs ran in the last minute than there are processors."""
    return os.getloadavg()[0] < (os.cpu_count() or 1)
