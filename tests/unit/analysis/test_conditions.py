import json
import math
from itertools import count, product
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    ConditionType,
    Contains,
    Equals,
    NearPosition,
    Scalar,
    at_field,
    parse_condition,
)
from ros2_memory.analysis.refusals import refusal_for
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue

SCENE: JsonValue = {
    "skill": "scene",
    "detections": [
        {"label": "Red Scissors", "score": 0.8999999761581421, "point": {"x": 1.0, "y": 2.0}},
        {"label": "mug", "score": 0.5, "point": {"x": 4.0, "y": -1.0, "z": 0.3}},
    ],
    "ids": [3, 7.5, True],
}
ESCAPED = json.dumps([{"label": "größer"}, 'say "hi"', "a\\b"])
"""As most programs write it: what is not ASCII is escaped, too."""


@pytest.mark.parametrize(
    ("needle", "field", "value", "is_met"),
    [
        *((word, None, SCENE, True) for word in ("scissors", "RED SC", "Mug", "scene")),
        # Not in keys, in digits of numbers, or in shorter strings.
        *((word, None, SCENE, False) for word in ("label", "hammer", "0.", "mugs")),
        ("STRASSE", None, ["in der Straße"], True),
        # A number is a whole value of a field, or an element of its list; its digits are a text.
        *((number, None, SCENE, False) for number in (3, 7.5, 8, "3", "7.5", "0.5", "20")),
        *((20, None, value, False) for value in ({"level": 20, "msg": "retry"}, [1, 20], 20)),
        *((number, "ids", SCENE, True) for number in (3, "3", 7.5, True, 1)),
        *((number, "ids", SCENE, False) for number in (5, "7")),
        *((number, "detections", SCENE, False) for number in (0.5, "0.")),
        (10**5000, None, ["", "1", "0"], False),
        (10**5000, "x", {"x": [10**5000]}, True),
        *((word, None, {"data": True}, True) for word in ("true", "True", True)),
        *((word, None, {"data": False}, False) for word in ("true", "True", True)),
        (True, None, [1, 1.0], False),
        (1, None, [True], False),
        *((word, None, ESCAPED, True) for word in ("größer", "GRÖSSER", 'say "hi"', "a\\b")),
        ("größer", None, f"x{ESCAPED}", False),  # no JSON
        *((leaf, "x", {"x": [leaf, None]}, True) for leaf in (-2.5, 1e300, "-2.5", False)),
    ],
    ids=count(),
)
def test_what_contains_finds(
    needle: Scalar, field: str | None, value: JsonValue, is_met: bool
) -> None:
    assert Condition(Contains(needle), field).matches(value) is is_met


@pytest.mark.parametrize(
    ("asked", "value", "is_met"),
    [
        *((True, value, True) for value in (True, [False, True], {"a": {"b": [[True]]}})),
        *((one, {"data": True}, True) for one in (1, 1.0, "1")),
        *((one, {"data": False}, False) for one in (1, 1.0, "1")),
        *((yes, {"data": 1}, True) for yes in (True, "True")),
        *((yes, [no, math.nan, None], False) for yes, no in ((True, 2), (False, 0.5), (2, True))),
        *((math.nan, [leaf], False) for leaf in (math.nan, None, 0)),
        *((number, [number], True) for number in (0.9, 1e300, -1e300, 10**400, 1e-320, math.inf)),
        (2**53 + 1, 2**53 + 2, False),
        # What a float32 would hold of it is another number.
        *((1_795_000_001, {"order": other}, False) for other in (1_795_000_064, 1_795_000_064.0)),
        *(("docked", {"state": held}, True) for held in ("docked", "Docked", "DOCKED")),
        ("docked", {"state": "undocked"}, False),
        # In quotes, as the plain one, and as the same text.
        *((f"{leaf}", [leaf], True) for leaf in (True, False, 3, -2.5)),
        ("1e3", 1000, True),
        (" 7 ", 7, True),
        *((text, 5, True) for text in ("5.", "+5.0", "50e-1", "5.e0", ".5e1")),
        (".", 0, False),
        *((text, {"data": text}, True) for text in ("true", "3", "9" * 5000)),
        *((text, leaf, False) for text, leaf in (("yes", True), ("inf", math.inf))),
        ("Größer", ESCAPED, True),
        ("groß", ESCAPED, False),
    ],
    ids=count(),
)
def test_what_equals_finds(asked: Scalar, value: JsonValue, is_met: bool) -> None:
    assert Condition(Equals(asked)).matches(value) is is_met


@given(st.floats(width=32, allow_nan=False, allow_infinity=False), st.floats(-1e-9, 1e-9))
def test_a_number_equals_what_a_float32_field_stores_of_it(held: float, nudge: float) -> None:
    asked = held * (1 + nudge)
    stored = float(np.float32(asked))
    is_meant = stored != 0 and not 2**24 <= abs(asked) < 2**53
    assert Condition(Equals(asked)).matches(stored) is (is_meant or stored == asked)


# above and below


@pytest.mark.parametrize("limit", [0.0, -2.5, 0.1, 1e300, 2**53 + 1])
def test_a_limit_is_not_part_of_either_side(limit: float) -> None:
    more, less = (limit + sign * max(1.0, abs(limit) / 9) for sign in (1, -1))
    # What a float32 holds of the limit is the limit.
    held = float(np.float32(limit)) if abs(limit) < 1e30 else limit
    for above, beyond in ((True, more), (False, less)):
        condition = Condition(Beyond(limit, above=above))
        values = (limit, held, more, less)
        assert [value for value in values if condition.matches([value])] == [beyond]


# near_position


ONE_TWO, OTHER = {"x": 1.0, "y": 2.0}, {"x": 9.0, "y": 9.0}
BAD = (None, math.nan, math.inf)


@pytest.mark.parametrize(
    ("z", "field", "value", "is_met"),
    [
        (None, None, {"pose": {"pose": {"position": {**ONE_TWO, "z": 0.0}}}}, True),
        (None, None, {"transforms": [{"transform": {"translation": ONE_TWO}}]}, True),
        (None, None, [OTHER, ONE_TWO], True),
        # What is a position itself is not searched for others.
        (None, None, {**OTHER, "point": ONE_TWO}, False),
        (None, None, SCENE, True),
        (None, "detections.1", SCENE, False),
        # A velocity is none, unless a field names it.
        (None, None, {"twist": {"linear": {**ONE_TWO, "z": 0.0}}}, False),
        (None, "linear", {"linear": ONE_TWO, "position": OTHER}, True),
        *((None, None, {"position": each}, False) for each in ([1.0, 2.0], {"x": "1", "y": "2"})),
        *((None, None, each, False) for each in ({"position": {"x": True, "y": 2.0}}, "1 2", None)),
        # Without a coordinate that is asked it is near nothing.
        *((None, None, {"position": {"x": bad, "y": 2.0}}, False) for bad in BAD),
        *((1.0, None, {**ONE_TWO, "z": bad}, False) for bad in BAD),
        (1.0, None, ONE_TWO, False),
        *((1.0, None, {**ONE_TWO, "z": z}, is_near) for z, is_near in ((1.4, True), (1.6, False))),
        *(
            (None, None, {"x": 1.3, "y": y}, is_near)
            for y, is_near in ((1.61, True), (1.59, False))
        ),
    ],
    ids=count(),
)
def test_positions_are_found_under_the_keys_that_hold_places(
    z: float | None, field: str | None, value: JsonValue, is_met: bool
) -> None:
    assert Condition(NearPosition(1.0, 2.0, z, 0.5), field).matches(value) is is_met


# fields


@pytest.mark.parametrize(
    ("value", "path", "found"),
    [
        (SCENE, "detections.label", ["Red Scissors", "mug"]),
        # A whole number picks one element; in an object it is a key.
        (SCENE, "detections.0.label", ["Red Scissors"]),
        (SCENE, "detections.-1.label", ["mug"]),
        ({"0": {"1": "a"}}, "0.1", ["a"]),
        *((SCENE, f"detections.{path}", []) for path in ("9", "-3.label", ".label")),
        *((SCENE, path, []) for path in ("nothing", "skill.x", "")),
        ([1, 2], "9" * 5000, []),
        ([[{"x": 1}], [{"x": 2}, {}]], "x", [1, 2]),
    ],
    ids=count(),
)
def test_what_a_path_leads_to(value: JsonValue, path: str, found: list[JsonValue]) -> None:
    assert at_field(value, path) == found


# parsing


@pytest.mark.parametrize(
    ("kind", "value", "complaint"),
    [
        (
            "near",
            {"x": 1, "y": 2},
            f"'near' is not one of {', '.join(get_args(ConditionType))};",
        ),
        ("contains", None, "not null"),
        ("contains", ["a", "b"], "not a list"),
        ("contains", "  ", "not blank"),
        ("equals", {"x": 1}, "not an object"),
        ("equals", math.nan, "NaN"),
        ("above", "high", "takes a number as value"),
        ("below", math.nan, "takes a number as value"),
        ("above", 3, "needs field"),
        ("near_position", "1,2", 'not "1,2"'),
        ("near_position", {"x": 1}, "'y' of 'near_position' must be a finite number"),
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


# what no value of a topic can meet

ODOM: JsonValue = {"position": {"x": 1.0, "y": 2.0, "z": 0.0}, "orientation": {"yaw_deg": 3.0}}
SEEN: JsonValue = {"skill": "scene", "detections": [{"label": "cup", "point": {"x": 1, "y": 2}}]}
NOTHING_SEEN: JsonValue = {"skill": "scene", "detections": []}
LOG: JsonValue = {"level": 30, "msg": "x"}
HERE: JsonValue = {"x": 1, "y": 2}
LISTED = "position, orientation, position.x"


@pytest.mark.parametrize(
    ("value", "kind", "wanted", "field", "said"),
    [
        # A field that values have or may have.
        *((ODOM, "equals", 1, field, None) for field in ("position", "position.x")),
        *(
            (SEEN, "equals", 1, f"detections.{field}", "are texts: the value must be a text")
            for field in ("label", "0.label")
        ),
        (SEEN, "equals", "1", "detections.label", None),
        (NOTHING_SEEN, "equals", 1, "detections.label", None),
        *(({"value": None}, "equals", 1, field, None) for field in ("value", "value.anything")),
        *((ODOM, "equals", 1, f, LISTED) for f in ("data", "position.w", "pose.position", "nope")),
        # Positions.
        *((value, "near_position", HERE, None, None) for value in (ODOM, SEEN, NOTHING_SEEN)),
        ({"percentage": 0.5}, "near_position", HERE, None, "no position"),
        # A number is contained in a text, or in what a field names.
        *((ODOM, "contains", number, None, "use equals") for number in (3, "3", 2.5)),
        (ODOM, "contains", 3, "position", "use equals"),
        (ODOM, "contains", 3, "position.x", None),
        (SEEN, "contains", 3, None, None),
        ({"data": []}, "contains", 3, None, None),
        # A text is not asked of numbers or booleans.
        *(
            row
            for kind in ("equals", "contains")
            for row in (
                ({"value": True}, kind, "yes", "value", "true or false"),
                (LOG, kind, "WARN", "level", "must be a number"),
                (LOG, kind, "WARN", None, None),
                ({"value": None}, kind, "yes", None, None),
                ({"value": True}, kind, "false", None, None),
            )
        ),
        # A limit is asked of numbers alone.
        ({"value": "12"}, "above", 3, "value", "are texts, and above and below compare numbers"),
        ({"value": True}, "below", 3, "value", "are booleans, and above and below compare numbers"),
        ({"value": [None, True]}, "below", 3, "value", None),
        (ODOM, "above", 3, "position", None),
        (ODOM, "equals", "cup", None, "must be a number"),
        (ODOM, "contains", "cup", None, None),
    ],
    ids=count(),
)
def test_what_no_value_can_meet_is_refused_with_the_reason(
    value: JsonValue, kind: str, wanted: JsonValue, field: str | None, said: str | None
) -> None:
    refused = refusal_for(parse_condition(kind, wanted, 0.5, field), value)
    assert (refused is None) is (said is None)
    assert said is None or said in (refused or "")


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
        *(("equals", wanted) for wanted in (1, "cup", True, "1")),
        *(("contains", wanted) for wanted in ("cup", "1", 2)),
        ("near_position", {"x": 1, "y": 1}),
    ]
    for (kind, wanted), where in product(tests, (field, None)):
        condition = parse_condition(kind, wanted, 2.0, where)
        assert not condition.matches(value) or refusal_for(condition, value) is None
