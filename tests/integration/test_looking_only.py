"""Whatever only looks leaves a folder of other people's bags as it is, entry for entry."""

import io
import json
import os
import shutil
import sqlite3
import subprocess
from collections.abc import Mapping
from contextlib import closing, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import anyio
import pytest
from mcp import Client

from ros2_memory import cli
from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.columns.store import FILE
from tests.support.bags import McapLayout, odom, set_mtime, write_db3, write_mcap
from tests.support.column_worlds import store_file
from tests.support.housekeepers import recorded_before, state
from tests.support.processes import until
from tests.support.robot_run import T0, ask_everything, write_run
from tests.support.served import Served, env_without_ours, serving

COMMANDS = {
    "info": ["info"],
    "topics": ["topics"],
    "ask": ["ask", "list_recorded_topics"],
    "ask a search": ["ask", "find_last_match", "topic=/odom", "condition_type=contains", "value=x"],
    "ask for a moment": ["ask", "remember_moment", "label=x", "server.write_tools=true"],
    "doctor": ["doctor"],
    "watch": ["watch", "--count", "2", "--every", "0.1"],
    "index": ["index"],
    "export": ["export", "--mcap", "{out}/out.mcap", "--latched"],
    "forget": ["forget", "--last", "1", "--dry-run"],
    "config": ["config", "show"],
}
STORAGES = ("mcap", "rosbag2")


@pytest.fixture
def strangers(tmp_path: Path) -> Path:
    """Bags of every kind that no recorder of this program made, some of them left open."""
    folder = tmp_path / "strangers"
    write_run(folder)
    messages = [odom(T0 + n * 10**8, 1.0, 2.0) for n in range(50)]
    write_mcap(folder / "cut/cut_0.mcap", messages, McapLayout(chunk_size=400, finish=False))
    write_db3(folder / "lite/lite_0.db3", messages)
    (folder / "cut/empty.mcap").touch()
    # As a crash leaves it: the last messages are in the log beside it.
    before = write_db3(tmp_path / "wal.db3", messages)
    with closing(sqlite3.connect(before)) as base:
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("DELETE FROM messages WHERE id = 1")
        base.commit()
        (folder / "wal").mkdir()
        for name in ("wal.db3", "wal.db3-wal"):
            shutil.copy(tmp_path / name, folder / "wal" / name)
    for path in folder.rglob("*"):
        set_mtime(path, T0)
    return folder


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    """The shipped defaults, and a `ros2` that leaves a log with every run, as the real one does."""
    programs = tmp_path / "bin"
    programs.mkdir()
    ros2 = programs / "ros2"
    ros2.write_text('#!/bin/sh\nmkdir -p "$ROS_LOG_DIR" && date > "$ROS_LOG_DIR/ros2.log"\n')
    ros2.chmod(0o755)
    path = f"{programs}:{os.environ['PATH']}"
    return {**env_without_ours(), "PATH": path, "XDG_CACHE_HOME": str(tmp_path / "cache")}


def run(env: dict[str, str], bag_dir: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """What the program does with these words, in this process."""
    out, err = io.StringIO(), io.StringIO()
    here = {**env, "MEMORY_BAG_DIR": str(bag_dir)}
    with patch.dict(os.environ, here, clear=True), redirect_stdout(out), redirect_stderr(err):
        code = cli.main(command)
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


@pytest.mark.parametrize("storage", STORAGES)
def test_no_command_that_only_looks_writes_beside_strangers_bags(
    strangers: Path, tmp_path: Path, env: dict[str, str], storage: str
) -> None:
    before = state(strangers)
    env = {**env, "MEMORY_CONFIG_OVERRIDES": f"storage={storage}"}
    for name, command in COMMANDS.items():
        ran = run(env, strangers, *(each.format(out=tmp_path) for each in command))
        assert "Traceback" not in ran.stderr, (name, ran.stderr)
        assert state(strangers) == before, (name, ran.stdout, ran.stderr)
    assert (tmp_path / "out.mcap").stat().st_size
    assert [*(tmp_path / "cache").rglob(FILE)]


async def asked_everything(served: Served) -> None:
    async with Client(served.url("/mcp")) as client:
        await ask_everything(client, of_several_robots=True)


@pytest.mark.parametrize("storage", STORAGES)
async def test_no_server_with_the_shipped_defaults_writes_beside_strangers_bags(
    strangers: Path, tmp_path: Path, env: dict[str, str], storage: str
) -> None:
    before = state(strangers)
    with serving(strangers, tmp_path / "log", f"storage={storage}", **env) as served:
        await asked_everything(served)
        until(lambda: is_full(served))
        assert state(strangers) == before
    assert state(strangers) == before
    assert [*(tmp_path / "cache").rglob(FILE)]


def is_full(served: Served) -> bool:
    """Whether no bag waits to be stored."""
    return bool(json.loads(served.get("/health")[1])["store"]["state"] == "ready")


def times_stored(served: Served) -> int:
    """How often a bag was stored, by the server or its helper."""
    return sum(each["bags"] for each in served.events() if each["event"] == "bags_stored")


def numbered(file: Path) -> dict[str, int]:
    """The number of each stored bag; another one where it was stored anew."""
    with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True)) as base:
        return dict(base.execute("SELECT path, id FROM bag WHERE size >= 0").fetchall())


def test_when_a_recorder_comes_the_store_goes_beside_the_bags_with_all_it_holds(
    strangers: Path, tmp_path: Path, env: dict[str, str]
) -> None:
    beside = store_file(strangers)
    with serving(strangers, tmp_path / "log", "logging.level=debug", **env) as served:
        until(lambda: is_full(served))
        [cached] = (tmp_path / "cache").rglob(FILE)
        known = numbered(cached)
        assert known
        recorded_before(strangers)

        def is_moved() -> bool:
            moves = [each for each in served.events() if each["event"] == "database_moved"]
            return str(beside) in [each["path"] for each in moves]

        until(is_moved)
        assert numbered(beside) == known
        assert times_stored(served) == len(known)
        anyio.run(asked_everything, served)
        assert times_stored(served) == len(known)
    # Started where there is one already, it takes over what the cache holds just the same.
    shutil.rmtree(beside.parent)
    assert run(env, strangers, "info").returncode == 0
    assert numbered(beside) == known


def test_it_stays_in_the_cache_where_nothing_is_recorded_though_a_heartbeat_was_copied_along(
    strangers: Path, tmp_path: Path, env: dict[str, str]
) -> None:
    recorded_before(strangers)
    before = state(strangers)
    for preset in ("query_only", "replay"):
        ran = run({**env, "MEMORY_DEPLOYMENT": preset}, strangers, "index")
        assert "bags are stored" in ran.stderr
        assert state(strangers) == before
    assert (strangers / HEARTBEAT_FILE).is_file()


def unshared(found: Mapping[str, object]) -> dict[str, object]:
    """Without the files by which several programs use one SQLite file, which readers touch too."""
    return {path: each for path, each in found.items() if not path.endswith(("-shm", "-wal"))}


def test_what_a_recorders_preset_stored_serves_who_only_looks(
    strangers: Path, tmp_path: Path, env: dict[str, str]
) -> None:
    recorded_before(strangers)
    assert run({**env, "MEMORY_DEPLOYMENT": "robot"}, strangers, "index").returncode == 0
    stored = numbered(store_file(strangers))
    assert stored
    before = unshared(state(strangers))
    assert run({**env, "MEMORY_DEPLOYMENT": "replay"}, strangers, "index").returncode == 0
    assert unshared(state(strangers)) == before
    # This preset's reader also opens `.db3` files.
    [cached] = (tmp_path / "cache").rglob(FILE)
    found = numbered(cached)
    assert stored.items() < found.items()
    assert {path.rpartition(".")[2] for path in found.keys() - stored.keys()} == {"db3"}
    # And the first one's leaves them there.
    assert run({**env, "MEMORY_DEPLOYMENT": "local"}, strangers, "index").returncode == 0
    assert numbered(cached) == found
