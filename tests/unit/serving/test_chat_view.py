"""What clients with MCP Apps find, and what others do not notice."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import anyio
from mcp import Client
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID

from ros2_memory.serving.mcp_server import TOOLS_WITH_VIEW, VIEW_URI, view
from tests.unit.serving.test_mcp_server import server

if TYPE_CHECKING:
    from pathlib import Path

MOST_BYTES = 300_000
LOADS = re.compile(
    r"\b(src|href)\s*=|@import|url\(|\bfetch\(|XMLHttpRequest|WebSocket|importScripts"
)


def seen_by_a_client(bag_dir: Path) -> dict[str, Any]:
    async def asked() -> dict[str, Any]:
        async with Client(server(bag_dir)) as client:
            listed = (await client.list_tools()).tools
            resources = (await client.list_resources()).resources
            [content] = (await client.read_resource(VIEW_URI)).contents
            return {
                "extensions": client.server_capabilities.extensions,
                "meta": {tool.name: tool.meta for tool in listed},
                "resources": [resource.uri for resource in resources],
                "content": content,
            }

    return anyio.run(asked)


def test_six_tools_name_the_view_which_is_read_and_not_listed(tmp_path: Path) -> None:
    seen = seen_by_a_client(tmp_path)
    meta = {"ui": {"resourceUri": VIEW_URI}}
    named = {name: own for name, own in seen["meta"].items() if own is not None}
    assert named == dict.fromkeys(TOOLS_WITH_VIEW, meta)
    assert len(TOOLS_WITH_VIEW) == 6
    assert VIEW_URI not in seen["resources"]
    assert EXTENSION_ID in seen["extensions"]
    content = seen["content"]
    assert (content.uri, content.mime_type) == (VIEW_URI, APP_MIME_TYPE)
    assert content.meta == {"ui": {"prefersBorder": True}}
    assert content.text == view().content


def test_the_document_is_one_file_that_loads_nothing() -> None:
    html = view().content
    assert isinstance(html, str)
    assert len(html.encode()) < MOST_BYTES
    assert html.count("<script>") == html.count("</script>") == html.count("<style>") == 1
    assert LOADS.findall(html) == []
