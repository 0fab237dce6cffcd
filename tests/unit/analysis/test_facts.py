import math
from dataclasses import replace
from unittest.mock import patch

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis import topic_events
from ros2_memory.analysis.facts import (
    BATTERY,
    CHARGE,
    COMMAND,
    FLAG,
    LABEL,
    State,
    Word,
    charge_levels,
    is_still,
    state_of,
    stated_by,
)
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    Report,
    events_of,
    joined_events,
)
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S


@patch.object(topic_events, "MAX_EVENTS", 10)
@patch.object(topic_events, "MAX_INTERVALS", 10)
def test_a_week_of_changes_is_counted_beyond_what_memory_may_hold() -> None:
    parts = []
    for nth in range(15):
        at = nth * 100 * NS_PER_S
        glimpse = events_of(stated_by([at], [State(((Word(LABEL, f"cup {nth}"), math.nan),))]))
        parts.append(
            replace(
                glimpse,
                last=at + NS_PER_S,
                known=tuple(KnownState(FLAG, path, at, 0, 1) for path in ("x", "y")),
                changes=tuple(Change(FLAG, path, at + 1, 1) for path in ("x", "y")),
                errors=(Report(f"error {nth}", at, at, 1),),
            )
        )
    events = joined_events(parts)
    assert events.visible.size == len(events.changes) == len(events.errors) == 10
    assert events.visible.intervals()[0].label == "cup 0"
    flips = 2 * 15 + 2 * 14
    assert events.left_out == (15 - 10) + (flips - 10) + (15 - 10)


numbers = st.sampled_from(
    [0.0, -0.0, 1e-5, 0.04, 0.051, 0.21, 0.15, 0.3, 1.0, 1.02, 80.0, -2.0, math.nan, math.inf]
)


def stated(value: JsonValue, type_name: str) -> dict[Word, float]:
    """The facts of a message, without the NaN of those that have no value."""
    facts = state_of(value, type_name).facts
    return {word: 0 if math.isnan(value) else value for word, value in facts}


TWIST = "geometry_msgs/msg/Twist"


@given(st.lists(numbers, max_size=8))
def test_values_of_columns_are_those_of_the_messages(rows: list[float]) -> None:
    column = np.array(rows, np.float64)
    charges = [stated({"percentage": number}, BATTERY).get(Word(CHARGE), -1) for number in rows]
    assert charge_levels(column).tolist() == charges
    commands = [stated({"linear": {"x": number}}, TWIST)[Word(COMMAND)] for number in rows]
    assert (~is_still(column)).tolist() == commands
