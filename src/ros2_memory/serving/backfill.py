"""Fills the catalogue and the store of columns with every closed bag, the newest first.

A kill at any moment loses at most the bag that is being digested: entries are written whole or not
at all.
"""

from __future__ import annotations

import math
import os
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

import anyio
import anyio.to_thread

from ros2_memory.bag_dir.handover_file import sure_handover
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.catalogue.lookup import bags_without_entry
from ros2_memory.columns.store import BagKey
from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import NS_PER_S, Ns, ms_from_ns, ns_from_unix
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.index.scan import settled
from ros2_memory.index.segment import in_time
from ros2_memory.insights.drive import slice_drive
from ros2_memory.places.region_visits import make_tracks
from ros2_memory.queries import list_recorded_topics
from ros2_memory.things.seen import Watching

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.handover_file import Handover
    from ros2_memory.catalogue.digest import Digester
    from ros2_memory.columns.fill import Filling
    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.history.context import Memory

T = TypeVar("T")

log = get_logger(__name__)

BACKLOG: Final = 8
"""A child process digests more bags than these, so that answers stay fast."""
PRUNE_INTERVAL_S: Final = 600.0
"""How often the entries of deleted files are removed."""

LONGEST_TURN_S: Final = 600.0
"""How long one of several catalogues is filled before it is the next one's turn."""
_LATELY: Final = 4
"""Intervals between scans after which bags count as out of reach."""
RETRY_NS: Final[Ns] = 600 * NS_PER_S
"""After this long a bag that could not be digested is tried again: the disk may have failed."""

_MAX_REFUSED: Final = 10_000


@dataclass(frozen=True, slots=True)
class Progress:
    """How many closed bags there are, and how many of them are still to be digested.

    `refused` cannot be digested; they are read by every query that concerns them.
    """

    closed: int
    waiting: int
    refused: int


class Backfill:
    """Digests the bags of one memory. Only `progress` may be called from several threads.

    Attributes:
        catalogue: what is filled.
        filling: fills the store of columns; None where there is none.
        undecodable: by topic, why its messages cannot be decoded, as `precompute` last found.

    Raises:
        ValueError: the memory has no catalogue.
    """

    def __init__(
        self,
        memory: Memory,
        digester: Digester,
        bag_dir: Path,
        filling: Filling | None = None,
    ) -> None:
        if memory.recall is None:
            raise ValueError("a memory without a catalogue has nothing to fill")
        self._memory = memory
        self._digests = memory.recall
        self.catalogue = memory.recall.catalogue
        self._digester = digester
        self.filling = filling
        self._bag_dir = bag_dir
        self._refused: dict[BagKey, Ns] = {}
        self.undecodable: dict[str, str] = {}

    def waiting(self) -> list[BagFile]:
        """Returns the bags to be digested, the newest first."""
        timeline = self._memory.index.snapshot().timeline
        missing = self._not_refused(bags_without_entry(timeline.segments, self._digests))
        return sorted(missing, key=in_time, reverse=True)

    def _not_refused(self, bags: list[BagFile]) -> list[BagFile]:
        if not self._refused:
            return bags
        return [bag for bag in bags if not self._is_refused(self._key(bag))]

    def progress(self) -> Progress:
        """Returns how much of the catalogue is filled."""
        bags = self._memory.index.snapshot().bags
        closed = sum(bag.state is BagState.CLOSED for bag in bags)
        refused = sum(self._is_refused(key) for key in list(self._refused))
        return Progress(closed, len(self.waiting()), refused)

    def not_stored(self) -> list[BagFile]:
        """Returns the bags of which columns are to be stored, the newest first."""
        snapshot = self._memory.index.snapshot()
        if self.filling is None or snapshot.problem is not None:
            return []
        return self.filling.waiting(snapshot.timeline)

    def store(self, bag: BagFile) -> bool:
        """Stores the columns of one bag; as `Filling.fill`."""
        timeline = self._memory.index.snapshot().timeline
        return self.filling is not None and self.filling.fill(bag, timeline)

    def merge(self) -> None:
        """Makes parts of what is stored and over, and keeps the store within what it may take."""
        snapshot = self._memory.index.snapshot()
        if self.filling is not None and snapshot.problem is None:
            make_fragments(self._memory, self.filling.merge(snapshot.timeline))
            self.filling.thin()
            self.filling.trim()

    def digest(self, bag: BagFile) -> bool:
        """Digests one bag; returns False if it must wait, has changed meanwhile, or is refused."""
        if not self._is_unchanged(bag):
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
        if digest.summary != bag.summary or not self._is_unchanged(bag):
            return False
        if not self.catalogue.put(self._key(bag), digest):
            return False
        log.debug(
            "bag_digested",
            path=str(bag.path),
            duration_ms=round(ms_from_ns(time.perf_counter_ns() - begun), 3),
        )
        return True

    def renew(self, bags: Sequence[BagFile]) -> list[BagFile]:
        """Keeps the entries of bags in which their recording's handover has changed nothing.

        Each rotation writes the `handover.json` of a recording with many bags again, and concerns
        one or two of these. Returns the bags that are to be digested.
        """
        among = self.catalogue.with_other_sidecar([self._key(bag) for bag in bags])
        handovers: dict[Path, Handover] = {}
        whole: list[tuple[BagKey, BagSummary]] = []
        for bag in bags if among else ():
            key = self._key(bag)
            if key not in among or not self._is_unchanged(bag):
                continue
            with suppress(BagError, OSError):
                if bag.recording not in handovers:
                    handovers[bag.recording] = sure_handover(bag.recording).handover
                if handovers[bag.recording].rule(bag.path.name) is not None:
                    continue
                # All messages of the bag count now. If an entry has as many, all did when it was
                # made: so it is the entry that would be made now.
                summary = self._memory.reader.summarize(bag.path)
                if summary == bag.summary and self._is_unchanged(bag):
                    whole.append((key, summary))
        renewed = self.catalogue.renew(whole)
        return [bag for bag in bags if self._key(bag) not in renewed] if renewed else [*bags]

    def look_after(self, *, thorough: bool = False) -> None:
        """Returns the catalogue to its file, unless the bag directory itself is missing.

        Args:
            thorough: whether the whole file is read to check its integrity.
        """
        if self._memory.index.snapshot().problem is None:
            self.catalogue.look_after(thorough=thorough)
            if self.filling is not None:
                self.filling.store.look_after(thorough=thorough)

    def write_again(self) -> None:
        """Finds out whether the disk works again, where nothing waits to be written."""
        self.catalogue.write_again()
        if self.filling is not None:
            self.filling.store.write_again()

    def precompute(self) -> None:
        """Finds out what cannot be decoded, and counts what overlapping recordings hold together.

        Before a client asks.
        """
        with suppress(EpisodicError):
            rows = list_recorded_topics(self._memory, Call())
            self.undecodable = {row.topic: row.undecodable for row in rows if row.undecodable}

    def prune(self) -> None:
        """Removes the entries of deleted files, and those of older configurations.

        Keeps those of files that only the reader of another preset opens. Does nothing where there
        are no bags: the disk of the bags is more likely missing than empty.
        """
        snapshot = self._memory.index.snapshot()
        if snapshot.problem is not None or not snapshot.bags:
            return
        present = {self._key(bag).path for bag in snapshot.timeline.bags}
        reads = self._memory.reader.reads
        absent = (path for path in self.catalogue.paths() if path not in present)
        gone = [
            path
            for path in absent
            if reads(self._bag_dir / path) or not (self._bag_dir / path).exists()
        ]
        self.catalogue.forget(gone)
        self.catalogue.forget_older_configurations()
        if self.filling is not None:
            self.filling.prune(snapshot.timeline)

    def _is_unchanged(self, bag: BagFile) -> bool:
        """Returns whether the file and its sidecar are as the index found them, for a while now."""
        try:
            stat = os.lstat(bag.path)
        except OSError:
            return False
        sidecar_ns = _mtime_ns(bag.path.with_name(HANDOVER_FILE))
        now = self._memory.clock.now()
        return (
            (stat.st_size, stat.st_mtime_ns, sidecar_ns) == (bag.size, bag.mtime_ns, bag.sidecar_ns)
            and settled(stat.st_mtime_ns, now)
            and settled(sidecar_ns, now)
        )

    def _refuse(self, bag: BagFile, reason: str) -> None:
        log.warning("bag_not_digested", path=str(bag.path), reason=reason)
        if len(self._refused) >= _MAX_REFUSED:
            self._refused.clear()
        self._refused[self._key(bag)] = self._memory.clock.now()

    def _is_refused(self, key: BagKey) -> bool:
        since = self._refused.get(key)
        return since is not None and abs(self._memory.clock.now() - since) < RETRY_NS

    def _key(self, bag: BagFile) -> BagKey:
        return BagKey.of(bag, self._bag_dir)


def make_fragments(memory: Memory, windows: Sequence[TimeWindow]) -> None:
    """Makes what follows from the parts of some times; stores it, and what questions made of it."""
    if memory.columns is None:
        return
    for window in windows:
        try:
            view = View(memory, Call())
            slice_drive(view, window)
            make_tracks(view, window)
            Watching(view).make(window)
        except EpisodicError as error:
            log.warning("fragments_not_made", reason=str(error))
        memory.columns.write_fragments()
    memory.columns.write_fragments()


async def keep_backfilled(
    backfill: Backfill,
    helper: Sequence[str],
    every_s: float,
    warm_up: Callable[[], bool] | None = None,
) -> None:
    """Digests closed bags every `every_s` seconds, until it is cancelled.

    `helper` is the command line of the program that digests a backlog (`ros2-memory index`).
    `warm_up` is called once the catalogue is full, until it returns that it is done.
    """
    filler = Filler(backfill, helper, warm_up)
    while True:
        await filler.fill()
        await anyio.sleep(every_s)


async def keep_all_backfilled(fillers: Sequence[tuple[Memory, Filler]], every_s: float) -> None:
    """Fills several catalogues, one after the other, until it is cancelled.

    A memory whose bags were not scanned lately is passed over: its disk may hang.
    """
    while True:
        for memory, filler in fillers:
            published = memory.index.published
            if published is None or published.problem is not None:
                continue
            if memory.clock.now() - published.scanned_at > ns_from_unix(_LATELY * every_s):
                continue
            with anyio.move_on_after(LONGEST_TURN_S):
                await filler.fill()
        await anyio.sleep(every_s)


class Filler:
    """Fills one catalogue, a round at a time; see `keep_backfilled`."""

    def __init__(
        self,
        backfill: Backfill,
        helper: Sequence[str],
        warm_up: Callable[[], bool] | None = None,
    ) -> None:
        self._backfill = backfill
        self._helper = helper
        self._warm_up = warm_up
        self._pruned_s = -math.inf
        self._is_precomputed = False

    async def fill(self) -> None:
        """Digests the closed bags that there are. Raises nothing but cancellation."""
        try:
            await self._fill()
        except Exception:
            log.exception("filling_failed")

    async def _fill(self) -> None:
        backfill = self._backfill
        due = time.monotonic() - self._pruned_s > PRUNE_INTERVAL_S
        await _in_thread(partial(backfill.look_after, thorough=due))
        find = backfill.waiting
        waiting = await _in_thread(find)
        waiting = await _in_thread(partial(backfill.renew, waiting))
        unstored = await _in_thread(backfill.not_stored)
        # A catalogue that is in memory cannot be filled by another process.
        has_file = backfill.catalogue.path is not None
        most = max(len(waiting), len(unstored))
        if most > BACKLOG and has_file and await _run_helper(self._helper):
            # Bags that the helper could not digest are tried here, and refused if they fail.
            waiting = await _in_thread(find)
            unstored = await _in_thread(backfill.not_stored)
        if not waiting and not unstored:
            await _in_thread(backfill.write_again)
        for bag in unstored[:BACKLOG]:
            await _in_thread(partial(backfill.store, bag))
        await _in_thread(backfill.merge)
        done = await _digest(backfill, waiting[:BACKLOG])
        # Earlier, bags without a digest would be read for it.
        if (done or not self._is_precomputed) and len(waiting) <= BACKLOG:
            await _in_thread(backfill.precompute)
            self._is_precomputed = True
        if self._warm_up and len(waiting) <= BACKLOG and await _in_thread(self._warm_up):
            self._warm_up = None
        if due:
            await _in_thread(backfill.prune)
            self._pruned_s = time.monotonic()


async def _in_thread(work: Callable[[], T]) -> T:
    return await anyio.to_thread.run_sync(work, abandon_on_cancel=True)


async def _digest(backfill: Backfill, bags: Sequence[BagFile]) -> int:
    """Returns how many of these bags could be digested and stored."""
    done = 0
    for bag in bags:
        done += await _in_thread(partial(backfill.digest, bag))
        if backfill.catalogue.is_failing:
            break
    return done


async def _run_helper(helper: Sequence[str]) -> bool:
    """Runs the helper to its end; returns whether it succeeded. Cancelling ends it."""
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
