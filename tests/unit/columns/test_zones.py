"""The zones of many parts say the same of each as the zone of that part alone."""

import math
import re
import sys

from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.columns.table import Zone, letters_of
from ros2_memory.columns.zones import Zones

T0 = 1_700_000_000 * 10**9
NUMBERS = st.one_of(
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from([2**53, 2**53 + 1, -(2**53) - 1, 0, 1]),
    st.floats(allow_nan=False),
    st.booleans(),
)
LIMITS = st.one_of(NUMBERS, st.just(10**400), st.just(-(10**400)))
WORDS = st.one_of(st.none(), st.text("ab[{\n", max_size=6))


@st.composite
def zones(draw: st.DrawFn) -> Zone:
    if draw(st.booleans()):
        return Zone(words=draw(WORDS))
    if draw(st.integers(0, 5)) == 0:
        return Zone()
    low, high = sorted((draw(NUMBERS), draw(NUMBERS)))
    return Zone(low, high)


def is_exact(*numbers: float) -> bool:
    return all(not math.isfinite(number) or abs(number) < 2**53 for number in numbers)


@given(st.lists(zones(), min_size=1, max_size=8), LIMITS, st.text("ab[", max_size=2))
@example([Zone(0, sys.float_info.max)], 1, "")
@example([Zone(0, math.inf)], 10**400, "")
@example([Zone(-math.inf, 0)], -(10**400), "")
def test_zones_rule_out_what_the_zone_of_each_part_does(
    given_zones: list[Zone], limit: float, text: str
) -> None:
    together = Zones.of(range(1, len(given_zones) + 1), given_zones)
    for nth, zone in enumerate(given_zones):
        pairs = [
            (zone.spans(limit), together.spans(limit)[nth]),
            (zone.reaches(limit, above=True), together.reaches(limit, above=True)[nth]),
            (zone.reaches(limit, above=False), together.reaches(limit, above=False)[nth]),
        ]
        for alone, among_others in pairs:
            assert among_others or not alone
            if is_exact(zone.low, zone.high) and abs(limit) < 2**53:
                assert among_others == alone
        assert together.may_have(text)[nth] == zone.may_have(text)
        assert together.may_be_json[nth] == zone.may_be_json


@given(st.text(st.characters(codec="ascii")) | st.text())
@example("".join(map(chr, range(128))))
def test_rows_of_letters_are_those_of_unicode(text: str) -> None:
    assert letters_of(text) == re.findall(r"[^\W\d_]+", text)
