"""Search and ways in a place, in any of several places, and while other topics meet conditions.

What is expected is counted from the drawn world itself, second by second.
"""

import math
from dataclasses import replace
from functools import partial
from itertools import count
from operator import attrgetter
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.motion.trajectory import Line
from ros2_memory.core.arrays import Ints
from ros2_memory.core.regions import Circle, Place
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange
from ros2_memory.places.placed_standstills import PlacedStandstill, stood_at
from ros2_memory.queries import trajectory_summary
from tests.support.bags import along_x, boolean, octets, odom, text, tf_of, write_mcap, write_splits
from tests.support.examples import examples
from tests.support.memories import Remember, asked, clause, memory_of, remembered
from tests.support.moving_map import BEGIN as MAP_BEGIN
from tests.support.moving_map import S
from tests.support.noting_reader import NotingReader
from tests.support.rooms import BEGIN, ROOMS, asked_of, bounds, draw, write
from tests.support.tables import table

T0 = 1_700_000_000 * S
HELLO = clause("/chatter", "contains", "hello")
CARRYING = clause("/bumper", "equals", True)


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    bags = tmp_path_factory.mktemp("rooms")
    write(draw(3, 60), bags)
    return asked_of(bags, stored=True)


@settings(max_examples=examples(8))
@example(seed=23, stored=False, rooms=["hall", "kitchen"])  # comes in with the newest pose
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    rooms=st.lists(st.sampled_from([*ROOMS]), min_size=2, max_size=3, unique=True),
)
def test_what_happened_in_any_of_several_places_is_what_happened_in_one_of_them(
    seed: int, stored: bool, rooms: list[str]
) -> None:
    world = draw(seed, 150)
    with TemporaryDirectory() as name:
        bags = Path(name)
        write(world, bags)
        memory = asked_of(bags, stored=stored)
        where = ", ".join(rooms)
        runs = world.runs_in(*rooms)
        seen = asked(memory, "find_matches", where=where, limit=100, **HELLO)
        assert [
            (row["first_seen"] - BEGIN, row["last_seen"] - BEGIN, row["count"])
            for row in reversed(seen["sightings"])
        ] == [(run.first, run.last, run.messages) for run in runs]
        visits = asked(memory, "visits", where=where, limit=100)
        assert [row["arrived"] - BEGIN for row in reversed(visits["visits"])] == [
            run.first for run in runs
        ]
        span = {"start": BEGIN, "end": BEGIN + 150}
        driven = asked(memory, "trajectory_summary", where=where, **span)
        assert driven["visits"] == len(runs)
        assert driven["distance_m"] == pytest.approx(world.metres_in(*rooms), abs=0.3)
        by_place = {"by": "place", "where": bounds(*rooms), **span}
        visited = table(asked(memory, "visits", by="place", where=rooms))
        driven = table(asked(memory, "trajectory_summary", **by_place))
        said = table(asked(memory, "find_matches", **HELLO, **by_place))
        named = [*rooms, "(elsewhere)", "(unknown)", "all"]
        assert [*visited] == [*driven] == [*said] == named
        for room in rooms:
            own = world.runs_in(room)
            assert visited[room]["entries"] == sum(run.first > 0 for run in own)
            # A wall is crossed half a second before the first message in the room, and after.
            ends = sum((run.first > 0) + (run.last < 149) for run in own)
            seconds = sum(run.last - run.first for run in own) + ends / 2
            assert visited[room]["minutes"] == pytest.approx(seconds / 60, abs=0.02)
            assert driven[room]["metres"] == pytest.approx(world.metres_in(room), abs=0.3)
            assert said[room]["seconds"] == pytest.approx(seconds, abs=len(own) + 1)
        metres = sum(driven[each]["metres"] for each in named[:-1])
        assert driven["all"]["metres"] == pytest.approx(metres, abs=0.05)


@settings(max_examples=examples(8))
@given(seed=st.integers(0, 10_000), stored=st.booleans(), room=st.sampled_from([*ROOMS]))
def test_metres_and_visits_while_a_topic_meets_a_condition_are_those_of_that_time(
    seed: int, stored: bool, room: str
) -> None:
    world, chance = draw(seed, 150), Random(seed)
    carries = [state for _ in range(15) for state in [chance.random() < 0.5] * 10]
    # Each half of a second is in the room that the robot is in at the whole second beside it.
    halves = [
        (world.room(nth + late) == room, abs(world.x[nth + 1] - world.x[nth]) / 2)
        for nth in range(149)
        if carries[nth]
        for late in (0, 1)
    ]
    own = world.runs_in(room)
    counted = [run for run in own if any(carries[max(run.first - 1, 0) : run.last + 1])]
    entries = sum(run.first > 0 and carries[run.first - 1] for run in own)
    with TemporaryDirectory() as name:
        bags = Path(name)
        write(world, bags)
        write_splits(bags / "flags", [boolean((BEGIN + n) * S, carries[n]) for n in range(150)], 20)
        memory = asked_of(bags, stored=stored)
        span = {"start": BEGIN, "end": BEGIN + 149, "while": CARRYING}
        driven = asked(memory, "trajectory_summary", **span)
        assert driven["distance_m"] == pytest.approx(sum(m for _, m in halves), abs=0.3)
        assert driven["duration_s"] == pytest.approx(len(halves) / 2, abs=0.01)
        assert driven.keys().isdisjoint({"where", "visits", "unknown_s", "error"})
        inside = asked(memory, "trajectory_summary", **span, where=room)
        metres = sum(m for is_inside, m in halves if is_inside)
        seconds = sum(is_inside for is_inside, _ in halves) / 2
        assert inside["distance_m"] == pytest.approx(metres, abs=0.3)
        assert inside["duration_s"] == pytest.approx(seconds, abs=0.3)
        assert inside["visits"] == len(counted)
        for where, wanted in (({}, driven), ({"where": room}, inside)):
            by_hour = table(asked(memory, "trajectory_summary", **span, **where, by="hour"))
            assert by_hour["all"]["metres"] == pytest.approx(wanted["distance_m"], abs=0.01)
        by_place = table(asked(memory, "trajectory_summary", **span, by="place"))
        assert by_place[room]["metres"] == pytest.approx(metres, abs=0.3)
        assert by_place["all"]["metres"] == pytest.approx(driven["distance_m"], abs=0.01)
        visited = asked(memory, "visits", **span, where=room, limit=100)
        assert [row["arrived"] - BEGIN for row in reversed(visited["visits"])] == [
            run.first for run in counted
        ]
        assert (visited["entries"], "there_now" in visited) == (entries, False)
        assert visited["minutes"] == pytest.approx(seconds / 60, abs=0.02)
        of_each = {row["place"]: row for row in asked(memory, "visits", **span)["places"]}
        assert of_each[room]["minutes"] == visited["minutes"]
        for by in ("hour", "place"):
            rows = table(asked(memory, "visits", **span, where=room, by=by))
            assert rows["all"]["entries"] == entries
            assert rows["all"]["minutes"] == pytest.approx(seconds / 60, abs=0.02)


def test_what_was_driven_while_a_topic_said_so_takes_a_few_searches_of_many_bags(
    tmp_path: Path,
) -> None:
    """One by one, the bags of a day took as many searches as there were."""
    messages = []
    for nth in range(1200):
        flag = boolean(T0 + nth * S + 1, nth // 100 % 2 == 0)
        messages += [odom(T0 + nth * S, nth / 100, 0.0), flag]
    write_splits(tmp_path, messages, 10)
    reader = NotingReader()
    memory = memory_of(tmp_path, reader=reader, recalls=True)
    span = {"start": T0 // S, "end": T0 // S + 1200, "while": CARRYING}
    reader.asked.clear()
    assert asked(memory, "trajectory_summary", **span)["duration_s"] == pytest.approx(600, abs=2)
    assert sum("/bumper" in topics for _, topics in reader.asked) < 20


def test_a_way_that_began_inside_before_the_window_begins_with_the_first_pose_of_it(
    tmp_path: Path,
) -> None:
    poses = [odom(T0 + (4 * nth + 1) * S // 4, nth / 10) for nth in range(40)]
    span = {"start": T0 // S + 5, "end": T0 // S + 15}
    inside = {"where": {"x": 0, "y": 0, "radius_m": 9}}
    driven = asked(remembered(tmp_path, poses), "trajectory_summary", **span, **inside)
    assert driven["start"] == driven["waypoints"][0]["timestamp"] == T0 // S + 5.25
    assert (driven["end"], driven["duration_s"], driven["avg_speed"]) == (T0 // S + 14.25, 9, 0.1)


def test_metres_of_many_short_times_are_measured_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A topic says so every other second: one by one, the times of a day took 20 s."""
    interpolated: list[int] = []
    at = Line.at

    def counting(line: Line, times: Ints) -> Line:
        interpolated.append(len(times))
        return at(line, times)

    monkeypatch.setattr(Line, "at", counting)
    looks = set()
    for seconds in (40, 400):
        bag = tmp_path / f"{seconds}" / "rec" / "rec_0.mcap"
        poses = [odom(T0 + nth * S, nth / 10, nth % 2) for nth in range(seconds + 1)]
        flags = [boolean(T0 + nth * S, nth % 4 < 2) for nth in range(seconds)]
        write_mcap(bag, sorted([*poses, *flags], key=attrgetter("log_time")))
        span = {"start": T0 // S, "end": T0 // S + seconds}
        memory, during = memory_of(tmp_path / f"{seconds}"), {"while": CARRYING}
        interpolated.clear()
        driven = asked(memory, "trajectory_summary", **span, **during, max_waypoints=0)
        assert driven["duration_s"] == pytest.approx(seconds / 2)
        looks.add(len(interpolated))
    assert len(looks) == 1


def test_a_condition_that_always_held_leaves_out_no_metre_of_sparse_poses(tmp_path: Path) -> None:
    """Bags begin 5 s apart; from 300 to 400 s nothing was recorded."""
    begin = 1_784_000_000  # the first split is number 0: of one run
    poses = [
        odom((begin + nth) * S, nth / 10, 0.0) for nth in range(0, 601, 5) if not 300 < nth < 400
    ]
    flags = [boolean(pose.log_time, True) for pose in poses]
    write_splits(tmp_path, sorted([*poses, *flags], key=attrgetter("log_time")), 10)
    span = {"start": begin, "end": begin + 600}
    memory = memory_of(tmp_path)
    whole = asked(memory, "trajectory_summary", **span)
    driven = asked(memory, "trajectory_summary", **span, **{"while": CARRYING})
    assert driven["distance_m"] == pytest.approx(whole["distance_m"]) == pytest.approx(50)
    assert driven["duration_s"] == pytest.approx(500, abs=0.1)


@pytest.mark.parametrize(
    ("name", "given"), [("trajectory_summary", {}), ("visits", {"x": 0, "y": 0})]
)
def test_a_while_of_a_topic_that_fell_silent_says_for_how_long_it_is_not_known(
    tmp_path: Path, name: str, given: dict[str, Any]
) -> None:
    poses = along_x(T0, 101, mps=0.1)
    flags = [boolean(T0 + nth * S, True) for nth in range(41)]
    memory = remembered(tmp_path, sorted([*poses, *flags], key=attrgetter("log_time")))
    span = {"start": T0 // S, "end": T0 // S + 100}
    for by in ({}, {"by": "hour"}):
        found = asked(memory, name, **given, **span, **by, **{"while": CARRYING})
        unknown_s = table(found)["all"]["unknown_s"] if by else found["unknown_s"]
        assert unknown_s == pytest.approx(60, abs=0.1)
        unmet = clause("/bumper", "above", 3)
        refused = asked(memory, name, **given, **span, **by, **{"while": unmet})
        assert refused["error"] == "invalid_arguments"
        absent = {**CARRYING, "topic": "/absent"}
        none = asked(memory, name, **given, **span, **by, **{"while": absent})
        assert "error" in none


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("hall, attic", 'no place is named "attic"; there are: den, hall, kitchen'),
        ([], "where was []; give the name of a place"),
        (",", 'no place is named ","'),
        (["hall", 5], "give the name of a place"),
        ({"hall": 5, "den": "den"}, 'where: "hall" was 5; give'),
        ({"hall": {"x": [5, 1], "y": [0, 1]}, "den": "den"}, 'where: "hall" was {"x": [5, 1]'),
        ({"hall": {"z": 1}}, 'where: "hall" was {"z": 1}; give'),
        ({"x": 1, "y": 2, "radius": 3}, "where was {"),
        ({f"p{nth}": {"x": nth, "y": 0, "radius_m": 1} for nth in range(31)}, "more than 30"),
        ({"x": [1, 0], "y": [0, 1]}, "where was {"),
        ({"x": [1, 1], "y": [0, 1]}, "where was {"),  # a line, on which no pose ever is
        ({"x": [0, 1], "y": [0, 1], "radius_m": 1}, "where was {"),
        (5, "where was 5; give the name"),
    ],
)
def test_what_is_no_place_is_named_with_the_reason_and_what_to_do(
    memory: Memory, where: Any, said: str
) -> None:
    reply = asked(memory, "visits", where=where)
    assert reply["error"] == "invalid_arguments"
    assert said in reply["detail"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"where": "hall", "x": 1.0}, "give either"),
        ({"x": 1.0}, "both"),
        ({"where": "hall", "frame_id": "moon"}, None),
        ({"x": 1.0, "y": 1.0, "frame_id": "moon"}, 'frame_id was "moon"'),
        *(({"x": 0, "y": 0, "radius_m": each}, "radius_m") for each in (0.0, -1.0, math.inf)),
    ],
)
def test_a_place_is_named_once_and_in_a_frame_of_the_robot(
    memory: Memory, given: dict[str, Any], said: str | None
) -> None:
    reply = asked(memory, "visits", **given)
    assert (said is None) == ("error" not in reply)
    assert said is None or said in reply["detail"]


@pytest.mark.parametrize("name", ["hall", "Hall", " HALL"])
def test_coordinates_with_the_name_of_a_place_leave_that_place_the_name_it_is_given(
    memory: Memory, name: str
) -> None:
    where = {name: bounds("den")["den"], "b": "hall"}
    visited = table(asked(memory, "visits", by="place", where=where))
    assert [*visited] == [name, "b", "(elsewhere)", "(unknown)", "all"]
    alone = table(asked(memory, "visits", by="place", where=["den", "hall"]))
    assert [visited[name], visited["b"]] == [alone["den"], alone["hall"]]


@pytest.mark.parametrize(
    ("tool", "argument"), [("visits", "where"), ("trajectory_summary", "farthest_from")]
)
def test_places_of_several_frames_are_refused_by_the_name_of_the_argument(
    memory: Memory, tool: str, argument: str
) -> None:
    dock = Place("dock", "base_dock", Circle(0.0, 0.0, 1.0))
    memory = replace(memory, limits=replace(memory.limits, places=(*memory.limits.places, dock)))
    span = {"start": BEGIN, "end": BEGIN + 60} if tool == "trajectory_summary" else {}
    reply = asked(memory, tool, **{argument: "hall, dock"}, **span)
    assert reply["detail"].startswith(f"{argument}: hall is in odom, dock is in base_dock")


def test_what_no_message_of_another_topic_can_meet_is_refused(remember: Remember) -> None:
    messages = [odom(MAP_BEGIN), octets(MAP_BEGIN, [1] * 60), boolean(MAP_BEGIN, True)]
    messages.append(text(MAP_BEGIN + S, "cup"))
    memory = remember(messages)
    cup = clause("/chatter", "contains", "cup")
    one = {"condition_type": "equals", "value": 1}
    for during, said in (
        ({"topic": "/odom", **one, "field": "nope"}, "no field"),
        ({"topic": "/octets", **one, "field": "data"}, "only summarised"),
        ({"topic": "/bumper", **one, "value": "yes"}, "true or false"),
    ):
        for by in ({}, {"by": "hour"}):
            refused = asked(memory, "find_matches", **cup, **by, **{"while": during})
            assert said in refused["detail"]


def test_a_while_is_answered_from_the_store_and_reads_few_messages(tmp_path: Path) -> None:
    """A bag of hours would be decompressed for them."""
    flags = [boolean(T0 + nth * S // 2, nth // 40 % 2 == 0) for nth in range(400)]
    hellos = [text(T0 + nth * S, "hello") for nth in range(200)]
    reader = NotingReader()
    memory = remembered(
        tmp_path, sorted([*flags, *hellos], key=attrgetter("log_time")), reader=reader, recalls=True
    )
    during = clause("/bumper", "equals", True)
    reader.read.clear()
    reply = asked(memory, "find_matches", by="hour", **HELLO, **{"while": during})
    assert reply["all"][reply["columns"].index("count") - 1] == 5
    assert reader.read.count("/bumper") < 10


def test_what_a_rare_topic_said_last_is_looked_up_once_for_all_matches(tmp_path: Path) -> None:
    """A search in a .db3 goes through all messages of other topics since then."""

    def looks(matches: int) -> int:
        bags = tmp_path / f"{matches}"
        hellos = (text(T0 + nth * S, "hello" if nth % 2 else "bye") for nth in range(2 * matches))
        state = text(T0, "SCOUTING", topic="/state")
        write_mcap(bags / "rec" / "rec_0.mcap", [state, *hellos])
        reader = NotingReader()
        memory = memory_of(bags, reader=reader, recalls=True)
        during = clause("/state", "equals", "SCOUTING")
        reader.asked.clear()
        reply = asked(memory, "find_matches", limit=100, **HELLO, **{"while": during})
        assert reply["total"] == matches
        return sum("/state" in topics for _, topics in reader.asked)

    assert looks(20) == looks(3)


def test_a_robot_that_turns_on_a_straight_way_has_its_own_heading_at_the_edge_of_a_place(
    remember: Remember,
) -> None:
    """Drives 0.5 m/s along x, and turns 0.3 rad/s meanwhile, as a holonomic robot may."""
    messages = [odom(MAP_BEGIN + n * S // 10, n / 20, 0.0, 0.03 * n) for n in range(900)]
    memory = remember(messages)
    window = {"start": MAP_BEGIN / S, "end": MAP_BEGIN / S + 90}
    where = {"x": [15, 20], "y": [-1, 1]}
    inside = asked(memory, "trajectory_summary", where=where, **window)
    assert len(inside["waypoints"]) == 2
    for each in inside["waypoints"]:
        there = asked(memory, "get_position_at", timestamp=each["timestamp"])
        assert each["yaw_deg"] == there["yaw_deg"]


@pytest.mark.parametrize("topic", ["/drone/odom", "drone/odom"])
def test_the_places_of_a_path_are_those_of_the_topic_that_is_asked_about(
    remember: Remember, topic: str
) -> None:
    """A drone flies 20 m along x and lands, while the robot of the same memory stands at 0."""
    flight = [odom(T0 + n * S, min(n, 20), topic="/drone/odom") for n in range(60)]
    memory = remember([*along_x(T0, 60), *flight])
    window = {"topic": topic, "start": T0 / S, "end": T0 / S + 59}
    ask = partial(asked, memory, "trajectory_summary", **window)
    pad = {"x": [15, 25], "y": [-1, 1]}
    landing = ask(where=pad)
    assert (landing["visits"], landing["duration_s"]) == (1, pytest.approx(44.0, abs=0.1))
    assert landing["distance_m"] == pytest.approx(5.0, abs=0.1)
    assert ask(where={"x": [-1, 1], "y": [-1, 1]})["distance_m"] == pytest.approx(1.0, abs=0.1)
    assert ask(farthest_from={"x": 0, "y": 0})["farthest"]["distance_m"] == 20.0
    rows = table(ask(by="place", where={"pad": pad}))
    assert rows["pad"]["metres"] == pytest.approx(5.0, abs=0.1)
    assert rows["pad"]["recorded_s"] == pytest.approx(44.0, abs=0.1)


def test_the_places_of_the_path_of_a_marker_are_not_those_of_a_robot_placed_by_transforms(
    remember: Remember,
) -> None:
    marker = [odom(T0 + n * S, min(n, 20), topic="/marker/pose") for n in range(60)]
    standing = [tf_of(T0 + n * S, "odom", "base_link", (0, 0, 0)) for n in range(60)]
    window = {"topic": "/marker/pose", "start": T0 / S, "end": T0 / S + 59}
    ask = partial(asked, remember([*marker, *standing]), "trajectory_summary", **window)
    assert ask(farthest_from={"x": 0, "y": 0})["farthest"]["distance_m"] == 20.0
    assert ask(where={"x": [15, 25], "y": [-1, 1]})["distance_m"] == pytest.approx(5.0, abs=0.1)


@settings(max_examples=examples(8))
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    x=st.floats(-3, 15),
    first=st.integers(0, 120),
    rooms=st.lists(st.sampled_from([*ROOMS]), max_size=2, unique=True),
)
def test_it_is_the_pose_of_the_window_or_of_a_place_that_is_farthest(
    seed: int, stored: bool, x: float, first: int, rooms: list[str]
) -> None:
    world = draw(seed, 200)
    with TemporaryDirectory() as name:
        write(world, Path(name))
        memory = asked_of(Path(name), stored=stored)
        bounds = {"start": BEGIN + first, "end": BEGIN + first + 60}
        given: dict[str, Any] = {"where": ", ".join(rooms)} if rooms else {}
        point = {"x": x, "y": 1.0}
        reply = asked(memory, "trajectory_summary", farthest_from=point, **bounds, **given)
        poses = {
            nth: math.hypot(world.x[nth] - x, 1.0)
            for nth in range(first, first + 61)
            if not rooms or world.room(nth) in rooms
        }
        if not poses:
            assert "farthest" not in reply
            return
        farthest = reply["farthest"]
        assert farthest["distance_m"] == pytest.approx(max(poses.values()), abs=0.001)
        at = round(farthest["timestamp"] - BEGIN)
        assert poses[at] == pytest.approx(max(poses.values()), abs=1e-6)
        assert (farthest["x"], farthest["frame_id"]) == (world.x[at], "odom")
        assert farthest["from"] == {"x": pytest.approx(x, abs=1e-3), "y": 1.0}
        assert farthest.get("in") == world.room(at)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"farthest_from": "attic"}, "farthest_from: no place is named"),
        ({"farthest_from": "kitchen, hall"}, "farthest_from has several places; give one"),
        ({"farthest_from": {"x": 1}}, "farthest_from was"),
        ({"farthest_from": "hall", "topic": "/other"}, "/other"),
        ({"farthest_from": "hall", "by": "hour"}, "farthest_from cannot be combined with by"),
        ({"farthest_from": {"x": 1, "y": 2}, "frame_id": "moon"}, 'frame_id was "moon"'),
    ],
)
def test_what_is_no_point_is_named(memory: Memory, given: dict[str, Any], said: str) -> None:
    span = {"start": BEGIN, "end": BEGIN + 60}
    reply = asked(memory, "trajectory_summary", **span, **given)
    assert said in reply["detail"]


def test_a_path_by_transforms_is_whole_where_a_bag_reaches_from_1970_to_now(
    remember: Remember,
) -> None:
    """The clock was set while it was recorded: of half a million hours two have messages."""
    times = [20 * S, *(MAP_BEGIN + n * S // 10 for n in range(300))]
    poses = [tf_of(at, "odom", "base_link", (1.0, 0, 0)) for at in times]
    memory = remember(poses)
    # Each look at the clock takes 10 ms.
    call = Call(Deadline.after(20.0, partial(next, count(0.0, 0.01))))
    found = trajectory_summary(memory, call, TimeRange(0.0, MAP_BEGIN / S + 30))
    assert found.trajectory.poses == 301
    assert "out of time" not in str(found.notes)


stands = st.lists(
    st.builds(
        PlacedStandstill,
        st.tuples(st.floats(0, 3), st.floats(0, 3), st.sampled_from([0.0, 2.7])),
        st.integers(0, 10**9),
        st.integers(1, 10**9),
    ),
    max_size=8,
)


@settings(max_examples=examples(40))
@given(stands, stands)
def test_every_standstill_is_of_one_place_and_near_to_it(
    one: list[PlacedStandstill], two: list[PlacedStandstill]
) -> None:
    found = stood_at(one, two)
    for side, given_ones in enumerate((one, two)):
        seconds = sum(at.seconds[side] or 0.0 for at in found)
        assert seconds == pytest.approx(sum(each.duration for each in given_ones) / S)
        for each in given_ones:
            assert min(math.dist(at.place, each.place) for at in found) <= 0.5
    assert {at.place for at in found} <= {each.place for each in (*one, *two)}
    assert [at.seconds for at in stood_at(two, one)] == [at.seconds[::-1] for at in found]
