"""One mutant beside two good bags: asked, stored, sometimes recovered, and judged."""

import asyncio
import io
import os
import shutil
import time
import traceback
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from ros2_memory import cli
from ros2_memory.bootstrap import build_backfill, build_memory, build_server
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.cli.maintenance.recover import recover_files
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.history.context import Memory
from ros2_memory.serving.mcp_server import EpisodicServer
from tests.fuzz.asking import OF_GOOD, ask, comparable, of_mutant
from tests.fuzz.classes import Job
from tests.fuzz.good import Good, neighbours
from tests.fuzz.holding import hold, truth_of
from tests.fuzz.mutant import LONG_AGO_S, Mutant
from tests.fuzz.oracle import Readable
from tests.fuzz.traps import sprung

MOST_S = 10.0
MOST_MB = 512
_ASKED_OF_GOOD = 2
_ASKED_OF_MUTANT = 4
_RECOVERED_EVERY = 4
_INDEXED_EVERY = 50
_MOST_COUNTED = 20_000
_SERVED_AT_MOST = 20


@dataclass
class Verdict:
    """What became of one mutant. `faults` are what must not happen.

    `told_apart`: what of it can be read is known, and its answers were held to that.
    """

    served: bool = False
    told_apart: bool = False
    asked: int = 0
    left_mb: float = 0.0
    faults: list[str] = field(default_factory=list)


class World:
    """A bag directory with two good bags, one storage, with a store of columns or without."""

    def __init__(self, root: Path, storage: str, *, stored: bool) -> None:
        self.bag_dir = root / f"bags {storage} {stored}"
        self.settings: Settings = load_settings(
            [f"storage={storage}", "recorder=none", f"recording.bag_dir='{self.bag_dir}'"], env={}
        )
        self.storage = storage
        self.stored = stored
        self.clear()
        self._known: list[Any] = []
        self._served = 0
        self._memory = build_memory(self.settings)
        self._server = build_server(self.settings, self._memory)

    def clear(self) -> None:
        """Removes all that is not one of the two good bags."""
        self.bag_dir.mkdir(exist_ok=True)
        good = {name.split("/")[0] for name in neighbours()}
        for entry in self.bag_dir.iterdir():
            if entry.name not in good:
                _remove(entry)
        for name, data in neighbours().items():
            path = self.bag_dir / name
            if not path.is_file():
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(data)
                os.utime(path, (LONG_AGO_S, LONG_AGO_S))

    def renew(self) -> None:
        """Lets go of the memory and of what it keeps between questions."""
        self._memory = build_memory(self.settings)
        self._server = build_server(self.settings, self._memory)

    def serving(self) -> tuple[Memory, EpisodicServer]:
        """A memory and a server; the same for some mutants, as a server outlives its bags."""
        self._served += 1
        if self._served % _SERVED_AT_MOST == 0:
            self.renew()
        self._memory.index.refresh()
        return self._memory, self._server

    def answers(self) -> list[Any]:
        """What the good bags answer when they are alone."""
        if not self._known:
            _, server = self.serving()
            self._known = [
                comparable(asyncio.run(ask(server, name, given))) for name, given in OF_GOOD
            ]
            for answer in self._known:
                if answer is None or "error" in answer:
                    raise AssertionError(f"the good bags do not answer: {answer}")
        return self._known


def tried(world: World, job: Job, mutant: Mutant, good: Good) -> Verdict:
    """Lays the mutant down, asks, and judges; takes it away again."""
    verdict = Verdict()
    world.clear()
    with _failures_in(verdict.faults):
        known = world.answers()
    truth = truth_of(mutant, good)
    verdict.told_apart = truth is not None
    bag = mutant.place(world.bag_dir, job.place)
    trapped = mutant.trap is not None
    # What was used to make it is not the program's.
    reset_peak()
    with _failures_in(verdict.faults), sprung(mutant.trap, bag):
        try:
            asyncio.run(_asked(world, job, known, bag, verdict, truth, trapped=trapped))
            if job.number % _RECOVERED_EVERY == 0:
                with in_time("recovering", verdict), suppress(EpisodicError):
                    recover_files(world.bag_dir, force=True)
            if job.number % _INDEXED_EVERY == 0:
                _indexed(world)
        except Exception:  # noqa: BLE001  whatever it is, it is what is looked for
            verdict.faults.append(f"raised: {traceback.format_exc()[-1500:]}")
    verdict.left_mb = resident_mb()
    if (peak_mb := _status_mb("VmHWM:")) > MOST_MB:
        verdict.faults.append(f"memory: {peak_mb:.0f} MB")
    world.clear()
    return verdict


async def _asked(
    world: World,
    job: Job,
    known: list[Any],
    bag: Path,
    verdict: Verdict,
    truth: list[Readable] | None,
    *,
    trapped: bool,
) -> None:
    with in_time("looking into the bag", verdict):
        memory, server = world.serving()
    rng = job.rng
    if world.stored and job.number % 2:
        _fill(world, memory, verdict)
    for name, given in of_mutant(rng)[:_ASKED_OF_MUTANT]:
        await _timed(server, name, given, verdict)
    told = await _timed(server, "data_time_range", {}, verdict)
    _look_for(memory, bag, told, verdict, trapped=trapped)
    held = next((each for each in memory.index.snapshot().bags if each.path == bag), None)
    if truth and held is not None:
        verdict.faults += await hold(memory, server, held, truth, rng)
    if world.stored and not job.number % 2:
        _fill(world, memory, verdict)
    for at in rng.sample(range(len(OF_GOOD)), _ASKED_OF_GOOD):
        name, given = OF_GOOD[at]
        answer = comparable(await _timed(server, name, given, verdict))
        if answer != known[at]:
            verdict.faults.append(
                f"good bags answer otherwise: {name} {str(answer)[:300]},"
                f" not {str(known[at])[:300]}"
            )


async def _timed(server: EpisodicServer, name: str, given: dict[str, Any], verdict: Verdict) -> Any:
    answer = None
    with in_time(f"{name} {given}", verdict):
        try:
            answer = await ask(server, name, given)
        except Exception as error:  # noqa: BLE001
            verdict.faults.append(f"no reply: {name}: {error!r}"[:500])
    verdict.asked += 1
    if isinstance(answer, dict) and answer.get("error") == "internal":
        verdict.faults.append(f"internal: {name} {given}")
    if isinstance(answer, dict) and "error" in answer and not answer.get("detail"):
        verdict.faults.append(f"no reason: {name} {answer}")
    return answer


def _look_for(memory: Memory, bag: Path, told: Any, verdict: Verdict, *, trapped: bool) -> None:
    """Whether the mutant answers, or is listed with a reason."""
    snapshot = memory.index.snapshot()
    served = {each.path: each for each in snapshot.bags}
    aside = {each.path: each for each in (*snapshot.active, *snapshot.damaged, *snapshot.unread)}
    if bag in served:
        verdict.served = True
        if not trapped:
            _count(memory, bag, served[bag].summary.notes, verdict)
        incomplete = isinstance(told, dict) and told.get("incomplete")
        if served[bag].state is BagState.INCOMPLETE and not incomplete:
            verdict.faults.append("an incomplete bag is not listed")
        return
    if bag in aside:
        if not aside[bag].reason:
            verdict.faults.append("set aside without a reason")
        if not isinstance(told, dict) or not any(
            told.get(each) for each in ("damaged", "unread", "active")
        ):
            verdict.faults.append(f"set aside, and not listed: {str(told)[:300]}")
        return
    # A folder may be called as it likes, and what lies in a hidden one is not looked at.
    hidden = any(name.startswith(".") for name in bag.parts)
    if trapped or hidden or bag.is_dir() or not (bag.exists() or bag.is_symlink()):
        return
    if not snapshot.empty:
        verdict.faults.append("silently absent")
    else:
        summary = memory.reader.summarize(bag)
        if not summary.empty or summary.notes:
            verdict.faults.append(f"counts as empty: {summary}"[:500])


def _count(memory: Memory, bag: Path, notes: tuple[str, ...], verdict: Verdict) -> None:
    """Whether a bag without a note contains what its summary states."""
    summary = memory.reader.summarize(bag)
    if notes or not summary.complete or summary.count > _MOST_COUNTED:
        return
    topics = {each.topic for each in summary.topics}
    try:
        read = sum(1 for _ in memory.reader.records(bag, topics, TimeWindow.everything()))
    except EpisodicError:
        return
    if read != summary.count:
        verdict.faults.append(f"states {summary.count} messages, gives {read}, says nothing")


def _fill(world: World, memory: Memory, verdict: Verdict) -> None:
    with in_time("storing", verdict):
        fill_store(build_backfill(world.settings, memory))


@contextmanager
def in_time(what: str, verdict: Verdict) -> Iterator[None]:
    """Seconds of the processor: a machine that is busy otherwise is no fault."""
    begun = time.process_time()
    yield
    if (spent := time.process_time() - begun) > MOST_S:
        verdict.faults.append(f"slow: {what} took {spent:.1f} s")


def _indexed(world: World) -> None:
    with redirect_stderr(io.StringIO()):
        code = cli.main(
            [
                "index",
                f"storage={world.storage}",
                "recorder=none",
                f"recording.bag_dir='{world.bag_dir}'",
            ]
        )
    if code:
        raise AssertionError(f"ros2-memory index ended with {code}")


@contextmanager
def _failures_in(faults: list[str]) -> Iterator[None]:
    """Within the block what the program logs as its own failure is a fault."""

    def hear(_logger: object, _method: str, event: MutableMapping[str, Any]) -> Mapping[str, Any]:
        if event.get("exc_info"):
            faults.append(f"{event['event']}: {traceback.format_exc()[-1500:]}")
        raise structlog.DropEvent

    structlog.configure(processors=[hear], cache_logger_on_first_use=False)
    try:
        yield
    finally:
        structlog.reset_defaults()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def reset_peak() -> None:
    """Has the peak of this process's memory measured anew (proc(5), clear_refs)."""
    Path("/proc/self/clear_refs").write_text("5")


def resident_mb() -> float:
    """The memory that this process has."""
    return _status_mb("VmRSS:")


def _status_mb(name: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) / 1024
    return 0.0
