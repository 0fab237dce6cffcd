"""Which robot last saw something is asked of the catalogues: no bag is opened to rule it out."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bootstrap import build_backfill, build_memory, shared_parts
from ros2_memory.bootstrap_fleet import robot_settings
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import WallClock
from ros2_memory.fleet.robots import Fleet, Robot
from tests.support.fleets import LENGTH_S, reply, seeded, write_robot
from tests.support.noting_reader import NotingReader

if TYPE_CHECKING:
    from pathlib import Path

NAMES = ("r1", "r2", "r3")


@pytest.mark.parametrize("label", ["mug", "elephant"])
def test_only_the_bag_of_the_newest_sight_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, label: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "robots"
    for name in NAMES:
        write_robot(seeded(name), folder / name)
    settings = load_settings([f"fleet.robots={folder}/*"], {"MEMORY_DEPLOYMENT": "fleet"})
    shared = shared_parts(settings)
    for name in NAMES:
        own = robot_settings(settings, name)
        memory = build_memory(own, shared)
        memory.index.refresh()
        fill_store(build_backfill(own, memory))
        assert memory.columns is not None
        assert memory.columns.store is not None
        memory.columns.store.close()
    reader = NotingReader()
    noted = shared._replace(reader=reader)
    fleet = Fleet(
        [
            Robot(name, folder / name, partial(build_memory, robot_settings(settings, name), noted))
            for name in NAMES
        ],
        WallClock(),
    )
    given: dict[str, object] = {
        "topic": "/vision/*",
        "condition_type": "contains",
        "value": label,
    }
    found = reply(fleet, "find_last_match", given)
    expected = set()
    for robot in map(seeded, NAMES):
        times = [at - robot.start_s for at, what in robot.seen if what == label]
        if times:
            expected.add(f"{robot.name}/rec/rec_{times[-1] // (LENGTH_S // 2)}.mcap")
    assert len(found["matches"]) == len(expected)
    assert {"/".join(path.parts[-3:]) for path, _ in reader.asked} == expected
