"""The turn to hold much of a bag: one thread has it, the others wait for as long as they may."""

import threading
from contextlib import nullcontext
from functools import partial

import pytest

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.large_reads import LargeReads
from tests.support.processes import PATIENCE_S, until


class Reader(threading.Thread):
    """Takes the turn in a block, and has it until it is told to go on."""

    def __init__(self, large: LargeReads, had: list[str], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._large = large
        self._had = had
        self.go_on = threading.Event()
        self.began = threading.Event()
        self.start()

    def run(self) -> None:
        with self._large.during():
            self.began.set()
            self._large.acquire()
            self._large.acquire()
            self._had.append(self.name)
            assert self.go_on.wait(PATIENCE_S)


def waiting(large: LargeReads) -> int:
    return len(large._queue)


def test_threads_have_the_turn_one_after_the_other_in_the_order_they_came() -> None:
    large, had = LargeReads(), list[str]()
    readers = []
    for nth in range(3):
        readers.append(Reader(large, had, str(nth)))
        until(lambda: waiting(large) == len(readers))
    for nth, reader in enumerate(readers):
        until(partial(had.__contains__, str(nth)))
        assert had == [str(each) for each in range(nth + 1)]
        reader.go_on.set()
        reader.join()
    assert not waiting(large)


def test_who_waits_is_told_when_its_time_is_over_and_leaves_the_queue() -> None:
    large, had = LargeReads(), list[str]()
    holder = Reader(large, had, "holder")
    until(lambda: had)

    def over() -> None:
        raise QueryTimeoutError("too late")

    with pytest.raises(QueryTimeoutError), large.during(over):
        large.acquire()
    assert waiting(large) == 1
    holder.go_on.set()
    holder.join()
    with large.during(over):
        large.acquire()  # it need not wait, so its time is not looked at
    assert not waiting(large)


@pytest.mark.parametrize("is_set_aside", [True, False])
def test_nobody_waits_outside_of_a_block_or_where_it_is_set_aside(is_set_aside: bool) -> None:
    large, had = LargeReads(), list[str]()
    holder = Reader(large, had, "holder")
    until(lambda: had)
    with large.during() if is_set_aside else nullcontext():
        with large.exempt():
            large.acquire()
        if not is_set_aside:
            large.acquire()
    holder.go_on.set()
    holder.join()
    assert not waiting(large)


def test_a_turn_that_is_passed_on_is_taken_again_behind_who_waited() -> None:
    large, had, waits = LargeReads(), list[str](), list[int]()

    def check() -> None:
        other.go_on.set()  # it goes on once it is waited for

    with large.during(check, waits.append):
        large.acquire()
        other = Reader(large, had, "other")
        until(lambda: waiting(large) == 2)
        assert not had
        large.release()
        until(lambda: had)
        large.acquire()
        other.join()
    assert [each > 0 for each in waits] == [True]
    assert not waiting(large)
