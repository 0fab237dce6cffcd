"""The query server as its own process, and what it holds of the system."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tests.support.processes import until

if TYPE_CHECKING:
    from collections.abc import Iterator


class Held(NamedTuple):
    """What a process holds at one moment."""

    rss_mb: float
    threads: int
    files: int


class Served:
    """A running server."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: Path) -> None:
        self.process = process
        self.port = port
        self.log = log

    def held(self) -> Held:
        """Resident memory in MB, threads and file descriptors, as the kernel counts them."""
        proc = Path("/proc") / str(self.process.pid)
        status = (proc / "status").read_text(encoding="ascii", errors="replace")
        [rss] = [line.split()[1] for line in status.splitlines() if line.startswith("VmRSS:")]
        threads, files = (sum(1 for _ in (proc / name).iterdir()) for name in ("task", "fd"))
        return Held(int(rss) / 1024, threads, files)

    def events(self) -> Iterator[dict[str, Any]]:
        """What was logged so far; the last line may be on its way."""
        with self.log.open(encoding="utf-8") as lines:
            for line in lines:
                if line.endswith("\n"):
                    yield json.loads(line)

    def came_back_to(self, start: Held) -> Held:
        """Waits until there are no more files and threads than there were at the start."""

        def back() -> Held | None:
            held = self.held()
            return held if held.files <= start.files and held.threads <= start.threads else None

        try:
            return until(back)
        except AssertionError:
            raise AssertionError(f"{start} at the start, and {self.held()} at the end") from None


@contextmanager
def serving(bag_dir: Path, log: Path, *overrides: str) -> Iterator[Served]:
    """The server over HTTP on a free port, from when it listens; killed in the end."""
    ours = ("MEMORY_", "MCP_", "ROS_")
    env = {name: text for name, text in os.environ.items() if not name.startswith(ours)}
    env |= {"MEMORY_BAG_DIR": str(bag_dir), "MCP_TRANSPORT": "sse", "MCP_PORT": "0"}
    command = [sys.executable, "-m", "ros2_memory.server", "data.now=latest", *overrides]
    with log.open("wb") as stderr:
        process = subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=stderr)
    try:
        served = Served(process, 0, log)

        def port() -> int | None:
            assert process.poll() is None, log.read_text(encoding="utf-8")
            ports = [each["port"] for each in served.events() if each["event"] == "listening"]
            return ports[0] if ports else None

        served.port = until(port)
        yield served
    finally:
        process.kill()
        process.wait()
