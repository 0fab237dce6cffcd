"""Recordings by `ros2 bag record`, under way and finished, for tests."""

from __future__ import annotations

import re
import signal
import subprocess
from typing import TYPE_CHECKING, Self

from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from tests.support.processes import PATIENCE_S
from tests.support.ros_processes import end, wait_for

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mcap.summary import Summary


class Recording:
    """A running `ros2 bag record`; what it says is in a file beside its directory."""

    def __init__(self, env: Mapping[str, str], directory: Path, *options: str) -> None:
        self.directory = directory
        self._log = directory.with_name(f"{directory.name}.log")
        self._log.parent.mkdir(parents=True, exist_ok=True)
        # Whatever this process inherited.
        signals = "--default-signal=INT,HUP"
        argv = ["env", signals, "ros2", "bag", "record", "-s", "mcap", "-o", str(directory)]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [*argv, *options], env=env, stdin=subprocess.DEVNULL, stderr=log
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        end(self.process)

    @property
    def said(self) -> str:
        return self._log.read_text()

    def await_said(self, *texts: str) -> None:
        """Returns once it has logged all of these."""
        wanted = ", ".join(texts)
        wait_for(lambda: all(text in self.said for text in texts), wanted, alive=self.process)

    def await_subscribed(self, *topics: str) -> None:
        self.await_said(*(f"Subscribed to topic '{topic}'" for topic in topics))

    def splits(self) -> list[Path]:
        """Its files, in the order of their numbers."""

        def number(file: Path) -> int:
            return int(re.findall(r"\d+", file.name.replace(self.directory.name, ""))[0])

        return sorted(self.directory.glob("*.mcap*"), key=number)

    def await_splits(self, count: int) -> None:
        """Returns once there are so many files, the last of them being written."""
        wait_for(lambda: len(self.splits()) >= count, f"{count} splits", alive=self.process)

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Sends the signal; the exit code, negative where a signal ended it."""
        self.process.send_signal(number)
        return self.process.wait(timeout=PATIENCE_S)


def messages(recording: Recording) -> list[tuple[str, int, int, bytes]]:
    """Topic, log time, publish time and payload of all its messages, in file order."""
    return [message for split in recording.splits() for message in in_file(split)]


def in_file(split: Path) -> list[tuple[str, int, int, bytes]]:
    """The same of one file."""
    topics: dict[int, str] = {}
    found: list[tuple[str, int, int, bytes]] = []
    with split.open("rb") as stream:
        records = list(StreamReader(stream).records)
    for record in records:
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics[record.channel_id]
            found.append((topic, record.log_time, record.publish_time, record.data))
    return found


def summary_of(file: Path) -> Summary:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def is_closed(file: Path) -> bool:
    """Whether the file has its footer."""
    return file.read_bytes().endswith(b"\x89MCAP0\r\n")
