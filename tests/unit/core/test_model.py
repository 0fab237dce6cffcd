import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    ns_from_unix,
    unix_from_ns,
)
from tests.support.strategies import moments


@given(moments, st.integers(0, 10**15))
def test_both_ends_of_a_question_are_inclusive_with_the_slack_of_a_float(
    first: int, span: int
) -> None:
    start_s, end_s = unix_from_ns(first), unix_from_ns(first + span)
    window = TimeWindow.from_unix(start_s, end_s)
    start, end = ns_from_unix(start_s), ns_from_unix(end_s)
    assert window.contains(end)
    assert window.contains(start - 2 * AT_OR_BEFORE_SLACK_NS)
    assert not window.contains(start - 2 * AT_OR_BEFORE_SLACK_NS - 1)
    assert window.contains(end + AT_OR_BEFORE_SLACK_NS)
    assert not window.contains(end + AT_OR_BEFORE_SLACK_NS + 1)
    assert not window.contains(window.start - 1)


def test_a_window_whose_start_is_after_its_end_is_refused_with_both_bounds() -> None:
    with pytest.raises(InvalidArgumentsError, match=r"start \(2.0\) is after end \(1.0\)"):
        TimeWindow.from_unix(2.0, 1.0)


@pytest.mark.parametrize("bounds", [(math.nan, 1.0), (1.0, math.nan), (-math.inf, 1.0)])
def test_a_bound_that_is_no_number_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidArgumentsError, match="Unix seconds"):
        TimeWindow.from_unix(*bounds)
