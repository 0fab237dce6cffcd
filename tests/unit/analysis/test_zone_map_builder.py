"""Whatever values are collected, their zone map rules out nothing that is among them."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
)
from ros2_memory.analysis.zone_map import united
from ros2_memory.analysis.zone_map_builder import ZoneMapBuilder
from tests.support.strategies import json_values

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue

needles = st.one_of(
    st.booleans(),
    st.integers(-5, 5),
    st.floats(allow_nan=False),
    st.sampled_from(
        ["a", "AB", "A B", "aB_c", "b", "1", " a", "b c", "true", "-3", "0.5", "ß", "-"]
    ),
    st.text(max_size=3),
)
texts = st.one_of(
    st.text(max_size=6), st.sampled_from(["a b", "Ab_c", "straße", "--", "1", "true"])
)
places = st.builds(
    lambda key, x, y, rest: {key: {"x": x, "y": y, **rest}},
    st.sampled_from(["position", "point", "translation", "velocity"]),
    st.one_of(st.floats(), st.integers(-(10**400), 10**400)),
    st.floats(-5, 5),
    st.dictionaries(st.just("z"), st.floats(), max_size=1),
)
seen = st.fixed_dictionaries(
    {"label": texts, "score": st.sampled_from([0.4, 0.5, None])},
    optional={"position": json_values, "x": json_values},
)
values = st.one_of(
    json_values,
    st.lists(st.one_of(texts, places, json_values), max_size=4),
    st.lists(st.one_of(seen, places), max_size=4),
    st.lists(seen, max_size=2).map(json.dumps),
)
conditions = st.builds(
    Condition,
    st.one_of(
        st.builds(Contains, needles.filter(lambda needle: needle != "")),
        st.builds(Equals, needles),
        st.builds(Beyond, st.one_of(st.floats(allow_nan=False), st.integers()), st.booleans()),
        st.builds(
            NearPosition,
            st.floats(-6, 6),
            st.floats(-6, 6),
            st.one_of(st.none(), st.floats(-6, 6)),
            st.floats(0, 3),
        ),
    ),
    st.sampled_from([None, "x", "position", "label", "velocity", "0", "position.x"]),
    st.sampled_from([0.0, 0.0, 0.5]),
)


@given(st.lists(values, max_size=4), values, conditions)
@example([], [{"point": {"x": 10**400, "y": 0.0}}], Condition(Equals(math.inf)))
@example([], ["STRASSE"], Condition(Contains("straße")))
@example([], ["STRASSE"], Condition(Equals("straße")))
@example([], ["Ab_c"], Condition(Equals("aB_C")))
@example([], {"x": [True, 2]}, Condition(Contains(1), "x"))
@example([], {"x": [True, 2]}, Condition(Contains("2"), "x"))
@example([], {"x": False}, Condition(Equals(0)))
@example([], {"x": 1.0}, Condition(Equals("true")))
def test_a_zone_map_never_rules_out_what_matches(
    others: list[JsonValue], value: JsonValue, condition: Condition
) -> None:
    collector = ZoneMapBuilder()
    for each in (*others, value):
        collector.add(each)
    evidence = collector.zone_map()
    if condition.matches(value):
        assert condition.can_match(evidence)
        assert condition.can_match(united([ZoneMapBuilder().zone_map(), evidence]))
