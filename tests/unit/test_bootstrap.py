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
    reading_of,
)
from ros2_memory.config import Settings, load_message_schemas, load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.robot_run import ANSWERED, ask


def settings(bag_dir: Path, *overrides: str) -> Settings:
    return load_settings(overrides, {"MEMORY_BAG_DIR": str(bag_dir)})


def test_the_storage_of_the_configuration_is_what_reads(tmp_path: Path) -> None:
    assert isinstance(build_reader(settings(tmp_path)), McapReader)
    assert isinstance(build_reader(settings(tmp_path, "storage=rosbag2")), Rosbag2Reader)
    # As the recorder has it, which reads each bag once.
    assert isinstance(build_reader(settings(tmp_path), cache_mb=2), McapReader)
    assert isinstance(
        build_reader(settings(tmp_path, "storage=rosbag2"), cache_mb=2), Rosbag2Reader
    )


def test_what_a_reader_refuses_is_told_in_its_own_words(tmp_path: Path) -> None:
    refused = settings(tmp_path, f"reader.custom_msg_paths=[{tmp_path}]")
    with pytest.raises(ConfigError, match=r"^reader\.custom_msg_paths: .* holds no"):
        build_reader(refused)


@pytest.mark.parametrize("preset", ["robot", "robot_live", "query_only", "replay", "local"])
def test_every_preset_uses_what_every_other_stored(tmp_path: Path, preset: str) -> None:
    plain, other = settings(tmp_path), settings(tmp_path, f"deployment={preset}")
    labels = settings(tmp_path, "data.min_score=0.5", "data.labels_file=null")
    schemas = load_message_schemas(plain)
    for each in (other, labels):
        assert reading_of(each, load_message_schemas(each)) == reading_of(plain, schemas)
    elsewhere = settings(tmp_path, "data.pose_topic=/amcl_pose")
    assert reading_of(elsewhere, schemas) != reading_of(plain, schemas)


def test_the_limits_of_the_configuration_reach_the_questions(tmp_path: Path) -> None:
    memory = build_memory(
        settings(
            tmp_path,
            "data.pose_topic=/amcl_pose",
            "data.time_tolerance_s=0.3",
            "data.position_tolerance_m=1.5",
            "data.now=latest",
            "data.tf_clock=log",
            "data.tf_topics=[/a,/b]",
            "data.max_plausible_speed_mps=3",
            "recording.split_duration_s=20",
        )
    )
    limits = memory.limits
    assert limits.pose_topic == "/amcl_pose"
    assert limits.time_tolerance_s == 0.3
    assert limits.position_tolerance_m == 1.5
    assert (limits.now, limits.tf_clock) == ("latest", "log")
    assert limits.tf_topics == ("/a", "/b")
    assert limits.tf_static_topics == ("/tf_static",)
    assert limits.max_plausible_speed_mps == 3
    assert limits.split_duration_s == 20


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
