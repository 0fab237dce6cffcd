"""A stand-in for the `ros2` program, for tests of what supervises it: no ROS, no network.

It "receives" messages that every one of its processes agrees on: on each topic one is published
every `STUB_PERIOD_MS` milliseconds of the wall clock, exactly at multiples of that. So two of them
that run side by side record the same messages, with the same publish times and other log times, as
two real recorders do. It splits when a message comes, closes a split after opening the next, writes
metadata.yaml at a clean end, and refuses a directory that exists.

Environment: STUB_PERIOD_MS, STUB_OPTIONS (what the help lists besides the common ones).
"""

import argparse
import os
import re
import signal
import sys
import time
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path

from mcap.writer import CompressionType, Writer

ENDED = False
LOST = "/events/rosbag2_messages_lost"
"""Its own topic, which it always offers; it loses nothing."""


def install(program: Path) -> None:
    """Makes this the program of that path, under the Python that runs the tests.

    It starts without what site-packages would have run first: coverage's swallows a signal that
    comes meanwhile, where a real recorder dies of it.
    """
    program.write_text(
        f"#!{sys.executable} -IS\n"
        "import runpy, sys\n"
        f"sys.path[:] = {sys.path!r}\n"
        f"runpy.run_path({__file__!r}, run_name='__main__')\n"
    )
    program.chmod(0o755)


def say(level: str, text: str, node: str = "rosbag2_recorder") -> None:
    now = time.time_ns()
    # Whoever read this may have died.
    with suppress(BrokenPipeError):
        sys.stderr.write(f"[{level}] [{now // 10**9}.{now % 10**9:09}] [{node}]: {text}\n")
        sys.stderr.flush()


class Split:
    """One MCAP file with a string channel for each topic."""

    def __init__(self, path: Path, topics: list[str]) -> None:
        self.stream: BufferedWriter = path.open("wb")
        self.writer = Writer(self.stream, chunk_size=256, compression=CompressionType.ZSTD)
        self.writer.start(profile="ros2", library="stub")
        schema = self.writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        self.channels = {
            topic: self.writer.register_channel(topic, "cdr", schema, {}) for topic in topics
        }
        self.first: int | None = None

    def add(self, topic: str, log_time: int, publish_time: int) -> None:
        text = b"%d" % publish_time
        payload = b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text + b"\0"
        self.writer.add_message(self.channels[topic], log_time, payload, publish_time)
        self.stream.flush()
        self.first = log_time if self.first is None else self.first

    def close(self) -> None:
        self.writer.finish()
        self.stream.close()


def record(directory: Path, split_s: float, pattern: str) -> None:
    if directory.exists():
        sys.exit(f"[ERROR] [ros2bag]: Output folder '{directory}' already exists.")
    offered = ("/odom", "/tf", "/tf_static", LOST)
    topics = [topic for topic in offered if re.search(pattern, topic)]
    period = int(os.environ.get("STUB_PERIOD_MS", "10")) * 10**6
    directory.mkdir(parents=True)
    number = 0
    split = Split(directory / f"{directory.name}_0.mcap", topics)
    sys.stderr.write("stdin is not a terminal device. Keyboard handling disabled.")
    say("INFO", "Press SPACE for pausing/resuming")
    say("INFO", "Recording...")
    time.sleep(0.2)
    done = time.time_ns() // period
    for topic in topics:
        say("INFO", f"Subscribed to topic '{topic}'")
    while not ENDED:
        now = time.time_ns()
        tick = now // period
        for published in range((done + 1) * period, (tick + 1) * period, period):
            if split.first is not None and now - split.first > split_s * 1e9:
                number += 1
                following = Split(directory / f"{directory.name}_{number}.mcap", topics)
                say("INFO", "Writing remaining messages from cache to the bag.", "rosbag2_cpp")
                split.close()
                split = following
            for topic in (each for each in topics if each != LOST):
                split.add(topic, time.time_ns(), published)
        done = max(done, tick)
        time.sleep(0.002)
    say("INFO", "Writing remaining messages from cache to the bag.", "rosbag2_cpp")
    split.close()
    (directory / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    say("INFO", "Recording stopped")


def end(_number: int, _frame: object) -> None:
    global ENDED  # noqa: PLW0603
    ENDED = True


def main() -> None:
    parser = argparse.ArgumentParser(prog="ros2 bag record")
    parser.add_argument("-s", "--storage", choices=["mcap", "sqlite3"])
    parser.add_argument("-d", "--max-bag-duration", type=int)
    parser.add_argument("-o", "--output")
    parser.add_argument("-e", "--regex")
    parser.add_argument("--qos-profile-overrides-path", type=argparse.FileType("r"))
    parser.add_argument("--storage-config-file", type=argparse.FileType("r"))
    parser.add_argument("--use-sim-time", action="store_true")
    for option in os.environ.get("STUB_OPTIONS", "").split():
        parser.add_argument(option, nargs="*")
    args = parser.parse_args(sys.argv[3:])
    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    record(Path(args.output), args.max_bag_duration, args.regex)


if __name__ == "__main__":
    main()
