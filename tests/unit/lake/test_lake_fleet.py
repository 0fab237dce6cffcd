"""A fleet's server with a lake: what was shipped answers, also where no bag is left."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from random import Random

import anyio
import pytest
import structlog

from ros2_memory import cli
from ros2_memory.bootstrap_fleet import build_fleet, engine_of
from ros2_memory.config import DuckdbNode, load_settings
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.fleet.robots import Fleet
from ros2_memory.history.context import Call
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.lake.engines.base import DataFiles
from ros2_memory.lake.tables import TABLES
from ros2_memory.server import keep_fleet_fresh
from tests.support.bags import text, write_mcap
from tests.support.fleets import SEEN, reply
from tests.support.lakes import START_S, ship_from, write_bag

CUP: dict[str, object] = {"topic": SEEN, "condition_type": "contains", "value": "cup"}


def overrides(folder: Path, engine: str) -> list[str]:
    robots = ", ".join(f"{name}: {folder / name}" for name in ("hall", "attic"))
    return [
        "deployment=fleet",
        f"fleet.robots={{{robots}}}",
        f"lake={engine}",
        f"lake.warehouse={folder / 'lake'}",
    ]


def served(folder: Path) -> Fleet:
    """The fleet of a server with a lake."""
    fleet = build_fleet(load_settings(overrides(folder, "duckdb"), {}))
    assert fleet is not None
    return fleet


def test_a_robot_whose_bags_are_gone_is_answered_from_the_lake(tmp_path: Path) -> None:
    for name in ("hall", "attic"):
        write_bag(tmp_path / name, 0)
    ship_from(tmp_path, "hall", "attic")
    shutil.rmtree(tmp_path / "hall")
    fleet = served(tmp_path)
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == {"hall", "attic"}
    assert found["notes"][-1].startswith("from the lake, which has what was shipped: ")
    assert fleet.robots["attic"].is_mounted
    assert not fleet.robots["hall"].is_mounted


@pytest.mark.parametrize("left", [0, 1], ids=["none", "the newest"])
def test_what_retention_deleted_of_a_mounted_robot_is_answered_from_the_lake(
    tmp_path: Path, left: int
) -> None:
    bags = [write_bag(tmp_path / "hall", number) for number in range(2)]
    ship_from(tmp_path)
    for bag in bags[: 2 - left]:
        bag.unlink()
    fleet = served(tmp_path)
    asked = {"robot": "hall", "topic": "/chatter"}
    old = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 1})
    assert old["value"] == {"value": "n1"}
    assert old["notes"][-1].startswith("from the lake")
    new = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 11})
    assert new["value"] == {"value": "n101"}
    assert ("notes" in new) is not left
    found = reply(fleet, "data_time_range", {"robot": "hall"})
    assert found["earliest"] == (START_S + 10 if left else START_S)
    nothing = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 500})
    assert nothing["error"] == "no_data"
    assert ("lake" in json.dumps(nothing)) is not left


def test_a_lake_that_cannot_be_read_leaves_the_robot_its_own_answer(tmp_path: Path) -> None:
    bags = [write_bag(tmp_path / "hall", number) for number in range(2)]
    ship_from(tmp_path)
    bags[0].unlink()
    fleet = served(tmp_path)
    for file in (tmp_path / "lake").rglob("*.parquet"):
        file.unlink()
    asked = {"robot": "hall", "topic": "/chatter"}
    assert "notes" not in reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 11})
    old = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 1})
    assert old["error"] == "no_data"
    assert any("the lake has no answer either: " in note for note in old["notes"])


def test_an_emptied_folder_does_not_hide_that_the_lake_has_times_alone(tmp_path: Path) -> None:
    write_bag(tmp_path / "hall", 0)
    draw = Random(0)
    long = [
        text((START_S + nth) * NS_PER_S, draw.randbytes(2000).hex(), "/camera") for nth in range(30)
    ]
    write_mcap(tmp_path / "hall" / "rec" / "rec_1.mcap", long)
    ship_from(tmp_path)
    for bag in (tmp_path / "hall").rglob("*.mcap"):
        bag.unlink()
    fleet = served(tmp_path)
    asked = {"robot": "hall", "topic": "/camera", "timestamp": START_S + 5}
    assert reply(fleet, "get_topic_at_time", asked)["error"] == "not_in_lake"
    asked = {"robot": "hall", "topic": "/camera", "condition_type": "contains", "value": "x"}
    assert reply(fleet, "find_last_match", asked)["error"] == "not_in_lake"


def test_a_mounted_robot_that_was_never_shipped_is_answered_from_its_bags(tmp_path: Path) -> None:
    for name in ("hall", "attic"):
        write_bag(tmp_path / name, 0)
    ship_from(tmp_path)
    fleet = served(tmp_path)
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == {"hall", "attic"}
    [note] = found["notes"]
    assert note.startswith("from the lake, which has what was shipped: hall up to ")
    assert "attic" not in note
    assert reply(fleet, "find_things", {"robot": "attic"})["robot_name"] == "attic"


def test_a_lake_without_a_bag_is_reported(tmp_path: Path) -> None:
    """As one is that was given by a wrong path."""
    write_bag(tmp_path / "hall", 0)
    with structlog.testing.capture_logs() as logs:
        served(tmp_path)
    assert [each["warehouse"] for each in logs if each["event"] == "lake_empty"] == [
        str(tmp_path / "lake")
    ]
    ship_from(tmp_path)
    with structlog.testing.capture_logs() as logs:
        build_fleet(load_settings(overrides(tmp_path, "duckdb"), {}))
    assert "lake_empty" not in {each["event"] for each in logs}


def test_the_command_line_asks_a_lake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    shutil.rmtree(tmp_path / "hall")
    settings = [*overrides(tmp_path, "duckdb"), "+lake.properties={x.y: z}"]
    question = [f"{key}={value}" for key, value in CUP.items()]
    capsys.readouterr()
    assert cli.main(["ask", "--json", "find_last_match", *settings, *question]) == 0
    [match] = json.loads(capsys.readouterr().out)["matches"]
    assert match["robot_name"] == "hall"


def test_a_robot_that_only_the_lake_knows_is_asked_unless_a_token_forbids_it(
    tmp_path: Path,
) -> None:
    names = ("attic", "cellar", "hall")
    for name in names:
        write_bag(tmp_path / name, 0)
    ship_from(tmp_path, *names)
    fleet = served(tmp_path)
    assert [*fleet.robots] == ["hall", "attic", "cellar"]
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == set(names)
    told = reply(fleet, "data_time_range", {"robot": "cellar"})
    assert "error" not in told
    limited = Call(robots=frozenset({"hall"}))
    assert [each.name for each in fleet.allowed(limited)] == ["hall"]
    with pytest.raises(InvalidArgumentsError, match='there is no robot "cellar"'):
        fleet.named("cellar", limited)


def test_a_robot_that_is_first_shipped_later_is_known_when_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.bootstrap_fleet._JOINED_AGAIN_S", 0.0)
    fleet = _with_a_later_robot(tmp_path)
    assert [*fleet.robots] == ["hall", "attic"]
    limited = Call(robots=frozenset({"hall"}))
    with pytest.raises(InvalidArgumentsError, match=r"cellar.*there is hall"):
        fleet.named("cellar", limited)
    assert "cellar" not in fleet.robots
    found = reply(fleet, "find_last_match", {**CUP, "robot": "cellar"})
    assert found["robot_name"] == "cellar"
    assert found["topic"] == SEEN
    with pytest.raises(InvalidArgumentsError, match="there are hall, attic, cellar"):
        fleet.named("garden", Call())


async def test_a_server_looks_at_what_was_shipped_before_it_is_asked_and_for_later_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.bootstrap_fleet._JOINED_AGAIN_S", 0.0)
    fleet = _with_a_later_robot(tmp_path)

    def published() -> list[Snapshot | None]:
        lakes = [robot.lake for robot in fleet.robots.values() if robot.lake is not None]
        return [lake.index.published for lake in lakes]

    assert published() == [None, None]
    with anyio.fail_after(60):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_fleet_fresh, fleet, 1.0, 0.01)
            while "cellar" not in fleet.robots or None in published():
                await anyio.sleep(0.01)
            tasks.cancel_scope.cancel()
    robots = [robot.memory().index for robot in fleet.robots.values()]
    latest = [index.snapshot().latest for index in robots]
    assert [each.latest for each in published() if each is not None] == latest


def _with_a_later_robot(folder: Path) -> Fleet:
    """The fleet of a server that was started before a robot was shipped for the first time."""
    for name in ("hall", "attic", "cellar"):
        write_bag(folder / name, 0)
    ship_from(folder, "hall", "attic")
    fleet = served(folder)
    ship_from(folder, "cellar")
    return fleet


def test_an_engine_has_the_settings_of_its_group(tmp_path: Path) -> None:
    given = [*overrides(tmp_path, "duckdb"), "lake.engine.memory_mb=64", "lake.engine.threads=1"]
    node = load_settings(given, {}).lake.engine
    assert isinstance(node, DuckdbNode)
    engine = engine_of(node)
    [row] = engine.select(
        "SELECT current_setting('memory_limit') AS memory, current_setting('threads') AS threads",
        "bags",
        DataFiles(TABLES["bags"].arrow_schema, (), {}),
        {},
    ).to_pylist()
    engine.close()
    assert row == {"memory": "64.0 MiB", "threads": 1}
    with pytest.raises(ConfigError, match=r"^lake\.engine\.address: unknown key; use one of: _tar"):
        load_settings([*given, "lake.engine.address=auto"], {})
    assert load_settings(["deployment=fleet", "fleet.robots={r: /r}"], {}).lake.engine is None


def test_an_engine_that_is_not_installed_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = importlib.util.find_spec
    monkeypatch.setattr(
        "ros2_memory.bootstrap_fleet.find_spec",
        lambda name: None if name == "duckdb" else known(name),
    )
    with pytest.raises(ConfigError, match=r"lake: .*pip install '\.\[lake\]"):
        build_fleet(load_settings(overrides(tmp_path, "duckdb"), {}))
