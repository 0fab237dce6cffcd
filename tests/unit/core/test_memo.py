"""What is remembered of an object, and goes with it."""

from __future__ import annotations

from typing import Final

from ros2_memory.core.memo import Key, Memo

LENGTH: Final[Key[int]] = Key()
NAMES: Final[Key[list[str]]] = Key()
NOTHING: Final[Key[None]] = Key()


def test_a_value_is_made_once_for_each_owner_and_key() -> None:
    made: list[int] = []

    def make() -> int:
        made.append(len(made))
        return made[-1]

    one, other = Memo(), Memo()
    assert [one.of(LENGTH, make), one.of(LENGTH, make), other.of(LENGTH, make)] == [0, 0, 1]
    one.of(NAMES, list).append("kitchen")
    assert (one.of(NAMES, list), other.of(NAMES, list)) == (["kitchen"], [])


def test_none_is_a_value_too() -> None:
    made: list[None] = []
    memo = Memo()
    for _ in range(2):
        memo.of(NOTHING, lambda: made.append(None))
    assert made == [None]
