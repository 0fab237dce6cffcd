"""A second process digests some of the bags while other programs leave a core for it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from ros2_memory.cli.maintenance.second_process import (
    FreeCores,
    SecondProcess,
    busy_ticks,
    is_second,
    used_ticks,
)
from ros2_memory.core.bag_summary import BagSummary, SummarySchema
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

SUMMARY = BagSummary.decoded(SummarySchema(()), b"")
MANY = [BagFile(f"/bags/rec_{n}.mcap", 1, 1, BagState.CLOSED, SUMMARY, n, n) for n in range(1_000)]


class FakeWorker:
    """A process that ends when it is told to."""

    pid = 77

    def __init__(self) -> None:
        self.alive = True

    def is_alive(self) -> bool:
        return self.alive

    def terminate(self) -> None:
        self.alive = False

    def join(self, timeout: float | None = None) -> None:
        assert not self.alive


class Machine:
    """How many cores are free, and the processes that were started."""

    def __init__(self) -> None:
        self.free: float | None = 2.0
        self.asked: list[list[int]] = []
        self.started: list[FakeWorker] = []
        self.second = SecondProcess(self.start, self.free_cores)

    def start(self, nth: int) -> FakeWorker:
        self.started.append(FakeWorker())
        assert nth == len(self.started)
        return self.started[-1]

    def free_cores(self, own: Sequence[int]) -> float | None:
        self.asked.append([*own])
        return self.free


def test_it_is_started_when_a_core_becomes_free_later() -> None:
    machine = Machine()
    for free in (1.2, None, 1.5):
        machine.free = free
        assert machine.second.share(MANY) == MANY
    assert machine.started == []
    machine.free = 2.0
    own = machine.second.share(MANY)
    assert own == [bag for bag in MANY if not is_second(bag.file, 1)]
    assert 400 < len(own) < 600
    assert len(machine.started) == 1
    machine.second.share(MANY)
    assert machine.asked[-2:] == [[os.getpid()], [os.getpid(), 77]]


def test_it_is_not_started_for_few_bags() -> None:
    machine = Machine()
    assert machine.second.share(MANY[:100]) == MANY[:100]
    assert machine.started == []


def test_it_is_stopped_where_other_programs_need_the_core_and_started_again() -> None:
    machine = Machine()
    for free in (2.0, None, 1.6):
        machine.free = free
        assert len(machine.second.share(MANY)) < 600
    machine.free = 1.1
    assert machine.second.share(MANY) == MANY
    assert not machine.started[0].alive
    # Not at once: each start reads the summaries of all bags.
    for free in (*[2.0] * 11, 1.6, *[2.0] * 5, None, *[2.0] * 6):
        machine.free = free
        assert machine.second.share(MANY) == MANY
    machine.free = 2.0
    assert machine.second.share(MANY) == [bag for bag in MANY if not is_second(bag.file, 2)]
    machine.second.stop()
    assert [each.alive for each in machine.started] == [False, False]


def test_what_is_left_where_it_ended_is_shared_again() -> None:
    machine = Machine()
    machine.second.share(MANY)
    machine.started[0].alive = False
    assert machine.second.share(MANY) == MANY
    left = [bag for bag in MANY if not is_second(bag.file, 1)] * 2
    own = machine.second.share(left)
    assert 0.4 < len(own) / len(left) < 0.6


def test_nothing_waits_for_it_alone() -> None:
    machine = Machine()
    machine.second.share(MANY)
    others = [bag for bag in MANY if is_second(bag.file, 1)]
    assert machine.second.share(others) == others
    assert not machine.started[0].alive


# The processors


def proc_stat(*busy: int) -> str:
    """Returns /proc/stat of cores that ran programs for so many ticks, and were idle for 10,000."""
    rows = [f"cpu{core} {ticks - 5} 1 1 10000 333 1 1 1 0 0" for core, ticks in enumerate(busy)]
    return "\n".join(["cpu  99 99 99 99 99 99 99 99 0 0", *rows, "intr 1 2 3", "ctxt 4"])


def test_the_time_of_processors_is_that_of_programs_on_the_cores_of_this_process() -> None:
    assert busy_ticks(proc_stat(100, 20, 3_000), {0, 2}) == 3_100


def test_the_time_of_a_process_with_any_name_is_read() -> None:
    assert used_ticks("77 (a) b (c) S 1 1 1 0 -1 4 5 6 7 8 120 34 0 0 20 0 1 0") == 154


def test_free_is_what_other_programs_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1})
    monkeypatch.setattr(os, "sysconf", lambda _name: 100)
    texts: dict[str, str] = {}
    now = [0]
    free = FreeCores(texts.__getitem__, lambda: now[0])

    def looked(at_s: int, own: int, *busy: int) -> float | None:
        now[0] = at_s * NS_PER_S
        texts["stat"] = proc_stat(*busy)
        texts["7/stat"] = f"7 (x) S 1 1 1 0 -1 4 5 6 7 8 {own} 0 0"
        return free([7])

    assert looked(0, 0, 1_000, 1_000) is None
    assert looked(2, 0, 1_000, 1_000) is None
    # This process alone, then with another one, for 10 s each.
    assert looked(10, 1_000, 2_000, 1_000) == pytest.approx(2.0)
    assert looked(20, 2_000, 3_000, 1_800) == pytest.approx(1.2)


def test_where_the_processors_cannot_be_watched_none_is_free() -> None:
    def read(_name: str) -> str:
        raise PermissionError

    assert FreeCores(read, lambda: 0)([1]) == 0.0


def test_none_is_free_where_a_container_numbers_its_cores_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {6, 7})
    assert FreeCores(lambda _name: proc_stat(10, 10), lambda: 0)([]) == 0.0
