"""What property tests draw from."""

import math

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from ros2_memory.core.geometry import normalised
from ros2_memory.core.model import JsonValue, Quaternion, Transform, Vector3

metres = st.floats(-1e4, 1e4, allow_nan=False)
points: SearchStrategy[Vector3] = st.tuples(metres, metres, metres)
angles = st.floats(-math.pi, math.pi)
ratios = st.floats(0.0, 1.0)

# From small whole numbers, half turns and right angles are drawn often.
_part = st.one_of(st.integers(-2, 2).map(float), st.floats(-1.0, 1.0))


def _unit(parts: Quaternion) -> Quaternion:
    unit = normalised(parts)
    assert unit is not None
    return unit


quaternions: SearchStrategy[Quaternion] = (
    st.tuples(_part, _part, _part, _part)
    .filter(lambda parts: max(abs(part) for part in parts) > 1e-3)
    .map(_unit)
)
transforms: SearchStrategy[Transform] = st.builds(Transform, points, quaternions)

moments = st.integers(0, 4 * 10**18)
"""Nanoseconds from the epoch to the year 2096."""

scalars: SearchStrategy[JsonValue] = st.one_of(
    st.none(), st.booleans(), st.integers(-5, 5), st.floats(), st.sampled_from(["", "a", "Ab", "1"])
)
json_values: SearchStrategy[JsonValue] = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(["x", "y", "position", "label"]), inner, max_size=4),
    ),
    max_leaves=12,
)
