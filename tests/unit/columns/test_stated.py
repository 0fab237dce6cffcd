"""What columns say that messages state: the same as each decoded message."""

import math

from hypothesis import given, settings

from ros2_memory.analysis.facts import LABEL, Facts, State, Word, state_of, stated_by
from ros2_memory.columns.stated import StatedColumns
from ros2_memory.columns.table import Table
from tests.support.examples import examples
from tests.support.memories import shipped_extractor
from tests.unit.columns.drawn_tables import Drawn, drawn_tables, stored

EXTRACTOR = shipped_extractor()
SETTLED = (
    "std_msgs/msg/Bool",
    "std_msgs/msg/String",
    "rcl_interfaces/msg/Log",
    "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/BatteryState",
    "geometry_msgs/msg/Twist",
    "ros2_vision_interfaces/msg/VisionDetectionArray",
    "ros2_vision_interfaces/msg/StampedString",
)


def by_row(facts: Facts, rows: set[int]) -> set[tuple[int, Word, float]]:
    """Facts; of several scores of a label in a message the best one, to four digits."""
    best: dict[tuple[int, Word], float] = {}
    cells = zip(facts.rows.tolist(), facts.codes.tolist(), facts.values.tolist(), strict=True)
    for row, code, value in cells:
        key = (row, facts.words[code])
        if row in rows:
            best[key] = max(best.get(key, -math.inf), -math.inf if math.isnan(value) else value)
    return {
        (*key, round(value, 4) if math.isfinite(value) else value) for key, value in best.items()
    }


def states_of(drawn: Drawn) -> list[State | None]:
    values = [EXTRACTOR.exact(message, drawn.type) for message in drawn.messages]
    return [state_of(value, drawn.type) for value in values]


def compared(table: Table, drawn: Drawn) -> int | None:
    """Checks what the columns settle; returns how many messages are to be read, None for all."""
    expected = stated_by(table.log_times.tolist(), states_of(drawn))
    found = StatedColumns(EXTRACTOR).of(table)
    if found is None:
        return None
    to_read = found.to_read(None).tolist()
    rows = {*range(len(table))} - {*to_read}
    assert by_row(found.stated.facts, rows) == by_row(expected.facts, rows)
    return len(to_read)


@settings(max_examples=examples(120), deadline=None)
@given(drawn_tables())
def test_columns_state_what_drawn_messages_state(drawn: Drawn) -> None:
    compared(drawn.table, drawn)


@settings(max_examples=examples(80), deadline=None)
@given(drawn_tables(SETTLED))
def test_nothing_is_read_where_columns_hold_what_matters(drawn: Drawn) -> None:
    read = compared(drawn.table, drawn)
    if read is None:  # an object without a name may hold detections
        facts = [fact for state in states_of(drawn) if state is not None for fact in state.facts]
        assert any(word.kind == LABEL for word, _ in facts)
    else:
        assert read == 0
    for step in (0.0, 1e-6):  # what may be wrong, rounded, is read
        compared(stored(drawn.table, step), drawn)
