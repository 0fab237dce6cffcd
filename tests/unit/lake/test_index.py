"""What is read again of a lake, and what stays, when more is shipped while a server runs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, timedelta
from pathlib import Path

import pyarrow as pa
import pytest

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.index.timeline import SEGMENT_BAGS
from ros2_memory.lake.engines.base import DataFiles, LakeEngine, Parameters
from ros2_memory.lake.memory import MOST_BAGS
from ros2_memory.lake.tables import day_of
from tests.support.bags import detections, text, write_mcap
from tests.support.fleets import SEEN, START_S
from tests.support.lake_rows import fill, lake_in, lake_robots
from tests.support.memories import memory_of, with_store

DAY_S = 86_400


class WatchedEngine(LakeEngine):
    """Keeps which files were read."""

    def __init__(self, engine: LakeEngine) -> None:
        self._engine = engine
        self.read: set[str] = set()

    def select(self, sql: str, table: str, files: DataFiles, parameters: Parameters) -> pa.Table:
        self.read.update(files.locations)
        return self._engine.select(sql, table, files, parameters)

    def days(self) -> set[date]:
        """The days of the files that were read since it was last asked."""
        folders = (part for each in self.read for part in each.split("/"))
        found = {date.fromisoformat(each[4:]) for each in folders if each.startswith("day=")}
        self.read.clear()
        return found


class Shipping:
    """A robot whose bags are shipped a few at a time."""

    def __init__(self, folder: Path, engine: LakeEngine) -> None:
        self._folder = folder
        self.engine = WatchedEngine(engine)
        self._catalog = lake_in(folder)
        self._passes = 0

    def ship(self, starts_s: Sequence[int], label: str = "cup", name: str = "") -> None:
        """Ships bags that begin at these times, and in which the robot saw something."""
        self._passes += 1
        bags = self._folder / f"bags_{self._passes}"
        for start_s in starts_s:
            at = start_s * NS_PER_S
            messages = [detections(at, [label]), text(at, label)]
            write_mcap(bags / "rec" / f"{name or f'rec_{start_s}'}.mcap", messages)
        fill(self._catalog, {"hall": with_store(memory_of(bags), bags)}, ["/chatter"])

    def robot(self, days: int = 31, most_bags: int = MOST_BAGS) -> Memory:
        robots = lake_robots(self._catalog, self.engine, ["hall"], days=days, most_bags=most_bags)
        return robots["hall"]


@pytest.fixture
def shipping(tmp_path: Path, engine: LakeEngine) -> Shipping:
    return Shipping(tmp_path, engine)


def starts(robot: Memory) -> list[int]:
    return [bag.start // NS_PER_S for bag in robot.index.refresh().bags]


def test_only_days_with_new_files_are_read_again(shipping: Shipping) -> None:
    old, now = START_S - 2 * DAY_S, START_S
    shipping.ship([old, old + 60, now])
    robot = shipping.robot()
    assert starts(robot) == [old, old + 60, now]
    assert shipping.engine.days() == {day_of(old * NS_PER_S), day_of(now * NS_PER_S)}
    assert starts(robot) == [old, old + 60, now]
    assert shipping.engine.days() == set()
    shipping.ship([now + 60])
    assert starts(robot) == [old, old + 60, now, now + 60]
    assert shipping.engine.days() == {day_of(now * NS_PER_S)}


def test_days_on_both_sides_of_a_known_one_are_read(shipping: Shipping) -> None:
    middle = START_S - DAY_S
    shipping.ship([middle])
    robot = shipping.robot()
    assert starts(robot) == [middle]
    shipping.engine.days()
    shipping.ship([START_S - 2 * DAY_S, START_S], label="fork")
    assert starts(robot) == [START_S - 2 * DAY_S, middle, START_S]
    known = day_of(middle * NS_PER_S)
    assert shipping.engine.days() == {known - timedelta(days=1), known + timedelta(days=1)}


def test_segments_without_a_new_bag_stay(shipping: Shipping) -> None:
    """What was computed of them is kept by segment."""
    shipping.ship(range(START_S, START_S + SEGMENT_BAGS + 8))
    robot = shipping.robot()
    before = robot.index.refresh().timeline.segments
    shipping.ship([START_S + 2 * SEGMENT_BAGS])
    after = robot.index.refresh().timeline.segments
    assert len(before) > 1
    assert [*map(id, after[: len(before) - 1])] == [*map(id, before[:-1])]


def test_a_bag_keeps_its_path_where_a_late_one_comes_before_it(shipping: Shipping) -> None:
    """A question that is under way reads the bag that it found."""
    shipping.ship([START_S])
    robot = shipping.robot()
    [bag] = robot.index.refresh().bags
    shipping.ship([START_S - 60], label="fork")
    late, same = robot.index.refresh().bags
    assert same is bag
    assert late.file != bag.file
    [record] = robot.reader.records(bag.path, [SEEN], TimeWindow(bag.start, bag.end + 1))
    assert b"cup" in record.payload


def test_the_newest_days_move_on_and_older_ones_are_still_found(shipping: Shipping) -> None:
    robot = shipping.robot(days=1, most_bags=1)
    shipping.ship([START_S - DAY_S])
    assert starts(robot) == [START_S - DAY_S]
    shipping.ship([START_S])
    assert starts(robot) == [START_S]
    older = robot.index.snapshot((START_S - DAY_S) * NS_PER_S)
    assert older.bags[0].start == (START_S - DAY_S) * NS_PER_S


def test_a_bag_of_older_days_is_found_while_these_are_looked_at_again(
    shipping: Shipping, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = START_S - DAY_S
    shipping.ship([older, START_S])
    robot = shipping.robot(days=1, most_bags=1)
    index = robot.index
    assert starts(robot) == [START_S]
    bag, *_ = index.snapshot(older * NS_PER_S).bags
    shipping.ship([older + 60], label="fork")
    index.refresh()
    found: list[BagSummary] = []
    select = shipping.engine.select

    def selected(sql: str, table: str, files: DataFiles, parameters: Parameters) -> pa.Table:
        found.append(robot.reader.summarize(bag.path))
        return select(sql, table, files, parameters)

    monkeypatch.setattr(shipping.engine, "select", selected)
    assert len(index.snapshot(older * NS_PER_S).bags) == 3
    assert set(found) == {bag.summary}


def test_bags_that_are_shipped_late_show_nothing_about_the_robots_clock(shipping: Shipping) -> None:
    shipping.ship([START_S])
    robot = shipping.robot()
    assert starts(robot) == [START_S]
    shipping.ship([START_S - 2 * DAY_S, START_S - 2 * DAY_S + 60], label="fork")
    found = robot.index.refresh()
    assert len(found.bags) == 3
    assert found.dating.faults == ()
    assert found.earliest == found.bags[0].start


def test_older_days_that_are_looked_at_show_nothing_about_the_robots_clock(
    shipping: Shipping,
) -> None:
    before, last = START_S - 2 * DAY_S, START_S - DAY_S + 60
    shipping.ship([before, last, START_S])
    robot = shipping.robot(days=2, most_bags=1)
    assert starts(robot) == [last, START_S]
    older = robot.index.snapshot(before * NS_PER_S)
    assert [bag.start // NS_PER_S for bag in older.bags] == [before, last]
    assert older.dating.faults == ()


def test_pauses_between_splits_and_between_recordings_are_told_apart_as_on_the_robot(
    tmp_path: Path, engine: LakeEngine
) -> None:
    bags = tmp_path / "bags"
    for name, begin in (("one/one_0", 0), ("one/one_1", 15), ("two/two_0", 30)):
        at = START_S + begin
        write_mcap(bags / f"{name}.mcap", [text((at + n) * NS_PER_S, "here") for n in range(10)])
    on_robot = with_store(memory_of(bags), bags)
    catalog = lake_in(tmp_path)
    fill(catalog, {"hall": on_robot}, ["/chatter"])
    in_lake = lake_robots(catalog, engine, ["hall"])["hall"]
    pause = (START_S + 24) * NS_PER_S, (START_S + 30) * NS_PER_S
    assert [*on_robot.index.snapshot().gaps] == [pause]
    assert [*in_lake.index.refresh().gaps] == [pause]


def test_bags_of_one_name_have_paths_of_their_own(shipping: Shipping) -> None:
    """As of a robot that was set up again: its recordings may have names of before."""
    robot = shipping.robot()
    shipping.ship([START_S - 2 * DAY_S], name="rec_0")
    shipping.ship([START_S], name="rec_0")
    assert len({bag.file for bag in robot.index.refresh().bags}) == 2
    shipping.ship([START_S - DAY_S], name="rec_0")
    bags = robot.index.refresh().bags
    assert len({bag.file for bag in bags}) == 3
    for bag in bags:
        [record] = robot.reader.records(bag.path, [SEEN], TimeWindow(0, bag.end + 1))
        assert record.log_time == bag.start
