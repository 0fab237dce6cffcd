"""Visits to places of any shape, in a map that moves under odometry or is not known yet."""

import math
from dataclasses import replace
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Polygon, Rectangle
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import View
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.places.visits import visits
from tests.support.bags import McapLayout, odom, text, tf, transform, write_mcap, write_splits
from tests.support.memories import asked, memory_of
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.tables import table

PLACES = (
    Place("corner", "map", Circle(4.0, 3.0, 0.5)),
    Place("start", "map", Rectangle(-0.6, 0.6, -0.6, 0.6)),
    Place("far side", "map", Polygon(((3.0, -1.0), (5.0, -1.0), (5.0, 4.0), (3.0, 4.0)))),
    Place("garden", "map", Rectangle(50.0, 60.0, 0.0, 9.0)),
    Place("yard", "elsewhere", Rectangle(-9.0, 9.0, -9.0, 9.0)),
)


def in_places(memory: Memory) -> Memory:
    return replace(memory, limits=replace(memory.limits, places=PLACES))


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    folder = tmp_path_factory.mktemp("moving")
    write_moving_map(folder, 1, seconds=300)
    return in_places(memory_of(folder))


def test_without_a_place_all_named_ones_are_told_at_once(moving: Memory) -> None:
    found = visits(moving, Call())
    assert found.places is not None
    by_name = {each.place: each for each in found.places}
    assert set(by_name) == {"corner", "start", "far side", "garden"}
    for name in ("corner", "start", "far side"):
        alone = visits(moving, Call(), where=name, limit=100)
        assert (by_name[name].entries, by_name[name].exits) == (alone.entries, alone.exits)
        assert by_name[name].duration == alone.duration
        few = visits(moving, Call(), where=name, limit=1)
        assert (few.total, few.visits, few.more) == (alone.total, alone.visits[:1], alone.total > 1)
        arrivals = [each.arrived for each in alone.visits]
        # Nobody saw the robot enter where it was from the beginning on.
        if name == "start":
            assert (len(arrivals), by_name[name].entries) == (5, 4)
            arrivals.pop()
        assert by_name[name].first == arrivals[-1]
    assert by_name["garden"].entries == 0
    assert "yard is left out" in str(found.notes)


def spots(memory: Memory, **where: Circle | Rectangle) -> Memory:
    places = tuple(Place(name, "odom", region) for name, region in where.items())
    return replace(memory, limits=replace(memory.limits, places=places))


def test_a_place_that_the_robot_passes_more_often_than_poses_are_always_read_for_has_no_visit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It drives to and fro in an arc past the shelf, through the door: its track is straighter."""
    along = [*range(20), *[20] * 10, *range(20, 0, -1), *[0] * 10]
    poses = [
        odom(BEGIN + nth * S // 2, at / 2, -0.045 * math.sin(math.pi * at / 20))
        for nth, at in enumerate(along * 60)
    ]
    write_splits(tmp_path, poses, 300)
    shelf, door = Rectangle(4.0, 6.0, -0.02, 1.0), Rectangle(3.0, 7.0, -1.0, 1.0)
    memory = spots(memory_of(tmp_path), shelf=shelf, door=door)
    rows = asked(memory, "visits")["places"]
    assert [(row["place"], row["entries"]) for row in rows] == [("door", 120), ("shelf", 0)]
    monkeypatch.setattr("ros2_memory.places.visits._MOST_CONFIRMED", 40)
    reply = asked(memory, "visits", where="shelf")
    assert reply["total"] == 20
    assert any(note.startswith("20 older visits may be none") for note in reply["notes"])


def test_with_two_topics_of_transforms_a_time_is_known_where_both_were_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot was elsewhere in the middle of two minutes, by the second topic."""
    messages = []
    for nth in range(1200):
        at, x = BEGIN + nth * S // 10, 5.0 if 550 <= nth < 650 else 0.0
        messages.append(tf(at, transform(at, "base_link", "arm", (0, 0, nth % 5))))
        messages.append(tf(at + 5, transform(at, "odom", "base_link", (x, 0, 0)), topic="/own/tf"))
    write_splits(tmp_path, messages)
    memory = memory_of(tmp_path, limits=QuerySettings(tf_topics=("/tf", "/own/tf")))
    known_since: set[int | None] = set()
    for looks in range(0, 60, 2):
        clock = chain([0.0] * (looks + 1), repeat(math.inf))
        deadline = Deadline.after(1.0, partial(next, clock))
        monkeypatch.setattr(Call, "partial_after", lambda *_, deadline=deadline: deadline)
        known = TrackReader(View(memory, Call()), "odom").track_in(
            TimeWindow(BEGIN, BEGIN + 120 * S)
        )
        known_since.add(known.since)
        if known.since is None or known.since < BEGIN + 50 * S:
            assert known.track.x.max() == 5.0
    assert len(known_since) > 10
    assert None in known_since


@pytest.mark.parametrize(
    ("recalls", "latched"),
    [(False, ()), (True, ()), (False, ("/odom",))],
    ids=["plain", "catalogue", "latched"],
)
def test_each_of_two_robots_in_a_folder_is_in_its_place(
    tmp_path: Path, recalls: bool, latched: tuple[str, ...]
) -> None:
    """The second one has a track of its own, in every tool that takes a place."""
    words = [text(BEGIN + n * S, "hello") for n in range(90)]
    for name, since, x, said in (("left", 0, 0.0, words), ("right", 5, 30.0, [])):
        poses = [odom(BEGIN + since * S + n * S // 5, x + 9 * (n >= 150)) for n in range(400)]
        messages = sorted([*poses, *said], key=lambda message: message.log_time)
        layout = McapLayout(latched=frozenset(latched))
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages, layout)
    memory = memory_of(tmp_path, recalls=recalls)
    memory = spots(memory, here=Circle(0.0, 0.0, 1.0), there=Circle(30.0, 0.0, 1.0))
    hello = {"topic": "/chatter", "condition_type": "contains", "value": "hello"}

    def cells(tool: str, row: str, **given: Any) -> dict[str, Any]:
        return table(asked(memory, tool, **given))[row]

    places = asked(memory, "visits")["places"]
    assert [(row["place"], row["exits"], row["minutes"]) for row in places] == [
        ("here", 1, 0.5),
        ("there", 1, 0.5),
    ]
    for name, first in (("here", 0), ("there", 5)):
        seen = asked(memory, "visits", where=name)
        assert (seen["total"], seen["exits"], seen["minutes"]) == (1, 1, 0.5)
        assert cells("visits", "all", where=name, by="hour")["minutes"] == 0.5
        [found] = asked(memory, "find_matches", where=name, **hello)["sightings"]
        assert (found["first_seen"] - BEGIN / S, found["count"]) == (first, 30)
        assert cells("find_matches", name, by="place", **hello)["seconds"] == 29.8
