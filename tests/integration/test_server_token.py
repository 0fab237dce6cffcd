"""The query server where others can reach it: no start and no answer without a token."""

import json
from pathlib import Path

import httpx2
from mcp import Client
from mcp.client.sse import sse_client
from mcp.client.streamable_http import streamable_http_client

from tests.support.processes import PATIENCE_S
from tests.support.robot_run import ask
from tests.support.served import Served, command, refusal, serving

GOOD = "kJ7-x._~+/0123456789=="
SHOWN = {"Authorization": f"Bearer {GOOD}"}
EVERYWHERE = ".".join("0000")


def test_it_does_not_start_without_a_token_where_others_can_reach_it(bag_dir: Path) -> None:
    said = refusal(command("server.transport=sse", "server.port=0"), bag_dir, MCP_HOST=EVERYWHERE)
    assert "MEMORY_API_TOKEN: missing" in said
    assert repr(EVERYWHERE) in said
    assert len(said.splitlines()) == 2


async def test_whoever_shows_the_token_is_answered_and_nobody_else(
    bag_dir: Path, tmp_path: Path
) -> None:
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    (credentials / "memory_api_token").write_text(GOOD + "\n")
    more = {"MCP_HOST": EVERYWHERE, "CREDENTIALS_DIRECTORY": str(credentials)}
    with serving(bag_dir, tmp_path / "log", "logging.level=debug", **more) as served:
        async with Client(
            sse_client(served.url("/sse"), headers=SHOWN, timeout=PATIENCE_S)
        ) as client:
            assert (await ask(client, "data_time_range", {}))[0]["bags"] == 1
        async with (
            httpx2.AsyncClient(headers=SHOWN) as shown,
            Client(streamable_http_client(served.url("/mcp"), http_client=shown)) as client,
        ):
            assert (await ask(client, "data_time_range", {}))[0]["bags"] == 1
        for path in ("/sse", "/mcp", "/messages/"):
            for headers in ({}, {"Authorization": "Bearer " + GOOD[:-1]}):
                assert served.get(path, headers, "POST")[0] == 401
        assert json.loads(served.get("/health")[1]) == {"status": "ok"}
        assert json.loads(served.get("/health", SHOWN)[1])["bags"] == 1
        _leave_traces(served)
    output = (tmp_path / "log").read_text(encoding="utf-8")
    assert '"event": "tool_call"' in output
    for secret in (GOOD, GOOD[:-2], "in-a-query"):
        assert secret not in output


def _leave_traces(served: Served) -> None:
    """Shows the token, and another, in every place that somebody may put into a log."""
    for path in (f"/sse?token={GOOD}", f"/mcp?access_token={GOOD}", "/health?token=in-a-query"):
        for headers in ({}, SHOWN | {"Host": "evil.example"}, SHOWN | {"Content-Length": "x"}):
            served.get(path, headers, "POST")
    served.get(f"/messages/?session_id={GOOD}", SHOWN, "POST")
    served.get(f"/messages/{GOOD}?session_id=in-a-query", SHOWN, "POST")
