"""The two yardsticks: plain rosbags, and the physical floor.

Plain rosbags: for every bag that overlaps the question, newest first where the question is,
`rosbags.rosbag2.Reader(path)`, `messages(connections of the topic, start, stop)`,
`typestore.deserialize_cdr`, the condition in Python, and stop at the answer. The floor: open, read
the bytes of one chunk, decompress, decode one message. Which bags overlap, and where in them the
message lies, is known beforehand and costs nothing.
"""

from __future__ import annotations

import os
import struct
import time
from typing import TYPE_CHECKING, Final, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader

from benchmarks.payloads import typestore

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from benchmarks.bags import Topic

MOST_BAGS: Final = 40
"""So many bags are read; the time of more is scaled up."""
_CHUNK_HEAD: Final = struct.calcsize("<BQQQQII") + len(b"zstd") + struct.calcsize("<Q")
"""From the start of a chunk record to its data, where its compression is `zstd`."""


class Bag(NamedTuple):
    """A bag that has an end: first and last log time in nanoseconds."""

    path: Path
    start: int
    stop: int


class Scan(NamedTuple):
    """What plain rosbags are asked: a topic in a window, and which messages count.

    Attributes:
        topic: its name; empty: only which topics there are.
        start: the first log time, in nanoseconds.
        stop: the end of the window.
        meets: whether a message counts.
        is_last: whether the newest that counts is the answer, so that older bags are not read.
    """

    topic: str
    start: int
    stop: int
    meets: Callable[[object], bool] = lambda _: True
    is_last: bool = False


def bags_of(place: Path) -> list[Bag]:
    """Returns a world's closed bags, oldest first."""
    found = []
    for path in (place / "bags").rglob("*.mcap"):
        with path.open("rb") as stream:
            try:
                summary = make_reader(stream).get_summary()
            except McapError:
                continue  # the power failed
        if summary is not None and summary.statistics is not None:
            times = summary.statistics.message_start_time, summary.statistics.message_end_time
            found.append(Bag(path, *times))
    return sorted(found, key=lambda bag: bag.start)


def asked(bags: Sequence[Bag], scan: Scan) -> tuple[float, bool]:
    """Returns the processor time (s) of a scan, and whether it was scaled up."""
    among = [bag for bag in bags if bag.start < scan.stop and scan.start <= bag.stop]
    for bag in among[-1:]:
        _count(bag, scan)  # compiles the decoders, which ours has done, too
    begun, read = time.process_time(), 0
    for bag in reversed(among[-MOST_BAGS:]):
        read += 1
        if _count(bag, scan) and scan.is_last:
            return time.process_time() - begun, False
    spent = time.process_time() - begun
    return spent * len(among) / max(read, 1), len(among) > read


def _count(bag: Bag, scan: Scan) -> int:
    # Not above: the server whose memory is measured is forked from this process.
    from rosbags.rosbag2 import Reader  # noqa: PLC0415

    with Reader(bag.path) as reader:
        wanted = [each for each in reader.connections if each.topic == scan.topic]
        if not wanted:
            return 0
        return sum(
            scan.meets(typestore().deserialize_cdr(raw, connection.msgtype))
            for connection, _, raw in reader.messages(wanted, scan.start, scan.stop)
        )


def floor(bags: Sequence[Bag], topic: Topic, at: int) -> float:
    """Returns the processor time (s) of reading and decoding the one message that answers."""
    # The robot may have begun a bag at this moment, so its last message is in the one before.
    for bag in (bag for bag in reversed(bags) if bag.start <= at):
        with bag.path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
            found = list(make_reader(stream).iter_messages([topic.name], ending_at=at))
        if summary is not None and found:
            break
    else:
        raise ValueError(f"no bag has a message of {topic.name} before the time asked for")
    _, channel, message = found[-1]
    index = next(
        each
        for each in summary.chunk_indexes
        if channel.id in each.message_index_offsets
        and each.message_start_time <= message.log_time <= each.message_end_time
    )
    place, length = index.chunk_start_offset + _CHUNK_HEAD, index.compressed_size

    unpacker = zstandard.ZstdDecompressor()

    def unpacked() -> bytes:
        descriptor = os.open(bag.path, os.O_RDONLY)
        try:
            return unpacker.decompress(os.pread(descriptor, length, place))
        finally:
            os.close(descriptor)

    begins = unpacked().index(message.data)
    begun, rounds = time.process_time(), 50
    for _ in range(rounds):
        payload = unpacked()[begins : begins + len(message.data)]
        typestore().deserialize_cdr(payload, topic.type)
    return (time.process_time() - begun) / rounds
