"""The memory of a server over small bags that decompress to gigabytes, asked by a real client."""

import asyncio
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType
from mcp import Client
from mcp.client.sse import sse_client

from tests.support.bags import McapLayout, text, write_mcap
from tests.support.examples import LONG
from tests.support.processes import PATIENCE_S, until
from tests.support.served import PROGRAM, Served, serving

MB = 1 << 20
PROMISED_MB = 512
"""What docs/security.md states, for the whole process."""
CACHED_MB = 160
"""What may stay: chunks (32 MB), columns (48 MB), and what the C library keeps of each arena."""
AT_ONCE = 8
SHAPES = {
    "few": (24 if LONG else 2, 40 * MB, MB),
    "many": (3000 if LONG else 300, 400_000, MB),
    "together": (3000 if LONG else 160, 400_000, 60 * MB),
}
"""How many messages of how many bytes, and the size of a chunk."""
_BOTH = (CompressionType.ZSTD, CompressionType.LZ4)
TRIED = [*product(SHAPES, _BOTH)] if LONG else [*zip(("together", "few"), _BOTH, strict=True)]


def questions(count: int) -> list[tuple[str, dict[str, Any], str]]:
    """Tools, their arguments, and what the answer has."""
    match = {"topic": "/chatter", "condition_type": "contains"}
    return [
        ("find_last_match", {**match, "value": "0001a"}, "0001a"),
        ("get_topic_in_range", {"topic": "/chatter", "start": 0, "end": 1e6}, "0001a"),
        ("get_topic_at_time", {"topic": "/chatter", "timestamp": 2.0}, "0002a"),
        ("find_matches", {**match, "value": f"{count:04d}a"}, "last_seen"),
    ]


def memory_mb(served: Served, name: str) -> int:
    status = Path(f"/proc/{served.process.pid}/status").read_text()
    return int(next(line for line in status.splitlines() if name in line).split()[1]) >> 10


async def asked(client: Client, tool: str, given: dict[str, Any]) -> str:
    reply = await client.call_tool(tool, given)
    return "".join(getattr(block, "text", "") for block in reply.content)


async def ask_alone_and_at_once(served: Served, count: int) -> None:
    """Asks each question alone, then eight at once: each is answered with what is there."""
    asks = questions(count)
    transport = sse_client(served.url("/sse"), timeout=PATIENCE_S)
    async with Client(transport, read_timeout_seconds=PATIENCE_S) as client:
        tool, given, expected = asks[0]
        assert expected in await asked(client, tool, given)
        assert memory_mb(served, "VmHWM") < PROMISED_MB, "for one"
        eight = [asks[nth % len(asks)] for nth in range(AT_ONCE)]
        told = await asyncio.gather(*(asked(client, tool, given) for tool, given, _ in eight))
        for (tool, _, expected), reply in zip(eight, told, strict=True):
            assert expected in reply, (tool, reply[:300])
        assert memory_mb(served, "VmHWM") < PROMISED_MB, "for eight at once"


@pytest.mark.parametrize(("shape", "compression"), TRIED)
def test_a_small_bag_of_large_messages_takes_no_more_memory_than_promised(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    shape: str,
    compression: CompressionType,
) -> None:
    count, size, chunk_size = SHAPES[shape]
    said = (text(n * 10**9, f"{n:04d}" + "a" * size) for n in range(1, count + 1))
    bag = tmp_path / "bags" / "rec" / "rec_0.mcap"
    write_mcap(bag, said, McapLayout(chunk_size=chunk_size, compression=compression))
    assert bag.stat().st_size < count * size // 100
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with serving(
        bag.parent.parent, tmp_path / "log", "server.call_timeout_s=170", program=PROGRAM
    ) as served:
        before = memory_mb(served, "VmRSS")
        asyncio.run(ask_alone_and_at_once(served, count))
        until(lambda: memory_mb(served, "VmRSS") < before + CACHED_MB)
        assert memory_mb(served, "VmHWM") < PROMISED_MB, "afterwards"
