"""Writes records as rosbag2 lays splits out: `python -m tests.integration.split_writer`.

A line on stdin takes it one step further: the next split is opened, and the one before it closed.
It answers each with a line of JSON. The end of stdin ends the recording.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.writer import CompressionType

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.core.timebase import NS_PER_S, WallClock
from tests.support.bags import McapLayout, Msg, odom, text, tf, transform, write_mcap

if TYPE_CHECKING:
    from collections.abc import Sequence

SPLIT = 10 * NS_PER_S
DOCK = "/docked"
LAYOUT = McapLayout(
    chunk_size=4096,
    compression=CompressionType.ZSTD,
    latched=frozenset({"/tf_static", DOCK}),
)


@dataclass
class Split:
    """A bag file that reaches the disk in two parts, as a recorder's does."""

    path: Path
    content: bytes

    def open(self) -> None:
        self.path.write_bytes(self.content[: len(self.content) * 6 // 10])

    def close(self) -> None:
        with self.path.open("ab") as stream:
            stream.write(self.content[len(self.content) * 6 // 10 :])


@dataclass
class Recorder:
    """Writes splits that are dated from `begin` on."""

    bag_dir: Path
    begin: int
    splits_in_recording: int
    written: int = 0
    open_split: Split | None = None

    def step(self) -> dict[str, object]:
        number, nth = divmod(self.written, self.splits_in_recording)
        start = self.begin + self.written * SPLIT
        name = f"rec_{number:04d}"
        split = Split(self.bag_dir / name / f"{name}_{nth}.mcap", b"")
        messages = [*(self.latched(start) if nth == 0 else []), *driven(self.begin, start)]
        beside = self.bag_dir.parent / "whole.mcap"
        split.content = write_mcap(beside, messages, LAYOUT).read_bytes()
        self.tell(name)
        split.path.parent.mkdir(exist_ok=True)
        split.open()
        closed = self.close()
        self.open_split = split
        self.written += 1
        return {"opened": str(split.path), "size": len(split.content), "closed": closed}

    def latched(self, start: int) -> list[Msg]:
        """Published once, and received again by each recording."""
        at = self.begin
        where = text(at, "home", DOCK)
        fixed = transform(at, "base_link", "laser", (0.1, 0.0, 0.2))
        return [
            Msg(DOCK, where.type, start + 1, where.body, at),
            tf(at, fixed, topic="/tf_static", log_time=start + 2),
        ]

    def close(self) -> str | None:
        if self.open_split is None:
            return None
        self.open_split.close()
        path, self.open_split = self.open_split.path, None
        if self.written % self.splits_in_recording == 0:
            (path.parent / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
        return str(path)

    def tell(self, *recordings: str) -> None:
        now = WallClock().now()
        beat = Heartbeat(
            os.getpid(), now, RecorderState.RECORDING, recordings, now, 0, (), (), None, 3600.0
        )
        write_heartbeat(self.bag_dir, beat)


def driven(begin: int, start: int) -> list[Msg]:
    """Ten seconds of odometry, one metre a second, and a word a second."""
    times = [start + 10 + n * NS_PER_S // 5 for n in range(50)]
    moved = [odom(at, (at - begin) / NS_PER_S, 0.0, vx=1.0) for at in times]
    return [*moved, *(text(start + 20 + n * NS_PER_S, f"word {n}") for n in range(10))]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("bag_dir", type=Path)
    parser.add_argument("--begin", type=int, required=True)
    parser.add_argument("--splits-in-recording", type=int, default=5)
    given = parser.parse_args(argv)
    recorder = Recorder(given.bag_dir, given.begin, given.splits_in_recording)
    for _ in sys.stdin:
        print(json.dumps(recorder.step()), flush=True)  # noqa: T201
    recorder.close()
    recorder.tell()
    return 0


if __name__ == "__main__":
    sys.exit(main())
