from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.catalogue.text_runs import (
    MAX_MESSAGES,
    MAX_TEXT_CHARS,
    MAX_TEXTS,
    TextRunsBuilder,
    decode_text_runs,
    encode_text_runs,
)

MESSAGES = st.lists(
    st.tuples(
        st.sampled_from([1, SILENCE_NS, SILENCE_NS + 1]),
        st.sets(st.sampled_from(["cup", "Cup", "a\nb", "\ud800", ""])),
    ),
    max_size=70,
)


@given(MESSAGES)
def test_what_is_stored_says_of_each_message_which_texts_it_has(
    messages: list[tuple[int, set[str]]],
) -> None:
    builder, one_by_one = TextRunsBuilder(), TextRunsBuilder()
    time = 0
    same: dict[frozenset[str], set[str]] = {}
    for pause, texts in messages:
        time += pause
        builder.add(time, same.setdefault(frozenset(texts), texts))
        one_by_one.add(time, {*texts})
    found = builder.runs()
    assert found == one_by_one.runs()
    every = set().union(*(texts for _, texts in messages))
    if found is None:
        assert not every
        return
    stored = decode_text_runs(encode_text_runs(found))
    assert stored == found
    assert (stored.size, {*stored.texts}) == (len(messages), every)
    for nth, (pause, texts) in enumerate(messages):
        assert {text for text, bits in stored.texts.items() if bits >> nth & 1} == texts
        assert bool(stored.silent >> nth & 1) == (nth > 0 and pause > SILENCE_NS)


@pytest.mark.parametrize(
    "texts",
    [
        [{f"{number}"} for number in range(MAX_TEXTS + 1)],
        [{"a" * MAX_TEXT_CHARS, "b"}],
        [{"a"}] * (MAX_MESSAGES + 1),
    ],
)
def test_of_too_many_texts_nothing_is_stored(texts: list[set[str]]) -> None:
    builder = TextRunsBuilder()
    for time, each in enumerate(texts):
        builder.add(time, each)
    assert builder.runs() is None


def test_what_is_not_known_of_one_message_is_known_of_none() -> None:
    builder = TextRunsBuilder()
    builder.add(0, {"cup"})
    builder.give_up()
    builder.add(1, {"cup"})
    assert builder.runs() is None


@pytest.mark.parametrize(
    "packed", [b"", b"3\n", b"[3,1]\n", b'[3,"cup"]\n\0', b'[3,"cup"]\n\0\0\0']
)
def test_damaged_bytes_are_refused(packed: bytes) -> None:
    with pytest.raises((ValueError, TypeError)):
        decode_text_runs(packed)
