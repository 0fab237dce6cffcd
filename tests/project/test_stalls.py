"""Whom a broken promise is blamed on: the product, or the machine that did not run its programs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.support.waiting import until
from tests.timing.stalls import DRIVES, LATE_S, WAITED, WITNESS, Watch, driven, in_time, watching
from tests.timing.witness import Witness

if TYPE_CHECKING:
    from collections.abc import Iterator


class Drives:
    """Drives one after another: `k` keeps its promise, `b` breaks it, and `s` is starved too."""

    def __init__(self, *kinds: str) -> None:
        self.kinds = kinds
        self.driven = 0

    def once(self, watch: Watch) -> str:
        kind = self.kinds[self.driven]
        self.driven += 1
        watch.tell("the robot", 2 * LATE_S if "s" in kind else LATE_S / 2)
        return kind


def judge(kind: str) -> None:
    assert "k" in kind, "it was broken\nand more of that"


def unwatched() -> nullcontext[Watch]:
    return nullcontext(Watch())


@pytest.mark.parametrize("kind", ["k", "ks"])
def test_a_promise_that_is_kept_needs_no_second_drive(kind: str) -> None:
    drives = Drives(kind)
    assert driven(drives.once, judge, unwatched) == kind
    assert drives.driven == 1


def test_one_that_is_broken_on_a_machine_that_was_in_time_is_not_driven_again() -> None:
    drives = Drives("b")
    assert driven(drives.once, judge, unwatched) == "b"
    assert drives.driven == 1


@pytest.mark.parametrize("kinds", [("bs", "k"), ("bs", "b"), ("bs", "ks")])
def test_where_programs_were_kept_waiting_the_drive_is_repeated(kinds: tuple[str, ...]) -> None:
    drives = Drives(*kinds)
    assert driven(drives.once, judge, unwatched) == kinds[-1]
    assert drives.driven == len(kinds)


def test_the_last_drive_is_given_whatever_it_is() -> None:
    assert driven(Drives(*["bs"] * DRIVES).once, judge, unwatched) == "bs"


def test_a_broken_promise_is_excused_by_a_machine_that_kept_programs_waiting_alone() -> None:
    watch = Watch(late_s={"the robot": LATE_S})
    with pytest.raises(AssertionError, match="it was broken"), watch.excusing():
        judge("b")
    watch.tell("the robot", 2 * LATE_S)
    with watch.excusing():
        judge("k")
    with pytest.raises(pytest.skip.Exception), watch.excusing():
        judge("b")


@pytest.mark.parametrize(
    "error",
    [
        AssertionError("no"),
        TimeoutError("no"),
        subprocess.TimeoutExpired("ros2", 5.0),
        ExceptionGroup("tasks", [ExceptionGroup("more", [AssertionError("no")])]),
    ],
)
def test_what_is_asserted_and_what_does_not_come_in_time_is_excused(error: Exception) -> None:
    with pytest.raises(pytest.skip.Exception), Watch(late_s={"a witness": 1.0}).excusing():
        raise error


@pytest.mark.parametrize(
    "error", [ValueError("no"), ExceptionGroup("tasks", [AssertionError("no"), ValueError("no")])]
)
def test_what_fails_otherwise_is_not(error: Exception) -> None:
    with pytest.raises(type(error)), Watch(late_s={"a witness": 1.0}).excusing():
        raise error


class Failing:
    """A test that fails so often, on a machine that starves its programs in so many runs."""

    def __init__(self, failing: int, starved: int) -> None:
        self.failing = failing
        self.starved = starved
        self.runs = 0

    @contextmanager
    def watched(self) -> Iterator[Watch]:
        watch = Watch()
        yield watch
        watch.tell("a witness", 0.2 if self.runs <= self.starved else 0.0)

    def run(self) -> None:
        self.runs += 1
        judge("b" if self.runs <= self.failing else "k")


@pytest.mark.parametrize(("failing", "starved", "runs"), [(0, 2, 1), (1, 1, 2), (1, 2, 2)])
def test_a_test_by_the_clock_runs_until_it_was_given_time(
    failing: int, starved: int, runs: int
) -> None:
    test = Failing(failing, starved)
    in_time(test.run, test.watched)
    assert test.runs == runs


@pytest.mark.parametrize(("failing", "starved"), [(1, 0), (2, 1)])
def test_one_that_fails_though_it_was_given_time_fails(failing: int, starved: int) -> None:
    test = Failing(failing, starved)
    with pytest.raises(AssertionError, match="it was broken"):
        in_time(test.run, test.watched)
    assert test.runs == failing


def test_where_the_machine_never_gave_time_it_is_skipped_with_the_figures() -> None:
    test = Failing(DRIVES, DRIVES)
    with pytest.raises(pytest.skip.Exception) as caught:
        in_time(test.run, test.watched)
    assert test.runs == DRIVES
    assert str(caught.value) == (
        "the machine did not run its programs in time: a witness was 0.20 s late, "
        "in each of 2 drives; at last: it was broken"
    )


@pytest.mark.parametrize(
    ("waited", "starved"),
    [
        (WAITED, None),
        (0.75, "in time: ros2 (7) waited for a processor for 75% of a second"),
    ],
)
def test_a_program_that_was_ready_and_did_not_run_was_starved(
    waited: float, starved: str | None
) -> None:
    told = Watch(waited={"ros2 (7)": waited}).starved
    assert told is None if starved is None else told is not None and told.endswith(starved)


def test_a_program_that_is_told_of_twice_was_as_late_as_at_worst() -> None:
    watch = Watch()
    for late_s in (0.2, 0.7, 0.3):
        watch.tell("the robot", late_s)
    assert watch.late_s == {"the robot": 0.7}


def test_witnesses_that_did_not_run_for_a_while_say_so() -> None:
    with watching() as watch:
        witnesses = own_witnesses()
        assert len(witnesses) == 2
        for pid in witnesses:
            os.kill(pid, signal.SIGSTOP)
        since = time.monotonic()
        until(lambda: time.monotonic() - since > 3 * LATE_S)
        for pid in witnesses:
            os.kill(pid, signal.SIGCONT)
    assert watch.starved is not None
    assert len(watch.late_s) == 2
    assert min(watch.late_s.values()) > 2 * LATE_S


def test_a_witness_ends_with_the_tests_that_it_stood_beside() -> None:
    tests = (
        "import subprocess, sys; "
        f"witness = subprocess.Popen([sys.executable, '-IS', {str(WITNESS)!r}, '0.01'], "
        "stdout=subprocess.PIPE, start_new_session=True); "
        "witness.stdout.readline(); print(witness.pid)"
    )
    ended = subprocess.run([sys.executable, "-c", tests], check=True, stdout=subprocess.PIPE)
    until(lambda: has_ended(int(ended.stdout)))


def has_ended(pid: int) -> bool:
    """Also where nobody has reaped it."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in {"Z", "X"}


def own_witnesses() -> list[int]:
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return [
        int(pid)
        for pid in children
        if str(WITNESS).encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    ]


def test_a_witness_names_the_threads_that_waited_for_the_greatest_part_of_a_second() -> None:
    witness = Witness(0.05, os.getpid())
    own = (os.getpid(), 1)
    witness.compare({own: 0}, {own: 300_000_000, (own[0], 2): 10**9}, 1.0)
    witness.compare({own: 300_000_000}, {own: 1_500_000_000}, 2.0)
    witness.compare({own: 0}, {own: 10_000_000}, 1.0)
    assert [*witness.waited.values()] == [0.6]
    assert all(name.endswith(f"({os.getpid()})") for name in witness.waited)


def test_of_many_programs_that_waited_those_that_waited_longest_are_named() -> None:
    told = Watch(waited={f"ros2 ({n})": n / 10 for n in range(10)}).starved
    assert told is not None
    assert [f"({n}) waited" in told for n in range(10)] == [False] * 7 + [True] * 3
