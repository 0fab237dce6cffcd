"""What is read again of a lake, and what stays, when more is shipped; how far back searches go."""

import re
from collections.abc import Iterable, Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Deadline, utc_day
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Call, Memory
from ros2_memory.insights.fields import describe_type
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.memory import LakeIndex, newest_days
from ros2_memory.lake.tables import NAMESPACE, TABLES, open_tables
from ros2_memory.lake.upkeep import Tombstone, forget_in_lake
from ros2_memory.lake.warehouse import Days, LakeFile
from tests.support.bags import Msg, battery, boolean, detections, text, write_mcap
from tests.support.clocks import FixedClock, SettableClock
from tests.support.fleets import NOW, SEEN, START_S, reply
from tests.support.lakes import (
    lake_in,
    lake_robot,
    lake_robots,
    location,
    robot_bags,
    ship,
    ship_from,
)
from tests.support.memories import clause

DAY_S = 86_400


class WatchedLake(Lake):
    """Keeps which files were read."""

    def __init__(self, folder: Path) -> None:
        super().__init__(lake_in(folder), memory_mb=256)
        self.read: set[str] = set()

    def rows(self, name: str, files: Iterable[LakeFile], *how: Any) -> pa.Table:
        files = [*files]
        self.read.update(file.location for file in files)
        return super().rows(name, files, *how)

    def days_read(self) -> set[str]:
        """The days of the files that were read since it was last asked."""
        found = {*re.findall("/day=([0-9-]+)/", str(self.read))}
        self.read.clear()
        return found


class Shipping:
    """A robot whose bags are shipped a few at a time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.lake = WatchedLake(folder / "lake")
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

    def robot(self, **how: Any) -> Memory:
        return lake_robots(self.lake, ["hall"], **how)["hall"]


@pytest.fixture
def shipping(tmp_path: Path) -> Shipping:
    return Shipping(tmp_path)


def starts(robot: Memory) -> list[int]:
    return [bag.start // NS_PER_S for bag in robot.index.refresh().bags]


def test_only_days_with_new_files_are_read_again(shipping: Shipping) -> None:
    old, now = START_S - 2 * DAY_S, START_S
    shipping.ship([old, old + 60, now])
    robot = shipping.robot()
    assert starts(robot) == [old, old + 60, now]
    days = [str(utc_day(at * NS_PER_S)) for at in (old - DAY_S, old, old + DAY_S, now)]
    assert shipping.lake.days_read() == {days[1], days[3]}
    for new, looked_at in (
        ([], set()),
        ([now + 60], {days[3]}),
        ([old - DAY_S, old + DAY_S], {days[0], days[2]}),
    ):
        if new:
            shipping.ship(new, label="fork")
        assert {*new} <= {*starts(robot)}
        assert shipping.lake.days_read() == looked_at


def test_a_bag_of_older_days_is_found_while_these_are_looked_at_again(
    shipping: Shipping, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = START_S - DAY_S
    robot = shipping.robot(days=1, most_bags=1)
    index = robot.index
    for last in (older, START_S):
        shipping.ship([last])
        assert starts(robot) == [last]
    bag, *_ = index.snapshot(older * NS_PER_S).bags
    shipping.ship([older + 60], label="fork")
    index.refresh()
    found: list[BagSummary] = []
    rows = shipping.lake.rows

    def read(*asked: Any) -> pa.Table:
        found.append(robot.reader.summarize(bag.path))
        return rows(*asked)

    monkeypatch.setattr(shipping.lake, "rows", read)
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
    tmp_path: Path,
) -> None:
    bags = tmp_path / "bags"
    for name, begin in (("one/one_0", 0), ("one/one_1", 15), ("two/two_0", 30)):
        at = START_S + begin
        write_mcap(bags / f"{name}.mcap", [text((at + n) * NS_PER_S, "here") for n in range(10)])
    on_robot = robot_bags("hall", bags)
    ship(tmp_path / "lake", [on_robot])
    pause = (START_S + 24) * NS_PER_S, (START_S + 30) * NS_PER_S
    for robot in (on_robot.memory, lake_robot(tmp_path / "lake")):
        assert [*robot.index.refresh().gaps] == [pause]


def test_a_lake_without_a_bag_shows_none_that_it_had(shipping: Shipping, tmp_path: Path) -> None:
    """Be it that everything was forgotten, or that its tables were made again."""
    shipping.ship([START_S - 40 * DAY_S, START_S])
    where, index = location(tmp_path / "lake"), shipping.robot(days=1, most_bags=1).index
    assert isinstance(index, LakeIndex)
    assert index.snapshot().older is not None
    assert where.last_change() is not None
    everything = Tombstone("hall", 0, START_S * 2 * NS_PER_S)
    with where.writable() as tables:
        forget_in_lake(tables, everything)
    shipping.lake.refresh()  # as the index of another robot does
    assert not index.snapshot((START_S - 40 * DAY_S) * NS_PER_S).bags
    assert where.last_change() is None
    shipping.ship([START_S + 60], label="fork")
    assert [*shipping.lake.days("bags")] == []
    shipping.lake.refresh()
    assert [*shipping.lake.days("bags")] == ["hall"]
    with where.opened() as catalog:
        for name in TABLES:
            catalog.drop_table(f"{NAMESPACE}.{name}")
        open_tables(catalog, TABLES)
    shipping.lake.refresh()
    assert [*shipping.lake.days("bags")] == []


def test_bags_of_one_name_have_paths_of_their_own_and_are_all_searched(shipping: Shipping) -> None:
    """As of a robot that was set up again: its recordings may have names of before.

    A question that is under way reads the bag that it found.
    """
    robot, found = shipping.robot(), list[BagFile]()
    of_days = Robot("hall", shipping.robot(days=1, most_bags=1), in_lake=True)
    for ago, label in ((4, "mug"), (0, "cup"), (2, "fork")):
        shipping.ship([START_S - ago * DAY_S], label, name="rec_0")
        bags = robot.index.refresh().bags
        assert {*found} < {*bags}
        found = [*bags]
    assert len({bag.file for bag in found}) == 3
    for bag, (label, ago) in zip(found, (("mug", 4), ("fork", 2), ("cup", 0)), strict=True):
        [record] = robot.reader.records(bag.path, [SEEN], TimeWindow(0, bag.end + 1))
        match = asked(of_days, "find_last_match", label)["matches"]
        assert [row["timestamp"] for row in match] == [START_S - ago * DAY_S]
        assert record.log_time == bag.start == (START_S - ago * DAY_S) * NS_PER_S


def test_after_a_clock_was_set_back_what_is_shipped_is_found(shipping: Shipping) -> None:
    clock = SettableClock(NOW)
    index = LakeIndex(shipping.lake, "hall", Path("/hall"), clock)
    shipping.ship([START_S])
    assert len(index.snapshot().bags) == 1
    clock.at -= 3600 * NS_PER_S
    shipping.ship([START_S + 60])
    shipping.lake.refresh(0)
    assert len(index.snapshot().bags) == 2


FIRST = date(2024, 2, 27)
SIZES = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 50)), max_size=12)


def days_of(sizes: Sequence[tuple[int, int]]) -> Days:
    """Days with gaps between them and files of so many rows."""
    found, day = {}, FIRST
    for gap, size in sizes:
        day += timedelta(days=gap + 1)
        found[day] = (LakeFile("hall", day, f"file:///{day}", size, 0, "", ""),)
    return found


@given(SIZES, st.integers(1, 60), st.integers(1, 40), st.integers(0, 500))
def test_the_newest_days_are_as_many_as_fit_and_at_least_those_asked_for(
    sizes: list[tuple[int, int]], most: int, fewest: int, after: int
) -> None:
    days, until = days_of(sizes), FIRST + timedelta(days=after)
    known = [day for day in days if day <= until]
    found, before = newest_days(days, until, most, fewest)
    assert [*found] == [day for day in known if before is None or day > before]
    if not found:
        assert not known
        return
    assert max(found) == known[-1]
    always = known[-1] - timedelta(days=fewest)
    rows = sum(file.rows for files in found.values() for file in files)
    assert rows <= most or min(found) > always
    if before is not None:
        assert rows + days[before][0].rows > most
        assert before <= always


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A robot of which one day at a time is looked at: it saw a mug, a day later a fork, then cups.

    Its track is of another topic since.
    """
    folder = tmp_path_factory.mktemp("old")
    for ago, seen in ((7, "mug"), (6, "fork"), *((ago, "cup") for ago in (4, 3, 1, 0))):
        at = (START_S - ago * DAY_S) * NS_PER_S
        messages: list[Msg] = [detections(at, [seen]), text(at + NS_PER_S, seen)]
        if seen == "mug":
            messages.append(detections(at + 2, ["spoon"], topic="/vision/old"))
        write_mcap(folder / "hall" / "rec" / f"rec_{7 - ago}.mcap", messages)
    ship_from(folder, most_bags=9)
    memory = lake_robot(folder / "lake", days=1, most_bags=1)
    return Robot("hall", memory, in_lake=True)


def asked(of: Robot, tool: str, label: str, topic: str = SEEN, **more: object) -> Any:
    given = {"topic": topic, "condition_type": "contains", "value": label, **more}
    return reply(Fleet([of], FixedClock(NOW)), tool, given)


def test_what_was_seen_before_the_newest_days_is_found_and_never_is_of_all(robot: Robot) -> None:
    for label, ago in (("cup", 0), ("fork", 6), ("mug", 7), ("elephant", None)):
        found = asked(robot, "find_last_match", label)
        times = [row["timestamp"] for row in found["matches"]]
        assert times == ([] if ago is None else [START_S - ago * DAY_S])
        assert ("never" in found) is (ago is None)
        assert "not looked at" not in str(found)
    before = START_S - 2 * DAY_S
    assert "never" not in asked(robot, "find_last_match", "mug", before=before)
    # A topic of old days alone.
    assert len(asked(robot, "find_last_match", "spoon", "/vision/old")["matches"]) == 1
    assert asked(robot, "find_last_match", "cup", "/vision/old")["never"] == ["hall"]


def test_older_days_end_with_a_pause_and_begin_where_the_memory_does(robot: Robot) -> None:
    """Two of the times asked are in pauses of more than a day, one is before the first bag."""
    fleet = Fleet([robot], FixedClock(NOW))
    for at, reason in ((-5.5, "gap"), (-2.5, "gap"), (-40, "outside_range")):
        span = {"start": START_S + at * DAY_S, "end": START_S + at * DAY_S + 60}
        found = reply(fleet, "get_topic_in_range", {"topic": SEEN, "robot": "hall", **span})
        assert found["reason"] == reason


def test_days_before_are_named_only_where_the_answer_is_of_them(robot: Robot) -> None:
    of_the_newest: list[Any] = [{"start": START_S}, {"last_s": 60}]
    before: list[Any] = [{}, {"start": START_S - DAY_S}, {"end": START_S - 2 * DAY_S}]
    for span in of_the_newest + before:
        for name in ({}, {"robot": "hall"}):
            found = asked(robot, "find_matches", "cup", **span, **name)
            assert ("not looked at" in str(found)) is (span in before), span


@pytest.mark.parametrize("tool", ["list_frames", "memory_status", "data_time_range"])
def test_what_takes_no_time_names_days_before_and_asks_for_no_time(robot: Robot, tool: str) -> None:
    notes = str(asked_alone(robot, tool)["notes"])
    assert "which were not looked at" in notes
    assert "an end" not in notes


@patch("ros2_memory.history.view.READING_S", 0.0)
def test_where_the_time_is_short_it_says_how_far_it_looked(robot: Robot) -> None:
    mug, fleet = {"condition_type": "contains", "value": "mug"}, Fleet([robot], FixedClock(NOW))
    for topic in (SEEN, "/none"):
        given = {**mug, "topic": topic, "robot": "hall"}
        found = reply(fleet, "find_last_match", given, Call(Deadline.after(60)))
        assert found.get("value") is None
        assert "the lake has days before " in str(found)


LONG_AGO_S = START_S - 100 * DAY_S


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A robot of which one day at a time is looked at, and that has changed since `LONG_AGO_S`.

    Then its bumper was pressed, it spoke and docked, and its battery stated percent, which states
    fractions since. The day before it named its map.
    """
    folder = tmp_path_factory.mktemp("changed")
    for ago in (101, 100, 2, 1, 0):
        at = (START_S - ago * DAY_S) * NS_PER_S
        messages: list[Msg] = [boolean(at + 60 * NS_PER_S, ago == 100)]
        messages.append(battery(at + 61 * NS_PER_S, 80.0 if ago == 100 else 0.8))
        if ago == 100:
            docks = ((2, "docking"), (4, "docking"), (6, ""))
            said = [text(at + after * NS_PER_S, word, "/dock") for after, word in docks]
            messages = [text(at, "ouch"), *said, *messages]
        if ago == 101:
            messages.insert(0, text(at, "the map", "/map_name"))
        write_mcap(folder / "hall" / f"rec_{ago}" / f"rec_{ago}_0.mcap", messages)
    topics = ("/chatter", "/dock", "/bumper", "/battery_state", "/map_name")
    ship_from(folder, messages=topics, most_bags=9)
    memory = lake_robot(folder / "lake", days=1, most_bags=1)
    return Robot("hall", memory, in_lake=True)


def asked_alone(of: Robot, tool: str, **given: object) -> Any:
    return reply(Fleet([of], FixedClock(NOW)), tool, {"robot": "hall", **given})


@pytest.mark.parametrize("before", [{}, {"before": LONG_AGO_S + DAY_S}], ids=["ever", "before"])
def test_a_value_is_of_the_days_of_the_match_or_before_them_and_of_no_day_is_not_recorded(
    changed: Robot, before: dict[str, Any]
) -> None:
    pressed = {"condition_topic": "/bumper", "condition_type": "equals", "value": True, **before}
    for topic, said in (("/chatter", "ouch"), ("/map_name", "the map"), ("/none", None)):
        found = asked_alone(changed, "get_value_when", value_topic=topic, **pressed)
        if said is None:
            assert found["reason"] == "topic_not_recorded"
        else:
            assert (found["timestamp"], found["value"]["value"]) == (LONG_AGO_S + 60, said)
        assert "not looked at" not in str(found)


def test_what_a_topic_is_follows_from_the_days_that_are_searched(changed: Robot) -> None:
    until = {"end": LONG_AGO_S + DAY_S}
    docked = clause("/dock", "contains", "docking")
    [episode] = asked_alone(changed, "find_matches", **docked, **until)["episodes"]
    assert (episode["start"], episode["end"]) == (LONG_AGO_S + 2, LONG_AGO_S + 6)
    full = clause("/battery_state", "above", 50)
    [match] = asked_alone(changed, "find_matches", **full, field="percentage", **until)["sightings"]
    assert match["first_seen"] == LONG_AGO_S + 61


def test_a_type_of_days_before_is_described(changed: Robot) -> None:
    found = describe_type(changed.memory, Call(), "std_msgs/msg/String")
    assert found.topics == ("/chatter", "/dock")
    with pytest.raises(NoDataError, match=r"BatteryState, std_msgs/msg/Bool$"):
        describe_type(changed.memory, Call(), "std_msgs/msg/Int8")


def test_each_of_two_windows_is_compared_by_its_own_days(changed: Robot) -> None:
    today, then = (START_S, START_S + 70), (LONG_AGO_S, LONG_AGO_S + 70)
    for (start, end), (with_start, with_end) in ((today, then), (then, today)):
        spans = {"start": start, "end": end, "with_start": with_start, "with_end": with_end}
        found = asked_alone(changed, "compare", **spans)
        recorded = [found["recorded_s"][name] for name in ("this", "with")]
        assert sorted(recorded) == [1.0, 61.0]
        assert (found["recorded_s"]["this"] == 61.0) is (start == LONG_AGO_S)
        assert "nothing was recorded between" not in str(found)
        assert "find_things answers about each" in str(found["notes"])
