"""Writes a recording of the simulated robot with the layout of `ros2 bag record`.

A directory with splits `<name>_<i>.mcap` (profile `ros2`, CDR, ros2msg definitions with all nested
ones, the publishers' QoS on each channel), and at a clean close `metadata.yaml`. A split ends when
a message arrives more than the split duration after its first message.
"""

from __future__ import annotations

import threading
from functools import cache
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.bootstrap import build_repairer
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import MCAP
from ros2_memory.core.timebase import Clock, WallClock, ns_from_unix, unix_from_ns
from ros2_memory.demo.messages import MessageSchedule, Stream, definition, payload
from ros2_memory.storage.base import Channel, Record, Schema
from ros2_memory.storage.mcap.writer import McapWriter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.core.reply import JsonObject

_FOR_EVER: Final[JsonObject] = {
    "sec": 9223372036,
    "nsec": 854775807,
}  # the largest duration of 64 bits
_STOP_WITHIN_S: Final = 10.0


class DemoRecorder:
    """Writes the messages of a `MessageSchedule` into a directory, each when it is received.

    Messages of the past are written at once. The directory must not exist (as with
    `ros2 bag record`); its name is the recording's. A thread records from the constructor until
    `stop`.

    Attributes:
        directory: the recording.
        splits: the number of files; the last one is open until `stop`.
        failure: the error that ended the recording early, such as a full disk.
    """

    def __init__(
        self,
        directory: Path,
        schedule: MessageSchedule,
        *,
        split_duration_s: float = 5.0,
        clock: Clock | None = None,
    ) -> None:
        directory.mkdir(parents=True)
        self.directory = directory
        self.splits = 0
        self.failure: BagError | None = None
        self._duration = ns_from_unix(split_duration_s)
        self._clock = clock or WallClock()
        self._messages = schedule.everything()
        self._next = next(self._messages)
        self._caught_up, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._record, name="demo-recorder", daemon=True)
        self._thread.start()
        self._caught_up.wait()

    def stop(self) -> None:
        """Ends the recording as a clean shutdown does: a footer, and metadata.yaml."""
        self._ending.set()
        self._thread.join(_STOP_WITHIN_S)
        build_repairer().correct_metadata(self.directory)

    def _record(self) -> None:
        writer = McapWriter()
        try:
            while not self._ending.is_set():
                file = self.directory / f"{self.directory.name}_{self.splits}{MCAP}"
                self.splits += 1
                writer.write(file, self._split())
        except BagError as error:
            self.failure = error
        self._caught_up.set()

    def _split(self) -> Iterator[Record]:
        """Yields the messages of one split, each when it is received."""
        first = self._next.log_time
        while self._next.log_time - first <= self._duration and self._wait_for_next():
            message, self._next = self._next, next(self._messages)
            channel = _channel(message.stream)
            yield Record(channel, message.log_time, message.publish_time, payload(message))

    def _wait_for_next(self) -> bool:
        """Waits until the next message is received; returns False if the recording ends before."""
        while (ahead := self._next.log_time - self._clock.now()) > 0:
            self._caught_up.set()
            if self._ending.wait(unix_from_ns(ahead)):
                return False
        return True


@cache
def _channel(stream: Stream) -> Channel:
    """Returns the channel of a stream, with the QoS that its publisher offers."""
    schema = Schema(stream.type, "ros2msg", definition(stream.type).encode())
    qos = {
        "history": "unknown",
        "depth": 0,
        "reliability": "reliable",
        "durability": "transient_local" if stream.latched else "volatile",
        "deadline": dict(_FOR_EVER),
        "lifespan": dict(_FOR_EVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOR_EVER),
        "avoid_ros_namespace_conventions": False,
    }
    offered = ("offered_qos_profiles", yaml.safe_dump([qos], sort_keys=False))
    return Channel(stream.topic, "cdr", schema, stream.latched, (offered,))
