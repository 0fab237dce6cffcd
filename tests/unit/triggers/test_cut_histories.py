"""However a history is cut into splits and rotations, a rule fires at the same times."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, boolean
from tests.support.examples import examples
from tests.support.watched_bags import T0, WatchedBags, flag, rule
from tests.unit.triggers.test_fold import expected

S = NS_PER_S
VALUES = st.lists(st.sampled_from([True, True, True, False]), min_size=4, max_size=24)


def published(at: int, value: bool, late: int) -> Msg:
    """A message that is received so many milliseconds after it was published."""
    made = boolean(at + late * 1_000_000, value)
    return Msg(made.topic, made.type, made.log_time, made.body, at)


@settings(max_examples=examples(15), deadline=None)
@given(
    VALUES,
    st.sampled_from([0, S * 3 // 2, S * 7 // 2]),
    st.lists(st.sampled_from(["split", "rotate", "look", "kill", ""]), min_size=24, max_size=24),
)
def test_a_rule_fires_at_the_times_of_the_uncut_stream(
    values: list[bool], hold: int, steps: list[str]
) -> None:
    stream: list[tuple[int, bool | None]] = []
    with TemporaryDirectory() as folder:
        robot = WatchedBags(Path(folder) / "bags", [rule(hold=hold)])
        name = robot.begin(T0)
        held: list[Msg] = []
        number = 0
        for at, (value, step) in enumerate(zip(values, steps, strict=False)):
            time = T0 + at * S
            stream.append((time, value))
            held.append(published(time, value, 0))
            if step in {"split", "rotate"}:
                # The new recording runs beside the old one, and has its last two messages too.
                overlap = held[-2:]
                robot.split(held, name)
                last = f"{name}_{number}.mcap"
                held, number = [], number + 1
                if step == "rotate":
                    old, name = name, robot.begin(time + S // 2)
                    robot.beat(old, name)
                    robot.hand_over(old, name, overlap[-1].published, last)
                    held = [
                        published(each.published, bool(each.body.data), 1)  # type: ignore[attr-defined]
                        for each in overlap
                    ]
                    number = 0
                    robot.beat(name)
            elif step == "look":
                robot.look()
            elif step == "kill":
                robot.house = robot.new_house()
        if held:
            robot.split(held, name)
        robot.close_all()
        fired = [each - T0 for each in robot.fired_at()]
    # Log times of the copies that count may be a millisecond late.
    wanted = [each - T0 for each in expected(stream, hold)]
    assert fired == pytest.approx(wanted, abs=2_000_000, rel=0)


def test_a_message_that_is_written_late_into_the_next_split_counts_in_its_place(
    tmp_path: Path,
) -> None:
    # As rosbag2 does: by less than a second, also across two splits.
    robot = WatchedBags(tmp_path / "bags", [rule(hold=S * 3 // 2)])
    robot.begin(T0)
    robot.split([flag(0, False), flag(8, True), flag(9, True), flag(10, True)])
    robot.look()
    robot.split([flag(9.5, False), flag(11, True), flag(12, True)])
    robot.close_all()
    assert robot.fired_at() == [T0 + 10 * S + S * 3 // 2]


def test_a_recording_waits_for_the_end_of_the_one_that_it_took_over_from(tmp_path: Path) -> None:
    robot = WatchedBags(tmp_path / "bags", [rule(hold=S * 3 // 2)])
    old = robot.begin(T0)
    robot.split([flag(n, False) for n in range(8)], old)
    new = robot.begin(T0 + 8 * S)
    robot.beat(old, new)
    robot.hand_over(old, new, T0 + 11 * S, f"{old}_1.mcap")
    robot.split([flag(n, n < 14) for n in range(11, 16)], new)
    robot.look()
    assert robot.fired_at() == []
    robot.beat(new)
    robot._splits = 1
    robot.split([flag(n, n >= 10) for n in range(8, 11)], old)
    robot.look()
    robot.split([flag(n, False) for n in range(16, 20)], new)
    robot.close_all()
    assert robot.fired_at() == [T0 + 11 * S + S // 2]
