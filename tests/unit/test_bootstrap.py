from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest
from mcp import Client

from ros2_memory import package_version
from ros2_memory.bootstrap import (
    build_memory,
    build_reader,
    build_server,
)
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import ConfigError
from tests.support.robot_run import ANSWERED, ask


def settings(bag_dir: Path, *overrides: str) -> Settings:
    return load_settings(overrides, {"MEMORY_BAG_DIR": str(bag_dir)})


def test_what_a_reader_refuses_is_told_in_its_own_words(tmp_path: Path) -> None:
    refused = settings(tmp_path, f"reader.custom_msg_paths=[{tmp_path}]")
    with pytest.raises(ConfigError, match=r"^reader\.custom_msg_paths: .* holds no"):
        build_reader(refused)


@pytest.mark.parametrize(
    ("override", "key", "expected"),
    [
        ("server.name=memory_two", "name", "memory_two"),
        ("data.time_tolerance_s=0.7", "tolerance", "default 0.7"),
    ],
)
async def test_the_server_is_built_as_configured(
    tmp_path: Path, override: str, key: str, expected: str
) -> None:
    chosen = settings(tmp_path, override)
    async with Client(build_server(chosen, build_memory(chosen))) as client:
        info = client.server_info
        assert info is not None
        texts = {
            "name": info.name,
            "tolerance": str([tool.description for tool in (await client.list_tools()).tools]),
        }
        assert info.version == version("ros2-memory") == package_version()
    assert expected in texts[key]


async def test_an_empty_memory_answers_every_question(tmp_path: Path) -> None:
    chosen = settings(tmp_path)
    async with Client(build_server(chosen, build_memory(chosen))) as client:
        for name, given, _ in ANSWERED:
            reply, is_error = await ask(client, name, given)
            assert not is_error
            if name == "list_recorded_topics":
                assert reply == []
            elif name not in {"data_time_range", "memory_status"}:
                assert reply["reason"] == "empty_memory", (name, reply)
