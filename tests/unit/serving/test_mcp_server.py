"""What a client reads besides tools: resources and the prompt, over the whole house."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from mcp import Client
from mcp.shared.exceptions import MCPError
from mcp.types import INVALID_PARAMS, TextContent, TextResourceContents

from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import load_settings
from tests.support.robot_run import write_run

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.serving.mcp_server import EpisodicServer


def server(bag_dir: Path, *overrides: str) -> EpisodicServer:
    given = (f"recording.bag_dir={bag_dir}", "recorder=none", "data.now=latest", *overrides)
    settings = load_settings(given, {})
    return build_server(settings, build_memory(settings))


async def read(client: Client, uri: str) -> Any:
    [content] = (await client.read_resource(uri)).contents
    assert isinstance(content, TextResourceContents)
    assert content.mime_type == "application/json"
    return json.loads(content.text)


async def test_tools_that_may_take_long_are_marked_in_their_annotations(tmp_path: Path) -> None:
    async with Client(server(tmp_path)) as client:
        for tool in (await client.list_tools()).tools:
            assert tool.annotations is not None
            assert tool.annotations.read_only_hint
            marked = (tool.annotations.title or "").endswith(" (blocking)")
            assert marked == (tool.description or "").startswith("Blocking")
            assert (tool.title is None) == marked


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
        assert "trust" in await read(client, "episodic://status")
        assert await read(client, "episodic://moments") == {"moments": []}


async def test_the_fields_of_a_type_are_a_resource(tmp_path: Path) -> None:
    write_run(tmp_path)
    async with Client(server(tmp_path)) as client:
        [template] = (await client.list_resource_templates()).resource_templates
        assert template.uri_template == "episodic://schema/{type}"
        reply = await read(client, "episodic://schema/nav_msgs/msg/Odometry")
        assert reply["topics"] == ["/odom"]
        assert reply["fields"]["position.x"] == "number"
        again = await read(client, "episodic://schema/nav_msgs%2Fmsg%2FOdometry")
        assert again == reply
        seen = await read(
            client, "episodic://schema/ros2_vision_interfaces/msg/VisionDetectionArray"
        )
        assert seen["fields"]["detections.label"] == "text"


async def test_a_type_that_was_not_recorded_is_no_data(tmp_path: Path) -> None:
    write_run(tmp_path)
    async with Client(server(tmp_path)) as client:
        reply = await read(client, "episodic://schema/x/msg/Y")
        assert (reply["error"], reply["reason"]) == ("no_data", "topic_not_recorded")


@pytest.mark.parametrize("uri", ["episodic://nothing", "episodic://schema/", "file:///etc/passwd"])
async def test_there_are_no_other_resources(tmp_path: Path, uri: str) -> None:
    write_run(tmp_path)
    async with Client(server(tmp_path)) as client:
        with pytest.raises(MCPError) as refused:
            await client.read_resource(uri)
    assert refused.value.error.code == INVALID_PARAMS
    for named in (uri, "episodic://topics", "episodic://status", "episodic://schema/{type}"):
        assert named in refused.value.error.message


async def test_a_resource_that_is_not_offered_is_told_with_those_that_are(tmp_path: Path) -> None:
    async with Client(server(tmp_path, "server.tools=spec")) as client:
        for uri in ("episodic://status", f"episodic://{'x' * 10_000}"):
            with pytest.raises(MCPError) as refused:
                await client.read_resource(uri)
            assert refused.value.error.code == INVALID_PARAMS
            assert refused.value.error.message.endswith("what can be read: episodic://topics")
            assert len(refused.value.error.message) < 300


async def test_the_prompt_teaches_with_tools_that_there_are(tmp_path: Path) -> None:
    async with Client(server(tmp_path)) as client:
        [prompt] = (await client.list_prompts()).prompts
        got = await client.get_prompt(prompt.name)
        [message] = got.messages
        assert isinstance(message.content, TextContent)
        tools = {tool.name for tool in (await client.list_tools()).tools}
        for name in ("find_matches", "recap", "visits", "memory_status", "data_time_range"):
            assert name in tools
            assert name in message.content.text
        with pytest.raises(MCPError, match=prompt.name) as refused:
            await client.get_prompt("another")
    assert refused.value.error.code == INVALID_PARAMS


@pytest.mark.parametrize("which", ["spec", "all"])
@pytest.mark.parametrize(
    ("name", "given"), [("describe_type", {"type": "nav_msgs/msg/Odometry"}), ("list_moments", {})]
)
async def test_what_is_only_read_is_no_tool_and_named_by_none(
    tmp_path: Path, which: str, name: str, given: dict[str, Any]
) -> None:
    async with Client(server(tmp_path, f"server.tools={which}")) as client:
        result = await client.call_tool(name, given)
    [block] = result.content
    assert isinstance(block, TextContent)
    detail = json.loads(block.text)["detail"]
    assert f'there is no tool "{name}"' in detail
    assert name not in detail.partition(";")[2]


async def test_with_the_specifications_tools_alone_nothing_speaks_of_the_others(
    tmp_path: Path,
) -> None:
    write_run(tmp_path)
    async with Client(server(tmp_path, "server.tools=spec")) as client:
        assert len((await client.list_tools()).tools) == 17
        assert [str(each.uri) for each in (await client.list_resources()).resources] == [
            "episodic://topics"
        ]
        assert (await client.list_resource_templates()).resource_templates == []
        assert "find_matches" not in (client.instructions or "")
