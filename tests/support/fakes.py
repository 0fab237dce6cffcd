"""Fakes at the ports. Each is held by the contract suite of its port."""

from __future__ import annotations

import resource
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.bag_summary import BagSummary, TopicSummary
from ros2_memory.core.errors import BagError, BagVanishedError, UndecodableError
from ros2_memory.storage.base import BagReader, Channel, Closing, Record, Schema
from tests.support.bags import Msg, typestore

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow


@dataclass(frozen=True)
class FakeBag:
    """What a bag in memory holds, and how it stands."""

    records: tuple[Record, ...] = ()
    channels: tuple[Channel, ...] = ()
    closing: Closing = Closing.CLOSED
    notes: tuple[str, ...] = ()
    damage: str = ""


class FakeReader(BagReader):
    """Bags in memory, keyed by path; no file is touched.

    `undecodable_types` gives the reason why a type cannot be decoded. `opened` lists the paths
    whose messages or summaries were asked for, in order.
    """

    def __init__(self, undecodable_types: Mapping[str, str] | None = None) -> None:
        self._bags: dict[Path, FakeBag] = {}
        self._reasons = dict(undecodable_types or {})
        self.opened: list[Path] = []

    def add(
        self,
        path: Path,
        messages: Iterable[Msg] = (),
        *,
        declared: Collection[tuple[str, str]] = (),
        latched: Collection[str] = ("/tf_static",),
        closing: Closing = Closing.CLOSED,
        notes: tuple[str, ...] = (),
    ) -> Path:
        """A bag with the messages in file order; `declared` adds (topic, type) without messages."""
        channels: dict[tuple[str, str], Channel] = {}

        def channel(topic: str, type_name: str) -> Channel:
            made = Channel(topic, "cdr", Schema(type_name), latched=topic in latched)
            return channels.setdefault((topic, type_name), made)

        for pair in declared:
            channel(*pair)
        records = tuple(
            Record(channel(m.topic, m.type), m.log_time, m.published, m.payload) for m in messages
        )
        self._bags[path] = FakeBag(records, tuple(channels.values()), closing, notes)
        return path

    def add_damaged(self, path: Path, reason: str = "damaged: not a bag") -> Path:
        """A file of which nothing can be read."""
        self._bags[path] = FakeBag(damage=reason)
        return path

    def remove(self, path: Path) -> None:
        """Lets a bag vanish."""
        del self._bags[path]

    def reads(self, path: Path) -> bool:
        return path.suffix == ".mcap"

    def closing(self, path: Path) -> Closing:
        return self._bag(path).closing

    def summarize(self, path: Path) -> BagSummary:
        bag = self._readable(path)
        times: dict[tuple[str, str], list[Record]] = {}
        for record in bag.records:
            times.setdefault((record.channel.topic, record.channel.type), []).append(record)
        topics = tuple(
            TopicSummary(
                topic,
                type_name,
                found[0].channel.encoding,
                len(found),
                min(record.log_time for record in found),
                max(record.log_time for record in found),
                any(record.channel.latched for record in found),
            )
            for (topic, type_name), found in sorted(times.items())
        )
        silent = {channel.topic for channel in bag.channels} - {topic for topic, _ in times}
        return BagSummary(topics, tuple(sorted(silent)), bag.closing is Closing.CLOSED, bag.notes)

    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        records = self._readable(path).records
        # Sorting is stable: ties stay in file order, and turn with all the rest.
        in_order = sorted(records, key=lambda record: record.log_time)
        for record in reversed(in_order) if newest_first else in_order:
            if record.channel.topic in topics and window.contains(record.log_time):
                yield record

    def channels(self, path: Path) -> Sequence[Channel]:
        return list(self._readable(path).channels)

    def undecodable(self, channel: Channel) -> str | None:
        if channel.type in self._reasons:
            return self._reasons[channel.type]
        return None if channel.type in typestore().types else "no definition of it is known"

    def decode(self, record: Record) -> object:
        channel = record.channel
        reason = self.undecodable(channel)
        if reason is None:
            try:
                return typestore().deserialize_cdr(record.payload, channel.type)
            except Exception as error:
                raise UndecodableError(channel.topic, channel.type, str(error)) from error
        raise UndecodableError(channel.topic, channel.type, reason)

    def _bag(self, path: Path) -> FakeBag:
        if path not in self._bags:
            raise BagVanishedError(str(path), "the file is not there any more")
        return self._bags[path]

    def _readable(self, path: Path) -> FakeBag:
        bag = self._bag(path)
        if bag.damage:
            raise BagError(str(path), bag.damage)
        self.opened.append(path)
        return bag


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """Within the block writing past so many bytes of a file fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
