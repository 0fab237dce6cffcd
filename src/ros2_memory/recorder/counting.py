"""A reader that leaves out what counts in another recording.

Where one recording took over from another the recorder wrote down which messages of each count
(see `handover`). This stands between an adapter and everything that reads through one, so that no
count, sum, search or answer has to think of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ros2_memory.model import BagSummary, TimeWindow, TopicSummary
from ros2_memory.recorder.handover import HandoverReading, read_handover
from ros2_memory.recorder.layout import HANDOVER_FILE
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.recorder.handover import Exclusion, Handover
    from ros2_memory.storage.base import Channel, Closing, Layout, Record
    from ros2_memory.timebase import Ns

_KNOWN_SIDECARS: Final = 4096


class CountingReader(BagReader):
    """Reads through another reader, and gives only the messages that count where they stand.

    Latched messages all count: one that was received again is recognised by what it is.
    """

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._known: dict[Path, tuple[tuple[int, int, int], HandoverReading]] = {}

    def reads(self, path: Path) -> bool:
        """As the reader beneath."""
        return self._reader.reads(path)

    def closing(self, path: Path) -> Closing:
        """As the reader beneath."""
        return self._reader.closing(path)

    def channels(self, path: Path) -> Sequence[Channel]:
        """As the reader beneath."""
        return self._reader.channels(path)

    def undecodable(self, channel: Channel) -> str | None:
        """As the reader beneath."""
        return self._reader.undecodable(channel)

    def decode(self, record: Record) -> object:
        """As the reader beneath."""
        return self._reader.decode(record)

    def layout(self, record: Record) -> Layout | None:
        """As the reader beneath."""
        return self._reader.layout(record)

    def summarize(self, path: Path) -> BagSummary:
        """Counts and times of the messages that count.

        Raises:
            BagError: as the reader beneath.
        """
        summary = self._reader.summarize(path)
        handover, problem = self._handover(path.parent)
        if problem is not None:
            summary = summary.replaced(notes=(*summary.notes, problem))
        if handover.hides_all:
            return summary.replaced(topics=())
        notes = handover.notes if handover.exclusions(path.name) else ()
        topics = tuple(
            counted
            for topic in summary.topics
            if (counted := self._counted(path, topic, handover)) is not None
        )
        return summary.replaced(topics=topics, notes=(*summary.notes, *notes))

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
        handover = self._handover(path.parent).handover
        if handover.hides_all:
            return
        records = self._reader.records(path, topics, window, newest_first=newest_first)
        exclusions = _touching(handover, path, window)
        if exclusions:
            records = (record for record in records if _counts(record, exclusions))
        yield from records

    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times of the messages that count.

        Raises:
            BagError: as the reader beneath.
        """
        handover = self._handover(path.parent).handover
        if handover.hides_all:
            return ()
        if not _touching(handover, path, window):
            return self._reader.log_times(path, topic, window)
        return [record.log_time for record in self.records(path, [topic], window)]

    def _handover(self, recording: Path) -> HandoverReading:
        """The recording's sidecar; parsed again when the file is another one than before."""
        try:
            stat = (recording / HANDOVER_FILE).stat()
        except OSError:
            return read_handover(recording)
        stamp = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        known = self._known.get(recording)
        if known is not None and known[0] == stamp:
            return known[1]
        reading = read_handover(recording)
        if len(self._known) >= _KNOWN_SIDECARS:
            self._known.clear()
        self._known[recording] = (stamp, reading)
        return reading

    def _counted(self, path: Path, topic: TopicSummary, handover: Handover) -> TopicSummary | None:
        """The topic without what counts elsewhere; None where nothing of it is left."""
        span = TimeWindow(topic.first, topic.last + 1)
        if topic.latched or not _touching(handover, path, span):
            return topic
        times = [
            record.log_time
            for record in self.records(path, [topic.topic], span)
            if record.channel.type == topic.type
        ]
        if not times:
            return None
        return replace(topic, count=len(times), first=times[0], last=times[-1])


def _touching(handover: Handover, path: Path, window: TimeWindow) -> list[Exclusion]:
    """What of a file may not count among the log times of a window."""
    return [
        each
        for each in handover.exclusions(path.name)
        if each.log_from < window.stop and window.start < each.log_until
    ]


def _counts(record: Record, exclusions: Sequence[Exclusion]) -> bool:
    return record.channel.latched or not any(
        each.excludes(record.publish_time, record.log_time) for each in exclusions
    )
