"""For how long it is not known where the robot was, or what another topic said (`unknown_s`)."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.regions import Circle, Place
from tests.support.bags import Msg, boolean, odom, text, tf, transform, write_splits
from tests.support.examples import examples
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.history.context import Memory

S = 10**9
T0 = 1_784_000_000
HERE = {"x": 0.0, "y": 0.0, "radius_m": 1.0}
PRESSED = {"topic": "/bumper", "condition_type": "equals", "value": True}
CALM = {"topic": "/mood", "condition_type": "equals", "value": "calm"}
FAR = {"x": 50.0, "y": 0.0, "radius_m": 1.0}

each_way = pytest.mark.parametrize("stored", [False, True], ids=["plain", "stored"])


def life(seconds: int, silent: Mapping[str, Sequence[tuple[float, float]]] | None = None) -> Any:
    """A robot that stands at the origin: poses 5 times, a bumper and a mood once in a second.

    `silent`: between which seconds (inclusive, exclusive) a topic has no message.
    """
    quiet = silent or {}
    messages: list[Msg] = []
    for step in range(seconds * 5):
        at = T0 * S + step * S // 5
        messages.append(odom(at, 0.0, 0.0))
        if step % 5 == 0:
            messages += [boolean(at, True), text(at, "calm", topic="/mood")]
    return [
        one
        for one in messages
        if not any(a <= one.log_time / S - T0 < b for a, b in quiet.get(one.topic, ()))
    ]


def world(
    folder: Path,
    messages: Iterable[Msg],
    *,
    name: str = "rec",
    split_s: int = 10,
    stored: bool = False,
) -> Memory:
    write_splits(folder, messages, split_s, name)
    memory = memory_of(folder)
    return with_store(memory, folder) if stored else memory


def cells(reply: Any) -> dict[str, Any]:
    """The row of all bins, by column."""
    return dict(zip(reply["columns"][1:], reply["all"], strict=True))


def test_a_window_without_any_pose_says_that_all_of_it_is_unknown(tmp_path: Path) -> None:
    memory = world(tmp_path, life(220, {"/odom": [(60, 160)], "/mood": [(60, 160)]}))
    window = {"start": T0 + 80, "end": T0 + 120}
    for tool, asks, what in (
        ("visits", FAR, "where the robot was"),
        ("visits", {**FAR, "by": "hour"}, "where the robot was"),
        ("find_matches", {**PRESSED, "where": FAR}, "where the robot was"),
        ("find_matches", {**PRESSED, "while": CALM}, "what /mood said"),
    ):
        reply = asked(memory, tmp_path, tool, **asks, **window)
        assert f"{what} is not known at any time of the window" in reply["notes"]


def test_named_places_have_the_unknown_time_beside_them(tmp_path: Path) -> None:
    plain = world(tmp_path, life(220, {"/odom": [(60, 160)]}))
    places = (Place("dock", "odom", Circle(0.0, 0.0, 1.0)), Place("hall", "odom", Circle(9, 9, 1)))
    memory = replace(plain, limits=replace(plain.limits, places=places))
    reply = asked(memory, tmp_path, "visits")
    assert [row["place"] for row in reply["places"]] == ["dock", "hall"]
    assert reply["unknown_s"] == pytest.approx(100.2)
    assert cells(asked(memory, tmp_path, "visits", by="day"))["unknown_s"] == pytest.approx(100.2)
    table = asked(memory, tmp_path, "visits", by="place")
    at = table["columns"].index("unknown_s")
    unknown = {row[0]: row[at] for row in table["rows"]}
    assert unknown == {"dock": 0, "hall": 0, "(elsewhere)": 0, "(unknown)": pytest.approx(100.2)}


@each_way
@pytest.mark.parametrize("split_s", [10, 45])
def test_matches_say_for_how_long_their_conditions_are_not_known(
    tmp_path: Path, stored: bool, split_s: int
) -> None:
    silent = {"/odom": [(60, 160)], "/mood": [(0, 20), (130, 190), (200, 208)]}
    memory = world(tmp_path, life(220, silent), split_s=split_s, stored=stored)
    for scope, unknown in (
        ({"where": HERE}, 100.2),
        ({"while": CALM}, 20 + 61),
        ({"where": HERE, "while": CALM}, 20 + (190 - 59.8)),
    ):
        found = asked(memory, tmp_path, "find_matches", **PRESSED, **scope)
        assert found["unknown_s"] == pytest.approx(unknown)
        table = asked(memory, tmp_path, "find_matches", **PRESSED, **scope, by="day")
        assert cells(table)["unknown_s"] == pytest.approx(unknown, abs=0.06)
    assert "unknown_s" not in asked(memory, tmp_path, "find_matches", **PRESSED)
    assert "unknown_s" not in cells(asked(memory, tmp_path, "find_matches", **PRESSED, by="day"))


@each_way
def test_a_topic_that_seldom_speaks_is_known_from_its_first_message_on(
    tmp_path: Path, stored: bool
) -> None:
    quiet = life(220, {"/mood": [(0, 220)]})
    rare = [text((T0 + at) * S, "calm", topic="/mood") for at in (40, 90, 200)]
    memory = world(tmp_path, [*quiet, *rare], stored=stored)
    found = asked(memory, tmp_path, "find_matches", **PRESSED, **{"while": CALM})
    assert (found["total"], found["unknown_s"]) == (1, 40.0)
    later = asked(memory, tmp_path, "find_matches", **PRESSED, **{"while": CALM}, start=T0 + 120)
    assert (later["total"], "unknown_s" in later) == (1, False)


def test_what_two_robots_do_at_once_is_unknown(tmp_path: Path) -> None:
    world(tmp_path, life(90), name="left")
    own = [one for one in life(120, {"/odom": [(0, 3)]}) if one.topic == "/odom"]
    other = [odom(one.log_time + 70_000_000, 30.0, 0.0) for one in own]
    memory = world(tmp_path, other, name="right")
    drives = {"topic": "/odom", "field": "linear_velocity.x", "condition_type": "above", "value": 1}
    for tool, asks in (
        ("visits", FAR),
        ("find_matches", {**PRESSED, "where": FAR}),
        ("find_matches", {**PRESSED, "while": drives}),
    ):
        reply = asked(memory, tmp_path, tool, **asks)
        assert (reply["total"], reply["unknown_s"]) == (0, pytest.approx(86.73, abs=0.01))
        assert any("as from several robots" in note for note in reply["notes"])
    table = cells(asked(memory, tmp_path, "visits", **FAR, by="day"))
    assert table["unknown_s"] == pytest.approx(86.7, abs=0.1)
    assert table["placed_s"] + table["unknown_s"] == pytest.approx(table["recorded_s"], abs=0.2)


def test_poses_that_no_transform_places_are_unknown_time(tmp_path: Path) -> None:
    maps = [
        tf((T0 + at) * S, transform((T0 + at) * S, "map", "odom", (1.0, 0.0, 0.0)))
        for at in (*range(60), *range(160, 220))
    ]
    memory = world(tmp_path, [*life(220), *maps])
    reply = asked(memory, tmp_path, "visits", **FAR)
    assert (reply["frame_id"], reply["total"]) == ("map", 0)
    # A transform holds for 2 s where no other follows.
    assert reply["unknown_s"] == pytest.approx(100, abs=5)


def test_pauses_of_the_recording_are_no_unknown_time(tmp_path: Path) -> None:
    """What was not recorded is in the gaps: a robot that is off is nowhere."""
    world(tmp_path, life(60), name="first")
    later = [replace(one, log_time=one.log_time + 600 * S) for one in life(60)]
    memory = world(tmp_path, later, name="second")
    for scope in ({"where": HERE}, {"while": CALM}):
        assert "unknown_s" not in asked(memory, tmp_path, "find_matches", **PRESSED, **scope)
    assert "unknown_s" not in asked(memory, tmp_path, "visits", **HERE)


def brute(times: Sequence[int], first: int, last: int, start: int, end: int) -> int:
    """How much (ns) of a window a topic leaves open, given all its times and what was recorded."""
    ends = sorted({first, last, *times})
    apart = [(a, b) for a, b in pairwise(ends) if b - a > SILENCE_NS]
    return sum(max(0, min(b, end) - max(a, start)) for a, b in apart)


@settings(max_examples=examples(25), suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), split_s=st.sampled_from([5, 10, 60]), stored=st.booleans())
def test_unknown_time_is_what_brute_force_says(seed: int, split_s: int, stored: bool) -> None:
    draw = random.Random(seed)
    silent: dict[str, list[tuple[float, float]]] = {"/odom": [], "/mood": []}
    for spans in silent.values():
        for _ in range(draw.randrange(4)):
            begin = draw.randrange(100)
            spans.append((begin, begin + draw.randrange(30)))
    messages = life(120, silent)
    times = {name: [one.log_time for one in messages if one.topic == name] for name in silent}
    first, last = T0 * S, (T0 + 119) * S
    last = max(last, *times["/odom"][-1:])
    start, end = sorted(T0 + draw.randrange(120) for _ in range(2))
    bounds = first, last, start * S, min(end * S, last)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        memory = world(bag_dir, messages, split_s=split_s, stored=stored)
        window = {"start": start, "end": end}
        for given, name in (({"where": HERE}, "/odom"), ({"while": CALM}, "/mood")):
            if len(times[name]) < 20:
                continue
            found = asked(memory, bag_dir, "find_matches", **PRESSED, **given, **window)
            expected = brute(times[name], *bounds) / S
            assert found.get("unknown_s", 0) == pytest.approx(expected, abs=1e-3)
            assert ("unknown_s" in found) is (expected > 0)
            by_hour = asked(
                memory, bag_dir, "find_matches", **PRESSED, **given, **window, by="hour"
            )
            assert cells(by_hour).get("unknown_s", 0) == pytest.approx(expected, abs=0.06)
            if name == "/odom":
                visited = asked(memory, bag_dir, "visits", **HERE, **window)
                assert visited.get("unknown_s", 0) == found.get("unknown_s", 0)
