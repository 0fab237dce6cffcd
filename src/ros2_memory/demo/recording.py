"""Writes a recording of the simulated robot with the layout of `ros2 bag record`.

A directory with splits `<name>_<i>.mcap` (profile `ros2`, CDR, ros2msg definitions with all nested
ones, the publishers' QoS on each channel, every channel in every split, zstd chunks small enough
that data reaches the disk within seconds), and at a clean close `metadata.yaml`. A split ends when
a message arrives more than the split duration after its first message, and gets its footer just
after the next one was opened.
"""

from __future__ import annotations

import threading
from typing import IO, TYPE_CHECKING, Final, Self

import yaml
from mcap.writer import CompressionType, Writer

from ros2_memory.bootstrap import build_repairer
from ros2_memory.core.timebase import Ns, WallClock, ns_from_unix, unix_from_ns
from ros2_memory.demo.messages import definition, payload
from ros2_memory.demo.published_topics import STREAMS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Clock
    from ros2_memory.demo.published_topics import Message, MessageSchedule, Stream

_CHUNK_BYTES: Final = 16 * 1024
_FOR_EVER: Final[dict[str, JsonValue]] = {"sec": 9223372036, "nsec": 854775807}
_STOP_WITHIN_S: Final = 10.0


class SplitWriter:
    """Writes one MCAP file; `first` and `last` are log times, None while empty."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.first: Ns | None = None
        self.last: Ns | None = None
        self.count = 0
        self._file: IO[bytes] = path.open("xb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="ros2-memory demo")
        schemas = {
            name: self._writer.register_schema(name, "ros2msg", definition(name).encode())
            for name in dict.fromkeys(stream.type for stream in STREAMS)
        }
        self._channels = {
            stream.topic: self._writer.register_channel(
                stream.topic,
                "cdr",
                schemas[stream.type],
                {"offered_qos_profiles": yaml.safe_dump([_qos(stream)], sort_keys=False)},
            )
            for stream in STREAMS
        }

    def full(self, log_time: Ns, duration: Ns) -> bool:
        """Returns whether a message of this log time belongs into the next split."""
        return self.first is not None and log_time - self.first > duration

    def add(self, message: Message) -> None:
        """Appends one message."""
        self._writer.add_message(
            self._channels[message.stream.topic],
            message.log_time,
            payload(message),
            message.publish_time,
            self.count,
        )
        self.first = message.log_time if self.first is None else self.first
        self.last = message.log_time
        self.count += 1

    def flush(self) -> None:
        """Passes every finished chunk to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Writes the last chunk, the summary and the footer."""
        try:
            self._writer.finish()
        finally:
            self._file.close()


class DemoRecorder:
    """Writes a `MessageSchedule` into `directory`: at once up to now, then as time passes.

    The directory must not exist (as with `ros2 bag record`); its name is the recording's. As a
    context manager it stops at the end of the block, and leaves a cleanly closed recording.
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
        self._duration = ns_from_unix(split_duration_s)
        self._clock = clock or WallClock()
        self._due: Iterator[Message] = timeline.everything()
        self._next = next(self._due)
        self._splits: list[SplitWriter] = []
        self._closed: list[tuple[Ns, Ns]] = []
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: OSError | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def failure(self) -> OSError | None:
        """The error that ended the live recording early, such as a full disk."""
        return self._failure

    @property
    def splits(self) -> int:
        """The number of files; all but the last are closed, and `stop` closes that."""
        return len(self._splits)

    def closed_ends(self, since: Ns, until: Ns) -> tuple[Ns, ...]:
        """Returns the ends of closed splits: the log times of their last messages.

        First the end of the newest split that was closed by the wall-clock time `since` (if there
        was one), then that of each that was closed after it up to `until`.
        """
        closed = list(self._closed)
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
        if self._splits:
            self._splits[-1].flush()

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
        still_open = self._splits[len(self._closed) :]
        for split in still_open:
            self._close(split)
        if still_open:
            build_repairer().correct_metadata(self.directory)

    def _live(self) -> None:
        try:
            while not self._ending.wait(unix_from_ns(self._next.log_time - self._clock.now())):
                self.write_until(self._clock.now())
        except OSError as error:
            self._failure = error

    def _write(self, message: Message) -> None:
        if not self._splits or self._splits[-1].full(message.log_time, self._duration):
            name = f"{self.directory.name}_{len(self._splits)}.mcap"
            self._splits.append(SplitWriter(self.directory / name))
            if len(self._splits) > 1:
                self._close(self._splits[-2])
        self._splits[-1].add(message)

    def _close(self, split: SplitWriter) -> None:
        # Noted first: who sees the footer must find the split among the closed ones.
        self._closed.append((self._clock.now(), split.last or self.timeline.start))
        split.close()


def _qos(stream: Stream) -> dict[str, JsonValue]:
    """Returns the QoS that the publisher offers, as rosbag2 records it."""
    return {
        "history": "unknown",
        "depth": 0,
        "reliability": "reliable" if stream.reliable else "best_effort",
        "durability": "transient_local" if stream.latched else "volatile",
        "deadline": dict(_FOR_EVER),
        "lifespan": dict(_FOR_EVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOR_EVER),
        "avoid_ros_namespace_conventions": False,
    }
