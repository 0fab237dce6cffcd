"""Writes a recording of the simulated robot with the layout of `ros2 bag record`.

A directory with splits `<name>_<i>.mcap` (profile `ros2`, CDR, ros2msg definitions with all nested
ones, the publishers' QoS on each channel, every channel in every split, zstd chunks small enough
that data reaches the disk within seconds), and at a clean close `metadata.yaml`. A split ends when
a message arrives more than the split duration after its first message, and gets its footer just
after the next one was opened.
"""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Final

import yaml
from mcap.writer import CompressionType, Writer

from ros2_memory.bootstrap import build_repairer
from ros2_memory.core.timebase import Clock, Ns, WallClock, ns_from_unix, unix_from_ns
from ros2_memory.demo.messages import STREAMS, Message, MessageSchedule, Stream, definition, payload

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.model import JsonValue

_CHUNK_BYTES: Final = 16 * 1024
_FOR_EVER: Final[dict[str, JsonValue]] = {"sec": 9223372036, "nsec": 854775807}
_STOP_WITHIN_S: Final = 10.0


@dataclass(slots=True)
class _Split:
    """One MCAP file that is being written; `first` and `last` are log times."""

    file: IO[bytes]
    writer: Writer
    channels: dict[str, int]
    first: Ns
    last: Ns
    count: int = 0


class DemoRecorder(AbstractContextManager["DemoRecorder"]):
    """Writes a `MessageSchedule` into `directory`: at once up to now, then as time passes.

    The directory must not exist (as with `ros2 bag record`); its name is the recording's. As a
    context manager it stops at the end of the block, and leaves a cleanly closed recording.

    Attributes:
        directory: of the recording.
        timeline: what is recorded.
        splits: the number of files; all but the last are closed, and `stop` closes that.
        failure: the error that ended the live recording early, such as a full disk.
    """

    def __init__(
        self,
        directory: Path,
        timeline: MessageSchedule,
        *,
        split_duration_s: float = 5.0,
        clock: Clock | None = None,
    ) -> None:
        directory.mkdir(parents=True)
        self.directory = directory
        self.timeline = timeline
        self.splits = 0
        self.failure: OSError | None = None
        self._duration = ns_from_unix(split_duration_s)
        self._clock = clock or WallClock()
        self._due = timeline.everything()
        self._next = next(self._due)
        self._split: _Split | None = None
        self._closed: list[tuple[Ns, Ns]] = []
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def __exit__(self, *_: object) -> None:
        self.stop()

    def closed_ends(self, since: Ns, until: Ns) -> tuple[Ns, ...]:
        """Returns the ends of closed splits: the log times of their last messages.

        First the end of the newest split that was closed by the wall-clock time `since` (if there
        was one), then that of each that was closed after it up to `until`.
        """
        closed = [*self._closed]
        before = [end for at, end in closed if at <= since]
        return (*before[-1:], *(end for at, end in closed if since < at <= until))

    def write_until(self, now: Ns) -> None:
        """Writes every message that is received by `now`.

        Raises:
            OSError: the disk does not take it.
        """
        while self._next.log_time <= now:
            self._write(self._next)
            self._next = next(self._due)
        if self._split is not None:
            self._split.file.flush()

    def start(self) -> None:
        """Continues as time passes, in a thread of its own, until `stop`."""
        self._thread = threading.Thread(target=self._live, name="demo-recorder", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the recording as a clean shutdown does: a footer, and metadata.yaml.

        Raises:
            OSError: the disk does not take it.
        """
        self._ending.set()
        if self._thread is not None:
            self._thread.join(_STOP_WITHIN_S)
            self._thread = None
        if self._split is not None:
            self._close(self._split)
            self._split = None
            build_repairer().correct_metadata(self.directory)

    def _live(self) -> None:
        try:
            while not self._ending.wait(unix_from_ns(self._next.log_time - self._clock.now())):
                self.write_until(self._clock.now())
        except OSError as error:
            self.failure = error

    def _write(self, message: Message) -> None:
        at = message.log_time
        if self._split is None or at - self._split.first > self._duration:
            before, self._split = self._split, self._opened(at)
            if before is not None:
                self._close(before)
        split = self._split
        channel = split.channels[message.stream.topic]
        split.writer.add_message(channel, at, payload(message), message.publish_time, split.count)
        split.last = at
        split.count += 1

    def _opened(self, first: Ns) -> _Split:
        """Returns the next split, with all channels."""
        file = (self.directory / f"{self.directory.name}_{self.splits}.mcap").open("xb")
        self.splits += 1
        writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="ros2-memory demo")
        schemas = {
            name: writer.register_schema(name, "ros2msg", definition(name).encode())
            for name in dict.fromkeys(stream.type for stream in STREAMS)
        }
        channels: dict[str, int] = {}
        for stream in STREAMS:
            qos = {"offered_qos_profiles": yaml.safe_dump([_qos(stream)], sort_keys=False)}
            schema = schemas[stream.type]
            channels[stream.topic] = writer.register_channel(stream.topic, "cdr", schema, qos)
        return _Split(file, writer, channels, first, first)

    def _close(self, split: _Split) -> None:
        # Noted first: who sees the footer must find the split among the closed ones.
        self._closed.append((self._clock.now(), split.last))
        with split.file:
            split.writer.finish()


def _qos(stream: Stream) -> dict[str, JsonValue]:
    """Returns the QoS that the publisher offers, as rosbag2 records it."""
    return {
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
