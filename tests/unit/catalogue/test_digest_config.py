"""Which digests two configurations share."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.catalogue.digest_config import DigestConfig, may_be_one

TYPES = st.sampled_from(["a/msg/A", "b/msg/B", "c/msg/C"])
CONFIGS = st.builds(
    DigestConfig,
    st.sampled_from(["one", "two"]),
    st.dictionaries(TYPES, st.sampled_from(["x", "y"])),
)


@given(CONFIGS, CONFIGS, st.sets(TYPES))
def test_they_share_a_bag_if_they_read_each_of_its_types_alike(
    one: DigestConfig, other: DigestConfig, types: set[str]
) -> None:
    alike = all(one.entries.get(name) == other.entries.get(name) for name in types)
    assert other.reads(one.text(types)) == (one.base == other.base and alike)


@given(CONFIGS, CONFIGS, st.sets(TYPES), st.sets(TYPES))
def test_texts_of_one_configuration_are_taken_for_such(
    one: DigestConfig, other: DigestConfig, types: set[str], others: set[str]
) -> None:
    assert may_be_one(one.text(types), one.text(others))
    if one.base != other.base:
        assert not may_be_one(one.text(types), other.text(others))


def test_the_text_of_another_program_is_of_no_configuration_here() -> None:
    for text in ("0123456789abcdef", "[]", '["one"]', "[1, {}]", "{}", "null"):
        assert not DigestConfig("one").reads(text)
        assert not may_be_one(text, DigestConfig("one").text([]))
        assert may_be_one(text, text)
