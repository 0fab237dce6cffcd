"""A real server process, asked without a session: as much as a load and a fault need."""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.faults.world import T0_S
from tests.support.forked_commands import Forked
from tests.support.processes import PATIENCE_S, until

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


def questions(count: int) -> list[tuple[str, dict[str, Any]]]:
    """What is asked over and over: of points, of windows, and through the whole history."""
    end = T0_S + 10 * count
    seen: list[tuple[str, dict[str, Any]]] = [
        (
            "find_last_match",
            {"topic": "/vision/*", "condition_type": "contains", "value": wanted},
        )
        for wanted in ("thing3", "never", "cup", f"thing{count - 1}")
    ]
    return [
        *seen,
        ("list_recorded_topics", {}),
        ("list_frames", {}),
        ("get_topic_at_time", {"topic": "/odom", "timestamp": T0_S + 42}),
        ("get_topic_in_range", {"topic": "/odom", "start": T0_S, "end": end, "max_samples": 5}),
        ("trajectory_summary", {"start": T0_S, "end": end}),
    ]


@dataclass
class Running:
    """One run of the server: from its start until it is killed or stopped."""

    process: subprocess.Popen[bytes]
    port: int
    log: Path
    begun_s: float = field(default_factory=time.monotonic)

    def health(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self._request("GET", "/health", None))
        return found

    def ask(self, tool: str, given: dict[str, Any]) -> str:
        """The text of one answer.

        One that says that it ran out of time is right and partial, and asked for again: how fast
        the machine is, is not what is tested.
        """
        return until(partial(self._whole_answer, tool, given))

    def _whole_answer(self, tool: str, given: dict[str, Any]) -> str | None:
        call = {"name": tool, "arguments": given}
        body = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": call}
        reply = json.loads(self._request("POST", "/mcp", json.dumps(body)))
        [block] = reply["result"]["content"]
        text = str(block["text"])
        late = "out of time" in text or "query_timeout" in text
        return None if late else text

    def ask_all(self, count: int) -> list[str]:
        return [self.ask(*question) for question in questions(count)]

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def events(self, name: str) -> list[dict[str, Any]]:
        whole, _, _ = self.log.read_text(encoding="utf-8").rpartition("\n")
        said = [json.loads(line) for line in whole.splitlines() if line.startswith("{")]
        return [each for each in said if each["event"] == name]

    def _request(self, method: str, path: str, body: str | None) -> bytes:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        headers = {
            "Content-Type": "application/json",
            "Accept": "application/json, text/event-stream",
            "MCP-Protocol-Version": "2025-06-18",
        }
        try:
            connection.request(method, path, body, headers if body else {})
            response = connection.getresponse()
            answer = response.read()
            assert response.status == 200, answer
            return answer
        finally:
            connection.close()


def start(
    bag_dir: Path, log: Path, *overrides: str, environment: dict[str, str] | None = None
) -> Running:
    """Starts the server on a free port, and returns once it listens."""
    ours = ("MEMORY_", "MCP_", "ROS_")
    kept = {name: text for name, text in os.environ.items() if not name.startswith(ours)}
    env = kept | {"MEMORY_BAG_DIR": str(bag_dir), "MCP_TRANSPORT": "sse", "MCP_PORT": "0"}
    given = ("data.now=latest", "reader.index_refresh_s=0.1", *overrides)
    with log.open("wb") as stderr:
        process = Forked("ros2-memory-server", *given, env=env | (environment or {}), stderr=stderr)
    running = Running(process, 0, log)

    def listening() -> bool:
        assert process.poll() is None, log.read_text(encoding="utf-8")
        said = running.events("listening")
        running.port = said[0]["port"] if said else 0
        return bool(said)

    try:
        until(listening)
    except BaseException:
        running.kill()
        raise
    return running


@contextmanager
def serving(
    bag_dir: Path, log: Path, *overrides: str, environment: dict[str, str] | None = None
) -> Iterator[Running]:
    """The server for the time of the block."""
    running = start(bag_dir, log, *overrides, environment=environment)
    try:
        yield running
    finally:
        running.kill()


@contextmanager
def load(running: Running, count: int, clients: int = 3) -> Iterator[list[str]]:
    """Clients that ask without pause; gives what they were answered, while it grows."""
    over = threading.Event()
    answered: list[str] = []

    def client(first: int) -> None:
        asked = questions(count)
        while not over.is_set():
            first += 1
            # The server is killed under them.
            with suppress(OSError, http.client.HTTPException, AssertionError, ValueError):
                answered.append(running.ask(*asked[first % len(asked)]))
                continue
            return

    threads = [threading.Thread(target=client, args=(3 * nth,)) for nth in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield answered
    finally:
        over.set()
        for thread in threads:
            thread.join()


def children_of(bag_dir: Path) -> list[int]:
    """All processes that index this bag directory."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            number = int(entry.name)
            argv = (entry / "cmdline").read_bytes()
            settings = (entry / "environ").read_bytes()
            if b"ros2_memory.cli\0index" in argv and os.fsencode(bag_dir) + b"\0" in settings:
                found.append(number)
    return found


def is_alive(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{number}/status").read_text(encoding="utf-8")


def stop(numbers: Sequence[int]) -> None:
    for number in numbers:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
