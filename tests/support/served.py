"""The query server as its own process."""

import http.client
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.forked_commands import Forked
from tests.support.processes import PATIENCE_S, until

PROGRAM = (sys.executable, "-m", "ros2_memory.server", "data.now=latest")


def command(*overrides: str) -> list[str]:
    return [*PROGRAM, *overrides]


def env_without_ours() -> dict[str, str]:
    """This test's environment, without the user's own settings."""
    ours = ("MEMORY_", "MCP_", "ROS_")
    return {name: text for name, text in os.environ.items() if not name.startswith(ours)}


def environment(bag_dir: Path, **more: str) -> dict[str, str]:
    """The same, with a bag directory."""
    return env_without_ours() | {"MEMORY_BAG_DIR": str(bag_dir)} | more


@dataclass
class Served:
    """A running server, and what it logs."""

    process: subprocess.Popen[Any]
    port: int
    log: Path

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.port}{path}"

    def get(
        self, path: str, headers: Mapping[str, str] | None = None, method: str = "GET"
    ) -> tuple[int, bytes]:
        """Status and body of the response."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request(method, path, headers=headers or {})
            response = connection.getresponse()
            return response.status, response.read()
        finally:
            connection.close()

    def events(self) -> list[dict[str, Any]]:
        """What was logged so far; the last line may be on its way."""
        whole, _, _ = self.log.read_text().rpartition("\n")
        return [json.loads(line) for line in whole.splitlines()]


@contextmanager
def serving(
    bag_dir: Path, log: Path, *overrides: str, program: Sequence[str] = (), **more: str
) -> Iterator[Served]:
    """The server over HTTP on a free port, from when it listens.

    `program`: what is started; none: it is forked. `more` joins its environment.
    """
    env = environment(bag_dir, MCP_TRANSPORT="sse", MCP_PORT="0", **more)
    with log.open("wb") as stderr:
        process: subprocess.Popen[Any] = (
            subprocess.Popen([*program, *overrides], env=env, stdout=subprocess.PIPE, stderr=stderr)
            if program
            else Forked("ros2-memory-server", "data.now=latest", *overrides, env=env, stderr=stderr)
        )
    try:
        served = Served(process, 0, log)

        def port() -> int | None:
            assert process.poll() is None, log.read_text()
            heard = (each["port"] for each in served.events() if each["event"] == "listening")
            return next(heard, None)

        served.port = until(port)
        yield served
    finally:
        process.kill()
        process.communicate()


def refusal(program: Sequence[str], bag_dir: Path, **more: str) -> str:
    """What a server says that does not start."""
    ended = subprocess.run(
        program,
        env=environment(bag_dir, **more),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert (ended.returncode, ended.stdout) == (2, "")
    return ended.stderr
