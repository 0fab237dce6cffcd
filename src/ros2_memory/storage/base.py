"""The ports for reading and writing bag files.

The docstrings are the contract; one test suite holds every adapter to it.

A reader takes single bag *files*; a rosbag2 directory is opened split by split, so that a deleted
split or a wrong metadata.yaml costs nothing of the others. Adapters translate every foreign
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

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns


ROS2_PROFILE: Final = "ros2"
"""The profile of every rosbag2 file; other readers of ROS 2 bags refuse every other."""


class Closing(StrEnum):
    """Whether a file says of itself that its writer has finished."""

    CLOSED = "closed"
    OPEN = "open"


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition as it stands in a bag. Equal by content: ids are local to one file.

    `encoding` is `ros2msg`, `ros2idl`, `jsonschema`, ... or empty where the recorder found none.
    """

    name: str
    encoding: str = ""
    text: bytes = b""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic under one type in one bag. `encoding` is the message encoding (`cdr`, `json`).

    `metadata` is what the recorder noted of it, such as what publishers offer
    (`offered_qos_profiles`), as it stands in the bag.
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
        """About how much memory its texts take."""
        held = len(self.topic) + len(self.schema.name) + len(self.schema.text)
        for name, text in self.metadata:
            held += len(name) + len(text)
        return held


class Record(NamedTuple):
    """One message, not yet decoded (a tuple: millions of them pass through a search).

    Where a format keeps one time only, `publish_time` equals `log_time`.
    """

    channel: Channel
    log_time: Ns
    publish_time: Ns
    payload: bytes


@dataclass(frozen=True, slots=True)
class CdrLayout:
    """Where the numbers of a message lie: offsets in its payload, little-endian.

    It is of every payload of `size` bytes that is the same outside of these numbers.

    Attributes:
        size: bytes of the payload.
        doubles: of each float64.
        singles: of each float32.
        times: of each time or duration: int32 seconds, then uint32 nanoseconds.
    """

    size: int
    doubles: tuple[int, ...]
    singles: tuple[int, ...]
    times: tuple[int, ...]


class BagReader(ABC):
    """Reads bag files of the kinds that `reads` accepts."""

    @abstractmethod
    def reads(self, path: Path) -> bool:
        """Whether the file is of a kind this adapter reads, judged by its name alone."""

    @abstractmethod
    def closing(self, path: Path) -> Closing:
        """Whether the writer has finished the file.

        Closing magic for MCAP; no journal or WAL beside a sqlite file; a whole frame for `.zstd`.
        A file that is not a bag at all counts as closed: `summarize` then says what is wrong.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be opened.
        """

    @abstractmethod
    def summarize(self, path: Path) -> BagSummary:
        """Topics with exact counts and exact first and last log times.

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
        """The undecoded messages of `topics` with log time inside the half-open window.

        Ordered by log time whatever the order in the file, ties in file order; `newest_first`
        gives exactly the reverse. Both channels of a topic that has two are read. Reads only
        what overlaps the window; holds a chunk (and those that overlap it in time), never a file.
        Payloads are plain serialized messages: message compression is already undone.
        Lazy: nothing is opened before the first item is asked for.

        Raises:
            BagVanishedError: the file is not there.
            BagError: what comes next cannot be read. With `lost` that is some messages only, and
                the iterator goes on behind them when it is asked again; else it has ended. Where
                `summarize` gave `complete=False` the early end is known, and simply ends it.
        """

    def newest(self, path: Path, topic: str, window: TimeWindow) -> Record | None:
        """The first of `records(path, [topic], window, newest_first=True)`; None without any.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be read.
        """
        return next(self.records(path, [topic], window, newest_first=True), None)

    @abstractmethod
    def log_times(self, path: Path, topic: str, window: TimeWindow) -> Sequence[Ns]:
        """The log times that `records(path, [topic], window)` would give, without the payloads.

        Raises:
            BagVanishedError: the file is not there.
            BagError: they cannot be read.
        """

    @abstractmethod
    def undecodable(self, channel: Channel) -> str | None:
        """Why no message of this channel can be decoded, or None where its type is understood."""

    @abstractmethod
    def channels(self, path: Path) -> Sequence[Channel]:
        """Every channel that is declared in the file, with or without messages.

        Raises:
            BagVanishedError: the file is not there.
            BagError: they cannot be read.
        """

    def profile(self, path: Path) -> str:
        """The profile of the file, as MCAP names it: `ros2`, or what its header holds.

        Raises:
            BagVanishedError: the file is not there.
            BagError: it cannot be read.
        """
        del path
        return ROS2_PROFILE

    @abstractmethod
    def decode(self, record: Record) -> object:
        """The message: an attribute object for a ROS type, a plain value for JSON.

        The definition inside the bag counts first, then the configured `.msg` folders, then the
        standard types.

        Raises:
            UndecodableError: no definition, a foreign encoding, or bytes that do not fit it.
        """

    def layout(self, record: Record) -> CdrLayout | None:
        """Where the numbers of this message lie; None where that is not told: then decode it."""
        del record
        return None


@dataclass(frozen=True, slots=True)
class Rewritten:
    """What became of a file that was cut short.

    `lost_bytes` are the bytes of it that made no whole record; how many messages never reached the
    disk nobody knows. `notes` are sentences on what was lost.
    """

    messages: int
    lost_bytes: int
    notes: tuple[str, ...] = ()


class BagWriter(ABC):
    """Writes closed, indexed bag files."""

    @abstractmethod
    def write(self, path: Path, records: Iterable[Record], *, profile: str = ROS2_PROFILE) -> None:
        """Writes a bag that holds these messages, in the order given, and nothing else.

        Payloads, both times, definitions and the metadata of channels stay as they are; ROS 2
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

        Schemas, channels, metadata, attachments, both times and sequence numbers stay as they are,
        and so does the order; what makes no whole record is left out. The target was read back and
        compared with the source, and is on the disk, when this returns. There must be no file of
        its name; the source is only read. `progress` is told how many bytes of it were read.

        Raises:
            BagVanishedError: the source is not there.
            BagError: nothing of the source can be read, or the target cannot be written, or it
                does not hold what was readable.
        """


class ChannelTotal(NamedTuple):
    """The messages of one channel: how many (at least one), the earliest and the latest."""

    channel: Channel
    messages: int
    first: Ns
    last: Ns


def summarize_channels(
    held: Iterable[ChannelTotal],
    declared: Iterable[Channel],
    *,
    complete: bool = True,
    notes: tuple[str, ...] = (),
    set_back: Ns = 0,
) -> BagSummary:
    """The summary of a file: channels of one topic and type count as one."""
    found: dict[tuple[str, str], ChannelTotal] = {}
    for each in held:
        key = (each.channel.topic, each.channel.type)
        other = found.get(key)
        found[key] = each if other is None else _together(other, each)
    silent = {channel.topic for channel in declared} - {topic for topic, _ in found}
    headings: list[TopicHeader] = []
    numbers: list[int] = []
    # Past the objects of single topics: an index makes one summary after the other.
    for (topic, type_name), (channel, *stated) in sorted(found.items(), key=itemgetter(0)):
        headings.append(TopicHeader(topic, type_name, channel.encoding, channel.latched))
        numbers += stated
    shape = shared_schema(tuple(headings), tuple(sorted(silent)), complete, notes, set_back)
    return BagSummary.decoded(shape, shape.numbers.pack(*numbers))


def _together(one: ChannelTotal, other: ChannelTotal) -> ChannelTotal:
    """Two channels of one topic and type."""
    channel = one.channel
    if other.channel.latched and not channel.latched:
        channel = replace(channel, latched=True)
    first, last = min(one.first, other.first), max(one.last, other.last)
    return ChannelTotal(channel, one.messages + other.messages, first, last)
