"""Carries latched messages past the deletion of the bags that contain them.

A latched message is valid until the next one, so an answer about today may need one received weeks
ago: a transform of `/tf_static` is only in the split in which it was received. Messages that are
still needed are therefore copied into one small bag, `latched/carried.mcap`, before their split is
deleted. Nothing of a message changes but its file, so that answers stay the same to the nanosecond;
its channel records from which recordings it came (see `Origin`).

Of the messages that would be gone, these are needed:

- The newest message of a topic, and the newest transform of each child frame, since every
  broadcaster publishes only its own frames.
- A message that was valid while a kept bag was recorded. Bags are deleted by age, so mostly that is
  the newest message only; but clocks step.
- A message that a kept bag repeats because its recording received it again: only the earliest copy
  shows when it was first received.

A superseded message is left out when the bag is written the next time, so the bag stays small.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import defaultdict
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.layout import CARRY_FILE, CARRY_FOLDER, is_derived, recorded_as
from ros2_memory.core.errors import BagError, BagVanishedError, UndecodableError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.spans import Spans, overlaps_any, united
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.retention.delete import new_file_beside
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.storage.base import errors_as_items

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader, BagWriter, Channel, Record

RECEIVED_AGAIN_NS: Final[Ns] = NS_PER_S
"""A latched message logged so long after it was published may have been received before."""
_DISCOVERY_NS: Final[Ns] = 30 * NS_PER_S
"""Publishers are found one after the other: for so long late messages may follow live ones."""
_RECORDINGS: Final = "ros2_memory_recordings"
_OFTEN: Final = "ros2_memory_often"

_log = get_logger(__name__)


class Origin(NamedTuple):
    """Where a carried message came from.

    Attributes:
        recordings: the folders, relative to the bag directory, of the recordings that received it:
            the first one, then each that still had bags when its own copy was deleted.
        often: whether the first recording had frequent messages of the topic, so that the message
            counts as not latched.
    """

    recordings: tuple[str, ...]
    often: bool


def with_origin(record: Record, origin: Origin) -> Record:
    """Returns the message with an origin, in place of the one that its channel names."""
    channel = record.channel
    rest = tuple(entry for entry in channel.metadata if entry[0] not in {_RECORDINGS, _OFTEN})
    new = ((_RECORDINGS, json.dumps(origin.recordings)), (_OFTEN, json.dumps(origin.often)))
    return record._replace(channel=replace(channel, metadata=(*rest, *new)))


def origin_of(channel: Channel) -> Origin | None:
    """Returns the origin of a carried message; None if its channel names none."""
    metadata = dict(channel.metadata)
    try:
        recordings = json.loads(metadata.get(_RECORDINGS, "null"))
    except ValueError:
        return None
    if not isinstance(recordings, list) or not recordings:
        return None
    return Origin(tuple(map(str, recordings)), metadata.get(_OFTEN) == "true")


class MessageIdentity(NamedTuple):
    """What all copies of one message share, whichever recording received them."""

    topic: str
    publish_time: Ns
    payload: bytes


_Copy: TypeAlias = tuple[Ns, MessageIdentity]
"""A message by its log time, too: which copy of it."""
_LateMessages: TypeAlias = "dict[tuple[Path, Ns, str], dict[MessageIdentity, Ns]]"
"""By bag, its mtime and topic: the late messages at its beginning, and their log times."""


class Latched(NamedTuple):
    """One latched message without its payload.

    `subjects` are its topic, and that topic with each child frame of its transforms: what a newer
    message must share to supersede it.
    """

    log_time: Ns
    identity: MessageIdentity
    subjects: tuple[tuple[str, str], ...]

    @property
    def copy(self) -> _Copy:
        """What shows which copy of the message it is."""
        return self.log_time, self.identity


def latched_message(record: Record, frames: Collection[str]) -> Latched:
    """Returns a message without its payload; `frames` are the child frames of its transforms."""
    topic = record.channel.topic
    digest = hashlib.blake2b(record.payload, digest_size=16).digest()
    subjects = ((topic, ""), *((topic, frame) for frame in frames))
    return Latched(record.log_time, MessageIdentity(topic, record.publish_time, digest), subjects)


def worth_carrying(
    messages: Iterable[Latched], kept: Spans, repeated: Mapping[MessageIdentity, Ns]
) -> set[Latched]:
    """Returns the messages that are still needed when their bags are deleted.

    Args:
        messages: all messages that would be gone, also carried ones, in any order.
        kept: the times of the bags that are kept.
        repeated: late messages in kept bags, and their earliest log time there.
    """
    earliest: dict[MessageIdentity, Latched] = {}
    for message in sorted(messages):
        earliest.setdefault(message.identity, message)
    missing = [
        message
        for identity, message in earliest.items()
        if repeated.get(identity, MAX_NS) > message.log_time
    ]
    needed = {message for message in missing if message.identity in repeated}
    by_subject: defaultdict[tuple[str, str], list[Latched]] = defaultdict(list)
    for message in missing:
        for subject in message.subjects:
            by_subject[subject].append(message)
    for (_, frame), of_subject in by_subject.items():
        needed.add(of_subject[-1])
        # A static transform is valid before it was received, too.
        since = MIN_NS if frame else of_subject[0].log_time
        for message, following in pairwise(of_subject):
            if message not in needed and overlaps_any(kept, since, following.log_time - 1):
                needed.add(message)
            since = following.log_time
    return needed


@dataclass(eq=False, repr=False)
class Carrier:
    """Writes the bag of carried messages of one bag directory.

    Args:
        static_topics: carried though no publisher is known to have offered them as transient local.
    """

    bag_dir: Path
    reader: BagReader
    writer: BagWriter
    static_topics: Collection[str]
    own: OwnRecordings
    _: KW_ONLY
    monotonic: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self.path = self.bag_dir / CARRY_FOLDER / CARRY_FILE
        self._failing = FailingFiles(self.monotonic)
        self._late: _LateMessages = {}

    def with_latched(self, snapshot: Snapshot, paths: Collection[str]) -> tuple[BagFile, ...]:
        """Returns the bags of `paths` with messages of a latched topic."""
        topics = self.topics(snapshot)
        return tuple(
            bag
            for bag in snapshot.bags
            if bag.file in paths and not bag.summary.schema.positions.keys().isdisjoint(topics)
        )

    def carry(self, snapshot: Snapshot, to_delete: set[str], saved: Collection[str]) -> int | None:
        """Writes the messages that must outlive the bags to delete, durably.

        Returns how many messages are carried then, or None if nothing had to be written. A bag that
        is also `saved` under another name counts as kept.

        Raises:
            BagError: a bag cannot be read or written; the messages carried before still are.
            OSError: the disk fails; the messages carried before still are.
        """
        with_messages = self.with_latched(snapshot, to_delete)
        if not with_messages:
            return None
        topics = self.topics(snapshot)
        carried = {
            latched_message(record, self._frames(record)): origin_of(record.channel)
            for record in self._records(self.path, topics)
        }
        origins = dict(carried)
        for bag in with_messages:
            origins.update(self._latched_in(snapshot, bag, topics))
        gone = to_delete.difference(saved)
        kept = [bag for bag in snapshot.bags if bag.file not in gone and not is_derived(bag.file)]
        wanted = worth_carrying(
            origins,
            united((bag.start, bag.end + 1) for bag in kept),
            self._repeated(snapshot, topics, to_delete),
        )
        remaining = frozenset(map(self._folder, {bag.recording for bag in kept}))
        chosen = _with_origins(wanted, origins, remaining)
        if chosen == {message.copy: origin for message, origin in carried.items()}:
            return None
        sources = [self.path, *(bag.path for bag in with_messages)]
        fetched = sorted(self._fetch(sources, topics, chosen), key=attrgetter("log_time"))
        if len(fetched) < len(chosen):
            raise BagError(str(self.path), "a latched message could not be read a second time")
        self._write(fetched)
        return len(wanted)

    def topics(self, snapshot: Snapshot) -> tuple[str, ...]:
        """Returns the latched topics. The last message of a frequent one may still be valid."""
        return tuple(
            topic
            for topic in snapshot.timeline.topics()
            if topic in self.static_topics or snapshot.timeline.is_transient_state(topic)
        )

    def _latched_in(
        self, snapshot: Snapshot, bag: BagFile, topics: Collection[str]
    ) -> Iterator[tuple[Latched, Origin]]:
        """Yields the readable messages of the topics, but only the newest of a frequent topic."""
        folder = self._folder(bag.recording)
        here = [topic for topic in topics if bag.summary.of(topic)]
        frequent = {topic for topic in here if self._is_frequent(snapshot, topic, bag.recording)}
        for record in self._records(bag.path, [topic for topic in here if topic not in frequent]):
            yield latched_message(record, self._frames(record)), Origin((folder,), often=False)
        for topic in frequent:
            try:
                everything = TimeWindow.everything()
                records = self.reader.records(bag.path, [topic], everything, newest_first=True)
                newest = next(records, None)
            except BagError:
                readable = self._records(bag.path, (topic,))
                newest = max(readable, key=attrgetter("log_time"), default=None)
            if newest is not None:
                yield latched_message(newest, ()), Origin((folder,), often=True)

    def _is_frequent(self, snapshot: Snapshot, topic: str, recording: Path) -> bool:
        """Whether a recording has frequent messages of a topic; never if they are transforms."""
        if topic in self.static_topics or any(map(_is_tf, snapshot.timeline.types_of(topic))):
            return False
        return not snapshot.timeline.pace(topic, recording).is_rare

    def _folder(self, recording: Path) -> str:
        """Returns the directory of a recording, relative to the bag directory."""
        return os.path.relpath(recorded_as(self.bag_dir, str(recording)), self.bag_dir)

    def _records(self, path: Path, topics: Collection[str]) -> Iterator[Record]:
        """Yields the readable messages of the topics.

        Raises:
            BagError: the bag of carried messages cannot be read. Its messages are nowhere else, so
                it must not be replaced by a bag without them.
            BagUnreachableError: the disk fails to read a bag, and may recover.
        """
        for record in errors_as_items(self.reader.records(path, topics, TimeWindow.everything())):
            if not isinstance(record, BagError):
                yield record
            elif isinstance(record, BagVanishedError):
                return
            elif self._failing.may_recover(path, record):
                raise record
            elif path == self.path:
                reason = f"{record.reason}; move it away to give up its messages"
                raise BagError(str(path), reason) from record
            else:
                _log.warning("latched_not_read", path=str(path), reason=record.reason)

    def _fetch(
        self,
        sources: Iterable[Path],
        topics: Collection[str],
        chosen: Mapping[_Copy, Origin | None],
    ) -> Iterator[Record]:
        """Yields the chosen messages with their payload and origin."""
        missing = {*chosen}
        for path in sources:
            for record in self._records(path, topics):
                copy = latched_message(record, ()).copy
                if copy in missing:
                    missing.remove(copy)
                    origin = chosen[copy]
                    yield record if origin is None else with_origin(record, origin)

    def _frames(self, record: Record) -> tuple[str, ...]:
        """Returns the child frames of a message of transforms, as they are written in it."""
        if not _is_tf(record.channel.type):
            return ()
        try:
            message = self.reader.decode(record)
        except UndecodableError:
            return ()
        transforms: Iterable[object] = getattr(message, "transforms", ())
        return tuple({str(getattr(transform, "child_frame_id", "")) for transform in transforms})

    def _repeated(
        self, snapshot: Snapshot, topics: Iterable[str], to_delete: Collection[str]
    ) -> dict[MessageIdentity, Ns]:
        """Returns the late messages of kept bags, and their earliest log time.

        Late messages come while the recorder of a recording discovers the publishers. So of each
        recording only the kept bags that begin within `_DISCOVERY_NS` of the first one are read.
        """
        late: _LateMessages = {}
        for topic in topics:
            begun: dict[Path, Ns] = {}
            early: list[BagFile] = []
            for bag in snapshot.bags:
                is_kept = bag.file not in to_delete and not is_derived(bag.file)
                if is_kept and topic in bag.summary.schema.positions:
                    since = begun.setdefault(bag.recording, bag.start)
                    if bag.start < since + _DISCOVERY_NS:
                        early.append(bag)
            for bag in early:
                key = (bag.path, bag.mtime_ns, topic)
                known = self._late.get(key)
                late[key] = self._late_in(bag.path, topic) if known is None else known
        self._late = late
        repeated: dict[MessageIdentity, Ns] = {}
        for log_times in late.values():
            for identity, log_time in log_times.items():
                repeated[identity] = min(log_time, repeated.get(identity, log_time))
        return repeated

    def _late_in(self, path: Path, topic: str) -> dict[MessageIdentity, Ns]:
        late: dict[MessageIdentity, Ns] = {}
        stop = MAX_NS
        for record in self._records(path, (topic,)):
            stop = min(stop, record.log_time + _DISCOVERY_NS)
            if record.log_time >= stop:
                break
            if record.log_time - record.publish_time > RECEIVED_AGAIN_NS:
                late.setdefault(latched_message(record, ()).identity, record.log_time)
        return late

    def _write(self, records: Sequence[Record]) -> None:
        folder = self.path.parent
        if folder.is_symlink():
            raise BagError(str(folder), "a symbolic link, which is not followed: remove it")
        if not records:
            self.path.unlink(missing_ok=True)
            return
        folder.mkdir(exist_ok=True)
        try:
            with new_file_beside(self.path) as new:
                self.writer.write(new, records)
                # Listed first: after a kill it would be foreign.
                self.own.add_bags(folder, [CARRY_FILE])
                new.replace(self.path)
        except BaseException:
            with suppress(OSError):
                folder.rmdir()
            raise
        flush(folder)
        flush(folder.parent)


def _is_tf(type_name: str) -> bool:
    return type_name.rpartition("/")[2].lower() == "tfmessage"


def _with_origins(
    wanted: Iterable[Latched], origins: Mapping[Latched, Origin | None], remaining: frozenset[str]
) -> dict[_Copy, Origin | None]:
    """Returns the wanted messages with all recordings that received them and still have bags."""
    received: defaultdict[MessageIdentity, set[str]] = defaultdict(set)
    for message, origin in origins.items():
        if origin is not None:
            received[message.identity].update(remaining.intersection(origin.recordings))
    chosen: dict[_Copy, Origin | None] = {}
    for message in wanted:
        chosen[message.copy] = origin = origins[message]
        if origin is not None:
            first, *others = origin.recordings
            others = sorted({*others, *received[message.identity]} - {first})
            chosen[message.copy] = origin._replace(recordings=(first, *others))
    return chosen
