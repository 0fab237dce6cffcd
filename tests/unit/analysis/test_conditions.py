from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
    Scalar,
    at_field,
    parse_condition,
    positions,
)
from ros2_memory.core.errors import InvalidArgumentsError
from tests.support.strategies import json_values, scalars

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue

SCENE: JsonValue = {
    "skill": "scene",
    "detections": [
        {"label": "Red Scissors", "score": 0.8999999761581421, "point": {"x": 1.0, "y": 2.0}},
        {"label": "mug", "score": 0.5, "point": {"x": 4.0, "y": -1.0, "z": 0.3}},
    ],
    "ids": [3, 7.5, True],
}
asked_scalars: st.SearchStrategy[Scalar] = st.one_of(
    st.booleans(),
    st.integers(-5, 5),
    st.floats(allow_nan=False),
    st.sampled_from(["a", "Ab", "1", "true", "-2.5"]),
)
asked_coordinates = st.floats(-10, 10)


# contains


@pytest.mark.parametrize("needle", ["scissors", "RED SC", "Mug", "scene"])
def test_a_text_is_found_inside_any_string_without_regard_to_case(needle: str) -> None:
    assert Contains(needle).matches(SCENE)


@pytest.mark.parametrize("needle", ["label", "hammer", "0.", "mugs"])
def test_a_text_is_not_found_in_keys_digits_of_numbers_or_shorter_strings(needle: str) -> None:
    assert not Contains(needle).matches(SCENE)


def test_case_is_folded_in_every_script() -> None:
    assert Contains("STRASSE").matches("in der Straße")
    assert Contains("ΣΟΦΟΣ").matches(["σοφος"])


@pytest.mark.parametrize("needle", [3, 7.5, 8, "3", "7.5", "0.5", "20"])
def test_a_number_is_not_contained_where_no_field_is_named(needle: Scalar) -> None:
    assert not Contains(needle).matches(SCENE)
    assert not Contains(needle).matches({"level": 20, "bbox": [1, 2, 3, 4], "on": True})


@pytest.mark.parametrize(
    ("needle", "field"),
    [
        (3, "ids"),
        ("3", "ids"),
        (7.5, "ids"),
        (True, "ids"),
        (1, "ids"),
        (0.5, "detections.score"),
        ("0.9", "detections.score"),
        (-1, "detections.point.y"),
    ],
)
def test_a_field_contains_the_number_that_it_is_or_lists(needle: Scalar, field: str) -> None:
    assert Condition(Contains(needle), field).matches(SCENE)


@pytest.mark.parametrize(
    ("needle", "field"),
    [(5, "ids"), ("7", "ids"), ("0.", "detections.score"), (0.5, "detections"), (4, "detections")],
)
def test_a_field_contains_no_part_of_a_number_and_none_of_an_object(
    needle: Scalar, field: str
) -> None:
    assert not Condition(Contains(needle), field).matches(SCENE)


@pytest.mark.parametrize("needle", [20, "20"])
def test_the_digits_of_a_number_are_found_in_texts(needle: Scalar) -> None:
    assert Contains(needle).matches({"level": 10, "msg": "retry in 20 s"})
    assert not Contains(needle).matches({"level": 20, "msg": "retry"})


def test_a_number_too_long_to_be_written_is_contained_in_no_text() -> None:
    assert not Contains(10**5000).matches(["", "1", "0"])
    assert Condition(Contains(10**5000), "x").matches({"x": [10**5000]})


@given(asked_scalars, json_values)
def test_what_a_field_is_equal_to_it_contains(asked: Scalar, value: JsonValue) -> None:
    held: JsonValue = {"x": [asked, value]}
    assert Condition(Contains(asked), "x").matches(held)
    if not isinstance(value, dict | list) and Equals(asked).matches(value):
        assert Condition(Contains(asked), "x").matches({"x": value})


@pytest.mark.parametrize("needle", ["true", "True", True])
def test_a_boolean_alone_is_contained_also_where_it_is_asked_for_in_quotes(needle: Scalar) -> None:
    assert Contains(needle).matches({"data": True})
    assert not Contains(needle).matches({"data": False})


def test_a_number_is_no_boolean_where_no_field_is_named() -> None:
    assert not Contains(True).matches([1, 1.0])
    assert not Contains(1).matches([True])
    assert not Contains(False).matches([0, None])


@given(asked_scalars, st.lists(json_values, max_size=4), json_values)
def test_a_longer_list_contains_all_that_a_shorter_one_did(
    needle: Scalar, shorter: list[JsonValue], more: JsonValue
) -> None:
    if Contains(needle).matches(shorter):
        assert Contains(needle).matches([*shorter, more])
        assert Contains(needle).matches([more, *shorter])


@given(asked_scalars, json_values)
def test_a_nested_value_contains_all_that_it_did_alone(needle: Scalar, value: JsonValue) -> None:
    if Contains(needle).matches(value):
        assert Contains(needle).matches({"x": [value]})


@given(st.text(min_size=1), st.text(), st.text())
def test_a_text_is_contained_in_any_text_around_it(needle: str, before: str, after: str) -> None:
    assert Contains(needle).matches([{"label": before + needle + after}])


# equals


@pytest.mark.parametrize("value", [True, [False, True], {"data": {"pressed": [[True]]}}])
def test_a_boolean_is_equal_to_a_leaf_at_any_depth(value: JsonValue) -> None:
    assert Equals(True).matches(value)


@pytest.mark.parametrize(("asked", "held"), [(1, True), (1.0, True), ("1", True), (0, False)])
def test_one_and_zero_equal_true_and_false_whichever_is_asked_for(
    asked: Scalar, held: bool
) -> None:
    assert Equals(asked).matches({"data": held})
    assert not Equals(asked).matches({"data": not held})
    assert Equals(held).matches({"data": int(held)})
    assert Equals(str(held)).matches({"data": int(held)})
    assert not Equals(not held).matches({"data": int(held)})


@given(st.booleans(), st.one_of(st.integers(), st.floats()).filter(lambda n: n not in (0, 1)))
def test_a_boolean_equals_no_other_number(asked: bool, number: float) -> None:
    assert not Equals(asked).matches([number])
    assert not Equals(number).matches([asked])


@given(st.floats(width=32, allow_nan=False, allow_infinity=False), st.floats(-1e-9, 1e-9))
def test_a_number_equals_what_a_float32_field_stores_of_it(held: float, nudge: float) -> None:
    asked = held * (1 + nudge)
    assert Equals(asked).matches(float(np.float32(asked)))


@pytest.mark.parametrize(
    "asked", [0.9, 1e300, -1e300, pytest.param(10**400, id="huge"), 1e-320, math.inf]
)
def test_a_number_of_any_size_equals_itself(asked: float) -> None:
    assert Equals(asked).matches({"value": asked})


def test_a_number_is_not_equal_to_its_neighbour() -> None:
    assert not Equals(0.9).matches(0.9000001)
    assert not Equals(2**53 + 1).matches(2**53 + 2)
    assert not Equals(1e300).matches(math.inf)


@given(asked_scalars)
def test_nothing_equals_nan_or_null(asked: Scalar) -> None:
    assert not Equals(asked).matches([math.nan, None])
    assert not Equals(math.nan).matches([asked, math.nan, None])


@pytest.mark.parametrize("held", ["docked", "Docked", "DOCKED"])
def test_a_string_is_equal_as_a_whole_without_regard_to_case(held: str) -> None:
    assert Equals("docked").matches({"state": held})
    assert Equals(held).matches({"state": "docked"})
    assert not Equals(held).matches({"state": "undocked"})
    assert not Equals(f"un{held}").matches({"state": held})


@given(st.text(), json_values)
def test_what_is_equal_to_a_text_contains_it(asked: str, value: JsonValue) -> None:
    for held in (asked, asked.upper(), asked.casefold()):
        if Equals(held).matches([asked, value]):
            assert Contains(held).matches([asked, value])
    assert Equals(asked.casefold()).matches([asked])


@pytest.mark.parametrize(
    ("asked", "leaf"),
    [("true", True), ("False", False), ("3", 3), ("-2.5", -2.5), ("1e3", 1000), (" 7 ", 7)],
)
def test_a_quoted_boolean_or_number_is_equal_to_the_plain_one(asked: str, leaf: Scalar) -> None:
    assert Equals(asked).matches([leaf])


@pytest.mark.parametrize("asked", ["true", "3"])
def test_a_quoted_value_is_equal_to_the_same_text_too(asked: str) -> None:
    assert Equals(asked).matches({"data": asked})


@pytest.mark.parametrize(("asked", "leaf"), [("yes", True), ("nan", math.nan), ("inf", math.inf)])
def test_a_text_that_spells_neither_is_only_a_text(asked: str, leaf: Scalar) -> None:
    assert not Equals(asked).matches(leaf)


def test_thousands_of_digits_are_a_text_or_a_number_but_no_crash() -> None:
    assert Equals("9" * 5000).matches("9" * 5000)
    assert at_field([1, 2], "9" * 5000) == []


# above and below


@given(st.floats(allow_nan=False), st.floats(allow_nan=False))
def test_a_limit_is_not_part_of_either_side(limit: float, number: float) -> None:
    assert Beyond(limit, above=True).matches([number]) == (number > limit)
    assert Beyond(limit, above=False).matches([number]) == (number < limit)
    assert not Beyond(limit, above=True).matches({"a": limit})
    assert not Beyond(limit, above=False).matches({"a": limit})


@pytest.mark.parametrize("value", [True, None, "9", [], {}])
def test_what_is_no_number_is_on_no_side(value: JsonValue) -> None:
    assert not Beyond(0, above=True).matches(value)
    assert not Beyond(2, above=False).matches(value)


# near_position


@given(asked_coordinates, asked_coordinates, st.floats(0, 5), asked_coordinates, asked_coordinates)
def test_near_is_within_the_tolerance_in_the_plane(
    x: float, y: float, tolerance_m: float, px: float, py: float
) -> None:
    near = NearPosition(x, y, None, tolerance_m).matches({"x": px, "y": py, "z": 1e6})
    assert near == (math.dist((x, y), (px, py)) <= tolerance_m)


def test_height_counts_where_it_is_asked() -> None:
    near = NearPosition(0.0, 0.0, 1.0, 0.5)
    assert near.matches({"x": 0.0, "y": 0.0, "z": 1.4})
    assert not near.matches({"x": 0.0, "y": 0.0, "z": 1.6})
    assert not near.matches({"x": 0.0, "y": 0.0})


@pytest.mark.parametrize(
    "value",
    [
        {"position": {"x": 1.0, "y": 2.0}},
        {"pose": {"pose": {"position": {"x": 1.0, "y": 2.0, "z": 0.0}}}},
        {"transforms": [{"transform": {"translation": {"x": 1.0, "y": 2.0}}}]},
        [{"x": 9.0, "y": 9.0}, {"x": 1.0, "y": 2.0}],
        {"position": [{"x": 9.0, "y": 9.0}, {"x": 1.0, "y": 2.0}]},
        SCENE,
    ],
)
def test_positions_are_found_under_the_keys_that_hold_places(value: JsonValue) -> None:
    assert NearPosition(1.0, 2.0, None, 0.01).matches(value)


@pytest.mark.parametrize(
    "value",
    [
        {"linear_velocity": {"x": 1.0, "y": 2.0}},
        {"twist": {"linear": {"x": 1.0, "y": 2.0, "z": 0.0}}},
        {"position": [1.0, 2.0]},
        {"position": {"x": "1", "y": "2"}},
        {"position": {"x": True, "y": 2.0}},
        "1.0 2.0",
        None,
    ],
)
def test_velocities_and_shapes_that_are_no_place_are_near_nothing(value: JsonValue) -> None:
    assert not NearPosition(1.0, 2.0, None, 0.01).matches(value)


@pytest.mark.parametrize("bad", [None, math.nan, math.inf])
def test_a_position_without_a_coordinate_is_near_nothing(bad: JsonValue) -> None:
    assert not NearPosition(0.0, 0.0, None, 1e9).matches({"position": {"x": bad, "y": 0.0}})
    assert not NearPosition(0.0, 0.0, 0.0, 1e9).matches({"x": 0.0, "y": 0.0, "z": bad})


def test_a_value_that_is_a_position_is_not_searched_for_others() -> None:
    value: JsonValue = {"x": 0.0, "y": 0.0, "point": {"x": 5.0, "y": 5.0}}
    assert [place[:2] for place in positions(value)] == [(0.0, 0.0)]


@given(json_values)
def test_any_value_is_searched_for_positions_without_a_fault(value: JsonValue) -> None:
    assert all(len(place) == 3 for place in positions(value))


# fields


def test_a_path_goes_on_in_every_element_of_a_list() -> None:
    assert at_field(SCENE, "detections.label") == ["Red Scissors", "mug"]
    assert at_field(SCENE, "detections.point.z") == [0.3]


@pytest.mark.parametrize(
    ("path", "label"), [("0", "Red Scissors"), ("-1", "mug"), ("-2", "Red Scissors")]
)
def test_a_whole_number_picks_one_element(path: str, label: str) -> None:
    assert at_field(SCENE, f"detections.{path}.label") == [label]


@pytest.mark.parametrize(
    "path", ["nothing", "detections.9", "detections.-3.label", "skill.x", "", "detections..label"]
)
def test_a_path_to_nothing_gives_nothing(path: str) -> None:
    assert at_field(SCENE, path) == []


def test_a_key_that_is_a_number_is_a_key_in_an_object() -> None:
    assert at_field({"0": {"1": "a"}}, "0.1") == ["a"]


def test_a_path_crosses_lists_of_lists() -> None:
    assert at_field([[{"x": 1}], [{"x": 2}, {}]], "x") == [1, 2]


@given(scalars)
def test_a_field_narrows_a_condition_to_its_targets(leaf: JsonValue) -> None:
    value: JsonValue = {"x": leaf, "label": "the label"}
    assert Condition(Contains("label"), "label").matches(value)
    assert not Condition(Contains("label"), "x").matches(value)


def test_a_field_that_names_a_velocity_is_taken_at_its_word() -> None:
    value: JsonValue = {"linear": {"x": 1.0, "y": 2.0}, "position": {"x": 0.0, "y": 0.0}}
    assert Condition(NearPosition(1.0, 2.0, None, 0.1), "linear").matches(value)
    assert not Condition(NearPosition(0.0, 0.0, None, 0.1), "linear").matches(value)


def test_a_field_with_positions_deeper_down_is_searched() -> None:
    assert Condition(NearPosition(4.0, -1.0, None, 0.1), "detections").matches(SCENE)
    assert not Condition(NearPosition(4.0, -1.0, None, 0.1), "detections.0").matches(SCENE)


# parsing


@pytest.mark.parametrize(
    ("kind", "value", "condition"),
    [
        ("contains", "mug", Condition(Contains("mug"))),
        ("equals", True, Condition(Equals(True))),
        ("equals", "", Condition(Equals(""))),
        ("near_position", {"x": 1, "y": 2}, Condition(NearPosition(1.0, 2.0, None, 0.5))),
        ("near_position", {"x": -0.5, "y": 0}, Condition(NearPosition(-0.5, 0.0, None, 0.5))),
        ("near_position", {"x": 1, "y": 2, "z": 3}, Condition(NearPosition(1.0, 2.0, 3.0, 0.5))),
        (
            "near_position",
            {"x": 1, "y": 2, "z": None},
            Condition(NearPosition(1.0, 2.0, None, 0.5)),
        ),
    ],
)
def test_arguments_become_conditions(kind: str, value: JsonValue, condition: Condition) -> None:
    assert parse_condition(kind, value, 0.5) == condition


@pytest.mark.parametrize("asked", [0.5, "0.5"])
def test_a_limit_may_stand_in_quotes(asked: JsonValue) -> None:
    condition = parse_condition("above", asked, 0.5, "detections.score")
    assert condition == Condition(Beyond(0.5, above=True), "detections.score")


@pytest.mark.parametrize(
    ("kind", "value", "complaint"),
    [
        (
            "near",
            {"x": 1, "y": 2},
            "'near' is not one of contains, contains_word, equals, above, below, near_position",
        ),
        ("contains", None, "not null"),
        ("contains", ["a", "b"], "not a list"),
        ("contains", "  ", "not blank"),
        ("equals", {"x": 1}, "not an object"),
        ("equals", math.nan, "NaN"),
        ("above", "high", "takes a number as value"),
        ("above", True, "not true"),
        ("below", math.nan, "takes a number as value"),
        ("below", {"x": 1}, "not an object"),
        ("above", 3, "needs field"),
        ("near_position", "1,2", 'not "1,2"'),
        ("near_position", [1, 2], "not a list"),
        ("near_position", {"x": 1}, "'y' of 'near_position' must be a finite number"),
        ("near_position", {"x": "1", "y": 2}, "'x' of 'near_position'"),
        ("near_position", {"x": True, "y": 2}, "not true"),
        ("near_position", {"x": math.inf, "y": 2}, "'x' of 'near_position'"),
        ("near_position", {"x": 10**400, "y": 2}, "'x' of 'near_position'"),
        ("near_position", {"x": 1, "y": 2, "z": "up"}, "'z' of 'near_position'"),
        ("near_position", {"x": 1, "y": 2, "radius": 3}, 'not ["radius"]'),
    ],
)
def test_arguments_that_mean_nothing_are_refused_with_an_example(
    kind: str, value: JsonValue, complaint: str
) -> None:
    with pytest.raises(InvalidArgumentsError, match="for example condition_type") as refused:
        parse_condition(kind, value, 0.5)
    assert complaint in str(refused.value)


def test_no_tolerance_means_the_very_place() -> None:
    exact = parse_condition("near_position", {"x": 1, "y": 2}, 0.0)
    assert exact.matches({"x": 1.0, "y": 2.0})
    assert not exact.matches({"x": 1.0, "y": 2.001})


@pytest.mark.parametrize("tolerance_m", [-0.1, math.nan, math.inf])
def test_a_tolerance_that_is_no_distance_is_refused(tolerance_m: float) -> None:
    with pytest.raises(InvalidArgumentsError, match="tolerance"):
        parse_condition("near_position", {"x": 1, "y": 2}, tolerance_m)
