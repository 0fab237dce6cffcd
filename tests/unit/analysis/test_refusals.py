"""A condition that no value of a topic can meet is distinguished from one that none has met."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import parse_condition, refusal_for

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue

ODOM: JsonValue = {"position": {"x": 1.0, "y": 2.0, "z": 0.0}, "orientation": {"yaw_deg": 3.0}}
SEEN: JsonValue = {"skill": "scene", "detections": [{"label": "cup", "point": {"x": 1, "y": 2}}]}
NOTHING_SEEN: JsonValue = {"skill": "scene", "detections": []}


def refusal(value: JsonValue, kind: str, wanted: JsonValue, field: str | None = None) -> str | None:
    return refusal_for(parse_condition(kind, wanted, 0.5, field), value)


@pytest.mark.parametrize(
    ("value", "field"),
    [
        (ODOM, "position"),
        (ODOM, "position.x"),
        (SEEN, "detections.label"),
        (SEEN, "detections.0.label"),
        (NOTHING_SEEN, "detections.label"),
        ({"value": None}, "value"),
        ({"value": None}, "value.anything"),
    ],
)
def test_a_field_that_values_have_or_may_have_is_no_fault(value: JsonValue, field: str) -> None:
    assert refusal(value, "equals", 1, field) is None


@pytest.mark.parametrize("field", ["data", "position.w", "pose.pose.position", "nope"])
def test_a_field_that_values_lack_is_refused_with_those_they_have(field: str) -> None:
    refused = refusal(ODOM, "equals", 1, field)
    assert refused is not None
    assert repr(field) in refused
    assert "position, orientation, position.x" in refused


def test_nearness_is_asked_of_values_with_positions_only() -> None:
    here: JsonValue = {"x": 1, "y": 2}
    assert refusal(ODOM, "near_position", here) is None
    assert refusal(SEEN, "near_position", here) is None
    assert refusal(NOTHING_SEEN, "near_position", here) is None
    refused = refusal({"percentage": 0.5}, "near_position", here)
    assert refused is not None
    assert "no position" in refused


@pytest.mark.parametrize("wanted", [3, "3", 2.5])
def test_a_number_is_contained_in_a_text_or_in_what_a_field_names(wanted: JsonValue) -> None:
    refused = refusal(ODOM, "contains", wanted)
    assert refused is not None
    assert "ask with equals" in refused
    assert refusal(ODOM, "contains", wanted, "position") is not None
    assert refusal(ODOM, "contains", wanted, "position.x") is None
    assert refusal(SEEN, "contains", wanted) is None
    assert refusal({"data": []}, "contains", wanted) is None


@pytest.mark.parametrize("kind", ["equals", "contains"])
def test_a_text_is_not_asked_of_numbers_or_booleans(kind: str) -> None:
    assert "true or false" in (refusal({"value": True}, kind, "yes", "value") or "")
    assert "must be a number" in (refusal({"level": 30, "msg": "x"}, kind, "WARN", "level") or "")
    assert "must be a number" in (refusal(ODOM, "equals", "cup") or "")
    assert refusal(ODOM, "contains", "cup") is None
    assert refusal({"level": 30, "msg": "x"}, kind, "WARN") is None
    assert refusal({"value": None}, kind, "yes") is None
    assert refusal({"value": True}, kind, "false") is None


_values = st.recursive(
    st.none() | st.booleans() | st.integers(0, 3) | st.sampled_from(["cup", "x"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "b", "position", "x", "y"]), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(_values, st.sampled_from(["a", "a.b", "position", "position.x", "b.0.x"]))
def test_what_matches_is_never_refused(value: JsonValue, field: str) -> None:
    tests: list[tuple[str, JsonValue]] = [
        ("equals", 1),
        ("equals", "cup"),
        ("contains", "cup"),
        ("contains", "1"),
        ("contains", 2),
        ("near_position", {"x": 1, "y": 1}),
    ]
    for kind, wanted in tests:
        for condition in (
            parse_condition(kind, wanted, 2.0, field),
            parse_condition(kind, wanted, 2.0),
        ):
            if condition.matches(value):
                assert refusal_for(condition, value) is None
