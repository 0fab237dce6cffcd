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
    def test_the_newest_of_each_hold(self) -> None:
        a, b, c = message(1, "/a"), message(2, "/a"), message(3, "/b")
        assert worth_carrying([a, b, c], nowhere, {}) == {b, c}

    def test_one_that_held_while_something_was_recorded_that_is_kept(self) -> None:
        a, b = message(10, "/a"), message(20, "/a")
        assert worth_carrying([a, b], during(15), {}) == {a, b}
        assert worth_carrying([a, b], during(9), {}) == {b}
        assert worth_carrying([a, b], during(20), {}) == {b}

    def test_the_first_transform_of_a_frame_holds_before_it_was_received(self) -> None:
        a, b = message(10, "/tf_static", "c"), message(20, "/tf_static", "c")
        assert worth_carrying([a, b], during(5), {}) == {a, b}

    def test_one_that_a_kept_bag_repeats_later(self) -> None:
        a, b = message(1, "/a"), message(2, "/a")
        assert worth_carrying([a, b], nowhere, {a.identity: 50}) == {a, b}

    def test_not_one_that_is_in_a_kept_bag_as_early(self) -> None:
        a = message(1, "/a")
        assert worth_carrying([a], nowhere, {a.identity: 1}) == set()

    def test_of_copies_only_the_earliest(self) -> None:
        a = message(5, "/a", published=1)
        copy = message(9, "/a", published=1)
        assert worth_carrying([copy, a], nowhere, {}) == {a}

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


def nowhere(start: int, stop: int) -> bool:
    return False


def during(moment: int) -> Callable[[int, int], bool]:
    return lambda start, stop: start <= moment < stop


def test_what_may_have_been_received_before_is_what_questions_take_for_it() -> None:
    assert latched_carry.RECEIVED_AGAIN_NS <= storage_base.RELATCHED_NS
