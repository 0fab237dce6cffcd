"""What a client reads besides tools: resources, the prompt, and the view of MCP Apps."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from mcp.shared.exceptions import MCPError
from mcp.types import INVALID_PARAMS, TextResourceContents

from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import Settings, load_settings
from ros2_memory.history.context import QuerySettings
from ros2_memory.serving.mcp_server import VIEW_URI, EpisodicServer, view
from ros2_memory.tools.build import build_tools, readable_tools
from tests.support.housekeepers import made_moment
from tests.support.robot_run import CALLS, write_run


def settings_of(bag_dir: Path, *overrides: str) -> Settings:
    given = (f"recording.bag_dir={bag_dir}", "recorder=none", "data.now=latest", *overrides)
    return load_settings(given, {})


def server(bag_dir: Path, *overrides: str) -> EpisodicServer:
    settings = settings_of(bag_dir, *overrides)
    return build_server(settings, build_memory(settings))


async def read(client: Client, uri: str) -> Any:
    [content] = (await client.read_resource(uri)).contents
    assert isinstance(content, TextResourceContents)
    assert content.mime_type == "application/json"
    return json.loads(content.text)


async def test_hints_say_what_a_call_changes(tmp_path: Path) -> None:
    chosen = ("server.write_tools=true", "recorder=ros2bag")
    async with Client(server(tmp_path, *chosen)) as client:
        hints = {tool.name: tool.annotations for tool in (await client.list_tools()).tools}
    assert all(hint and hint.open_world_hint is False for hint in hints.values())
    writing = {name for name, hint in hints.items() if hint and not hint.read_only_hint}
    assert writing == {"remember_moment"}
    keeping = hints["remember_moment"]
    # It adds a moment at each call, and removes nothing.
    assert keeping
    assert (keeping.destructive_hint, keeping.idempotent_hint) == (False, False)


async def test_topics_and_status_are_resources(tmp_path: Path) -> None:
    write_run(tmp_path)
    async with Client(server(tmp_path)) as client:
        listed = (await client.list_resources()).resources
        assert [str(each.uri) for each in listed] == [
            "episodic://topics",
            "episodic://status",
            "episodic://moments",
        ]
        assert "/odom" in {row["topic"] for row in await read(client, "episodic://topics")}
        assert "doubts" in await read(client, "episodic://status")
        assert (await read(client, "episodic://moments"))["moments"] == []


@pytest.mark.parametrize(
    ("uri", "offered"),
    [
        *(
            (uri, "all")
            for uri in ("episodic://nothing", "episodic://schema/", "file:///etc/passwd")
        ),
        *((uri, "spec") for uri in ("episodic://status", f"episodic://{'x' * 10_000}")),
    ],
)
async def test_there_are_no_other_resources_than_those_that_are_told(
    tmp_path: Path, uri: str, offered: str
) -> None:
    async with Client(server(tmp_path, f"server.tools={offered}")) as client:
        with pytest.raises(MCPError) as refused:
            await client.read_resource(uri)
    code, told = refused.value.error.code, refused.value.error.message
    assert (code, uri[:30] in told, len(told) < 300) == (INVALID_PARAMS, True, True)
    named = told.partition("; the resources are: ")[2].split(", ")
    assert named[0] == "episodic://topics"
    more = {"episodic://status", "episodic://schema/{type}"}
    assert more & {*named} == (more if offered == "all" else set())


async def test_no_tool_names_another_that_is_not_offered(tmp_path: Path) -> None:
    write_run(tmp_path)
    tools = [*build_tools(QuerySettings(), writing=True), *readable_tools()]
    # But for words of English that replies use for keys.
    known = {tool.name for tool in tools} - {"visits", "compare", "recap"}
    async with Client(server(tmp_path, "server.tools=spec")) as client:
        listed = (await client.list_tools()).tools
        assert len(listed) == 17
        [resource] = (await client.list_resources()).resources
        assert str(resource.uri) == "episodic://topics"
        assert (await client.list_resource_templates()).resource_templates == []
        [prompt] = (await client.list_prompts()).prompts
        [message] = (await client.get_prompt(prompt.name)).messages
        read = [tool.model_dump_json() for tool in listed]
        read += [client.instructions or "", message.model_dump_json()]
        for name, given in CALLS:
            if name not in known - {tool.name for tool in listed}:
                read.append(str((await client.call_tool(name, given)).content))
    lacking = known - {tool.name for tool in listed}
    assert [(name, text) for name in lacking for text in read if name in text] == []
    # The words that are left out above: as names of tools they follow a colon.
    assert [text for text in read if re.search(r": (visits|compare|recap)\b", text)] == []


async def test_one_moment_is_a_resource(tmp_path: Path) -> None:
    write_run(tmp_path)
    name = "20260921T101320Z-here"
    made_moment(tmp_path / "moments" / name)
    async with Client(server(tmp_path)) as client:
        shown = await read(client, f"episodic://moments/{name}")
        [listed] = (await read(client, "episodic://moments"))["moments"]
        assert shown == {"now": shown["now"], **listed}
        assert (shown["moment"], shown["label"]) == (name, "here")
        refused = await read(client, "episodic://moments/there")
    assert refused["error"] == "invalid_arguments"
    assert name in refused["detail"]


async def test_a_moment_can_be_saved_only_where_something_records(tmp_path: Path) -> None:
    async with Client(server(tmp_path, "server.write_tools=true")) as client:
        assert "remember_moment" not in {each.name for each in (await client.list_tools()).tools}
        refused = await client.call_tool("remember_moment", {"label": "x"})
        assert "remember_moment is not offered here: it needs a recorder" in str(refused.content)


MOST_BYTES = 300_000
DRAWN = {"recap", "visits", "find_things", "find_matches", "trajectory_summary", "compare"}
LOADS = re.compile(
    r"\b(src|href)\s*=|@import|url\(|\bfetch\(|XMLHttpRequest|WebSocket|importScripts"
)


async def test_six_tools_name_the_view_which_is_read_and_not_listed(tmp_path: Path) -> None:
    async with Client(server(tmp_path)) as client:
        tools = (await client.list_tools()).tools
        resources = (await client.list_resources()).resources
        [content] = (await client.read_resource(VIEW_URI)).contents
        assert EXTENSION_ID in (client.server_capabilities.extensions or {})
    named = {tool.name: tool.meta for tool in tools if tool.meta is not None}
    assert set(named) == DRAWN
    assert all(meta == {"ui": {"resourceUri": VIEW_URI}} for meta in named.values())
    assert VIEW_URI not in {resource.uri for resource in resources}
    assert isinstance(content, TextResourceContents)
    assert (content.uri, content.mime_type) == (VIEW_URI, APP_MIME_TYPE)
    assert content.meta == {"ui": {"prefersBorder": True}}
    assert content.text == view().content


def test_the_document_is_one_file_that_loads_nothing() -> None:
    html = view().content
    assert isinstance(html, str)
    assert len(html.encode()) < MOST_BYTES
    assert html.count("<script>") == html.count("</script>") == html.count("<style>") == 1
    assert LOADS.findall(html) == []
