"""A disk that fails: whatever it fails at, nothing false is answered, and all is there afterwards.

`FAULTS_READS` is how many calls are made to fail one after another for each kind of file (4 unless
given); with 0 every single one is: that takes an hour.
"""

import errno
import os
import random
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ros2_memory.columns.fill import RETRY_NS, Progress
from ros2_memory.history.context import Memory
from ros2_memory.index.file_state import RETRY_SOON_NS
from ros2_memory.serving.health import Health
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.faults.failing_disk import LOOK, OPEN, PASSING, failing
from tests.faults.world import NOW, T0, compress, fill_up, served, told, write_bag, write_bags
from tests.support.bags import odom, write_db3
from tests.support.clocks import SettableClock
from tests.support.memories import memory_of

READS = int(os.environ.get("FAULTS_READS", "4"))
COUNT = 3


def memory_at(bag_dir: Path, reader: BagReader | None = None) -> tuple[Memory, SettableClock]:
    """A memory that has seen nothing yet, and whose clock can be moved."""
    clock = SettableClock(NOW.now())
    return memory_of(bag_dir, clock=clock, reader=reader or Rosbag2Reader()), clock


def ask_honest(memory: Memory, right: list[str]) -> list[str]:
    """Asks; every answer is right, or says that something is missing, or health does then."""
    amiss: list[bool] = []

    def look() -> None:
        seen = memory.index.published
        amiss.append(seen is None or bool(seen.damaged or seen.problem))

    answers = told(memory, count=COUNT, after_each=look)
    for given, expected, told_elsewhere in zip(answers, right, amiss, strict=True):
        says = "Error(" in given or ("notes=(" in given and "notes=()" not in given)
        assert given == expected or says or told_elsewhere, given
    return answers


def chosen(calls: int, seed: int) -> list[int]:
    """Which calls are made to fail: all, or some drawn by chance, the first and the last."""
    if not READS or calls <= READS:
        return list(range(calls))
    drawn = random.Random(seed).sample(range(calls), READS - 2)
    return sorted({0, calls - 1, *drawn})


@pytest.mark.parametrize("functions", [OPEN, LOOK], ids=["reading", "looking"])
@pytest.mark.parametrize("packed", [False, True], ids=["mcap", "mcap.zstd"])
@pytest.mark.parametrize("lasting", [False, True], ids=["once", "until it is over"])
def test_a_call_that_fails_hides_nothing_for_good(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    functions: frozenset[str],
    *,
    packed: bool,
    lasting: bool,
) -> None:
    for path in write_bags(tmp_path, COUNT):
        if packed:
            compress(path)
    right = told(memory_at(tmp_path)[0], count=COUNT)
    with failing(monkeypatch, functions) as disk:
        assert told(memory_at(tmp_path)[0], count=COUNT) == right
        calls = disk.calls
        for nth, after in enumerate(chosen(calls, seed=len(functions))):
            memory, clock = memory_at(tmp_path)
            disk.fail(PASSING[nth % len(PASSING)], after=after, times=1 << 60 if lasting else 1)
            ask_honest(memory, right)
            assert disk.failed
            disk.heal()
            clock.at += RETRY_SOON_NS
            assert told(memory, count=COUNT) == right, (nth, after)


@pytest.mark.parametrize("functions", [OPEN, LOOK], ids=["reading", "looking"])
@pytest.mark.parametrize("number", PASSING, ids=errno.errorcode.get)
async def test_a_disk_that_fails_under_a_running_memory_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, functions: frozenset[str], number: int
) -> None:
    write_bags(tmp_path, COUNT)
    memory, clock = memory_at(tmp_path, McapReader())
    right = told(memory, count=COUNT)
    with failing(monkeypatch, functions) as disk:
        disk.fail(number)
        answers = ask_honest(memory, right)
        told_health = await Health(memory)()
        disk.heal()
    if functions is LOOK:
        assert told_health["status"] == "degraded"
        assert not [each for each in answers if "was deleted" in each]
    clock.at += RETRY_SOON_NS
    assert told(memory, count=COUNT) == right
    assert (await Health(memory)())["status"] == "ok"


def test_a_disk_that_fails_while_bags_are_stored_has_them_stored_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bags(tmp_path, COUNT)
    clock = SettableClock(NOW.now())
    memory, filler = served(tmp_path, clock)
    right = told(memory, count=COUNT)
    for after in range(0, 60, 3):
        with failing(monkeypatch, OPEN) as disk:
            disk.fail(errno.EIO, after=after)
            fill_up(filler)
    assert filler.progress().refused
    clock.at += RETRY_NS
    fill_up(filler)
    assert filler.progress() == Progress(COUNT, COUNT)
    assert told(memory, count=COUNT) == right


def test_short_reads_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bags(tmp_path, COUNT)
    right = told(memory_at(tmp_path)[0], count=COUNT)
    with failing(monkeypatch, OPEN) as disk:
        disk.short = True
        assert told(memory_at(tmp_path)[0], count=COUNT) == right


@contextmanager
def few_files(more: int) -> Iterator[None]:
    """So many more files can be opened than are."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # The next one gets the lowest free number: those above it are what is left.
    with Path(os.devnull).open("rb") as probe:
        least = probe.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (least + more, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("kind", ["mcap", "mcap.zstd", "db3"])
@pytest.mark.parametrize("more", [0, 1])
def test_too_many_open_files_are_a_fault_that_passes(tmp_path: Path, kind: str, more: int) -> None:
    for number in range(COUNT):
        path = write_bag(tmp_path, number)
        if kind == "mcap.zstd":
            compress(path)
        if kind == "db3":
            path.unlink()
            write_db3(path.with_suffix(".db3"), [odom(T0 + number, 0.0, 0.0)])
    right = told(memory_at(tmp_path)[0], count=COUNT)
    memory, clock = memory_at(tmp_path)
    memory.index.snapshot()
    with few_files(more):
        ask_honest(memory, right)
    clock.at += RETRY_SOON_NS
    assert told(memory, count=COUNT) == right
    fresh, clock = memory_at(tmp_path)
    with few_files(more):
        ask_honest(fresh, right)
    clock.at += RETRY_SOON_NS
    assert told(fresh, count=COUNT) == right
