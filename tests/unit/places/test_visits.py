"""Visits to places of any shape, and how long it is not known where the robot was."""

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Polygon, Rectangle
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import TimeRange, View
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.places.visits import visits
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    diagnostics,
    odom,
    text,
    tf,
    tf_of,
    transform,
    write_mcap,
    write_splits,
)
from tests.support.clocks import SettableClock, in_zone
from tests.support.examples import LONG, examples
from tests.support.memories import Remember, asked, clause, memory_of, remembered, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.tables import table

T0 = 1_784_000_000
THERE = {"x": 10.0, "y": 0.0, "radius_m": 1.0}


def line(*legs: tuple[float, float], begin: float = 0.0) -> list[Msg]:
    """Odometry at 5 Hz along x: legs of (seconds, metres per second)."""
    messages, x = [], 0.0
    for length, speed in legs:
        for _ in range(round(length * 5)):
            messages.append(odom(BEGIN + round(begin * S), x))
            begin += 0.2
            x += speed * 0.2
    return messages


def remembering(folder: Path, messages: list[Msg], *, split_s: float = 10.0) -> Memory:
    write_splits(folder, messages, split_s)
    return memory_of(folder)


def at(memory: Memory, now: int) -> Memory:
    """The memory, asked at another time."""
    return replace(memory, clock=SettableClock(now))


def test_where_a_robot_was_long_ago_is_not_where_it_is(tmp_path: Path) -> None:
    """A year ago, or minutes: its newest pose is its last one there, and a note says so."""
    memory = remembering(tmp_path, line((20, 0.5), (30, 0.0)))
    newest = BEGIN + round(49.8 * S)
    for later in (31 * S, 365 * 86_400 * S):
        shown = asked(at(memory, newest + later), "visits", **THERE)
        assert "there_now" not in shown
        [visit] = shown["visits"]
        assert visit["departed"] == pytest.approx(newest / S)
        assert visit["ago_s"] == pytest.approx(later / S)
        assert "too old to know whether the robot is there now" in shown["notes"][0]
    elsewhere = visits(at(memory, newest + 365 * 86_400 * S), Call(), 5.0, 0.0, radius_m=1.0)
    assert elsewhere.visits
    assert elsewhere.there_now is None
    assert elsewhere.notes == ()


@pytest.mark.parametrize("in_map", [False, True])
def test_visits_of_before_a_restart_of_odometry_are_marked_unless_they_are_in_a_map(
    tmp_path: Path, *, in_map: bool
) -> None:
    twice = [each for begin in (0, 1000) for each in line((10, 0.0), (20, 0.5), begin=begin)]
    fixed = tf_of(BEGIN, "map", "odom", (0.5, 0.0, 0.0), topic="/tf_static")
    memory = remembering(tmp_path, [*[fixed] * in_map, *twice])
    answer = visits(memory, Call(), 0.0, 0.0, radius_m=1.0)
    assert answer.frame_id == ("map" if in_map else "odom")
    assert [each.restarts for each in answer.visits] == [0, int(not in_map)]
    assert ("odometry restarted" in str(answer.notes)) is not in_map
    assert visits(with_store(memory, tmp_path), Call(), 0.0, 0.0, radius_m=1.0) == answer
    driven = asked(memory, "trajectory_summary", start=T0, end=T0 + 1100)
    assert "jumped back to their origin 1 time, as where odometry restarts" in str(driven["notes"])
    assert "of the jumps" not in str(driven["notes"])


def test_coordinates_of_odometry_that_are_nowhere_in_the_map_are_hinted_at(tmp_path: Path) -> None:
    fixed = tf_of(BEGIN, "map", "odom", (50.0, 1.0, 0.0), topic="/tf_static")
    memory = remembering(tmp_path, [fixed, *line((10, 0.0), (20, 0.5))])
    pasted: dict[str, Any] = {"x": 0.0, "y": 0.0, "radius_m": 1.0}
    found = visits(memory, Call(), **pasted)
    [hint] = [each for each in found.notes if "x and y were taken in map" in each]
    assert hint.endswith('get_position_*: ask with frame_id "odom"')
    window = {"start": T0, "end": T0 + 9, "where": pasted}
    driven = clause("/odom", "above", -1, field="position.x")
    for tool, given_ in (
        ("visits", {**pasted, "by": "hour"}),
        ("recap", window),
        ("trajectory_summary", window),
        ("find_matches", {**driven, "where": pasted}),
    ):
        reply = str(asked(memory, tool, **given_))
        assert reply.count("x and y were taken in map") == 1
        assert 'with frame_id "odom"' in reply
    for other in ({"frame_id": "odom"}, {"frame_id": "map", "x": 900.0}, {"x": 50.0, "y": 1.0}):
        found = visits(memory, Call(), **pasted | other)
        assert "were taken in" not in str(found.notes)


def walk(draw: random.Random, count: int, step: float) -> list[tuple[int, float, float]]:
    """Poses at random steps along x and y, some of them after a silence."""
    poses, x, y, at = [], 0.0, 0.0, BEGIN
    for _ in range(count):
        x, y = x + draw.uniform(-step, step), y + draw.uniform(-step, step)
        poses.append((at, x, y))
        at += draw.choice([S // 5] * 24 + [2 * S] * 6 + [12 * S])
    return poses


@settings(max_examples=12 if LONG else 2)
@given(seed=st.integers(0, 2**32), split_s=st.sampled_from([5.0, 12.0, 60.0]))
@example(seed=2013, split_s=5.0)
@example(seed=7197, split_s=5.0)
def test_a_window_cuts_the_visits_of_all_times(seed: int, split_s: float) -> None:
    """The same times with and without bounds; a visit under way at one of them is marked."""
    draw = random.Random(seed)
    poses = walk(draw, 200, 0.3)
    start, end = sorted(draw.sample(range(T0, poses[-1][0] // S), 2))
    # A window of which nothing was recorded is refused.
    assume(any(start * S <= t <= end * S for t, _, _ in poses))
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        plain = remembering(bag_dir, [odom(t, x, y) for t, x, y in poses], split_s=split_s)
        place: dict[str, Any] = {"radius_m": 1.0, "limit": 100}
        every = visits(plain, Call(), 0.0, 0.0, **place).visits
        bounds = TimeRange(float(start), float(end))
        told = visits(plain, Call(), 0.0, 0.0, span=bounds, **place)
        stored = with_store(plain, bag_dir)
        assert visits(stored, Call(), 0.0, 0.0, span=bounds, **place) == told
        last = poses[-1][0]
        inside = [(each.arrived or 0, each.departed or last) for each in every]
        # Bounds in float seconds have a tolerance of a microsecond or two.
        known = [(a, b) for a, b in inside if a <= end * S and b >= start * S]
        found = [(each.arrived or 0, each.departed or last) for each in told.visits]
        assert found == [(max(a, start * S), min(b, end * S)) for a, b in known]
        assert told.total == len(found)
        assert told.entries == sum(not each.already_inside for each in told.visits)
        for each, (arrived, _) in zip(told.visits, known, strict=True):
            assert each.already_inside or arrived >= start * S


@pytest.mark.parametrize("nth", [3, -1])
def test_a_pose_that_cannot_be_decoded_hides_no_visit(
    tmp_path: Path, remember: Remember, nth: int
) -> None:
    way = line((20.0, 0.1))
    way[nth] = replace(way[nth], body=way[nth].payload[:40])
    memory = remember(way)
    found = visits(memory, Call(), 0.0, 0.0)
    assert len(found.visits) == 1
    assert found.frame_id == "odom"
    assert "cannot be decoded" in str(found.notes)
    torn = [replace(each, body=each.payload[:40]) for each in line((3.0, 0.1))]
    with pytest.raises(UndecodableError, match="does not fit"):
        visits(remembering(tmp_path / "torn", torn), Call(), 0.0, 0.0)


def test_a_robot_that_stands_on_the_edge_of_a_region_does_not_leave_it(tmp_path: Path) -> None:
    """Its poses are 1 cm inside or outside, at random; the track is within 5 cm of them."""
    draw = random.Random(3)
    edge = [(BEGIN + n * S // 5, 1.0 + draw.uniform(-0.01, 0.01)) for n in range(600)]
    there = [(BEGIN + n * S // 5 - 20 * S, 5.0 - n * 0.04) for n in range(100)]
    messages = [odom(at, x) for at, x in (*there, *edge)]
    found = visits(remembering(tmp_path, messages), Call(), 0.0, 0.0, radius_m=1.0)
    inside = [at for at, x in edge if x <= 1.0]
    assert [(one.arrived, one.departed) for one in found.visits] in (
        [(inside[0], inside[-1])],
        [(inside[0], None)],
    )


HERE = {"x": 0.0, "y": 0.0, "radius_m": 1.0}
PRESSED = clause("/bumper", "equals", True)
CALM = clause("/mood", "equals", "calm")


def life(seconds: int, silent: Mapping[str, Sequence[tuple[int, int]]]) -> list[Msg]:
    """A robot that stands at the origin: poses 5 times, a bumper and a mood once in a second.

    `silent`: between which seconds (inclusive, exclusive) a topic has no message.
    """
    messages: list[Msg] = []
    for step in range(seconds * 5):
        at = BEGIN + step * S // 5
        messages.append(odom(at))
        if step % 5 == 0:
            messages += [boolean(at, True), text(at, "calm", topic="/mood")]
    return [
        one
        for one in messages
        if not any(a <= one.log_time / S - T0 < b for a, b in silent.get(one.topic, ()))
    ]


def brute(times: Sequence[int], first: int, last: int, start: int, end: int) -> int:
    """How much (ns) of a window a topic leaves open, given all its times and what was recorded."""
    ends = sorted({first, last, *times})
    apart = [(a, b) for a, b in pairwise(ends) if b - a > SILENCE_NS]
    return sum(max(0, min(b, end) - max(a, start)) for a, b in apart)


@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**32), split_s=st.sampled_from([5, 10, 60]), stored=st.booleans())
def test_unknown_time_is_what_brute_force_says(seed: int, split_s: int, stored: bool) -> None:
    draw = random.Random(seed)
    silent: dict[str, list[tuple[int, int]]] = {"/odom": [], "/mood": []}
    for spans in silent.values():
        for _ in range(draw.randrange(4)):
            begin = draw.randrange(100)
            spans.append((begin, begin + draw.randrange(30)))
    messages = life(120, silent)
    times = {name: [one.log_time for one in messages if one.topic == name] for name in silent}
    first, last = BEGIN, BEGIN + 119 * S
    last = max(last, *times["/odom"][-1:])
    start, end = sorted(T0 + draw.randrange(120) for _ in range(2))
    bounds = first, last, start * S, min(end * S, last)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        write_splits(bag_dir, messages, split_s)
        memory = memory_of(bag_dir, recalls=stored)
        window = {"start": start, "end": end}
        for given, name in (({"where": HERE}, "/odom"), ({"while": CALM}, "/mood")):
            if len(times[name]) < 20:
                continue
            found = asked(memory, "find_matches", **PRESSED, **given, **window)
            expected = brute(times[name], *bounds) / S
            assert found.get("unknown_s", 0) == pytest.approx(expected, abs=1e-3)
            assert ("unknown_s" in found) is (expected > 0)
            by_hour = asked(memory, "find_matches", **PRESSED, **given, **window, by="hour")
            assert table(by_hour)["all"].get("unknown_s", 0) == pytest.approx(expected, abs=0.06)
            if name == "/odom":
                visited = asked(memory, "visits", **HERE, **window)
                assert visited.get("unknown_s", 0) == found.get("unknown_s", 0)


def test_a_state_that_is_said_every_six_seconds_is_rare_and_lasts_through_a_pause(
    tmp_path: Path,
) -> None:
    said = [n for n in range(0, 300, 6) if not 100 < n < 200]
    messages = [odom(BEGIN + n * S) for n in range(300)]
    messages += [text(BEGIN + n * S + 1, "calm", topic="/mood") for n in said]
    [visit] = asked(remembering(tmp_path, messages), "visits", **HERE, **{"while": CALM})["visits"]
    assert visit["duration_s"] == pytest.approx(299)


@pytest.mark.parametrize("split_s", [10.0, 60.0, 10_000.0])
def test_a_fault_of_a_node_holds_from_its_message_to_its_next_one_while_others_are_well(
    tmp_path: Path, remember: Remember, split_s: float
) -> None:
    """However bags are cut; a node that says nothing more is gone after an hour."""
    hot = {10: (2, "hot"), 90: (0, "ok"), 200: (2, "hot")}
    messages = [odom(BEGIN + n * S) for n in range(0, 4000, 2)]
    messages += [diagnostics(BEGIN + n * S + 1, camera=(0, "ok")) for n in range(0, 4000, 2)]
    messages += [diagnostics(BEGIN + n * S, motor=level) for n, level in hot.items()]
    messages += [boolean(BEGIN + n * S, n % 20 == 0) for n in range(0, 4000, 10)]
    write_splits(tmp_path, messages, split_s)
    while_hot: dict[str, Any] = {"while": clause("/diagnostics", "contains", "hot")}
    memory = remember()
    [visit] = asked(memory, "visits", **HERE, **while_hot)["visits"]
    assert visit["duration_s"] == pytest.approx(80 + 3600)
    window = {"start": T0, "end": T0 + 199}
    [visit] = asked(memory, "visits", **HERE, **while_hot, **window)["visits"]
    assert visit["duration_s"] == pytest.approx(80)
    found = asked(memory, "find_matches", **PRESSED, **while_hot, **window, limit=100)
    assert [row["first_seen"] - T0 for row in found["sightings"]] == [80, 60, 40, 20]


@pytest.mark.filterwarnings("error")
def test_a_place_beyond_all_others_is_answered_without_a_warning(tmp_path: Path) -> None:
    memory = remembering(tmp_path, line((20, 0.5), (30, 0.0)))
    assert asked(memory, "visits", x=1e308, y=-1e308, radius_m=1e308)["total"] == 0
    assert asked(memory, "visits", x=0, y=0, radius_m=1e308)["total"] == 1


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
    assert "left out, as in elsewhere: yard" in str(found.notes)


def test_visits_are_those_of_the_path_where_the_clock_was_set_back(
    tmp_path: Path, remember: Remember
) -> None:
    """It drives to x = 60 in 120 s; the next file begins 100 s earlier, and it comes back."""
    came = along_x(T0 * S, 120, mps=0.5, hz=5)
    back = [odom((T0 + 20) * S + n * S // 5, 60 - n / 10, 0.0) for n in range(600)]
    for nth, driven in enumerate((came, back)):
        write_mcap(tmp_path / "run" / f"run_{nth}.mcap", driven)
    memory = remember()
    for x, seen in ((15, [26, 34]), (40, [76, 84]), (55, [106, 114])):
        where = {"x": x, "y": 0, "radius_m": 2}
        driven_there = asked(memory, "trajectory_summary", start=T0, end=T0 + 200, where=where)
        assert (driven_there["visits"], driven_there["distance_m"]) == (1, pytest.approx(4))
        reply = asked(memory, "visits", **where)
        [row] = reply["visits"]
        assert [row["arrived"] - T0, row["departed"] - T0] == pytest.approx(seen, abs=0.01)
        assert reply["unknown_s"] == pytest.approx(100, abs=1)
        assert "what was where then is not known" in str(reply["notes"])


def test_the_first_entry_is_none_that_a_wrong_clock_dated(tmp_path: Path) -> None:
    """Unless all are: a robot whose clock is not set at its start drives in 1970."""
    for name, begin in (("unset", 1000 * S), ("rec", T0 * S), ("later", (T0 + 3600) * S)):
        write_mcap(tmp_path / name / f"{name}_0.mcap", along_x(begin, 60, mps=0.5))
    memory = spots(memory_of(tmp_path), den=Circle(10.0, 0.0, 2.0))
    [den] = asked(memory, "visits")["places"]
    assert (den["entries"], den["first_entry"]) == (3, T0 + 16)
    assert "dated by a wrong clock" in str(asked(memory, "visits")["notes"])


def test_times_of_places_that_overlap_are_noted_as_counted_to_both(moving: Memory) -> None:
    room = Rectangle(-3.0, 2.0, -3.0, 6.0)
    noted = "places overlap: what is in two of them counts to both"
    nested = spots(moving, room=room, start=Rectangle(-0.6, 0.6, -0.6, 0.6))
    assert noted in asked(nested, "visits")["notes"]
    touching = asked(spots(moving, room=room, beside=Rectangle(2.0, 8.0, -3.0, 6.0)), "visits")
    assert all(row["minutes"] > 0 for row in touching["places"])
    assert noted not in touching.get("notes", [])


def test_a_robot_that_looks_into_the_next_room_and_comes_back_is_not_in_two_at_once(
    tmp_path: Path,
) -> None:
    """It drives 1.6 m over 16 s, and is beyond the edge at 1.5 m for some 2 s."""
    memory = remembering(tmp_path, line((20, 0.0), (16, 0.1), (16, -0.1), (20, 0.0)))
    rooms = spots(memory, here=Rectangle(-3, 1.5, -3, 3), there=Rectangle(1.5, 5, -3, 3))
    reply = asked(rooms, "visits")
    assert [row["entries"] for row in reply["places"] if row["place"] == "there"] == [1]
    assert "places overlap" not in str(reply)


def spots(memory: Memory, **where: Circle | Rectangle) -> Memory:
    places = tuple(Place(name, "odom", region) for name, region in where.items())
    return replace(memory, limits=replace(memory.limits, places=places))


def test_a_robot_that_left_before_it_first_came_has_no_time_that_runs_backwards(
    tmp_path: Path,
) -> None:
    """It leaves its dock after 10 s, for 40 s."""
    memory = remembering(tmp_path, line((10, 0.0), (20, 0.5), (20, -0.5), (30, 0.0)))
    with in_zone("UTC"):
        [dock] = asked(spots(memory, dock=Circle(0.0, 0.0, 1.0)), "visits")["places"]
    assert dock["last_exit"] == pytest.approx(T0 + 12, abs=0.3)
    assert dock["first_entry"] == pytest.approx(T0 + 48, abs=0.3)
    assert dock["local"] == "Tue 2026-07-14 03:34:08"


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
        messages.append(tf_of(at, "base_link", "arm", (0, 0, nth % 5)))
        messages.append(tf(at + 5, transform(at, "odom", "base_link", (x, 0, 0)), topic="/own/tf"))
    memory = remembered(
        tmp_path, messages, split_s=10, limits=QuerySettings(tf_topics=("/tf", "/own/tf"))
    )
    known_since: set[int | None] = set()
    for looks in range(0, 60, 2):
        deadline = Deadline.after(looks, count().__next__)
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
    hello = clause("/chatter", "contains", "hello")

    def cells(tool: str, row: str, **given: Any) -> dict[str, Any]:
        return table(asked(memory, tool, **given))[row]

    of_places = asked(memory, "visits")
    assert "places overlap" not in str(of_places["notes"])
    places = of_places["places"]
    assert [(row["place"], row["exits"], row["minutes"]) for row in places] == [
        ("here", 1, 0.5),
        ("there", 1, 0.5),
    ]
    for name, first in (("here", 0), ("there", 5)):
        seen = asked(memory, "visits", where=name)
        assert (seen["total"], seen["exits"], seen["minutes"]) == (1, 1, 0.5)
        assert cells("visits", "all", where=name, by="hour")["minutes"] == 0.5
        [found] = asked(memory, "find_matches", where=name, **hello)["sightings"]
        assert (found["first_seen"] - T0, found["count"]) == (first, 30)
        assert cells("find_matches", name, by="place", **hello)["seconds"] == 29.8


@pytest.mark.parametrize("map_frame", ["map", "world"])
def test_a_fixed_frame_of_an_arm_on_a_rail_is_named_as_the_map(
    tmp_path: Path, map_frame: str
) -> None:
    """It goes along its rail in two recordings; only transforms place it, in `world`."""
    for nth in range(2):
        times = [BEGIN + (1000 * nth + n) * S // 10 for n in range(100)]
        moved = [tf_of(at, "world", "base_link", (n / 50, 0.0, 0.0)) for n, at in enumerate(times)]
        write_mcap(tmp_path / f"rec{nth}" / f"rec{nth}_0.mcap", moved)
    memory = memory_of(tmp_path, limits=QuerySettings(map_frame=map_frame))
    reply = asked(memory, "visits", x=1.0, y=0.0, radius_m=0.2)
    assert (reply["frame_id"], reply["total"]) == ("world", 2)
    notes = str(reply["notes"])
    asked_for = "the origin of world may change with every start, unless data.map_frame names it"
    assert (asked_for in notes) == (map_frame == "map")
    assert "changes with every start" not in notes


@pytest.mark.parametrize("frames", [("odom", "map"), ("map", "odom")])
def test_a_robot_whose_poses_are_in_another_frame_since_an_update_was_there_before_it_too(
    tmp_path: Path, remember: Remember, frames: tuple[str, str]
) -> None:
    for nth, frame_id in enumerate(frames):
        messages = []
        for at in range(BEGIN + nth * 100 * S, BEGIN + (nth * 100 + 60) * S, S):
            pose = odom(at + 1, 0.0 if frame_id == "odom" else 5.0)
            pose.body.header.frame_id = frame_id  # type: ignore[attr-defined]
            messages += [tf(at, transform(at, "map", "odom", (5.0, 0.0, 0.0))), pose]
        write_mcap(tmp_path / f"rec{nth}" / f"rec{nth}_0.mcap", messages)
    reply = asked(remember(), "visits", x=5.0, y=0.0, radius_m=1.0)
    assert (reply["frame_id"], reply["total"], reply["minutes"]) == ("map", 2, 1.97)
    assert "no transform places" not in str(reply)
    assert "unknown_s" not in reply


@pytest.mark.parametrize("root", ["site", "map"])
def test_of_several_runs_the_note_names_the_frame_that_is_or_may_be_the_map(
    tmp_path: Path, root: str
) -> None:
    for nth in range(2):
        begin = (1_784_000_000 + nth * 1000) * 10**9
        moved = [
            tf(
                at := begin + n * 10**8,
                transform(at, root, "vision", (0.0, 0.0, 0.0)),
                transform(at, "vision", "base_link", (n / 50, 0.0, 0.0)),
            )
            for n in range(100)
        ]
        poses = [odom(message.log_time, n / 50) for n, message in enumerate(moved)]
        for pose in poses:
            pose.body.header.frame_id = "vision"  # type: ignore[attr-defined]
        write_mcap(tmp_path / f"rec{nth}" / f"rec{nth}_0.mcap", [*moved, *poses])
    window = {"start": 1_784_000_000, "end": 1_784_002_000}
    notes = asked(memory_of(tmp_path), "trajectory_summary", **window)["notes"]
    advice = {
        "site": "if site, which it leads to, is a map, set data.map_frame=site",
        "map": "ask with frame_id=map",
    }
    assert f"may be another place in each; {advice[root]}" in str(notes)
    placed = asked(memory_of(tmp_path), "trajectory_summary", **window, frame_id=root)
    assert (placed["frame_id"], "another place in each" in str(placed["notes"])) == (root, False)
    if root == "map":
        return
    notes = asked(memory_of(tmp_path), "visits", x=1.0, y=0.0, radius_m=0.2)["notes"]
    assert advice["site"] in str(notes)
