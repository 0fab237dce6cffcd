import os
from importlib.metadata import version
from pathlib import Path

import pytest
from mcp import Client

from ros2_memory import package_version
from ros2_memory.bootstrap import build_backfill, build_memory, build_reader, build_server
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import ConfigError
from tests.support.robot_run import ANSWERED, T0_S, ask, write_run


def settings(bag_dir: Path, *overrides: str) -> Settings:
    return load_settings(overrides, {"MEMORY_BAG_DIR": str(bag_dir)})


def test_what_a_reader_refuses_is_told_in_its_own_words(tmp_path: Path) -> None:
    refused = settings(tmp_path, f"reader.custom_msg_paths=[{tmp_path}]")
    with pytest.raises(ConfigError, match=r"^reader\.custom_msg_paths: .* holds no"):
        build_reader(refused)


async def test_the_server_is_built_as_configured(tmp_path: Path) -> None:
    chosen = settings(tmp_path, "server.name=memory_two", "data.time_tolerance_s=0.7")
    async with Client(build_server(chosen, build_memory(chosen))) as client:
        info, tools = client.server_info, (await client.list_tools()).tools
    assert info is not None
    assert (info.name, info.version) == ("memory_two", version("ros2-memory"))
    assert info.version == package_version()
    assert "default 0.7" in str([tool.description for tool in tools])


def test_a_memory_stores_columns_unless_it_is_told_not_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    bag_dir = tmp_path / "bags"
    bag_dir.mkdir()
    without = settings(bag_dir, "recorder=none", "store.enabled=false")
    memory = build_memory(without)
    assert memory.scanner.store is None
    assert build_backfill(without, memory).filling is None
    store = build_memory(settings(bag_dir, "recorder=none")).scanner.store
    assert store is not None
    assert store.path is not None
    assert store.path.is_relative_to(tmp_path / "cache")


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


@pytest.mark.parametrize("lost", ["from the start", "after a look", "the recorder's files"])
async def test_where_the_disk_does_not_tell_no_question_is_an_internal_error(
    tmp_path: Path, lost: str
) -> None:
    """As at a mount whose robot is gone. Here a link leads to a name that is too long."""
    write_run(tmp_path / "run")
    for path in (tmp_path / "run").rglob("*.mcap"):
        os.utime(path, (T0_S - 3600, T0_S - 3600))  # nobody writes it any more
    bag_dir = tmp_path / "bags"
    bag_dir.symlink_to(tmp_path / "run")
    chosen = settings(bag_dir, "recorder=none", "data.now=latest", "reader.index_refresh_s=1000")
    memory = build_memory(chosen)
    if lost == "after a look":
        memory.index.snapshot()
    own = tmp_path / "run" / ".episodic"
    out_of_reach = own if lost == "the recorder's files" else bag_dir
    out_of_reach.unlink(missing_ok=True)
    out_of_reach.symlink_to("x" * 300)
    async with Client(build_server(chosen, memory)) as client:
        for name, given, _ in ANSWERED:
            reply, _ = await ask(client, name, given)
            assert "internal" not in str(reply), (name, reply)
        asked = {"topic": "/vision/*/scene_objects", "condition_type": "contains", "value": "x"}
        reply, _ = await ask(client, "find_last_match", asked)
    if lost == "the recorder's files":
        assert ".episodic cannot be read: what was lost or deleted is not known" in reply["notes"]
    filler = build_backfill(chosen, memory)
    for batch in filler.batches():
        filler.store(batch)
    filler.prune()
