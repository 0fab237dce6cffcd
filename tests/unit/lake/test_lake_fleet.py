"""A fleet's server with a lake: what was shipped answers, also where no bag is left."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from tests.support.fleets import SEEN
from tests.support.lakes import robot_bags, ship, write_bag
from tests.unit.lake.test_questions import reply

CUP: dict[str, object] = {"topic": SEEN, "condition_type": "contains", "value": "cup"}


def overrides(folder: Path, engine: str) -> list[str]:
    robots = ", ".join(f"{name}: {folder / name}" for name in ("hall", "attic"))
    return [
        "deployment=fleet",
        f"fleet.robots={{{robots}}}",
        f"lake.engine={engine}",
        f"lake.warehouse={folder / 'lake'}",
    ]


def test_a_robot_whose_bags_are_gone_is_answered_from_the_lake(tmp_path: Path) -> None:
    for name in ("hall", "attic"):
        write_bag(tmp_path / name, 0)
    ship(tmp_path / "lake", [robot_bags(name, tmp_path / name) for name in ("hall", "attic")])
    shutil.rmtree(tmp_path / "hall")
    fleet = build_fleet(load_settings(overrides(tmp_path, "duckdb"), {}))
    assert fleet is not None
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == {"hall", "attic"}
    assert found["notes"][-1].startswith("from the lake, which has what was shipped: ")
    assert fleet.robots["attic"].is_mounted
    assert not fleet.robots["hall"].is_mounted


def test_an_engine_that_is_not_installed_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = importlib.util.find_spec
    monkeypatch.setattr(
        "ros2_memory.bootstrap_lake.find_spec",
        lambda name: None if name in {"daft", "duckdb"} else known(name),
    )
    for engine, extra in (("duckdb", "lake"), ("ray", "ray")):
        with pytest.raises(ConfigError, match=rf"lake\.engine: .*ros2-memory\[{extra}\]"):
            build_fleet(load_settings(overrides(tmp_path, engine), {}))
