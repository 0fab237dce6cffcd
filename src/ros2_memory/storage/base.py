"""The ports for reading and writing bag files.

The docstrings are the contract; one test suite holds every adapter to it.

A reader takes single bag *files*; a rosbag2 directory is opened split by split, so that a deleted
split or a wrong metadata.yaml does not affect the others. Adapters translate every foreign
exception into `BagError`, `BagVanishedError` or `UndecodableError`, and never let another escape.
A reader is safe to use from several threads at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from ros2_memory.core.arrays import numbered, rows_by
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import TimeWindow

T = TypeVar("T")
IntArray: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.int64]]"
Mask: TypeAlias = "np.ndarray[tuple[int], np.dtype[np.bool_]]"

REPEATED_NS: Final[Ns] = NS_PER_S
"""A latched message logged so long after it was published may have been received before."""
ROS2_PROFILE: Final = "ros2"
"""The profile of every rosbag2 file; other readers of ROS 2 bags refuse every other."""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition of a bag. Compared by content: ids are local to one file.

    `encoding` is `ros2msg`, `ros2idl`, `jsonschema`, ... or empty where the recorder found none.
    """

    name: str
    encoding: str = ""
    text: bytes = b""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic under one type in one bag. `encoding` is the message encoding (`cdr`, `json`).

    `metadata` is what the recorder wrote about it, such as the QoS that publishers offer
    (`offered_qos_profiles`).
    """

    topic: str
    encoding: str
    schema: Schema
    latched: bool = False
    metadata: tuple[tuple[str, str], ...] = ()

    @property
    def type(self) -> str:
        """The message type, `package/msg/Name` for ROS 2."""
        return self.schema.name

    @property
    def memory_bytes(self) -> int:
        """The approximate size of its texts in memory, in bytes."""
        size = len(self.topic) + len(self.schema.name) + len(self.schema.text)
        return size + sum(len(name) + len(text) for name, text in self.metadata)


class Record(NamedTuple):
    """One message, not yet decoded (a tuple: millions of them pass through a search).

    Where a format keeps one time only, `publish_time` equals `log_time`.
    """

    channel: Channel
    log_time: Ns
    publish_time: Ns
    payload: bytes

    @property
    def may_be_repeated(self) -> bool:
        """Whether another recording may have received this very message before."""
        return self.channel.latched and self.log_time - self.publish_time > REPEATED_NS


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Undecoded messages of one channel that lie in one buffer.

    Attributes:
        channel: their channel.
        log_times: in ns, in any order.
        publish_times: in ns; equal to the log times where a format keeps one time only.
        places: the order in the file, which breaks ties of log times; no two messages of a file
            have the same.
        buffer: holds the payloads; often also other batches, and bytes between the payloads.
        starts: where each payload begins in the buffer.
        sizes: the bytes of each payload, with the 4 of the encapsulation header of CDR.
    """

    channel: Channel
    log_times: IntArray
    publish_times: IntArray
    places: IntArray
    buffer: bytes
    starts: IntArray
    sizes: IntArray

    def payload(self, nth: int) -> bytes:
        """Returns a copy of one payload."""
        start = int(self.starts[nth])
        return self.buffer[start : start + int(self.sizes[nth])]

    def record(self, nth: int) -> Record:
        """Returns one message, as `BagReader.records` would yield it."""
        log_time, publish_time = int(self.log_times[nth]), int(self.publish_times[nth])
        return Record(self.channel, log_time, publish_time, self.payload(nth))

    def select(self, rows: IntArray | Mask) -> Batch:
        """Returns the messages at these positions, or where the mask is set, in the same buffer."""
        return replace(
            self,
            log_times=self.log_times[rows],
            publish_times=self.publish_times[rows],
            places=self.places[rows],
            starts=self.starts[rows],
            sizes=self.sizes[rows],
        )


SEQUENCE: Final = -1
"""The `length` of a field that is a sequence: each message states its own."""


class Field(NamedTuple):
    """A field of a message type.

    Attributes:
        name: as in the definition.
        kind: a primitive type of ROS (`float64`, `string`), or the definition of a nested message.
        length: None for a single value, the number of elements for a fixed array, `SEQUENCE` for a
            sequence.
    """

    name: str
    kind: str | Definition
    length: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Definition:
    """The fields of a message type and of its nested types.

    Equal nested types are one object: a definition of a few lines can nest so deep that its
    spelled-out fields would not fit into memory.

    Attributes:
        constants: the whole numbers that the type itself names.
    """

    type: str
    fields: tuple[Field, ...]
    constants: tuple[tuple[str, int], ...] = ()

    def text(self) -> str:
        """Returns the definition as rosbag2 writes it: `.msg` files, one after the other.

        The nested types follow the type itself. Constants and bounds are missing: payloads do not
        have them.
        """
        text = ""
        written: set[str] = set()
        waiting = [self]
        while waiting:
            definition = waiting.pop()
            if definition.type in written:
                continue
            written.add(definition.type)
            if definition is not self:
                text += f"{'=' * 80}\nMSG: {definition.type.replace('/msg/', '/')}\n"
            for field in definition.fields:
                text += _msg_line(field)
                if isinstance(field.kind, Definition):
                    waiting.append(field.kind)
        return text


def _msg_line(field: Field) -> str:
    """Returns the line of a `.msg` file that declares a field."""
    kind = field.kind
    if isinstance(kind, Definition):
        kind = kind.type.replace("/msg/", "/")
    if field.length is None:
        return f"{kind} {field.name}\n"
    length = "" if field.length == SEQUENCE else field.length
    return f"{kind}[{length}] {field.name}\n"


class BagReader(ABC):
    """Reads bag files of the kinds that `reads` accepts."""

    @abstractmethod
    def reads(self, path: Path) -> bool:
        """Returns whether this adapter reads such a file, judged by its name alone."""

    @abstractmethod
    def is_finished(self, path: Path) -> bool:
        """Returns whether the writer has finished the file.

        Closing magic for MCAP; no journal or WAL beside a sqlite file; a whole frame for `.zstd`.
        A file that is not a bag at all counts as finished: `summarize` then raises the reason.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be opened.
        """

    @abstractmethod
    def summarize(self, path: Path) -> BagSummary:
        """Returns topics with exact counts and exact first and last log times.

        Costs the summary section where the file has one. A file that ends early is summarised by
        what is readable, with `complete=False`.

        Raises:
            BagVanishedError: the file is not there.
            BagError: nothing of it can be read.
        """

    @abstractmethod
    def records(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        newest_first: bool = False,
    ) -> Iterator[Record]:
        """Yields the undecoded messages of `topics` with log time inside the half-open window.

        Ordered by log time whatever the order in the file; ties in file order. `newest_first`
        yields exactly the reverse. Both channels of a topic that has two are read. Reads only
        what overlaps the window; keeps a chunk (and those that overlap it in time) in memory, never
        a file. Payloads are plain serialized messages: message compression is already undone.
        Lazy: nothing is opened before the first item is requested.

        Raises:
            BagVanishedError: the file is not there.
            BagError: what comes next cannot be read. With `lost` that is some messages only, and
                the iterator continues behind them with the next item; else it has ended. If
                `summarize` returned `complete=False`, the early end is known and raises nothing.
        """

    @abstractmethod
    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        """Yields the messages of `records(path, topics, window)`, many at once, in any order.

        A buffer is shared by one batch for each channel, and these batches follow each other. A
        buffer has at most 64 MiB or one chunk, and the reader keeps none. Lazy: nothing is opened
        before the first item is requested.

        Args:
            path: the file.
            topics: as for `records`.
            window: as for `records`.
            bare: topics whose payloads are not needed. Where that saves reading a chunk, their
                messages come with empty payloads and the log time as publish time. Their times are
                then taken from the file's indexes and were not compared with the messages.

        Raises:
            BagVanishedError: the file is not there.
            BagError: as by `records`: with `lost`, the iterator continues behind it.
            BagContradictionError: the indexes contradict the messages. The iterator continues with
                the messages that it has not yielded yet, and none is lost.
        """

    @abstractmethod
    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded; None if its type is known."""

    def times_alone(self, path: Path) -> Collection[str]:  # noqa: ARG002 - a lake needs it
        """Returns the topics for which the bag has log and publish times, and no payloads."""
        return frozenset()

    def is_file(self, path: Path) -> bool:  # noqa: ARG002 - a lake needs it
        """Returns whether the bag is a file, which may change; a bag of a lake does not."""
        return True

    @abstractmethod
    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns every channel that is declared in the file, with or without messages.

        Raises:
            BagVanishedError: the file is not there.
            BagError: they cannot be read.
        """

    @abstractmethod
    def decode(self, record: Record) -> object:
        """Decodes a message: an attribute object for a ROS type, a plain value for JSON.

        The definition inside the bag counts first, then the configured `.msg` folders, then the
        standard types.

        Raises:
            UndecodableError: no definition, a foreign encoding, or bytes that do not fit it.
        """

    def encode(self, channel: Channel, message: object) -> bytes:
        """Returns a decoded message of a channel, changed since, as a payload.

        Raises:
            UndecodableError: messages of the channel are not CDR, or this is none of them.
        """
        raise UndecodableError(channel.topic, channel.type, f"{message!r:.80} is not encoded")

    def definition(self, channel: Channel) -> Definition | None:
        """Returns the fields of a channel's messages; None if it is not CDR or has no definition.

        While the reader remembers a channel, it returns the same object for it.
        """
        del channel
        return None


BATCH_BYTES: Final = 16 << 20
"""Payloads are joined in one buffer up to this size; a larger payload has one of its own."""
MESSAGE_BYTES: Final = 200
"""About how much memory a waiting message takes besides its payload."""


def batched(items: Iterable[tuple[int, Record | T]]) -> Iterator[Batch | T]:
    """Yields messages in batches, with their payloads copied into common buffers.

    Args:
        items: messages with their places in the file. Anything else among them, such as an error,
            is yielded as it is, after the messages before it.
    """
    places: list[int] = []
    records: list[Record] = []
    size = 0
    for place, item in items:
        if not isinstance(item, Record):
            yield from _batch_by_channel(places, records)
            places, records, size = [], [], 0
            yield item
            continue
        if records and size + len(item.payload) > BATCH_BYTES:
            yield from _batch_by_channel(places, records)
            places, records, size = [], [], 0
        places.append(place)
        records.append(item)
        size += len(item.payload) + MESSAGE_BYTES
    yield from _batch_by_channel(places, records)


def _batch_by_channel(places: list[int], records: list[Record]) -> Iterator[Batch]:
    """Yields a batch for each channel of the messages; all share one buffer."""
    buffer = b"".join([record.payload for record in records])
    sizes = np.array([len(record.payload) for record in records], np.int64)
    log_times = np.array([record.log_time for record in records], np.int64)
    publish_times = np.array([record.publish_time for record in records], np.int64)
    starts = np.cumsum(sizes) - sizes
    in_file = np.array(places, np.int64)
    # By identity: to hash a channel hashes the text of its definition.
    channels, channel_of = numbered(id(record.channel) for record in records)
    for rows in rows_by(channel_of, len(channels)):
        channel = records[int(rows[0])].channel
        whole = Batch(channel, log_times, publish_times, in_file, buffer, starts, sizes)
        yield whole.select(rows)


def errors_as_items(items: Iterator[T]) -> Iterator[T | BagError]:
    """Yields the items of a reader's iterator, and each `BagError` in place of what it lost."""
    while True:
        try:
            item = next(items)
        except StopIteration:
            return
        except BagError as error:
            yield error
            continue
        yield item
        del item  # and its buffer, before the next is read


def raise_if_error(item: T | BagError) -> T:
    """Returns an item of `errors_as_items`; raises it if it is an error."""
    if isinstance(item, BagError):
        raise item
    return item


@dataclass(frozen=True, slots=True)
class Rewritten:
    """The result of rewriting a file that was cut short.

    Attributes:
        messages: how many were written.
        lost_bytes: bytes of the source that made no whole record. Nobody knows how many messages
            never reached the disk.
        notes: sentences on what was lost.
        last: log time of the newest message; None without messages.
    """

    messages: int
    lost_bytes: int
    notes: tuple[str, ...]
    last: Ns | None

    def describe_loss(self) -> str:
        """Returns a sentence on what was lost."""
        if self.last is None:
            newest = "no message reached the disk"
        else:
            newest = (
                f"the newest message is of {unix_from_ns(self.last):.3f}; later ones that had not "
                "reached the disk are lost"
            )
        return f"{newest}, and {counted(self.lost_bytes, 'byte')} of the file made no whole message"


class BagWriter(ABC):
    """Writes closed, indexed bag files.

    Every failure is raised as a `BagError` about the new file, and nothing is left of that file.
    """

    @abstractmethod
    def write(
        self,
        path: Path,
        records: Iterable[Record],
        *,
        dense: bool = False,
    ) -> None:
        """Writes a bag of these messages, in the order given.

        Payloads, both times, definitions and the metadata of channels are unchanged; ROS 2
        types are named `package/msg/Name`, as every reader knows them. MCAP's profile is `ros2`
        where the first message is CDR, else empty. With `dense` the file is a third smaller, and
        to read one message of it takes longer. The bag is on the disk when this returns. There
        must be no file of that name.

        Raises:
            BagError: it cannot be written; or what `records` raises.
        """

    @abstractmethod
    def rewrite(self, source: Path, target: Path) -> Rewritten:
        """Writes all that can be read of a file that was cut short into a whole file.

        Schemas, channels, metadata, attachments, both times, sequence numbers and the order are
        unchanged; incomplete records are left out. When this returns, the target was read back,
        compared with the source and synced. There must be no file of its name; the source is only
        read.

        Raises:
            BagVanishedError: the source is not there.
            BagError: nothing of the source can be read, or the target cannot be written, or it
                does not hold what was readable.
        """

    @abstractmethod
    def cut(
        self,
        source: Path,
        target: Path,
        leaves_out: Callable[[str, Ns, Ns], bool],
    ) -> Counter[str]:
        """Copies a whole, uncompressed file without some messages.

        All else is unchanged, as by `rewrite`. Only the metadata.yaml that rosbag2 embeds is left
        out, since it counts messages. When this returns, the target was read back, compared and
        synced. There must be no file of its name; the source is only read.

        Args:
            source: a file that its writer finished.
            target: the new file.
            leaves_out: whether a message is left out, by topic, log time and publish time.

        Returns:
            How many messages of each topic were left out.

        Raises:
            BagVanishedError: the source is not there.
            BagError: not all of the source can be read, or the target cannot be written.
        """
