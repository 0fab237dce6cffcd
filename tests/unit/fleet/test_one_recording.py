"""Several robots in one recording: each has the topics of its name, and those of nobody."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bootstrap import shared_parts
from ros2_memory.bootstrap_fleet import build_fleet, build_robots
from ros2_memory.columns.store import FILE
from ros2_memory.config import Settings, load_settings
from tests.support.bags import Msg, detections, odom, set_mtime, tf_of, write_mcap
from tests.support.fleets import START_S, reply
from tests.support.lakes import lake_rows, ship
from tests.support.program import Program, exits

__all__ = ["exits"]

S = 10**9
FIRST = START_S * S
SEEN = {"r1": "scissors", "r2": "mug"}


def of_robot(name: str, x: float, first: int) -> list[Msg]:
    """A robot that drives from x, and sees its thing."""
    drive = [replace(odom(first + at * S, x=x + at), topic=f"/{name}/odom") for at in range(5)]
    frames = [
        tf_of(each.log_time, "odom", "base_link", (x, 0.0, 0.0), topic=f"/{name}/tf")
        for each in drive
    ]
    return [*drive, *frames, detections(first + S, [SEEN[name]], topic=f"/{name}/scene_objects")]


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """Both robots in the first bag, one of them in the second."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    both = [
        *of_robot("r1", 0.0, FIRST),
        *of_robot("r2", 50.0, FIRST),
        tf_of(FIRST, "map", "odom", (0.0, 0.0, 0.0)),
    ]
    for number, messages in enumerate((both, of_robot("r2", 55.0, FIRST + 60 * S))):
        bag = write_mcap(tmp_path / "bags" / "rec" / f"rec_{number}.mcap", messages)
        os.utime(bag, (START_S, START_S))
    return load_settings(given(tmp_path), {})


def given(folder: Path) -> list[str]:
    return [
        "deployment=fleet",
        f"fleet.robots={{r1: {folder}/bags, r2: {folder}/bags}}",
        "fleet.pose_topics={r1: /r1/odom, r2: /r2/odom}",
        "data.tf_topics=[/tf, /r1/tf, /r2/tf]",
    ]


def test_each_robot_saw_and_records_what_is_its_own(settings: Settings) -> None:
    fleet = build_fleet(settings)
    assert fleet is not None
    for name, thing in SEEN.items():
        [other] = SEEN.keys() - {name}
        asked = {"topic": "*/scene_objects", "condition_type": "contains", "value": thing}
        found = reply(fleet, "find_last_match", asked)
        assert ([row["robot_name"] for row in found["matches"]], found["never"]) == (
            [name],
            [other],
        )
    topics = {
        row["topic"]: row["robot_names"]
        for row in reply(fleet, "list_recorded_topics", {})["topics"]
    }
    assert sorted(topics.pop("/tf")) == ["r1", "r2"]
    assert len(topics) == 6
    assert all(names == [topic.split("/")[1]] for topic, names in topics.items())


def test_each_robot_is_placed_by_its_own_transforms(settings: Settings) -> None:
    fleet = build_fleet(settings)
    assert fleet is not None
    asked: dict[str, Any] = {"parent": "odom", "child": "base_link", "timestamp": START_S + 2}
    for name, x in (("r1", 0.0), ("r2", 50.0)):
        assert reply(fleet, "get_transform_at", {**asked, "robot": name})["translation"]["x"] == x


def test_each_robot_is_shipped_with_its_own_topics(settings: Settings, tmp_path: Path) -> None:
    robots = build_robots(settings, shared_parts(settings))
    done = ship(tmp_path / "lake", robots)
    assert (done.bags, done.problems) == (3, [])
    rows = lake_rows(tmp_path / "lake", "sightings")
    assert sorted((row["robot"], row["label"]) for row in rows) == [
        ("r1", "scissors"),
        ("r2", "mug"),
        ("r2", "mug"),
    ]
    topics = {
        row["topic"] for row in lake_rows(tmp_path / "lake", "channels") if row["robot"] == "r1"
    }
    assert topics == {"/tf", "/r1/tf", "/r1/odom", "/r1/scene_objects"}


def test_columns_of_each_robot_are_in_a_store_of_its_own(
    settings: Settings, tmp_path: Path, exits: Program
) -> None:
    told = exits(0, "index --json", *given(tmp_path)).json
    assert {name: row["stored"] for name, row in told.items()} == {"r1": 1, "r2": 2}
    assert len([*(tmp_path / "cache").rglob(FILE)]) == 2
    test_each_robot_saw_and_records_what_is_its_own(settings)


def test_messages_of_another_robot_are_not_missing(settings: Settings, tmp_path: Path) -> None:
    files = "".join(f"  - path: rec_{n}.mcap\n    message_count: 20\n" for n in range(3))
    listing = tmp_path / "bags" / "rec" / "metadata.yaml"
    listing.write_text(f"rosbag2_bagfile_information:\n  files:\n{files}")
    set_mtime(listing, FIRST)
    fleet = build_fleet(settings)
    assert fleet is not None
    for name in SEEN:
        notes = reply(fleet, "data_time_range", {"robot": name})["notes"]
        assert [note for note in notes if "metadata.yaml" in note] == [
            "metadata.yaml of rec lists 1 missing file"
        ]
