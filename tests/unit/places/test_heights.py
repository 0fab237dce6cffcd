"""Places with a height: where the robot and things are in a house of two storeys."""

import random
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import FLICKER_NS
from ros2_memory.core.regions import Circle, Storey
from ros2_memory.history.context import Memory
from tests.support.bags import detected, odom, tf_of, write_splits
from tests.support.examples import examples
from tests.support.memories import Remember, asked, memory_of, remembered
from tests.support.storeys import (
    BEGIN,
    END,
    HOUSE,
    ROOM,
    TIMES,
    UP_M,
    WAY,
    S,
    house,
    times_in,
    with_places,
)
from tests.support.tables import table

HELLO = {"topic": "/chatter", "condition_type": "contains", "value": "hello"}


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "catalogue"])
def memory(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    folder = tmp_path_factory.mktemp("house")
    write_splits(folder, house(), 20)
    return with_places(memory_of(folder, recalls=request.param))


@pytest.mark.parametrize("name", [*HOUSE])
def test_the_robot_is_in_the_place_of_its_storey_alone(memory: Memory, name: str) -> None:
    inside = times_in(name)
    [row] = asked(memory, "visits", where=name)["visits"]
    assert row["arrived"] == pytest.approx(inside[0] / S)
    assert row.get("departed", END) == pytest.approx(inside[-1] / S)
    places = {row["place"]: row for row in asked(memory, "visits")["places"]}
    lasted_s = pytest.approx((inside[-1] - inside[0]) / S, abs=0.6)
    assert places[name]["minutes"] == pytest.approx(row["duration_s"] / 60, abs=0.01)
    assert row["duration_s"] == lasted_s
    span: dict[str, Any] = {"start": BEGIN, "end": END, "where": name}
    assert asked(memory, "trajectory_summary", **span)["duration_s"] == lasted_s
    assert asked(memory, "recap", **span)["inside_s"] == lasted_s
    [said] = asked(memory, "find_matches", where=name, **HELLO)["sightings"]
    assert said["count"] == len([at for at in inside if at % S == 0])
    by_place = table(asked(memory, "find_matches", by="place", **HELLO))
    assert by_place[name]["recorded_s"] == lasted_s
    by_hour = table(asked(memory, "visits", by="hour", where=name))
    assert by_hour["all"]["minutes"] == pytest.approx(row["duration_s"] / 60, abs=0.01)


def test_a_question_may_ask_about_coordinates_at_some_heights(memory: Memory) -> None:
    plan = {"x": [-1.0, 4.0], "y": [-1.0, 1.0]}
    up = plan | {"z": [2.0, 9.0]}
    asks: tuple[tuple[str, dict[str, object]], ...] = (
        ("visits", {}),
        ("find_things", {}),
        ("recap", {"start": BEGIN, "end": END}),
    )
    for tool, span in asks:
        reply = asked(memory, tool, where=up, **span)
        named = asked(memory, tool, where="bedroom", **span)
        for key in ("total", "inside_s", "minutes"):
            assert reply.get(key) == named.get(key), (tool, key)
    assert asked(memory, "recap", where=up, start=BEGIN, end=END)["where"] == up
    above = plan | {"z": [2.0, None]}
    assert asked(memory, "recap", where=above, start=BEGIN, end=END)["where"] == above
    assert (
        asked(memory, "visits", where=above)["total"] == asked(memory, "visits", where=up)["total"]
    )
    below = asked(memory, "find_things", where=plan | {"z": [None, 2]})
    assert below["things"] == asked(memory, "find_things", where="kitchen")["things"]
    for heights in (2.0, [3.0], [3, 2], ["a", None], ["a", "b"]):
        refused = asked(memory, "visits", where=plan | {"z": heights})
        assert '"z": [2, 4]' in refused["detail"]


def test_things_are_in_the_place_of_their_own_height(memory: Memory) -> None:
    def heights(**given: Any) -> list[float]:
        return sorted(row["place"]["z"] for row in asked(memory, "find_things", **given)["things"])

    assert heights() == [0.8, 3.5]
    assert heights(where="kitchen") == [0.8]
    assert heights(where="bedroom") == [3.5]
    assert heights(where="kitchen, bedroom") == [0.8, 3.5]
    rooms = {row["place"]["z"]: row["in"] for row in asked(memory, "find_things")["things"]}
    assert rooms == {0.8: "kitchen", 3.5: "bedroom"}


def test_what_was_where_the_robot_was_has_the_name_of_its_storey(memory: Memory) -> None:
    for second, name in ((20, "kitchen"), (100, "bedroom")):
        assert asked(memory, "get_position_at", timestamp=BEGIN + second)["in"] == name
    farthest = asked(
        memory, "trajectory_summary", start=BEGIN, end=BEGIN + 59, farthest_from={"x": 0, "y": 0}
    )["farthest"]
    assert (farthest["in"], farthest["also_in"]) == ("kitchen", ["column"])


def test_what_differs_is_in_the_place_of_its_storey(memory: Memory) -> None:
    above, below = (BEGIN + 70, END), (BEGIN, BEGIN + 59)
    given = dict(zip(("start", "end", "with_start", "with_end"), (*above, *below), strict=True))
    reply = asked(memory, "compare", **given)
    assert (reply["minutes"]["kitchen"]["this"], reply["minutes"]["bedroom"]["with"]) == (0, 0)
    assert "column" not in reply["minutes"]
    cups = {tuple(row)[1]: tuple(row.values())[1]["in"] for row in reply["things"]["not_looked_at"]}
    assert cups == {"is": "bedroom", "was": "kitchen"}
    of_kitchen = asked(memory, "compare", where="kitchen", **given)
    assert [*of_kitchen["minutes"]] == ["kitchen"]
    assert [row["was"]["in"] for row in of_kitchen["things"]["not_looked_at"]] == ["kitchen"]


def test_what_was_carried_to_the_storey_above_was_moved(tmp_path: Path) -> None:
    """To the same x and y, as a ball on a gallery."""
    messages = []
    for second in range(120):
        at = (BEGIN + second) * S
        ball = ("ball", 0.9, (2.0, 0.0, 0.3 if second < 60 else UP_M + 0.3))
        messages += [odom(at), detected(at, [ball], frame="odom")]
    memory = with_places(remembered(tmp_path, messages))
    given = {"start": BEGIN + 60, "end": BEGIN + 120, "with_start": BEGIN, "with_end": BEGIN + 59}
    things = asked(memory, "compare", **given)["things"]
    [moved] = things["moved"]
    assert (moved["was"]["in"], moved["is"]["in"]) == ("kitchen", "bedroom")


@pytest.mark.parametrize(
    "of_body", [False, True], ids=["odometry in the plane", "transforms alone"]
)
def test_transforms_to_the_map_have_heights(remember: Remember, *, of_body: bool) -> None:
    messages = []
    for at, (x, z) in zip(TIMES, WAY, strict=True):
        own = tf_of(at, "odom", "base_link", (x, 0.0, 0.0)) if of_body else odom(at, x)
        messages += [tf_of(at, "map", "odom", (0.0, 0.0, z)), own]
    memory = with_places(remember(messages), frame="map")
    for name in HOUSE:
        [row] = asked(memory, "visits", where=name)["visits"]
        inside = times_in(name)
        assert row["arrived"] == pytest.approx(inside[0] / S, abs=0.21)
        assert row.get("departed", END) == pytest.approx(inside[-1] / S, abs=0.21)
    span = {"start": BEGIN, "end": END}
    for second, name in ((20, "kitchen"), (100, "bedroom")):
        assert asked(memory, "get_position_at", timestamp=BEGIN + second)["in"] == name
    assert asked(memory, "recap", where="bedroom", **span)["inside_s"] == pytest.approx(62, abs=1)


def test_a_robot_whose_map_goes_on_a_storey_above_did_not_pass_the_landing(tmp_path: Path) -> None:
    messages = [odom(at, z=UP_M if nth >= 150 else 0.0) for nth, at in enumerate(TIMES[:300])]
    memory = with_places(remembered(tmp_path, messages), {"landing": Storey(ROOM, 0.5, 2.0)})
    reply = asked(memory, "recap", where="landing", start=BEGIN, end=BEGIN + 60)
    assert (reply["visits"], reply["inside_s"]) == (0, 0)


@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**32), stored=st.booleans())
def test_visits_last_from_the_first_to_the_last_pose_at_the_heights_of_the_place(
    seed: int, stored: bool
) -> None:
    """In a lift that goes at any speed, stops anywhere, and may turn back."""
    draw = random.Random(seed)
    z, way = 0.0, []
    for _ in range(draw.randrange(2, 12)):
        speed, length = draw.choice([0.0, 0.3, -0.3, 1.1, -1.1, 3.0, -3.0]), draw.randrange(5, 100)
        for _ in range(length):
            z += speed / 5
            way.append((z, draw.uniform(-0.02, 0.02)))
    low, high = sorted((draw.uniform(-5, 5), draw.uniform(-5, 5)))
    poses = [(BEGIN * S + nth * S // 5, z + off) for nth, (z, off) in enumerate(way)]
    # The track is within 20 cm of each height.
    deep = {at: min(height - low, high - height) for at, height in poses}
    runs = [[*run] for _, run in groupby(deep, key=lambda at: deep[at] >= 0)]
    stays: list[list[int]] = []
    for nth, run in enumerate(runs):
        assume(max(abs(deep[at]) for at in run) > 0.25)
        lasted = run[-1] - run[0] + 2 * S // 5
        is_inner = 0 < nth < len(runs) - 1
        assume(not (is_inner and abs(lasted - FLICKER_NS) < 2 * S))
        if deep[run[0]] < 0:
            continue
        if stays and run[0] - stays[-1][1] < FLICKER_NS:
            stays[-1][1] = run[-1]
        else:
            stays.append([run[0], run[-1]])
    with TemporaryDirectory() as folder:
        memory = remembered(Path(folder), [odom(at, z=z) for at, z in poses], recalls=stored)
        rooms = with_places(memory, {"room": Storey(Circle(0.0, 0.0, 1.0), low, high)})
        rows = asked(rooms, "visits", where="room", limit=100)["visits"]
    found = [(row["arrived"], row.get("departed", poses[-1][0] / S)) for row in reversed(rows)]
    assert found == [pytest.approx((first / S, last / S), abs=1e-3) for first, last in stays]
