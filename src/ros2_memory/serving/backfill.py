"""Fills the catalogue: every closed bag that has no entry is digested, the newest first.

A kill at any moment loses at most the bag under way: entries are written whole or not at all.
"""

from __future__ import annotations

import math
import os
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import anyio
import anyio.to_thread

from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.catalogue.lookup import bags_without_entry
from ros2_memory.catalogue.store import BagKey
from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import NS_PER_S, Ns, ms_from_ns
from ros2_memory.history.context import Call
from ros2_memory.history.time_arguments import TimeRange
from ros2_memory.index.scan import settled
from ros2_memory.queries import list_recorded_topics, trajectory_summary

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.catalogue.digest import Digester
    from ros2_memory.core.model import BagFile
    from ros2_memory.history.context import Memory

log = get_logger(__name__)

BACKLOG: Final = 8
"""More bags than these are digested by a program of its own, so that answers stay fast."""
TIDY_S: Final = 600.0
"""How often entries are looked through for files that are gone."""

LAST_S: Final = 9.2e9
"""Unix seconds after everything that was ever recorded."""

AGAIN_NS: Final[Ns] = 600 * NS_PER_S
"""After this long a bag that could not be digested is tried again: the disk may have failed."""

_MOST_REFUSED: Final = 10_000


@dataclass(frozen=True, slots=True)
class Progress:
    """How many closed bags there are, and how many of them are still to be digested.

    `refused` cannot be digested: they are read whenever a question is about them.
    """

    closed: int
    waiting: int
    refused: int

    def after(self, more: int) -> Progress:
        """When some more have been digested."""
        return Progress(self.closed, self.waiting - more, self.refused)


class Backfill:
    """Digests the bags of one memory. Not for several threads at once, but for `progress`."""

    def __init__(self, memory: Memory, digester: Digester, bag_dir: Path) -> None:
        self._memory = memory
        self._digester = digester
        self._bag_dir = bag_dir
        self._refused: dict[BagKey, Ns] = {}
        self.undecodable: dict[str, str] = {}
        """By topic, why its messages cannot be decoded, as it was when that was last looked at."""

    def waiting(self) -> list[BagFile]:
        """The bags to be digested, the newest first."""
        recall = self._memory.recall
        if recall is None:
            return []
        missing = bags_without_entry(self._memory.index.snapshot().segments, recall)
        return [bag for bag in reversed(missing) if not self._is_refused(self._key(bag))]

    def progress(self) -> Progress:
        """How far the catalogue is."""
        bags = self._memory.index.snapshot().bags
        closed = sum(bag.state is BagState.CLOSED for bag in bags)
        refused = sum(self._is_refused(key) for key in list(self._refused))
        return Progress(closed, len(self.waiting()), refused)

    def digest(self, bag: BagFile) -> bool:
        """Digests one bag; False where it must wait, was changed meanwhile, or is refused."""
        recall = self._memory.recall
        if recall is None or not self._looks_like_itself(bag):
            return False
        begun = time.perf_counter_ns()
        try:
            digest = self._digester.digest(bag.path)
        except BagError as error:
            self._refuse(bag, error.reason)
            return False
        except Exception as error:
            log.exception("digest_failed", path=str(bag.path))
            self._refuse(bag, type(error).__name__)
            return False
        if digest.summary != bag.summary or not self._looks_like_itself(bag):
            return False
        if not recall.catalogue.put(self._key(bag), digest):
            return False
        log.debug(
            "bag_digested",
            path=str(bag.path),
            duration_ms=round(ms_from_ns(time.perf_counter_ns() - begun), 3),
        )
        return True

    @property
    def cannot_write(self) -> bool:
        """Whether what was digested last could not be kept."""
        recall = self._memory.recall
        return recall is not None and recall.catalogue.is_failing

    @property
    def trouble(self) -> str | None:
        """Why the catalogue is not what it should be; None where nothing is amiss."""
        recall = self._memory.recall
        return None if recall is None else recall.catalogue.trouble

    def look_after(self, *, thorough: bool = False) -> None:
        """Has the catalogue go back to its file, unless the bag directory itself is away.

        Args:
            thorough: whether all of the file is read to see that it is whole.
        """
        recall = self._memory.recall
        if recall is not None and self._memory.index.snapshot().problem is None:
            recall.catalogue.look_after(thorough=thorough)

    @property
    def in_memory(self) -> bool:
        """Whether no other process could see what is written."""
        recall = self._memory.recall
        return recall is None or recall.catalogue.path is None

    def warm(self) -> None:
        """Works out what recordings that overlap hold together, before somebody asks."""
        with suppress(EpisodicError):
            rows = list_recorded_topics(self._memory, Call())
            self.undecodable = {row.topic: row.undecodable for row in rows if row.undecodable}
        with suppress(EpisodicError):
            trajectory_summary(self._memory, Call(), TimeRange(start_s=0.0, end_s=LAST_S))

    def tidy(self) -> None:
        """Drops the entries of files that are gone, and those of older configurations.

        Not while there are no bags at all.
        """
        recall = self._memory.recall
        snapshot = self._memory.index.snapshot()
        # Where no bag is left the disk of the bags is rather missing than empty.
        if recall is None or snapshot.problem is not None or not snapshot.bags:
            return
        there = {self._key(bag).path for run in snapshot.segments for bag in run.bags}
        recall.catalogue.forget([path for path in recall.catalogue.paths() if path not in there])
        recall.catalogue.forget_older_configurations()

    def _looks_like_itself(self, bag: BagFile) -> bool:
        """Whether the file and its sidecar look as the index saw them, and long enough so."""
        try:
            stat = os.lstat(bag.path)
        except OSError:
            return False
        sidecar_ns = _mtime_ns(bag.path.with_name(HANDOVER_FILE))
        now = self._memory.clock.now()
        return (stat.st_size, stat.st_mtime_ns, sidecar_ns) == (
            bag.size,
            bag.mtime_ns,
            bag.sidecar_ns,
        ) and (settled(stat.st_mtime_ns, now) and settled(sidecar_ns, now))

    def _refuse(self, bag: BagFile, reason: str) -> None:
        log.warning("bag_not_digested", path=str(bag.path), reason=reason)
        if len(self._refused) >= _MOST_REFUSED:
            self._refused.clear()
        self._refused[self._key(bag)] = self._memory.clock.now()

    def _is_refused(self, key: BagKey) -> bool:
        since = self._refused.get(key)
        return since is not None and abs(self._memory.clock.now() - since) < AGAIN_NS

    def _key(self, bag: BagFile) -> BagKey:
        return BagKey.of(bag, self._bag_dir)


async def keep_backfilled(filler: Backfill, helper: Sequence[str], every_s: float) -> None:
    """Digests what has closed, every `every_s` seconds, until it is cancelled.

    `helper` is the command line of the program that digests a backlog (`ros2-memory index`).
    """
    tidied, warmed = -math.inf, False
    while True:
        try:
            due = time.monotonic() - tidied > TIDY_S
            look_after = partial(filler.look_after, thorough=due)
            await anyio.to_thread.run_sync(look_after, abandon_on_cancel=True)
            waiting = await anyio.to_thread.run_sync(filler.waiting, abandon_on_cancel=True)
            if len(waiting) > BACKLOG and not filler.in_memory and await _helped(helper):
                # What it could not digest is tried here, and refused if need be.
                waiting = await anyio.to_thread.run_sync(filler.waiting, abandon_on_cancel=True)
            done = await _digest(filler, waiting[:BACKLOG])
            # What is still to be digested would be read for it.
            if (done or not warmed) and len(waiting) <= BACKLOG:
                await anyio.to_thread.run_sync(filler.warm, abandon_on_cancel=True)
                warmed = True
            if due:
                await anyio.to_thread.run_sync(filler.tidy, abandon_on_cancel=True)
                tidied = time.monotonic()
        except Exception:
            log.exception("filling_failed")
        await anyio.sleep(every_s)


async def _digest(filler: Backfill, bags: Sequence[BagFile]) -> int:
    """How many of these bags could be digested and kept."""
    done = 0
    for bag in bags:
        done += await anyio.to_thread.run_sync(filler.digest, bag, abandon_on_cancel=True)
        if filler.cannot_write:
            break
    return done


async def _helped(helper: Sequence[str]) -> bool:
    """Runs the helper to its end; whether it did its work. Cancelling ends it."""
    try:
        async with await anyio.open_process(
            helper, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=None
        ) as process:
            code = await process.wait()
    except OSError as error:
        log.warning("filling_helper_failed", reason=str(error))
        return False
    if code:
        log.warning("filling_helper_failed", reason=f"it ended with exit code {code}")
    return code == 0


def _mtime_ns(path: Path) -> Ns:
    try:
        return os.lstat(path).st_mtime_ns
    except OSError:
        return 0
