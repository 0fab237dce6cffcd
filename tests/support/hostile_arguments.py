"""What no sound client sends, and what a careless or hostile one does, as arguments of tools."""

import math
from collections.abc import Mapping
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from tests.support.robot_run import ANSWERED, T0_S

DEEP = 10_000
"""Levels of nesting: past what Python's own recursion allows."""

MEGABYTE = 1_000_000


def nested(levels: int, *, kind: str = "list") -> Any:
    """A value that many levels deep, built without recursion."""
    value: Any = 1
    for _ in range(levels):
        value = [value] if kind == "list" else {"x": value}
    return value


NUMBERS = [
    math.nan,
    math.inf,
    -math.inf,
    1e308,
    -1e308,
    5e-324,
    -0.0,
    10**400,
    -(10**400),
    10**4000,
    2**63,
    -1,
    -1.5,
    0,
    1,
    T0_S,
    T0_S * 1000,
    T0_S * 10**9,
]
TEXTS = [
    "",
    " ",
    "x" * MEGABYTE,
    "/" * MEGABYTE,
    "[" * MEGABYTE,
    '{"x":' * 20_000,
    "*" * 2000,
    "[!" * 400,
    "*a" * 300,
    "\ud800",
    "/odom\udfff",
    "/odom\x00",
    "\x00",
    "\u202e/modo\u202c",
    "\u2028\u2029\x85\x1b[2J",
    "İ" * 500,
    "ﷺ" * 500,
    "NaN",
    "1e999999999",
    "9" * 5000,
    "../../etc/passwd",
    "'; DROP TABLE bags; --",
    "%s%n{0}{x.__class__}",
    "/odom",
    "odom",
    '{"x": 1e400, "y": NaN}',
    '{"x": 0, "y": 0}',
    "contains",
    "near_position",
]
OTHERS = [
    None,
    True,
    False,
    [],
    {},
    nested(DEEP),
    nested(DEEP, kind="object"),
    ["/odom"] * 10_000,
    {str(n): n for n in range(10_000)},
    {"x": math.nan, "y": 1},
    {"x": 10**400, "y": 1},
    {"x": 1e308, "y": -1e308, "z": 1e308},
    {"x": [], "y": {}},
    {"x": True, "y": "1"},
    {"\ud800": 1},
    [None, math.nan, [10**400]],
]

values: SearchStrategy[Any] = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.sampled_from(OTHERS),
    st.floats(),
    st.integers(),
    st.text(st.characters(), max_size=40),
)
"""One argument's value. Characters include lone surrogates, controls and bidirectional marks."""

names: SearchStrategy[str] = st.one_of(
    st.sampled_from(
        ["__class__", "moment", "span", "self", "x" * MEGABYTE, "\ud800", "", "topics"]
    ),
    st.text(max_size=20),
)


def calls(tools: Mapping[str, Mapping[str, Any]]) -> SearchStrategy[tuple[str, dict[str, Any]]]:
    """Calls of any tool: good ones, each argument of which may be replaced, left out or joined.

    `tools` maps each name to the JSON schema of its arguments.
    """
    # What writes is refused where nothing is recorded, and so is no good question there.
    good: dict[str, dict[str, Any]] = {name: {} for name in tools}
    good |= {name: given for name, given, _ in ANSWERED}
    return st.sampled_from(sorted(tools)).flatmap(
        lambda name: st.tuples(st.just(name), _arguments(tools[name], good[name]))
    )


def _arguments(
    schema: Mapping[str, Any], good: Mapping[str, Any]
) -> SearchStrategy[dict[str, Any]]:
    known = {
        name: st.one_of(st.just(good[name]), values, values) if name in good else values
        for name in schema["properties"]
    }
    required = [name for name in known if name in good]
    kept = st.fixed_dictionaries(
        {name: known[name] for name in required},
        optional={name: known[name] for name in known if name not in required},
    )
    missing = st.sets(st.sampled_from(required), max_size=1) if required else st.just(set[str]())
    extra = st.dictionaries(names, values, max_size=2)
    return st.builds(
        _joined,
        kept,
        st.one_of(st.just(set[str]()), missing),
        st.one_of(st.just(dict[str, Any]()), extra),
    )


def _joined(kept: dict[str, Any], missing: set[str], extra: dict[str, Any]) -> dict[str, Any]:
    return {name: item for name, item in kept.items() if name not in missing} | extra
