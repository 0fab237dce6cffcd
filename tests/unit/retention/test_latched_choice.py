from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.retention import latched_carry
from ros2_memory.retention.latched_carry import Latched, MessageIdentity, worth_carrying
from ros2_memory.storage import base as storage_base

if TYPE_CHECKING:
    from collections.abc import Callable


class TestWorthCarrying:
    @given(st.data())
    def test_what_is_carried_is_carried_on_whatever_the_order(self, data: st.DataObject) -> None:
        drawn = data.draw(st.lists(st.tuples(st.integers(0, 20), st.sampled_from("ab"))))
        messages = [message(moment, "/tf_static", child) for moment, child in drawn]
        once = worth_carrying(messages, during(7), {})
        shuffled = data.draw(st.permutations(messages))
        assert worth_carrying(shuffled, during(7), {}) == once
        assert worth_carrying(once, during(7), {}) == once


def message(moment: int, topic: str, child: str = "", *, published: int | None = None) -> Latched:
    holds = ((topic, ""), (topic, child)) if child else ((topic, ""),)
    sent = moment if published is None else published
    return Latched(moment, MessageIdentity(topic, sent, child.encode()), holds)


def during(moment: int) -> Callable[[int, int], bool]:
    return lambda start, stop: start <= moment < stop


def test_what_may_have_been_received_before_is_what_questions_take_for_it() -> None:
    assert latched_carry.RECEIVED_AGAIN_NS <= storage_base.RELATCHED_NS
