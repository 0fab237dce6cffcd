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
    StateLevel,
    charge_levels,
    charge_of,
    is_still,
    levels_of,
)
from ros2_memory.core.model import JsonValue

TWIST = "geometry_msgs/msg/Twist"


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


@pytest.mark.parametrize("charge", [math.nan, -1.0, 101.0, math.inf, None, "full", True])
def test_a_charge_that_is_not_known_has_no_level(charge: JsonValue) -> None:
    assert charge_of({"percentage": charge}) is None
    assert levels_of({"percentage": charge}, BATTERY) == ()


numbers = st.sampled_from([0.0, -0.0, 1e-5, 0.04, 0.15, 0.3, 1.0, 80.0, -2.0, math.nan, math.inf])


@given(st.lists(numbers, max_size=8))
def test_levels_of_columns_are_those_of_the_values(rows: list[float]) -> None:
    column = np.array(rows, np.float64)
    charges = charge_levels(column).tolist()
    known = [levels_of({"percentage": number}, BATTERY) for number in rows]
    assert charges == [found[0].value if found else -1 for found in known]
    velocities = [levels_of({"linear": {"x": number}}, TWIST)[0].value for number in rows]
    assert (~is_still(column)).tolist() == [bool(level) for level in velocities]
