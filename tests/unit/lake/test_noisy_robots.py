"""A lake answers as the memories do about robots with noise, a moving map and much that changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest

from ros2_memory.core.errors import NotShippedError
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.lake.tables import ROWS_VERSION
from tests.support.fleets import fleet_memory
from tests.support.lake_rows import fill, fleet_of, lake_in, lake_robots
from tests.support.memories import with_store
from tests.support.moving_map import BEGIN, S
from tests.support.noisy_robots import LENGTH_S, write_noisy_robot
from tests.unit.lake.test_questions import Robots, asked_both_ways, reply

NAMES = ("attic", "hall")
START_S = BEGIN // S
SPOT: dict[str, object] = {"where": {"x": 3.0, "y": 1.0, "radius_m": 1.5}}
ALL: dict[str, object] = {"start": START_S, "end": START_S + LENGTH_S}
SEEN: dict[str, object] = {"topic": "/vision/*/*", "condition_type": "contains", "value": "ghost"}
PATH_M = 0.2
"""Of a path between two times that cut bags: at each its end, and what noise adds near it."""
PLACE_M = 0.08
"""Of the thinned track, and what a robot drives between two of its poses' times."""


@pytest.fixture(scope="module")
def robots(engine: LakeEngine, tmp_path_factory: pytest.TempPathFactory) -> Robots:
    folder = tmp_path_factory.mktemp("robots")
    memories = {}
    for name in NAMES:
        bag_dir = write_noisy_robot(name, folder / name)
        memories[name] = with_store(fleet_memory(bag_dir), bag_dir)
    catalog = lake_in(tmp_path_factory.mktemp("lake"))
    fill(catalog, memories)
    return asked_both_ways(memories, lake_robots(catalog, engine, NAMES))


def both(robots: Robots, tool: str, given: dict[str, object]) -> tuple[Any, Any]:
    expected, found = (reply(each, tool, given) for each in robots[:2])
    assert "error" not in expected
    return expected, found


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("recap", ALL),
        ("find_things", {}),
        ("visits", SPOT),
        ("trajectory_summary", {**ALL, "by": "day"}),
        ("find_matches", {**SEEN, "by": "hour"}),
        ("find_last_match", {**SEEN, "value": "elephant"}),
    ],
)
def test_what_is_folded_of_whole_bags_is_equal(
    robots: Robots, tool: str, given: dict[str, object]
) -> None:
    expected, found = both(robots, tool, given)
    if tool in {"recap", "trajectory_summary"}:
        rows = expected.get("robots", [expected]), found.get("robots", [found])
        for one, other in zip(*rows, strict=True):
            check_drive(one, other, 0.01)
    if tool == "find_things":
        check_things(expected, found)
    if tool == "visits":
        check_visits(expected, found)
    assert found == expected


def check_visits(expected: Any, found: Any) -> None:
    """Compares when visits begin and end, and takes it out of both.

    A lake has the poses of the thinned track alone, so another pose may be the first one inside.
    """
    for one, other in zip(expected["visits"], found["visits"], strict=True):
        assert other.pop("closest_m") == pytest.approx(one.pop("closest_m"), abs=PLACE_M)
        for name in ("arrived", "departed", "duration_s", "ago_s", "closest_at"):
            assert other.pop(name) == pytest.approx(one.pop(name), abs=0.5)


def check_things(expected: Any, found: Any) -> None:
    """Compares how many things there are and from where they were seen, and takes it out of both.

    A lake has what was seen in each bag, placed by that bag alone: what lies at the edge of being
    one thing with another may be two.
    """
    counts = [
        {"all": answer.pop("total"), **answer.pop("labels")}
        | {name: robot.pop("total") for name, robot in answer["by_robot"].items()}
        for answer in (expected, found)
    ]
    assert counts[0].keys() == counts[1].keys()
    assert all(abs(count - counts[1][name]) <= 1 for name, count in counts[0].items())
    for one, other in zip(expected["things"], found["things"], strict=True):
        assert other.pop("seen_from") == pytest.approx(one.pop("seen_from"), abs=PLACE_M)


def check_drive(expected: Any, found: Any, of_length: float, of_speed: float = 0.05) -> None:
    """Compares what is measured of poses, and takes it out of both.

    A lake has the path, the stops and the drops of speed of each bag alone: noise is estimated in
    each, and what happens as one bag ends and the next begins may be missed.
    """
    if "rows" in expected:
        for row, other in zip(expected.pop("rows"), found.pop("rows"), strict=True):
            assert row[:-1] == other[:-1]
            assert other[-1] == pytest.approx(row[-1], rel=of_length)
        for name, row in expected.pop("all").items():
            assert found["all"][name] == pytest.approx(row, rel=of_length)
        del found["all"]
        return
    distance_m = expected.pop("distance_m")
    assert found.pop("distance_m") == pytest.approx(distance_m, rel=of_length, abs=PATH_M)
    assert found.pop("max_speed") == pytest.approx(expected.pop("max_speed"), abs=of_speed)
    assert found.pop("stood_s", 0) == pytest.approx(expected.pop("stood_s", 0), abs=4.0)
    for name in ("stops", "speed drops"):
        counts = [answer["counts"].pop(name, 0) for answer in (expected, found)]
        assert abs(counts[0] - counts[1]) <= 1
    for answer in (expected, found):
        answer.pop("path_sum_m", None)
        of_drive = ("stood", "slowed")
        events = [event for event in answer["events"] if not event["text"].startswith(of_drive)]
        notes = [note for note in answer.get("notes", []) if "noisy" not in note]
        # Which of too many are shown depends on how many stops there are.
        are_all = not any("too many" in note for note in notes)
        answer["events"] = [{**event, "before": None} for event in events] if are_all else []
        answer["notes"] = [note for note in notes if "too many" not in note]


def cuts() -> Iterator[dict[str, object]]:
    """Times that cut bags at either end."""
    # Between two messages of the detector, the second of which has no detection.
    times = [(22.328, 48.935)]
    draw = Random(16)
    for _ in range(7):
        start = draw.uniform(0, 40)
        times.append((start, draw.uniform(start + 4, LENGTH_S)))
    for nth, (start, end) in enumerate(times):
        yield {"start": START_S + start, "end": START_S + end, "robot": NAMES[nth % 2]}


def test_a_recap_of_a_time_that_cuts_bags_differs_by_path_and_stops_alone(robots: Robots) -> None:
    kinds: set[str] = set()
    for given in cuts():
        expected, found = both(robots, "recap", given)
        kinds.update(expected["counts"])
        # Of a bag that is cut there is the thinned track alone: 5 cm at both ends of a second.
        check_drive(expected, found, 0.03, of_speed=0.1)
        assert found == expected, given
    assert kinds >= {"errors", "failed goals", "stops", "on/off changes", "goals", "sightings"}


def test_what_changed_before_a_moment_lacks_the_battery_alone(robots: Robots) -> None:
    expected, found = both(robots, "recap", {"around": START_S + 30.5, "robot": "hall"})
    [note] = [each for each in found["notes"] if "battery" in each]
    assert "/battery_state: name it in lake.messages" in note
    assert found["before"] == expected["before"]
    assert found["after"] == expected["after"]
    assert "/battery_state" in expected["state"]
    del expected["state"]["/battery_state"]
    assert found.get("state", {}) == expected["state"]


def test_things_and_sightings_of_a_time_that_cuts_bags(robots: Robots) -> None:
    for given in list(cuts())[:3]:
        expected, found = both(robots, "find_matches", {**SEEN, **given, "limit": 50})
        assert expected["sightings"]
        for one, other in zip(expected["sightings"], found["sightings"], strict=True):
            one.pop("place"), other.pop("place")
            mine, its = one.pop("robot"), other.pop("robot")
            assert all(abs(mine[axis] - its[axis]) <= PLACE_M for axis in "xy")
        assert found == expected


def test_events_are_known_where_digests_are_of_another_version(
    robots: Robots, engine: LakeEngine, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    memories = {"hall": robots.mounted.robots["hall"].memory()}
    with monkeypatch.context() as patched:
        patched.setattr("ros2_memory.lake.rows.ROWS_VERSION", ROWS_VERSION + 1)
        catalog = lake_in(tmp_path)
        fill(catalog, memories)
    of_lake = lake_robots(catalog, engine, ["hall"])["hall"].memory
    found = reply(fleet_of({"hall": of_lake}), "recap", {**ALL, "robot": "hall"})
    expected = reply(robots.mounted, "recap", {**ALL, "robot": "hall"})
    reported = ("errors", "failed goals", "on/off changes", "goals", "sightings")
    assert [found["counts"].get(each) for each in reported] == [
        expected["counts"].get(each) for each in reported
    ]


def test_rows_of_before_states_were_shipped_answer_what_they_did(
    robots: Robots, engine: LakeEngine, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patched:
        for name in ("KIND", "EMPTY_KIND"):
            patched.setattr(f"ros2_memory.lake.rows.{name}", "of a later version")
        catalog = lake_in(tmp_path)
        fill(catalog, {"hall": robots.mounted.robots["hall"].memory()})
    over_lake = fleet_of({"hall": lake_robots(catalog, engine, ["hall"])["hall"].memory})
    sightings = {**SEEN, "robot": "hall", "by": "hour"}
    for tool, given in (("recap", {**ALL, "robot": "hall"}), ("find_matches", sightings)):
        expected, found = reply(robots.mounted, tool, given), reply(over_lake, tool, given)
        if tool == "recap":
            check_drive(expected, found, 0.01)
        assert found == expected
    cut = reply(over_lake, "recap", {"start": START_S + 5, "end": START_S + 50, "robot": "hall"})
    assert cut["error"] == NotShippedError.code
