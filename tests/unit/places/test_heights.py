"""Places with a height: where the robot and things are in a house of two storeys."""

from pathlib import Path
from typing import Any

import pytest

from ros2_memory.history.context import Memory
from tests.support.bags import detected, odom, write_splits
from tests.support.memories import asked, memory_of, remembered
from tests.support.storeys import BEGIN, END, HOUSE, UP_M, S, house, times_in, with_places
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
