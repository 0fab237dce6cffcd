"""Carries latched messages past the deletion of the bags that they stand in.

A latched message holds until the next one, so an answer about today may need one received weeks
ago: a transform of `/tf_static` stands only in the split in which it was received. What answers
still need is therefore carried into one small bag, `latched/carried.mcap`, before its split is
deleted. Everything of a message stays as it is but the file that it stands in, so that an answer
stays the same to the nanosecond; its channel says of which recordings it was (see `origin`).

What is needed, of all messages that would be gone otherwise:

- The newest message of a topic; and of transforms the newest of each child frame, since every
  broadcaster publishes only its own.
- One that held while something was recorded that is kept. Deleting goes by age, so mostly that is
  the newest only; but clocks step.
- One that a kept bag repeats because its recording received it again: only the earliest copy tells
  when it was first received.

Whatever is superseded leaves the bag when that is written the next time, so it stays small.
"""

from __future__ import annotations

import hashlib
import os
from bisect import bisect_left
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.carried_origin import Origin, origin_of, with_origin
from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.layout import CARRY_FILE, CARRY_FOLDER, is_carried
from ros2_memory.core.errors import BagError, BagVanishedError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader, BagWriter, Record

RECEIVED_AGAIN_NS: Final[Ns] = NS_PER_S
"""A latched message logged so long after it was published may have been received before."""

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


class Identity(NamedTuple):
    """What all copies of one message share, whichever recording received them."""

    topic: str
    publish_time: Ns
    payload: bytes


class Latched(NamedTuple):
    """One latched message without its payload.

    `holds` names what it holds for: its topic, and each child frame of its transforms.
    """

    log_time: Ns
    identity: Identity
    holds: tuple[tuple[str, str], ...]


def latched_message(record: Record, frames: Collection[str]) -> Latched:
    """What is to know of a message; `frames` are the child frames of its transforms, if any."""
    topic = record.channel.topic
    digest = hashlib.blake2b(record.payload, digest_size=16).digest()
    holds = ((topic, ""), *((topic, frame) for frame in frames))
    return Latched(record.log_time, Identity(topic, record.publish_time, digest), holds)


def is_late(message: Latched) -> bool:
    """Whether it may have been received before, by another recording."""
    return message.log_time - message.identity.publish_time > RECEIVED_AGAIN_NS


def worth_carrying(
    messages: Iterable[Latched],
    recorded_in: Callable[[Ns, Ns], bool],
    repeated: Mapping[Identity, Ns],
) -> set[Latched]:
    """Which of these messages are still needed when the bags that they stand in are gone.

    Args:
        messages: all that would be gone, those carried before included, in any order.
        recorded_in: whether anything is kept that was recorded in `[start, stop)`.
        repeated: late messages that stand in kept bags, and their earliest log time there.
    """
    missing = [
        each
        for each in _earliest_copies(messages)
        if repeated.get(each.identity, MAX_NS) > each.log_time
    ]
    needed = {each for each in missing if each.identity in repeated}
    by_hold: defaultdict[tuple[str, str], list[Latched]] = defaultdict(list)
    for each in sorted(missing):
        for hold in each.holds:
            by_hold[hold].append(each)
    for (_, frame), held in by_hold.items():
        needed.add(held[-1])
        # A static transform holds before it was received, too.
        since = MIN_NS if frame else held[0].log_time
        for message, following in pairwise(held):
            if message not in needed and recorded_in(since, following.log_time):
                needed.add(message)
            since = following.log_time
    return needed


def _earliest_copies(messages: Iterable[Latched]) -> Collection[Latched]:
    earliest: dict[Identity, Latched] = {}
    for each in messages:
        known = earliest.get(each.identity)
        if known is None or each.log_time < known.log_time:
            earliest[each.identity] = each
    return earliest.values()


class Carrier:
    """Writes the bag of carried messages of one bag directory.

    Args:
        bag_dir: where the bags lie.
        reader: reads them.
        writer: writes the one of carried messages.
        static_topics: carried though no publisher is known to have offered them as transient local.
    """

    def __init__(
        self, bag_dir: Path, reader: BagReader, writer: BagWriter, static_topics: Collection[str]
    ) -> None:
        self.path = bag_dir / CARRY_FOLDER / CARRY_FILE
        self._reader = reader
        self._writer = writer
        self._static_topics = frozenset(static_topics)
        self._late: dict[tuple[Path, Ns, str], dict[Identity, Ns]] = {}

    def concerned(self, snapshot: Snapshot, doomed: Collection[Path]) -> tuple[BagFile, ...]:
        """Those of the bags that hold messages of a latched topic."""
        found: dict[str, BagFile] = {}
        leaving = {str(path) for path in doomed}
        everything = TimeWindow.everything()
        for topic in self._topics(snapshot):
            held = snapshot.extents(topic, everything)
            found.update((bag.file, bag) for bag, *_ in held if bag.file in leaving)
        return tuple(found.values())

    def carry(
        self, snapshot: Snapshot, doomed: Collection[Path], kept: Collection[Path] = ()
    ) -> int | None:
        """Writes what must outlive these bags; how many messages are carried then.

        Of the doomed some are `kept` under another name: what was recorded in them stays. None
        where nothing had to be written. All is on the disk when this returns.

        Raises:
            BagError: it cannot be written; what was carried before still is.
            OSError: likewise.
        """
        leaving = self.concerned(snapshot, doomed)
        if not leaving:
            return None
        topics = self._topics(snapshot)
        gone = {*doomed} - {*kept}
        there = [bag for bag in snapshot.bags if bag.path not in gone and not is_carried(bag.path)]
        carried = dict(self._carried(topics))
        origins = dict(carried)
        staying = {self._folder(bag.path) for bag in there}
        for bag in leaving:
            origins.update(self._read(snapshot, bag, topics))
        wanted = worth_carrying(origins, _presence(there), self._repeated(snapshot, topics, doomed))
        chosen = {each[:2]: _united(each, origins, staying) for each in wanted}
        if chosen == {each[:2]: origin for each, origin in carried.items()}:
            return None
        sources = [self.path, *(bag.path for bag in leaving)]
        fetched = sorted(self._fetched(sources, topics, chosen), key=lambda each: each.log_time)
        if len(fetched) < len(chosen):
            raise BagError(str(self.path), "a latched message could not be read a second time")
        self._write(fetched)
        return len(wanted)

    def _topics(self, snapshot: Snapshot) -> tuple[str, ...]:
        """Also of topics that say much: nobody may have said since what the last message did."""
        return tuple(
            topic
            for topic in snapshot.topics()
            if topic in self._static_topics or snapshot.is_transient_state(topic)
        )

    def _carried(self, topics: Collection[str]) -> Iterator[tuple[Latched, Origin | None]]:
        """What is carried already."""
        for record in self._records(self.path, topics):
            yield latched_message(record, self._frames(record)), origin_of(record.channel)

    def _read(
        self, snapshot: Snapshot, bag: BagFile, topics: Collection[str]
    ) -> Iterator[tuple[Latched, Origin]]:
        """The messages of these topics; of a bag that cannot be read to its end, the readable.

        Of a topic that has many only the newest: what it said before holds no longer.
        """
        folder = self._folder(bag.path)
        here = [topic for topic in topics if bag.summary.of(topic)]
        often = {topic for topic in here if self._is_often(snapshot, topic, bag.recording)}
        for record in self._records(bag.path, [topic for topic in here if topic not in often]):
            yield latched_message(record, self._frames(record)), Origin((folder,), often=False)
        for topic in often:
            for record in self._newest(bag.path, topic):
                yield latched_message(record, ()), Origin((folder,), often=True)

    def _newest(self, path: Path, topic: str) -> Iterator[Record]:
        """The newest message of a topic that can be read."""
        try:
            newest = self._reader.newest(path, topic, TimeWindow.everything())
        except BagVanishedError:
            return
        except BagError:
            found = {each.log_time: each for each in self._records(path, (topic,))}
            newest = found[max(found)] if found else None
        if newest is not None:
            yield newest

    def _is_often(self, snapshot: Snapshot, topic: str, recording: Path) -> bool:
        """Whether a recording has messages of a topic often; transforms are of many frames."""
        if topic in self._static_topics or any(map(_is_tf, snapshot.types_of(topic))):
            return False
        return not snapshot.pace(topic, recording).is_rare

    def _folder(self, bag: Path) -> str:
        """The folder of a bag's recording, from the bag directory on; also of a moment's bag."""
        bag_dir = self.path.parent.parent
        return os.path.relpath(HardLinks(bag_dir).recorded_as(str(bag.parent)), bag_dir)

    def _records(self, path: Path, topics: Collection[str]) -> Iterator[Record]:
        """The messages of these topics.

        Raises:
            BagError: the bag of carried messages cannot be read. What it holds stands nowhere
                else, so it must not be replaced by one without it.
        """
        try:
            yield from self._reader.records(path, topics, TimeWindow.everything())
        except BagVanishedError:
            return
        except BagError as error:
            if path == self.path:
                reason = f"{error.reason}; move it away to give up what it holds"
                raise BagError(str(path), reason) from error
            _log.warning("latched_not_read", path=str(path), reason=error.reason)

    def _fetched(
        self,
        sources: Iterable[Path],
        topics: Collection[str],
        chosen: Mapping[tuple[Ns, Identity], Origin | None],
    ) -> Iterator[Record]:
        """The messages themselves, with their origins; they are few, so they are held at once."""
        missing = {*chosen}
        for path in sources:
            for record in self._records(path, topics):
                log_time, identity, _ = latched_message(record, ())
                if (log_time, identity) in missing:
                    missing.remove((log_time, identity))
                    origin = chosen[log_time, identity]
                    yield record if origin is None else with_origin(record, origin)

    def _frames(self, record: Record) -> tuple[str, ...]:
        """The child frames of a message of transforms, as they are written in it."""
        if not _is_tf(record.channel.type):
            return ()
        try:
            message = self._reader.decode(record)
        except UndecodableError:
            return ()
        transforms: Iterable[object] = getattr(message, "transforms", ())
        return tuple({str(getattr(each, "child_frame_id", "")) for each in transforms})

    def _repeated(
        self, snapshot: Snapshot, topics: Iterable[str], doomed: Collection[Path]
    ) -> dict[Identity, Ns]:
        """The late messages of kept bags, and their earliest log time.

        They come first in a recording, when its recorder has just subscribed.
        """
        repeated: dict[Identity, Ns] = {}
        asked: dict[tuple[Path, Ns, str], dict[Identity, Ns]] = {}
        for topic in topics:
            seen: set[Path] = set()
            for bag, *_ in snapshot.extents(topic, TimeWindow.everything()):
                if bag.recording in seen or bag.path in doomed or is_carried(bag.path):
                    continue
                seen.add(bag.recording)
                key = (bag.path, bag.mtime_ns, topic)
                known = self._late.get(key)
                asked[key] = self._late_in(bag.path, topic) if known is None else known
                for identity, moment in asked[key].items():
                    repeated[identity] = min(moment, repeated.get(identity, moment))
        self._late = asked
        return repeated

    def _late_in(self, path: Path, topic: str) -> dict[Identity, Ns]:
        late: dict[Identity, Ns] = {}
        for record in self._records(path, (topic,)):
            message = latched_message(record, ())
            if not is_late(message):
                break
            late.setdefault(message.identity, message.log_time)
        return late

    def _write(self, records: Sequence[Record]) -> None:
        folder = self.path.parent
        if folder.is_symlink():
            raise BagError(str(folder), "a symbolic link, which is not followed: remove it")
        if not records:
            self.path.unlink(missing_ok=True)
            return
        folder.mkdir(exist_ok=True)
        beside = folder / f".{CARRY_FILE}.tmp"
        try:
            beside.unlink(missing_ok=True)
            self._writer.write(beside, records)
            beside.replace(self.path)
        except BaseException:
            with suppress(OSError):
                folder.rmdir()
            raise
        flush(folder)
        flush(folder.parent)


def _is_tf(type_name: str) -> bool:
    return type_name.rpartition("/")[2].lower() == "tfmessage"


def _united(
    wanted: Latched, origins: Mapping[Latched, Origin | None], staying: Collection[str]
) -> Origin | None:
    """The origin of a message and its copies: of these the recordings that still have bags."""
    own = origins[wanted]
    if own is None:
        return None
    copies = [
        recording
        for each, origin in origins.items()
        if each.identity == wanted.identity and origin is not None
        for recording in origin.recordings
        if recording in staying
    ]
    first, *others = own.recordings
    return replace(own, recordings=(first, *sorted({*others, *copies} - {first})))


def _presence(bags: Sequence[BagFile]) -> Callable[[Ns, Ns], bool]:
    """Tells whether any of these bags has a moment in `[start, stop)`."""
    spans = sorted((bag.start, bag.end) for bag in bags)
    starts = [start for start, _ in spans]
    reach = list(accumulate((end for _, end in spans), max))

    def recorded_in(start: Ns, stop: Ns) -> bool:
        begun = bisect_left(starts, stop)
        return begun > 0 and reach[begun - 1] >= start

    return recorded_in
