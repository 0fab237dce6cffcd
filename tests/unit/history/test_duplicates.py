"""The same duplicates are left out in both directions of a stream."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

from hypothesis import example, given
from hypothesis import strategies as st

from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.history.duplicates import (
    StoredMessage,
    deduplicate_backward,
    deduplicate_forward,
)
from ros2_memory.storage.base import Channel, Record, Schema
from tests.support.bags import boolean, write_mcap
from tests.support.memories import asked, each_way, memory_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CHANNEL = Channel("/bumper", "cdr", Schema("std_msgs/msg/Bool"))
EVERYWHERE = [(MIN_NS, MAX_NS)]
MS = 10**6
S = 10**9


def found(recording: str, time: int, said: bytes = b"x") -> StoredMessage:
    bag = BagFile(f"/{recording}/0.mcap", 1, 1, BagState.CLOSED, BagSummary(()), 0, 0)
    return StoredMessage(bag, Record(CHANNEL, time, 0, said))


@st.composite
def histories(draw: st.DrawFn) -> list[StoredMessage]:
    """Rows of a few messages that are alike, in two recordings or three, some rows close by.

    Those without a pause are shorter than the horizon.
    """
    messages = []
    start = 0
    for _ in range(draw(st.integers(1, 4))):
        start += draw(st.sampled_from([MS, 3 * S, 20 * S]))
        for _ in range(draw(st.integers(1, 6))):
            at = start + draw(st.integers(0, 3)) * draw(st.sampled_from([1, 150 * MS]))
            said = draw(st.sampled_from([b"x", b"y"]))
            messages.append(found(draw(st.sampled_from("aabbc")), at, said))
        start = max(each.time for each in messages)
    return sorted(messages, key=lambda each: each.time)


@given(histories())
@example([found("a", 0), found("b", 1), found("b", 2)])
@example([found("a", 0), found("b", 1), found("a", 2)])
def test_the_same_copies_are_kept_newest_first(messages: list[StoredMessage]) -> None:
    forwards = list(deduplicate_forward(messages, EVERYWHERE))
    backwards = list(deduplicate_backward(reversed(messages), EVERYWHERE))
    assert backwards[::-1] == forwards


@given(histories(), st.integers(0, 30 * S), st.integers(0, 30 * S))
def test_what_lies_outside_of_the_overlap_is_kept_both_ways(
    messages: list[StoredMessage], one: int, other: int
) -> None:
    spans = [(min(one, other), max(one, other))]
    forwards = list(deduplicate_forward(messages, spans))
    assert list(deduplicate_backward(reversed(messages), spans))[::-1] == forwards
    outside = [each for each in messages if not spans[0][0] <= each.time < spans[0][1]]
    assert not Counter(map(id, outside)) - Counter(map(id, forwards))


@each_way
def test_messages_without_a_publish_time_are_no_copies(tmp_path: Path, recalls: bool) -> None:
    """Some writers state 0 for a publish time that they do not know."""
    for nth, robot in enumerate(("ann", "bob")):
        alike = [boolean(S + n * S // 10 + nth * MS, data=False) for n in range(20)]
        unknown = [replace(message, publish_time=0) for message in alike]
        write_mcap(tmp_path / robot / f"{robot}_0.mcap", unknown)
    memory = memory_of(tmp_path, recalls=recalls)
    [bumper] = asked(memory, tmp_path, "list_recorded_topics")
    assert bumper["count"] == 40


def test_no_more_is_held_of_messages_that_are_all_alike_than_of_some_seconds() -> None:
    taken = 0

    def endless() -> Iterator[StoredMessage]:
        nonlocal taken
        for number in range(10_000):
            taken += 1
            yield found("ab"[number % 2], (10_000 - number) * 100 * MS)

    kept = deduplicate_backward(endless(), EVERYWHERE)
    next(kept)
    assert taken * 100 * MS < 4 * COPY_HORIZON_NS
    assert 4_900 < 1 + sum(1 for _ in kept) < 5_600
