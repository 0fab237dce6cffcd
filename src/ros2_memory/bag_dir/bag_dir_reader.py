"""Reads the bags of one bag directory through another `BagReader`, with four rules added.

- It stays inside the directory. Seconds pass between a scan and a query, in which somebody may
  replace a folder by a link. `O_NOFOLLOW` protects the last part of a path; this reader checks the
  parts before it.
- It leaves out messages that count in another recording, by `handover.json`.
- If retention deleted the path that the index knows, it reads the bag under another hard link, in a
  saved moment.
- It leaves out topics of other robots that are in the same bags.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.handover_file import (
    FileRule,
    Handover,
    HandoverReading,
    sure_handover,
)
from ros2_memory.bag_dir.json_files import until_changed
from ros2_memory.bag_dir.layout import HANDOVER_FILE, MOMENTS_FOLDER, recorded_as
from ros2_memory.core.directories import LINK_NOT_FOLLOWED
from ros2_memory.core.errors import (
    BagContradictionError,
    BagError,
    BagUnreachableError,
    BagVanishedError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.storage.base import (
    BagReader,
    Batch,
    Channel,
    Definition,
    Record,
    errors_as_items,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.core.bag_summary import BagSummary, TopicSummary
    from ros2_memory.core.timebase import Ns

_sidecar: Final = until_changed(HANDOVER_FILE, most=4096)(sure_handover)


@dataclass(eq=False, repr=False)
class BagDirReader(BagReader):
    """Reads bags through an adapter, under the rules of a bag directory.

    Latched messages always count: queries recognise a repeated one by topic, publish time and
    payload.

    Args:
        reader: the adapter, which decodes messages.
        bag_dir: the directory that paths must lie in, which may be a link; None allows any path.
        every_message: ignores `handover.json`, so that counts are those of the files.
        hidden: prefixes of the topics that are in no summary and no list of channels.
    """

    reader: BagReader
    bag_dir: Path | None = None
    _: KW_ONLY
    every_message: bool = False
    hidden: tuple[str, ...] = ()

    def reads(self, path: Path) -> bool:
        """Returns what the adapter returns."""
        return self.reader.reads(path)

    def is_finished(self, path: Path) -> bool:
        """Returns whether the writer has finished the file.

        Raises:
            BagError: see the adapter; or the path leads out of the bag directory.
        """
        return self.reader.is_finished(self._confined(path))

    def summarize(self, path: Path) -> BagSummary:
        """Returns counts and times of the messages that count in this recording.

        Raises:
            BagError: see the adapter; or the path leads out of the bag directory.
        """
        summary = self.reader.summarize(self._confined(path))
        if self.hidden:
            shown = (each for each in summary.topics if not each.topic.startswith(self.hidden))
            summary = summary.with_topics([*shown])
        handover, problem = self._sidecar_of(path)
        if problem is not None:
            summary = summary.with_notes((*summary.notes, problem))
        rule = handover.rule(path.name)
        if rule is None:
            return summary
        if rule.hides_all:
            return summary.with_topics(())
        topics = (self._counted_summary(path, topic, rule) for topic in summary.topics)
        counted = summary.with_topics([topic for topic in topics if topic is not None])
        return counted.with_notes((*summary.notes, *handover.notes))

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields the messages that count in this recording.

        Raises:
            BagError: see the adapter; or the path leads out of the bag directory.
        """

        def opened() -> Iterator[Iterator[Record]]:
            located = self._located(path)
            rule = self._rule_of(located, topics, window)
            if rule is not None and rule.hides_all:
                return
            records = self.reader.records(located, topics, window, newest_first=newest_first)
            yield records if rule is None else filter(rule.counts, records)

        # A generator would end at the first error. The adapter's iterator goes on behind a damaged
        # chunk, and so do `filter` and `chain`.
        return chain.from_iterable(opened())

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        """Yields the messages that count in this recording, many at once.

        Raises:
            BagError: see the adapter; or the path leads out of the bag directory.
        """

        def opened() -> Iterator[Iterator[Batch]]:
            located = self._located(path)
            rule = self._rule_of(located, topics, window)
            if rule is None:
                yield self.reader.batches(located, topics, window, bare=bare)
            elif not rule.hides_all:
                # Not bare: publish times and payloads decide which messages count.
                batches = self.reader.batches(located, topics, window)
                yield map(partial(_counted_batch, rule), batches)

        return chain.from_iterable(opened())

    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns every channel that the file declares, but those of hidden topics."""
        channels = self.reader.channels(self._located(path))
        return [channel for channel in channels if not channel.topic.startswith(self.hidden)]

    def undecodable(self, channel: Channel) -> str | None:
        """Returns what the adapter returns."""
        return self.reader.undecodable(channel)

    def decode(self, record: Record) -> object:
        """Decodes as the adapter does."""
        return self.reader.decode(record)

    def encode(self, channel: Channel, message: object) -> bytes:
        """Encodes as the adapter does."""
        return self.reader.encode(channel, message)

    def definition(self, channel: Channel) -> Definition | None:
        """Returns what the adapter returns."""
        return self.reader.definition(channel)

    def _confined(self, path: Path) -> Path:
        """Returns the path unless it leads out of the bag directory, or through a link in it.

        Raises:
            BagVanishedError: a folder of the path does not exist.
            BagUnreachableError: the disk fails.
            BagError: the path leads out of the directory.
        """
        if self.bag_dir is None:
            return path
        # Texts, since every read comes here, and paths are slow.
        text, folder = str(path), f"{str(self.bag_dir).rstrip(os.sep)}{os.sep}"
        names = text[len(folder) :].split("/")[:-1]
        if not text.startswith(folder) or os.pardir in names:
            raise BagError(text, "it is not in the bag directory")
        for name in names:
            folder += name
            try:
                mode = os.lstat(folder).st_mode
            except (FileNotFoundError, NotADirectoryError) as error:
                raise BagVanishedError(text, "the file is not there any more") from error
            except OSError as error:
                reason = f"it cannot be opened or read: {error.strerror or error}"
                raise BagUnreachableError(text, reason) from error
            if stat.S_ISLNK(mode):
                raise BagError(text, LINK_NOT_FOLLOWED)
            folder += os.sep
        return path

    def _located(self, path: Path) -> Path:
        """Returns the path, or another hard link of the bag if the path was deleted.

        Raises:
            BagError: see `_confined`.
        """
        if self.bag_dir is None or os.path.lexists(path):
            return self._confined(path)
        recorded = Path(recorded_as(self.bag_dir, str(path)))
        name = os.path.relpath(recorded, self.bag_dir)
        links = [recorded]
        with suppress(OSError):
            moments = sorted((self.bag_dir / MOMENTS_FOLDER).iterdir())
            links += [moment / name for moment in moments]
        existing = [link for link in links if os.path.lexists(link)]
        return self._confined(existing[0] if existing else path)

    def _rule_of(self, path: Path, topics: Collection[str], window: TimeWindow) -> FileRule | None:
        """Returns which messages of the topics count in a window; None if all do."""
        rule = self._sidecar_of(path).handover.rule(path.name)
        return rule if rule is not None and rule.touches(window, topics) else None

    def _sidecar_of(self, path: Path) -> HandoverReading:
        """Returns the sidecar of a file's recording; it is parsed again if it has changed.

        Raises:
            BagUnreachableError: the disk fails, so it is unknown which messages count.
        """
        if self.every_message:
            return HandoverReading(Handover(), None)
        reading = _sidecar(path.parent)
        if reading is None:
            try:
                reading = sure_handover(path.parent)
            except OSError as error:
                # Without its sidecar a recording would count messages twice.
                reason = f"{HANDOVER_FILE} cannot be read: {error.strerror or error}"
                raise BagUnreachableError(str(path), reason) from error
        return reading

    def _counted_summary(
        self, path: Path, topic: TopicSummary, rule: FileRule
    ) -> TopicSummary | None:
        """Returns the topic without messages that count elsewhere; None if no message is left."""
        span = TimeWindow(topic.first, topic.last + 1)
        if (topic.latched and not rule.hides_latched) or not rule.touches(span, [topic.topic]):
            return topic
        windows = [span]
        if topic.topic not in rule.elsewhere:
            # Without listed messages, only the few chunks with excluded ones are read.
            excluded = [span.intersect(exclusion.logged) for exclusion in rule.exclusions]
            spans = united((window.start, window.stop) for window in excluded)
            windows = [TimeWindow(start, stop) for start, stop in spans]
        uncounted = 0
        for window in windows:
            for record in _with_losses(self.reader.records(path, [topic.topic], window)):
                if isinstance(record, Record) and record.channel.type == topic.type:
                    uncounted += not rule.counts(record)
        if not uncounted:
            return topic
        first = self._end_of(path, topic, newest_first=False)
        last = self._end_of(path, topic, newest_first=True)
        if first is None or last is None:
            return None
        return replace(topic, count=topic.count - uncounted, first=first, last=last)

    def _end_of(self, path: Path, topic: TopicSummary, *, newest_first: bool) -> Ns | None:
        """Returns the log time (ns) of the topic's first or last message that counts, if any.

        Messages that cannot be read may count.
        """
        span = TimeWindow(topic.first, topic.last + 1)
        records = self.records(path, [topic.topic], span, newest_first=newest_first)
        for record in _with_losses(records):
            if isinstance(record, TimeWindow):
                lost = record.intersect(span)
                return lost.stop - 1 if newest_first else lost.start
            if record.channel.type == topic.type:
                return record.log_time
        return None


def _with_losses(records: Iterator[Record]) -> Iterator[Record | TimeWindow]:
    """Yields the messages, and the window of those that cannot be read.

    Raises:
        BagError: the file cannot be read.
    """
    for record in errors_as_items(records):
        if isinstance(record, Record):
            yield record
        elif record.lost is None:
            raise record
        elif not isinstance(record, BagContradictionError):  # nothing is lost
            first, last = record.lost
            yield TimeWindow(first, last + 1)


def _counted_batch(rule: FileRule, batch: Batch) -> Batch:
    """Returns the messages of a batch that count."""
    counts = [rule.counts(batch.record(nth)) for nth in range(batch.sizes.size)]
    return batch if all(counts) else batch.select(np.array(counts, np.bool_))
