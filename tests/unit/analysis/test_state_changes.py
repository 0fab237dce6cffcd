from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.state_changes import (
    BATTERY,
    DIAGNOSTICS,
    GOALS,
    LOG,
    Change,
    Report,
    StateChanges,
    StateLevel,
    charge_levels,
    charge_of,
    is_still,
    levels_of,
    reports_of,
)
from ros2_memory.analysis.stated import events_of, stated_by
from ros2_memory.analysis.topic_events import State
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S as S

TWIST = "geometry_msgs/msg/Twist"


def changes_of(*messages: tuple[float, list[StateLevel], list[str]]) -> StateChanges:
    states = [
        State(levels=tuple(levels), reports=tuple(reports)) for _, levels, reports in messages
    ]
    events = events_of(stated_by([round(at * S) for at, *_ in messages], states))
    assert events is not None
    return events.changes


def test_a_level_that_changes_is_a_change_and_its_first_value_is_not() -> None:
    values = [0, 0, 1, 1, 0]
    found = changes_of(*((at, [StateLevel("m", value)], []) for at, value in enumerate(values)))
    assert found.changes == (Change("m", 2 * S, 1), Change("m", 4 * S, 0))


def test_entries_alike_but_for_their_numbers_are_one_report_while_they_follow_each_other() -> None:
    times = [0.0, 1.0, 2.5, 10.0]
    found = changes_of(*((at, [], [f"late by {at:.0f} s"]) for at in times))
    assert found.reports == (
        Report("late by 0 s", 0, round(2.5 * S), 3),
        Report("late by 10 s", 10 * S, 10 * S, 1),
    )


def test_statuses_and_goals_have_a_level_each() -> None:
    status: JsonValue = {
        "status": [
            {"name": "motor", "level": 1, "message": "hot"},
            {"name": "camera", "level": 0, "message": "30 frames/s"},
            {"name": 5, "level": 0},
            "none",
        ]
    }
    assert levels_of(status, DIAGNOSTICS) == (
        StateLevel("status motor", 1, "hot"),
        StateLevel("status camera", 0),
    )
    goal: JsonValue = {"goal_info": {"goal_id": {"uuid": [0, 255]}}, "status": 2}
    assert levels_of({"status_list": [goal, {"status": 1}, None]}, GOALS) == (
        StateLevel("goal 00ff", 2),
    )
    assert levels_of(None, DIAGNOSTICS) == levels_of(7, GOALS) == ()


@pytest.mark.parametrize(
    ("charge", "level"),
    [(1.0, 0), (0.2, 0), (0.199, 1), (0.09, 2), (0.0, 3), (45.0, 0), (12.0, 1)],
)
def test_how_low_a_battery_is_counts_the_fractions_that_it_is_below(
    charge: float, level: int
) -> None:
    assert levels_of({"percentage": charge}, BATTERY) == (StateLevel("charge", level),)


@pytest.mark.parametrize("charge", [math.nan, -1.0, 101.0, math.inf, None, "full", True])
def test_a_charge_that_is_not_known_has_no_level(charge: JsonValue) -> None:
    assert charge_of({"percentage": charge}) is None
    assert levels_of({"percentage": charge}, BATTERY) == ()


def test_a_commanded_velocity_is_zero_where_all_of_it_is() -> None:
    def level(x: float, turn: float) -> int:
        value: JsonValue = {"linear": {"x": x, "y": 0.0}, "angular": {"z": turn}}
        [found] = levels_of(value, TWIST)
        return found.value

    assert level(0.0, -0.0) == level(1e-17, 0.0) == 0
    assert level(0.3, 0.0) == level(0.0, -0.9) == level(math.nan, 0.0) == 1


numbers = st.sampled_from([0.0, -0.0, 1e-5, 0.04, 0.15, 0.3, 1.0, 80.0, -2.0, math.nan, math.inf])


@given(st.lists(numbers, max_size=8))
def test_levels_of_columns_are_those_of_the_values(rows: list[float]) -> None:
    column = np.array(rows, np.float64)
    charges = charge_levels(column).tolist()
    known = [levels_of({"percentage": number}, BATTERY) for number in rows]
    assert charges == [found[0].value if found else -1 for found in known]
    velocities = [levels_of({"linear": {"x": number}}, TWIST)[0].value for number in rows]
    assert (~is_still(column)).tolist() == [bool(level) for level in velocities]


def test_a_log_entry_counts_from_warn_on_and_says_how_bad_it_is() -> None:
    def report(level: int) -> tuple[str, ...]:
        return reports_of({"level": level, "name": "planner", "msg": "no way"}, LOG)

    assert [report(level) for level in (20, 30, 40, 50)] == [
        (),
        ("warning of planner: no way",),
        ("error of planner: no way",),
        ("fatal of planner: no way",),
    ]
    assert reports_of({"level": 40, "name": "", "msg": None}, LOG) == ("error",)
    assert reports_of({"level": 40, "name": "n", "msg": "x" * 900}, LOG)[0].endswith("…") or (
        len(reports_of({"level": 40, "name": "n", "msg": "x" * 900}, LOG)[0]) <= 130
    )
