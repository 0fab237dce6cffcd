"""A reader that leaves out what counts in another recording.

Where one recording took over from another the recorder wrote down which messages of each count
(see `handover`). This stands between an adapter and everything that reads through one, so that no
count, sum, search or answer has to think of it.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.handover_file import (
    Handover,
    HandoverReading,
    read_handover,
    sure_handover,
)
from ros2_memory.bag_dir.layered import LayeredReader
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.core.errors import BagUnreachableError
from ros2_memory.core.model import BagSummary, TimeWindow, TopicSummary
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.handover_file import Exclusion
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import Record

_KNOWN_SIDECARS: Final = 4096
_NONE: Final = HandoverReading(Handover(), None)
"""What is read where there is no sidecar."""


class CountingReader(LayeredReader):
    """Reads through another reader, and gives only the messages that count where they stand.

    Latched messages all count: one that was received again is recognised by what it is.
    """

    def __init__(self, reader: BagReader) -> None:
        super().__init__(reader)
        self._known: dict[str, tuple[tuple[int, int, int], HandoverReading]] = {}

    def summarize(self, path: Path) -> BagSummary:
        """Counts and times of the messages that count.

        Raises:
            BagError: as the reader beneath.
        """
        summary = self._reader.summarize(path)
        handover, problem = self._handover(path)
        if problem is not None:
            summary = summary.replaced(notes=(*summary.notes, problem))
        if handover.hides_all:
            return summary.replaced(topics=())
        exclusions = handover.exclusions(path.name)
        if not exclusions:
            return summary
        topics = (self._counted(path, topic, exclusions) for topic in summary.topics)
        return summary.replaced(
            topics=tuple(topic for topic in topics if topic is not None),
            notes=(*summary.notes, *handover.notes),
        )

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """The messages that count.

        Raises:
            BagError: as the reader beneath.
        """

        def found() -> Iterator[Iterator[Record]]:
            handover = self._handover(path).handover
            if handover.hides_all:
                return
            records = self._reader.records(path, topics, window, newest_first=newest_first)
            exclusions = _touching(handover.exclusions(path.name), window)
            # Not a generator, which would end where some messages are lost.
            counts = partial(_counts, exclusions=exclusions)
            yield filter(counts, records) if exclusions else records

        return chain.from_iterable(found())

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The latest message that counts.

        Raises:
            BagError: as the reader beneath.
        """
        handover = self._handover(path).handover
        if handover.hides_all:
            return None
        if _touching(handover.exclusions(path.name), window):
            # Out of those that count: the port's own way.
            return BagReader.newest(self, path, topic, window)
        return self._reader.newest(path, topic, window)

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of the messages that count.

        Raises:
            BagError: as the reader beneath.
        """
        handover = self._handover(path).handover
        if handover.hides_all:
            return ()
        if not _touching(handover.exclusions(path.name), window):
            return self._reader.log_times(path, topic, window)
        return [record.log_time for record in self.records(path, [topic], window)]

    def _handover(self, path: Path) -> HandoverReading:
        """The sidecar of a file's recording; parsed again when it is another one than before.

        Raises:
            BagUnreachableError: the disk fails: which messages count is not known.
        """
        file = str(path)
        sidecar = file[: file.rfind("/") + 1] + HANDOVER_FILE
        try:
            stat = os.stat(sidecar)  # noqa: PTH116 - before every reading; a Path costs more
            stamp = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
            known = self._known.get(sidecar)
            if known is not None and known[0] == stamp:
                return known[1]
            reading = sure_handover(path.parent)
        except (FileNotFoundError, NotADirectoryError):
            return _NONE
        except PermissionError:
            return read_handover(path.parent)
        except OSError as error:
            # Taken for missing, it would have messages count twice.
            reason = f"{HANDOVER_FILE} cannot be read: {error.strerror or error}"
            raise BagUnreachableError(file, reason) from error
        if len(self._known) >= _KNOWN_SIDECARS:
            self._known.clear()
        self._known[sidecar] = (stamp, reading)
        return reading

    def _counted(
        self, path: Path, topic: TopicSummary, exclusions: Sequence[Exclusion]
    ) -> TopicSummary | None:
        """The topic without what counts elsewhere; None where nothing of it is left."""
        span = TimeWindow(topic.first, topic.last + 1)
        if topic.latched or not _touching(exclusions, span):
            return topic
        # What is excluded lies in few of the chunks: only these are read.
        lost = sum(
            record.channel.type == topic.type and not _counts(record, exclusions)
            for window in _united(exclusions, span)
            for record in self._reader.records(path, [topic.topic], window)
        )
        if not lost:
            return topic
        first, last = (
            next((each.log_time for each in found if each.channel.type == topic.type), None)
            for found in (
                self.records(path, [topic.topic], span),
                self.records(path, [topic.topic], span, newest_first=True),
            )
        )
        if first is None or last is None:
            return None
        return replace(topic, count=topic.count - lost, first=first, last=last)


def _touching(exclusions: Iterable[Exclusion], window: TimeWindow) -> list[Exclusion]:
    """What of a file may not count among the log times of a window."""
    return [
        each for each in exclusions if each.log_from < window.stop and window.start < each.log_until
    ]


def _united(exclusions: Iterable[Exclusion], span: TimeWindow) -> list[TimeWindow]:
    """The log times of a span in which something may not count; none twice."""
    united: list[TimeWindow] = []
    for each in sorted(_touching(exclusions, span), key=attrgetter("log_from")):
        start = max(each.log_from, united[-1].stop if united else span.start)
        united.append(TimeWindow(start, max(start, min(each.log_until, span.stop))))
    return united


def _counts(record: Record, exclusions: Sequence[Exclusion]) -> bool:
    return record.channel.latched or not any(
        each.excludes(record.publish_time, record.log_time) for each in exclusions
    )
