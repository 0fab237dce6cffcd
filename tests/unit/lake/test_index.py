"""What is read again of a lake, and what stays, when more is shipped while a server runs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path

import pyarrow as pa
import pytest

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.lake.engines.base import DataFiles, LakeEngine, Parameters
from ros2_memory.lake.tables import day_of
from tests.support.bags import detections, text, write_mcap
from tests.support.fleets import SEEN, START_S
from tests.support.lakes import lake_robot, robot_bags, ship

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
        self._passes = 0

    def ship(self, starts_s: Sequence[int], label: str = "cup", name: str = "") -> None:
        """Ships bags that begin at these times, and in which the robot saw something."""
        self._passes += 1
        bags = self._folder / f"bags_{self._passes}"
        for start_s in starts_s:
            at = start_s * NS_PER_S
            messages = [detections(at, [label]), text(at, label)]
            write_mcap(bags / "rec" / f"{name or f'rec_{start_s}'}.mcap", messages)
        ship(self._folder / "lake", [robot_bags("hall", bags)], most_bags=500)

    def robot(self, **how: int) -> Memory:
        return lake_robot(self._folder / "lake", self.engine, **how)


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
    days = [day_of(at * NS_PER_S) for at in (old - DAY_S, old, old + DAY_S, now)]
    assert shipping.engine.days() == {days[1], days[3]}
    for new, looked_at in (
        ([], set()),
        ([now + 60], {days[3]}),
        ([old - DAY_S, old + DAY_S], {days[0], days[2]}),
    ):
        if new:
            shipping.ship(new, label="fork")
        assert {*new} <= {*starts(robot)}
        assert shipping.engine.days() == looked_at


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


def test_a_bag_of_older_days_is_found_while_these_are_looked_at_again(
    shipping: Shipping, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = START_S - DAY_S
    robot = shipping.robot(days=1, most_bags=1)
    index = robot.index
    for newest in (older, START_S):
        shipping.ship([newest])
        assert starts(robot) == [newest]
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


def test_days_that_are_looked_at_late_show_nothing_about_the_robots_clock(
    shipping: Shipping,
) -> None:
    before, last = START_S - 2 * DAY_S, START_S - DAY_S + 60
    shipping.ship([START_S])
    robots = shipping.robot(), shipping.robot(days=2, most_bags=1)
    assert [starts(robot) for robot in robots] == [[START_S]] * 2
    shipping.ship([before, last], label="fork")
    assert [starts(robot) for robot in robots] == [[before, last, START_S], [last, START_S]]
    found = robots[0].index.snapshot()
    assert (found.dating.faults, found.earliest) == ((), found.bags[0].start)
    older = robots[1].index.snapshot(before * NS_PER_S)
    assert [bag.start // NS_PER_S for bag in older.bags] == [before, last]
    assert older.dating.faults == ()


def test_pauses_between_splits_and_between_recordings_are_told_apart_as_on_the_robot(
    tmp_path: Path, engine: LakeEngine
) -> None:
    bags = tmp_path / "bags"
    for name, begin in (("one/one_0", 0), ("one/one_1", 15), ("two/two_0", 30)):
        at = START_S + begin
        write_mcap(bags / f"{name}.mcap", [text((at + n) * NS_PER_S, "here") for n in range(10)])
    on_robot = robot_bags("hall", bags)
    ship(tmp_path / "lake", [on_robot])
    pause = (START_S + 24) * NS_PER_S, (START_S + 30) * NS_PER_S
    for robot in (on_robot.memory, lake_robot(tmp_path / "lake", engine)):
        assert [*robot.index.refresh().gaps] == [pause]


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
