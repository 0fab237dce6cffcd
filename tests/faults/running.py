"""A real server process, asked without a session: as much as a load and a fault need."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx2

from tests.faults.world import T0_S
from tests.support import served
from tests.support.processes import PATIENCE_S, until
from tests.support.served import Served


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
class Running(Served):
    """One run of the server: from its start until it is killed."""

    def health(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.get("/health")[1])
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
        headers = {"accept": "application/json", "mcp-protocol-version": "2025-06-18"}
        asked = httpx2.post(self.url("/mcp"), json=body, headers=headers, timeout=PATIENCE_S)
        reply = asked.raise_for_status().json()
        [block] = reply["result"]["content"]
        text = str(block["text"])
        late = "out of time" in text or "query_timeout" in text
        return None if late else text

    def ask_all(self, count: int) -> list[str]:
        return [self.ask(*question) for question in questions(count)]

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def logged(self, name: str) -> list[dict[str, Any]]:
        return [each for each in self.events() if each["event"] == name]


@contextmanager
def serving(bag_dir: Path, log: Path, *overrides: str, **more: str) -> Iterator[Running]:
    """The server for the time of the block; `more` joins its environment."""
    with served.serving(bag_dir, log, "reader.index_refresh_s=0.1", *overrides, **more) as found:
        yield Running(found.process, found.port, found.log)


@contextmanager
def load(running: Running, count: int) -> Iterator[list[str]]:
    """Clients that ask without pause; gives what they were answered, while it grows."""
    over = threading.Event()
    answered: list[str] = []

    def client(first: int) -> None:
        asked = questions(count)
        while not over.is_set():
            first += 1
            # The server is killed under them.
            with suppress(OSError, httpx2.HTTPError, AssertionError, ValueError):
                answered.append(running.ask(*asked[first % len(asked)]))
                continue
            return

    threads = [threading.Thread(target=client, args=(3 * nth,)) for nth in range(3)]
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
