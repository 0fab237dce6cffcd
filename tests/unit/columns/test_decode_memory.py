"""The memory that decoding takes, in long runs: a file of 10 GB, and 100 MB/s of images."""

from __future__ import annotations

import subprocess
import sys
from itertools import count
from typing import TYPE_CHECKING, Final

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from tests.support.bags import definition, header, make, odom, typestore
from tests.support.examples import LONG
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

MAX_MB: Final = 200
SCRIPT: Final = """
import sys
from pathlib import Path
from ros2_memory.columns.decode import undecoded
from ros2_memory.storage.mcap_reader import McapReader

def most_kb():  # not getrusage, whose peak a child inherits
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if "VmHWM" in line).split()[1])

before = most_kb()
rows = groups = 0
reader = McapReader()
for group in undecoded(reader, Path(sys.argv[1])):
    groups += 1
    rows += sum(map(len, group.tables()))
print(rows, groups, most_kb() - before >> 10)
"""

in_long_runs = pytest.mark.skipif(not LONG, reason="writes 10 GB; EPISODIC_LONG=1 runs it")


def decoded_apart(path: Path) -> tuple[int, int, int]:
    """Rows, groups and the MiB that decoding took, in a process of its own."""
    command = [sys.executable, "-c", SCRIPT, str(path)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    rows, groups, memory_mb = map(int, told.stdout.split())
    return rows, groups, memory_mb


def written(
    path: Path,
    kinds: Iterable[tuple[str, str, bytes, int]],
    total: int,
    compression: CompressionType,
) -> int:
    """Writes topics, types, payloads and how many of each follow each other, up to `total` bytes.

    In chunks as rosbag2 makes them by default. Returns how many messages there are.
    """
    times = count()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=768 << 10, compression=compression)
        writer.start(profile="ros2", library="test")
        channels = []
        for topic, kind, payload, many in kinds:
            schema = writer.register_schema(kind, "ros2msg", definition(kind).encode())
            channels.append((writer.register_channel(topic, "cdr", schema), payload, many))
        size = 0
        while size < total:
            for channel, payload, many in channels:
                for _ in range(many):
                    time = next(times)
                    writer.add_message(channel, time, payload, time)
                size += many * len(payload)
        writer.finish()
    return next(times)


def scan(beams: int) -> bytes:
    made = make(
        "sensor_msgs/msg/LaserScan",
        header=header(1, "laser"),
        angle_min=0.0,
        angle_max=1.0,
        angle_increment=0.1,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.1,
        range_max=20.0,
        ranges=np.linspace(0.1, 20.0, beams, dtype=np.float32),
        intensities=np.zeros(0, np.float32),
    )
    return bytes(typestore().serialize_cdr(made, "sensor_msgs/msg/LaserScan"))


@in_long_runs
@pytest.mark.parametrize(
    ("compression", "many"),
    [(CompressionType.NONE, (200, 20)), (CompressionType.ZSTD, (600, 1))],
    ids=["scans", "odometry"],
)
def test_a_file_of_10_gb_is_decoded_in_groups(
    tmp_path: Path, compression: CompressionType, many: tuple[int, int]
) -> None:
    path = tmp_path / "large.mcap"
    kinds = (
        ("/odom", "nav_msgs/msg/Odometry", odom(1, 0.0, 0.0).payload, many[0]),
        ("/scan", "sensor_msgs/msg/LaserScan", scan(10_000), many[1]),
    )
    messages = written(path, kinds, (10 if many[1] > 1 else 2) << 30, compression)
    rows, groups, memory_mb = decoded_apart(path)
    path.unlink()
    assert rows == messages
    assert groups > 10
    assert memory_mb < MAX_MB
