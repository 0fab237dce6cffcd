"""A message's value is the same after it was taken apart into columns."""

from __future__ import annotations

import json
from itertools import chain

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.lake.typed_values import put_together, taken_apart

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**64), 2**64)
    | st.floats(allow_nan=False)
    | st.text(max_size=5)
)
NAMES = st.text("ab._ß", max_size=3)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=12,
)


@given(VALUES)
def test_what_was_taken_apart_is_put_together_as_it_was(value: object) -> None:
    apart = taken_apart(value)  # type: ignore[arg-type]  # JSON
    scalars = dict(chain.from_iterable(each.items() for each in apart[1:]))
    assert len(scalars) == sum(map(len, apart[1:]))
    # As text, since that has the order of fields, and tells 1 from 1.0 and from true.
    assert json.dumps(put_together(apart.rest, scalars)) == json.dumps(value)


def test_scalars_have_columns_by_their_kind_and_their_paths() -> None:
    apart = taken_apart(
        {"header": {"frame_id": "map", "stamp": {"sec": 5}}, "on": True, "x": 0.5, "data": [1, 2]}
    )
    assert apart.rest == (
        '{"header":{"frame_id":null,"stamp":{"sec":null}},"on":null,"x":null,"data":[1,2]}'
    )
    assert apart[1:] == (
        {"on": True},
        {"header.stamp.sec": 5},
        {"x": 0.5},
        {"header.frame_id": "map"},
    )
