"""A conversation over streamable HTTP has a name, and nothing depends on it."""

from __future__ import annotations

import pytest

from tests.unit.serving.test_web_app import MCP_HEADERS, app, call_tool, client, running

HELLO = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {
        "protocolVersion": "2025-11-25",
        "capabilities": {},
        "clientInfo": {"name": "test", "version": "1"},
    },
}
HEADER = "mcp-session-id"


async def test_a_conversation_is_named_where_it_begins_and_each_otherwise() -> None:
    web = app()
    async with running(web), client(web) as http:
        names = [
            (await http.post("/mcp", json=HELLO, headers=MCP_HEADERS)).headers[HEADER]
            for _ in range(3)
        ]
    assert len(set(names)) == 3
    assert all(name.isalnum() and len(name) >= 32 for name in names)


async def test_a_client_that_has_a_name_is_given_no_other() -> None:
    web = app()
    async with running(web), client(web) as http:
        headers = MCP_HEADERS | {HEADER: "of-before-a-restart"}
        response = await http.post("/mcp", json=HELLO, headers=headers)
    assert response.status_code == 200
    assert HEADER not in response.headers


@pytest.mark.parametrize("given", [{}, {HEADER: "of-before-a-restart"}])
async def test_a_call_needs_no_name_and_takes_any(given: dict[str, str]) -> None:
    web = app()
    async with running(web), client(web) as http:
        response = await http.post("/mcp", json=call_tool("ask"), headers=MCP_HEADERS | given)
    assert response.status_code == 200
    assert HEADER not in response.headers
