"""The real server as a process of its own: how long to its first answer, how large it becomes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Self

from benchmarks import ours
from benchmarks.bags import ODOM, SCENE, SPLIT_NS
from benchmarks.footprint import resident_mb
from benchmarks.motion import NOWHERE
from benchmarks.payloads import NEVER_SEEN
from benchmarks.report import Figure

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

_MAX_MB: Final = 200.0
_HELLO: Final = {
    "protocolVersion": "2025-06-18",
    "capabilities": {},
    "clientInfo": {"name": "benchmark", "version": "0"},
}


class Served:
    """`ros2-memory-server` over stdio, from its start to its end."""

    def __init__(self, bag_dir: Path) -> None:
        argv = [sys.executable, "-m", "ros2_memory.server", *ours.overrides(bag_dir)]
        environment = {
            name: text
            for name, text in os.environ.items()
            if not name.startswith(("MEMORY_", "MCP_"))
        }
        self._process = subprocess.Popen(
            argv,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._asked = 0

    def __enter__(self) -> Self:
        """The server, greeted."""
        self._request("initialize", _HELLO)
        self._send({"jsonrpc": "2.0", "method": "notifications/initialized"})
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Ends it, as a client does: by closing its input."""
        self._wire(self._process.stdin).close()
        self._process.wait(timeout=30)
        self._wire(self._process.stdout).close()

    def ask(self, tool: str, arguments: Mapping[str, object]) -> str:
        """The text of one tool's reply.

        Raises:
            RuntimeError: the reply is an error, or there is none.
        """
        reply = self._request("tools/call", {"name": tool, "arguments": dict(arguments)})
        result = reply.get("result")
        if not isinstance(result, dict) or result.get("isError"):
            raise RuntimeError(f"{tool} was not answered: {reply}")
        return str(result["content"][0]["text"])

    def resident_mb(self, field: str) -> float:
        """Its resident memory, see `footprint.resident_mb`."""
        return resident_mb(field, str(self._process.pid))

    def processor_s(self) -> float:
        """The processor time that it has used, in seconds."""
        stat = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="ascii")
        user, system = stat.rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def _request(self, method: str, params: Mapping[str, object]) -> dict[str, object]:
        self._asked += 1
        self._send({"jsonrpc": "2.0", "id": self._asked, "method": method, "params": params})
        for line in self._wire(self._process.stdout):
            reply: dict[str, object] = json.loads(line)
            if reply.get("id") == self._asked:
                return reply
        raise RuntimeError(f"the server ended before it answered {method}")

    def _send(self, message: Mapping[str, object]) -> None:
        wire = self._wire(self._process.stdin)
        wire.write(json.dumps(message) + "\n")
        wire.flush()

    @staticmethod
    def _wire(stream: IO[str] | None) -> IO[str]:
        if stream is None:
            raise RuntimeError("the server was started without pipes")
        return stream


def figures(bag_dir: Path, bags: int, end: int) -> list[Figure]:
    """What a server over so many bags costs; `end` is where its history ends."""
    newest = (end - SPLIT_NS // 2) / 1e9
    begun = time.perf_counter()
    with Served(bag_dir) as server:
        server.ask("get_position_at", {"timestamp": newest})
        started = time.perf_counter() - begun
        place = {"x": NOWHERE[0], "y": NOWHERE[1]}
        server.ask("data_time_range", {})
        server.ask("list_recorded_topics", {})
        for topic, kind, value in (
            (SCENE.name, "contains", NEVER_SEEN),
            (ODOM.name, "near_position", place),
        ):
            asked = {"topic": topic, "condition_type": kind, "value": value}
            server.ask("find_last_match", asked)
        server.ask("trajectory_summary", {"start": newest - 86_400, "end": newest})
        resident, peak = server.resident_mb("VmRSS"), server.resident_mb("VmHWM")
    over = f"the server over {bags} bags"
    return [
        Figure("server-start", f"{over}: from exec to its first answer", started, "s"),
        Figure("server-rss", f"{over}: resident memory after six tools", resident, "MB", _MAX_MB),
        Figure("server-peak", f"{over}: peak of it", peak, "MB"),
    ]
