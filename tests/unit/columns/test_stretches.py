"""What follows from whole parts is joined by stretches of the clock, and goes with any of these."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from ros2_memory.columns import scan
from ros2_memory.columns.scan import Stretch
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.history.scan import joined_back, open_scan
from ros2_memory.history.view import View
from ros2_memory.insights.topic_events import events_in
from ros2_memory.serving import backfill
from tests.support.bags import McapLayout, Msg, boolean, odom, tf, transform, write_mcap
from tests.support.column_worlds import World
from tests.unit.columns.test_fragments import WORDS, Words

S = NS_PER_S
T0 = 1_700_000_400 * S
LENGTH = 1200 * S
"""Of a stretch in these tests: one begins at T0."""
WINDOW = TimeWindow(T0 - LENGTH, T0 + 6 * LENGTH)


@pytest.fixture(autouse=True, scope="module")
def length_of_stretches() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (scan, backfill):
            patch.setattr(module, "STRETCH_NS", LENGTH)
        yield


def driven(number: int) -> list[Msg]:
    """Odometry of 300 s."""
    start = T0 + number * 300 * S
    return [odom(start + n * 5 * S, number + n / 300, 0.1) for n in range(60)]


def docked(number: int) -> list[Msg]:
    return [boolean(pose.log_time, n % 7 > 3, "/docked") for n, pose in enumerate(driven(number))]


@pytest.fixture(scope="module")
def world(length_of_stretches: None, tmp_path_factory: pytest.TempPathFactory) -> World:
    """Four stretches and a half in bags of 300 s, of three recordings."""
    folder = tmp_path_factory.mktemp("bags")
    for number in range(18):
        poses = driven(number)
        write_mcap(folder / f"rec_{number // 6}" / f"{number}.mcap", poses)
    world = World.of(folder)
    world.fill()
    return world


@pytest.fixture
def latched(tmp_path: Path) -> World:
    """Three recordings of two stretches each; each begins with what was said 5 s before."""
    layout = McapLayout(latched=frozenset({"/docked"}))
    for number in range(24):
        messages = [*driven(number), *docked(number)]
        if number and not number % 8:
            last = docked(number - 1)[-1]
            again = replace(last, log_time=last.log_time + 5 * S + 1, publish_time=last.log_time)
            messages.insert(1, again)
        write_mcap(tmp_path / f"rec_{number // 8}" / f"{number:02}.mcap", messages, layout)
    world = World.of(tmp_path)
    world.fill()
    return world


def latched_stretches(world: World) -> dict[int, tuple[int, ...] | None]:
    opened = open_scan(View(world.memory, Call()), "/docked", WINDOW)
    return {one.window.start: one.parts for one in opened.stretches()}


def test_what_was_received_again_is_of_the_parts_that_had_it_before_and_counts_without_them(
    latched: World, tmp_path: Path
) -> None:
    parts = latched_stretches(latched)
    own = [parts[T0 + n * LENGTH] or () for n in range(5)]
    assert all(own)
    # The third stretch begins a recording, with what the second ends with.
    assert [len({*one} & {*other}) for one, other in pairwise(own)] == [0, 1, 0, 1]

    def rows(world: World) -> list[int]:
        opened = open_scan(View(world.memory, Call()), "/docked", WINDOW)
        return [len(one) for one in opened.rows(among=TimeWindow(T0 + 2 * LENGTH, WINDOW.stop))]

    def events(world: World) -> object:
        return events_in(View(world.memory, Call()), "/docked", WINDOW)

    before = rows(latched)
    assert latched_stretches(latched)[T0 + 2 * LENGTH]
    assert events(latched) == events(latched.unstored())
    (tmp_path / "rec_0" / "07.mcap").unlink()
    again = World.of(tmp_path)
    assert (rows(again)[0], rows(again)[1:]) == (before[0] + 1, before[1:])
    assert latched_stretches(again).get(T0 + 2 * LENGTH) is None
    assert events(again) == events(again.unstored())


def test_what_was_made_in_time_is_told_before_the_time_is_over(world: World) -> None:
    view = View(world.memory, Call())
    opened = open_scan(view, "/odom", WINDOW)

    def made(stretch: Stretch) -> Iterator[tuple[int, Words]]:
        yield stretch.window.start, Words("one")
        if stretch.parts is not None:
            raise QueryTimeoutError("no time")

    found: list[int] = []
    with pytest.raises(QueryTimeoutError):
        found += (start for start, _ in joined_back(view, opened, WORDS, made))
    newest = next(one for one in opened.stretches() if one.parts is not None)
    assert found[-1] == newest.window.start


def test_what_could_not_be_decoded_is_said_again_of_what_is_stored(tmp_path: Path) -> None:
    for number in range(14):
        start = T0 + number * 300 * S
        fixed = tf(start, transform(start, "map", "odom", (1, 0, 0)), topic="/tf_static")
        torn = Msg("/tf_static", "tf2_msgs/msg/TFMessage", start + S, b"\0\1\0\0\xff\xff\xff\x7f")
        messages = [fixed, *[torn] * (number == 2), *driven(number)]
        write_mcap(tmp_path / "rec" / f"{number}.mcap", messages)
    world = World.of(tmp_path)
    world.fill()
    for memory in (world.unstored().memory, world.memory, World.of(tmp_path).memory):
        view = View(memory, Call())
        assert view.sessions.static(view.sessions.of(tmp_path / "rec"))
        assert not view.notes.complete
        [said] = [one for one in view.notes.sentences() if "could not be decoded" in one]
        assert said.startswith("messages of /tf_static could not be decoded: ")
