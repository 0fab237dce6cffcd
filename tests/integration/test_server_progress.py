"""Progress of a call reaches the client over every transport, from a server in its own process."""

import json
import sys
from pathlib import Path
from typing import Any

import anyio
import httpx2
import pytest
from mcp import Client
from mcp.client.sse import sse_client
from mcp.types import TextContent

from tests.support.processes import PATIENCE_S
from tests.support.robot_run import write_run
from tests.support.served import Served, serving

REPORTS = 2
SLOW = "list_frames"
PROGRAM = f"""
import sys

import anyio

from ros2_memory import server
from ros2_memory.serving import mcp_server
from ros2_memory.serving.dispatch import Dispatcher

reported = 0
answer, report = Dispatcher.answer, mcp_server.EpisodicServer._report_progress

async def answer_late(self, name, *given, **options):
    global reported
    reported = 0
    while name == {SLOW!r} and reported < {REPORTS}:
        await anyio.sleep(0.001)
    return await answer(self, name, *given, **options)

async def count(self, send):
    async def counted(*progress):
        global reported
        await send(*progress)
        reported += 1
    await report(self, counted)

mcp_server.PROGRESS_EVERY_S = 0.001
Dispatcher.answer = answer_late
mcp_server.EpisodicServer._report_progress = count
sys.exit(server.main())
"""
"""The server, with a tool that answers once two reports of its progress were sent."""


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("history") / "bags"
    write_run(folder)
    return folder


def command() -> list[str]:
    return [sys.executable, "-c", PROGRAM, "data.now=latest"]


async def asked_for_progress(client: Client) -> None:
    reports: list[float] = []
    received = anyio.Event()

    async def note(progress: float, total: float | None, message: str | None) -> None:
        del total, message
        reports.append(progress)
        if len(reports) == REPORTS:
            received.set()

    with anyio.fail_after(PATIENCE_S):
        result = await client.call_tool(SLOW, {}, progress_callback=note)
        await received.wait()
    [block] = result.content
    assert isinstance(block, TextContent)
    assert "frames" in json.loads(block.text)
    assert reports[:REPORTS] == [1, 2]


def posted(served: Served, name: str, accept: str, **meta: object) -> Any:
    call = {"name": name, "arguments": {}, **({"_meta": meta} if meta else {})}
    body = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": call}
    return httpx2.post(
        served.url("/mcp"), json=body, headers={"accept": accept}, timeout=PATIENCE_S
    )


BOTH = "application/json, text/event-stream"


async def test_over_sse_and_streamable_http(bag_dir: Path, tmp_path: Path) -> None:
    with serving(bag_dir, tmp_path / "log", program=command()) as served:
        async with Client(sse_client(served.url("/sse"), timeout=PATIENCE_S)) as client:
            await asked_for_progress(client)
        async with Client(served.url("/mcp")) as client:
            await asked_for_progress(client)
        async with Client(served.url("/mcp"), mode="legacy") as client:
            await asked_for_progress(client)
        streamed = posted(served, SLOW, BOTH, progressToken="mine")
        assert streamed.headers["content-type"].startswith("text/event-stream")
        told = [json.loads(line[6:]) for line in streamed.text.splitlines() if line[:6] == "data: "]
        assert [each["params"]["progressToken"] for each in told[:-1]] == ["mine"] * (len(told) - 1)
        plain = posted(served, SLOW, "application/json", progressToken="mine")
        unasked = posted(served, "list_recorded_topics", BOTH)
        for each in (plain, unasked):
            assert each.headers["content-type"] == "application/json"
            assert each.json()["result"]["content"]
