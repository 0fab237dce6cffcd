"""The memory that decoding takes, in long runs: a file of 10 GB, and many small messages."""

import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Final

import pytest
from mcap.writer import CompressionType, Writer

from tests.support.bags import definition, octets, odom
from tests.support.examples import LONG
from tests.support.mcap_surgery import raw_mcap
from tests.support.memories import ROOT

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


@pytest.mark.skipif(not LONG, reason="writes 10 GB; EPISODIC_LONG=1 runs it")
@pytest.mark.parametrize(
    ("compression", "many", "size"),
    [(CompressionType.NONE, (200, 20), 10 << 30), (CompressionType.ZSTD, (600, 1), 2 << 30)],
    ids=["arrays", "odometry"],
)
def test_a_large_file_is_decoded_in_groups(
    tmp_path: Path, compression: CompressionType, many: tuple[int, int], size: int
) -> None:
    times = count()

    def fill(writer: Writer) -> None:
        channels = []
        for message, each in zip((odom(1, 0.0, 0.0), octets(1, bytes(40_000))), many, strict=True):
            text = definition(message.type).encode()
            schema = writer.register_schema(message.type, "ros2msg", text)
            channel = writer.register_channel(message.topic, "cdr", schema)
            channels += [(channel, message.payload)] * each
        left = size
        while left > 0:
            for channel, payload in channels:
                time = next(times)
                writer.add_message(channel, time, payload, time)
                left -= len(payload)

    path = raw_mcap(
        tmp_path / "a.mcap", fill, profile="ros2", chunk_size=768 << 10, compression=compression
    )
    # In a process of its own.
    command = [sys.executable, "-c", SCRIPT, str(path)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    rows, groups, memory_mb = map(int, told.split())
    path.unlink()
    assert rows == next(times)
    assert groups > 10
    assert memory_mb < MAX_MB
