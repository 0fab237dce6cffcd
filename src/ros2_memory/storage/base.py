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
from enum import StrEnum
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.bag_summary import BagSummary, TopicHeader, shared_schema
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow


RELATCHED_NS: Final[Ns] = NS_PER_S
"""A latched message logged so long after it was published may have been received before."""
ROS2_PROFILE: Final = "ros2"
"""The profile of every rosbag2 file; other readers of ROS 2 bags refuse every other."""


class Closing(StrEnum):
    """Whether the writer of a file has finished, by the file itself."""

    CLOSED = "closed"
    OPEN = "open"


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
    def may_be_relatched(self) -> bool:
        """Whether another recording may have received this very message before."""
        return self.channel.latched and self.log_time - self.publish_time > RELATCHED_NS


@dataclass(frozen=True, slots=True)
class CdrLayout:
    """The offsets of the numbers of a message in its little-endian payload.

    It holds for every payload of `size` bytes that has the same bytes outside of these numbers.

    Attributes:
        size: bytes of the payload.
        doubles: offset of each float64.
        singles: offset of each float32.
        times: offset of each time or duration: int32 seconds, then uint32 nanoseconds.
    """

    size: int
    doubles: tuple[int, ...]
    singles: tuple[int, ...]
    times: tuple[int, ...]


class BagReader(ABC):
    """Reads bag files of the kinds that `reads` accepts."""

    @abstractmethod
    def reads(self, path: Path) -> bool:
        """Returns whether this adapter reads such a file, judged by its name alone."""

    @abstractmethod
    def closing(self, path: Path) -> Closing:
        """Returns whether the writer has finished the file.

        Closing magic for MCAP; no journal or WAL beside a sqlite file; a whole frame for `.zstd`.
        A file that is not a bag at all counts as closed: `summarize` then raises the reason.

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

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """Returns the first of `records(path, [topic], window, newest_first=True)`, or None.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be read.
        """
        return next(self.records(path, [topic], window, newest_first=True), None)

    @abstractmethod
    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """Returns the log times of `records(path, [topic], window)`, without the payloads.

        Raises:
            BagVanishedError: the file is not there.
            BagError: they cannot be read.
        """

    @abstractmethod
    def undecodable(self, channel: Channel) -> str | None:
        """Returns why no message of this channel can be decoded; None if its type is known."""

    @abstractmethod
    def channels(self, path: Path) -> Sequence[Channel]:
        """Returns every channel that is declared in the file, with or without messages.

        Raises:
            BagVanishedError: the file is not there.
            BagError: they cannot be read.
        """

    def profile(self, path: Path) -> str:
        """Returns the MCAP profile of the file: `ros2`, or the one in its header.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be read.
        """
        del path
        return ROS2_PROFILE

    @abstractmethod
    def decode(self, record: Record) -> object:
        """Decodes a message: an attribute object for a ROS type, a plain value for JSON.

        The definition inside the bag counts first, then the configured `.msg` folders, then the
        standard types.

        Raises:
            UndecodableError: no definition, a foreign encoding, or bytes that do not fit it.
        """

    def layout(self, record: Record) -> CdrLayout | None:
        """Returns the offsets of this message's numbers; None if it must be decoded."""
        del record
        return None


@dataclass(frozen=True, slots=True)
class Rewritten:
    """The result of rewriting a file that was cut short.

    Attributes:
        messages: how many were written.
        lost_bytes: bytes of the source that made no whole record; how many messages never reached
            the disk is unknown.
        notes: sentences on what was lost.
        last: log time of the newest message; None without one.
    """

    messages: int
    lost_bytes: int
    notes: tuple[str, ...] = ()
    last: Ns | None = None

    def describe_loss(self) -> str:
        """Returns a sentence on what was lost."""
        kept = "no message reached the disk"
        if self.last is not None:
            kept = (
                f"the newest message is of {unix_from_ns(self.last):.3f}; later ones that had not "
                "reached the disk are lost"
            )
        return f"{kept}, and {counted(self.lost_bytes, 'byte')} of the file made no whole message"


class BagWriter(ABC):
    """Writes closed, indexed bag files.

    Every failure is raised as a `BagError` about the file to be written, with the
    `reason`, and nothing is left of that file.
    """

    @abstractmethod
    def write(self, path: Path, records: Iterable[Record], *, profile: str = ROS2_PROFILE) -> None:
        """Writes a bag of these messages, in the order given.

        Payloads, both times, definitions and the metadata of channels are unchanged; ROS 2
        types are named `package/msg/Name`, as every reader knows them. `profile` is MCAP's. The bag
        is on the disk when this returns. There must be no file of that name.

        Raises:
            BagError: it cannot be written; or what `records` raises.
        """

    @abstractmethod
    def rewrite(
        self, source: Path, target: Path, progress: Callable[[int], None] | None = None
    ) -> Rewritten:
        """Writes all that can be read of a file that was cut short into one that is whole.

        Schemas, channels, metadata, attachments, both times and sequence numbers are unchanged,
        as is the order; incomplete records are left out. The target was read back and
        compared with the source, and is on the disk, when this returns. There must be no file of
        its name; the source is only read. `progress` is called with the bytes read so far.

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
        takes: Callable[[str, Ns, Ns], bool],
        edit_metadata: Callable[[str], str],
    ) -> Counter[str]:
        """Writes a whole file again, of any kind but compressed ones, without some messages.

        All else is unchanged, as by `rewrite`, except the counts that rosbag2 embeds. The target
        was read back and compared, and is on the disk, when this returns. There must be no file of
        its name; the source is only read.

        Args:
            source: a file that its writer finished.
            target: the new one.
            takes: whether a message is left out, by topic, log time and publish time.
            edit_metadata: returns the corrected text of an embedded metadata.yaml.

        Returns:
            How many messages of each topic were left out.

        Raises:
            BagVanishedError: the source is not there.
            BagError: not all of the source can be read, or the target cannot be written.
        """


class ChannelTotal(NamedTuple):
    """The messages of one channel: how many (at least one), the earliest and the latest."""

    channel: Channel
    messages: int
    first: Ns
    last: Ns


def summarize_channels(
    totals: Iterable[ChannelTotal],
    declared: Iterable[Channel],
    *,
    complete: bool = True,
    notes: tuple[str, ...] = (),
    set_back: Ns = 0,
) -> BagSummary:
    """Returns the summary of a file; channels of one topic and type count as one."""
    found: dict[tuple[str, str], ChannelTotal] = {}
    for each in totals:
        key = (each.channel.topic, each.channel.type)
        other = found.get(key)
        found[key] = each if other is None else _together(other, each)
    silent = {channel.topic for channel in declared} - {topic for topic, _ in found}
    headers: list[TopicHeader] = []
    numbers: list[int] = []
    # Encoded at once, without an object for each topic: an index makes thousands of summaries.
    for (topic, type_name), (channel, *stated) in sorted(found.items(), key=itemgetter(0)):
        headers.append(TopicHeader(topic, type_name, channel.encoding, channel.latched))
        numbers += stated
    schema = shared_schema(tuple(headers), tuple(sorted(silent)), complete, notes, set_back)
    return BagSummary.decoded(schema, schema.numbers.pack(*numbers))


def _together(one: ChannelTotal, other: ChannelTotal) -> ChannelTotal:
    """Returns two channels of one topic and type as one."""
    channel = one.channel
    if other.channel.latched and not channel.latched:
        channel = replace(channel, latched=True)
    first, last = min(one.first, other.first), max(one.last, other.last)
    return ChannelTotal(channel, one.messages + other.messages, first, last)
