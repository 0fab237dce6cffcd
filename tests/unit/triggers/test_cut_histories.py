"""However a history is cut into splits and rotations, a rule fires at the same times."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, boolean
from tests.support.watched_bags import T0, WatchedBags, rule
from tests.unit.triggers.test_fold import expected

S = NS_PER_S
VALUES = st.lists(st.sampled_from([True, True, True, False]), min_size=4, max_size=24)


def published(at: int, value: bool, late: int) -> Msg:
    """A message that is received so many milliseconds after it was published."""
    made = boolean(at + late * 1_000_000, value)
    return Msg(made.topic, made.type, made.log_time, made.body, at)


@settings(max_examples=15, deadline=None)
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
