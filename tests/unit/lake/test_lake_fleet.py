"""A fleet's server with a lake: what was shipped answers, also where no bag is left."""

import importlib.util
import os
import shutil
import threading
from pathlib import Path
from random import Random
from typing import Any

import anyio
import pytest

from ros2_memory.bag_dir.layout import MEMORY_FOLDER, memory_file
from ros2_memory.bag_dir.state_files import append_deleted, deleted_of
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError, InvalidArgumentsError, RefusedError
from ros2_memory.core.timebase import NS_PER_S, Deadline
from ros2_memory.fleet.robots import Fleet
from ros2_memory.history.context import Call
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.server import keep_fleet_fresh
from tests.support.bags import text, write_mcap
from tests.support.fleets import SEEN, START_S, reply
from tests.support.lakes import ship_from, write_bag
from tests.support.memories import clause

CHATTER = {"robot": "hall", "topic": "/chatter", "seconds": 1e9}
CUP = clause(SEEN, "contains", "cup")


def overrides(folder: Path) -> list[str]:
    robots = ", ".join(f"{name}: {folder / name}" for name in ("hall", "attic"))
    return [
        "deployment=fleet",
        f"fleet.robots={{{robots}}}",
        "lake=duckdb",
        f"lake.warehouse={folder / 'lake'}",
    ]


def served(folder: Path) -> Fleet:
    """The fleet of a server with a lake."""
    fleet = build_fleet(load_settings(overrides(folder), {}))
    assert fleet is not None
    return fleet


def test_robots_whose_bags_are_gone_or_were_never_shipped_are_answered_from_where_they_are(
    tmp_path: Path,
) -> None:
    for name in ("hall", "attic"):
        write_bag(tmp_path / name, 0)
    ship_from(tmp_path)
    shutil.rmtree(tmp_path / "hall")
    fleet = served(tmp_path)
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == {"hall", "attic"}
    [note] = found["notes"]
    assert note.startswith("from the lake, which has what was shipped: hall up to ")
    assert "attic" not in note
    assert reply(fleet, "find_things", {"robot": "attic"})["robot_name"] == "attic"


def test_a_server_starts_though_the_folder_of_a_robot_hangs_and_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("hall", "attic"):
        write_bag(tmp_path / name, 0)
    ship_from(tmp_path)
    released, stat = threading.Event(), os.stat

    def hanging(path: Any, **options: Any) -> os.stat_result:
        if str(path) == str(tmp_path / "hall"):
            released.wait()
        return stat(path, **options)

    monkeypatch.setattr(os, "stat", hanging)
    found = reply(served(tmp_path), "find_last_match", CUP, Call(Deadline.after(12.0)))
    released.set()
    assert found["robots_failed"] == {"hall": "timeout"}
    assert [row["robot_name"] for row in found["matches"]] == ["attic"]


def test_what_retention_deleted_and_what_is_not_shipped_yet_are_in_one_answer(
    tmp_path: Path,
) -> None:
    bags = [write_bag(tmp_path / "hall", number) for number in range(3)]
    away = bags[2].rename(tmp_path / bags[2].name)
    ship_from(tmp_path)
    bags[0].unlink()
    away.rename(bags[2])
    fleet = served(tmp_path)

    def answer(tool: str, **given: object) -> Any:
        return reply(fleet, tool, {"robot": "hall", **given})

    old = answer("get_topic_at_time", topic="/chatter", timestamp=START_S + 1)
    assert old["value"] == {"value": "n1"}
    newest = answer("find_last_match", **CUP)
    assert (newest["timestamp"], "notes" in newest) == (START_S + 20, False)
    assert answer("find_matches", **CUP)["sightings"][0]["count"] == 3
    # In one recording, which is the same one in the lake and on the robot.
    assert "restart" not in str(answer("recap", start=START_S, end=START_S + 30))
    write_bag(tmp_path / "hall", 3)
    hall = fleet.robots["hall"]
    assert hall.own is not None
    hall.own.index.refresh()
    assert answer("find_last_match", **CUP)["timestamp"] == START_S + 30
    ship_from(tmp_path)
    for bag in (tmp_path / "hall").rglob("*.mcap"):
        bag.unlink()
    found = reply(served(tmp_path), "find_matches", {"robot": "hall", **CUP})
    assert found["sightings"][0]["count"] == 4


def test_a_bag_by_whose_name_the_lake_has_another_one_is_named_and_not_taken_for_it(
    tmp_path: Path,
) -> None:
    bag = write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    bag.unlink()
    write_bag(tmp_path / "hall", 1).rename(bag)
    fleet = served(tmp_path)
    asked = {"robot": "hall", "topic": "/chatter"}
    for second, value in ((1, {"value": "n1"}), (11, None)):
        found = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + second})
        assert found.get("value") == value
    assert "the lake has another bag of this name" in str(found)
    found = reply(fleet, "find_matches", {**CUP, "robot": "hall"})
    assert "the lake has another bag of this name" in str(found["notes"])


def test_a_bag_that_begins_when_a_shipped_one_does_is_not_taken_for_it(tmp_path: Path) -> None:
    """As of two runs of a simulation, whose clock begins anew."""
    write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    write_bag(tmp_path / "hall", 1, at_s=START_S, most=8)
    asked = {"robot": "hall", "topic": "/chatter", "timestamp": START_S + 7}
    assert reply(served(tmp_path), "get_topic_at_time", asked).get("value") == {"value": "n107"}


def test_a_bag_that_lost_its_first_message_since_it_was_shipped_is_not_another_one(
    tmp_path: Path,
) -> None:
    """As where a topic has a shorter life than its bags (`retention.topics`)."""
    write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    write_bag(tmp_path / "hall", 0, at_s=START_S + 1, most=2)
    fleet = served(tmp_path)
    found = reply(fleet, "get_topic_in_last", CHATTER)
    assert [sample["value"]["value"] for sample in found["samples"]] == ["n0", "n1", "n2"]
    assert "could not be read" not in str(found)
    assert reply(fleet, "find_last_match", CUP | {"value": "tree"})["never"] == ["hall"]


@pytest.mark.parametrize(
    ("shipped", "first", "left"), [(3, 0, 0), (3, 3, 0), (2, 3, 0), (1, 0, 0), (1, 9, 1)]
)
def test_of_a_day_counts_what_was_shipped_or_what_stayed_if_less_was_shipped(
    tmp_path: Path, shipped: int, first: int, left: int
) -> None:
    """Retention deletes the bags of a day, of which some messages stay, rounded (`memory.keep`).

    The first of the bags may be `left`, with the first message that stays.
    """
    bags = [write_bag(tmp_path / "hall", number, most=10) for number in range(3)]
    for bag in bags[shipped:]:
        bag.rename(tmp_path / bag.name)
    ship_from(tmp_path)
    for bag in bags[left:]:
        bag.unlink(missing_ok=True)
    ends = [(START_S + 10 * nth) * NS_PER_S for nth in range(4)]
    named = [(f"rec_{nth}", ends[nth], ends[nth + 1] - NS_PER_S) for nth in range(3)]
    append_deleted(tmp_path / "hall", [deleted_of("rec", named[left:])])
    stayed = [text((START_S + nth) * NS_PER_S, "n") for nth in range(first, 30, 3)]
    write_mcap(tmp_path / "hall" / MEMORY_FOLDER / memory_file("20261120"), stayed)
    found = reply(served(tmp_path), "get_topic_in_last", CHATTER)
    is_needed = shipped == 1
    assert found["total"] == (len(stayed) + 10 * left if is_needed else 10 * shipped)
    wanted = clause("/chatter", "contains", "n")
    last = reply(served(tmp_path), "find_last_match", {**wanted, "robot": "hall"})
    assert last["timestamp"] == START_S + (27 if is_needed else 10 * shipped - 1)
    assert ("only some messages stayed" in str(last)) is is_needed


def test_a_lake_that_cannot_be_read_leaves_the_robot_its_own_answer(tmp_path: Path) -> None:
    bags = [write_bag(tmp_path / "hall", number) for number in range(2)]
    ship_from(tmp_path)
    bags[0].unlink()
    fleet = served(tmp_path)
    for file in (tmp_path / "lake").rglob("*.parquet"):
        file.unlink()
    asked = {"robot": "hall", "topic": "/chatter"}
    new = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 11})
    assert (new["value"], "notes" in new) == ({"value": "n101"}, False)
    old = reply(fleet, "get_topic_at_time", {**asked, "timestamp": START_S + 1})
    assert old["error"] == "refused"
    assert old["detail"].startswith("the lake cannot be read")


def write_long(bag_dir: Path) -> None:
    """Messages of which a lake has the times alone."""
    words = [Random(nth).randbytes(2000).hex() for nth in range(30)]
    long = [text((START_S + nth) * NS_PER_S, word, "/camera") for nth, word in enumerate(words)]
    write_mcap(bag_dir / "rec" / "rec_0.mcap", long)


def test_an_emptied_folder_does_not_hide_that_the_lake_has_times_alone(tmp_path: Path) -> None:
    write_long(tmp_path / "hall")
    write_bag(tmp_path / "hall", 1)
    ship_from(tmp_path)
    for bag in (tmp_path / "hall").rglob("*.mcap"):
        bag.unlink()
    fleet, of_camera = served(tmp_path), {"robot": "hall", "topic": "/camera"}
    for tool, given in (
        ("get_topic_at_time", {"timestamp": START_S + 5}),
        ("find_last_match", CUP),
    ):
        assert reply(fleet, tool, {**given, **of_camera})["error"] == "not_in_lake"


def test_a_status_names_topics_of_which_the_lake_has_times_alone_though_not_in_its_newest_bag(
    tmp_path: Path,
) -> None:
    write_long(tmp_path / "roof")
    write_bag(tmp_path / "roof", 9)
    ship_from(tmp_path, "roof")
    doubts = reply(served(tmp_path), "memory_status", {"robot": "roof"})["doubts"]
    assert "of 1 topic there are only the times here: /camera" in doubts


def _with_a_later_robot(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """The fleet of a server that was started before a robot was shipped for the first time."""
    monkeypatch.setattr("ros2_memory.bootstrap_fleet._JOINED_AGAIN_S", 0.0)
    for name in ("hall", "cellar", "roof"):
        write_bag(folder / name, 0)
    ship_from(folder, "hall", "roof")
    fleet = served(folder)
    ship_from(folder, "cellar")
    return fleet


def test_robots_that_only_the_lake_knows_are_asked_unless_a_token_forbids_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = _with_a_later_robot(tmp_path, monkeypatch)
    assert [*fleet.robots] == ["hall", "attic", "roof"]
    limited = Call(robots=frozenset({"hall"}))
    for name in ("cellar", "roof"):
        with pytest.raises(
            InvalidArgumentsError, match=f'there is no robot "{name}"; there is hall'
        ):
            fleet.named(name, limited)
    assert [robot.name for robot in fleet.allowed(limited)] == ["hall"]
    # One that was shipped later is known when it is asked for.
    assert "cellar" not in fleet.robots
    found = reply(fleet, "find_last_match", {**CUP, "robot": "cellar"})
    assert (found["robot_name"], found["topic"]) == ("cellar", SEEN)
    found = reply(fleet, "find_last_match", CUP)
    assert {row["robot_name"] for row in found["matches"]} == {"hall", "cellar", "roof"}
    with pytest.raises(InvalidArgumentsError, match="there are hall, attic, roof, cellar"):
        fleet.named("garden", Call())


async def test_a_server_looks_at_what_was_shipped_before_it_is_asked_and_for_later_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = _with_a_later_robot(tmp_path, monkeypatch)

    def published() -> list[Snapshot | None]:
        return [robot.memory.index.published for robot in fleet.robots.values()]

    assert published() == [None] * 3
    with anyio.fail_after(60):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_fleet_fresh, fleet, 1.0, 0.01)
            while "cellar" not in fleet.robots or None in published():
                await anyio.sleep(0.01)
            tasks.cancel_scope.cancel()
    latest = [snapshot and snapshot.latest for snapshot in published()]
    last = (START_S + 2) * NS_PER_S
    assert [*fleet.robots] == ["hall", "attic", "roof", "cellar"]
    assert latest == [last, None, last, last]


def test_an_engine_has_the_settings_of_its_group_and_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [*overrides(tmp_path), "lake.engine.memory_mb=64"]
    fleet = build_fleet(load_settings(given, {}))
    assert fleet is not None
    assert fleet.tables is not None
    with pytest.raises(RefusedError, match="more than 64 MiB"):
        fleet.tables.query("SELECT len(range(200000000))")
    with pytest.raises(ConfigError, match=r"^lake\.engine\.address: unknown key; use one of: _tar"):
        load_settings([*given, "lake.engine.address=auto"], {})
    assert load_settings(["deployment=fleet", "fleet.robots={r: /r}"], {}).lake.engine is None
    known = importlib.util.find_spec
    monkeypatch.setattr(
        "ros2_memory.bootstrap.find_spec",
        lambda name: None if name == "duckdb" else known(name),
    )
    with pytest.raises(ConfigError, match=r"lake: .*pip install '\.\[lake\]"):
        served(tmp_path)
