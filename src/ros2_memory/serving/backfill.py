"""Fills the store of columns with every closed bag, the newest first.

A kill at any moment loses at most the bag that is being stored: bags are written whole or not at
all.
"""

from __future__ import annotations

import math
import subprocess
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from heapq import merge
from typing import TYPE_CHECKING, Final, TypeVar

import anyio
import anyio.to_thread

from ros2_memory.columns.fill import Batch, Filling, Progress
from ros2_memory.columns.scan import STRETCH_NS
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, TimeWindow
from ros2_memory.core.timebase import Ns, ns_from_unix
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.insights.changes_before import topics_with_changes
from ros2_memory.insights.drive import make_drive_slices
from ros2_memory.insights.topic_events import make_events
from ros2_memory.places.pose_frames import make_tracks
from ros2_memory.queries import list_recorded_topics
from ros2_memory.things.seen import SightReader

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.index.timeline import Timeline

T = TypeVar("T")

log = get_logger(__name__)

BACKLOG: Final = 8
"""If more bags wait, a child process stores them, so that answers stay fast."""
_MERGED_HERE: Final = 100
"""Likewise if their batches have more bags: to store an hour of short splits again as one part."""
_BACKLOG_ALONE: Final = 256
"""How many bags are stored in a round without a child process, as for a lake."""
PRUNE_INTERVAL_S: Final = 600.0
"""How often what is stored of deleted files is removed, and the file of the store is checked."""
_MOST_GONE: Final = 1 / 64
"""If a larger share of the stored bags was deleted, the store is pruned at once."""

LONGEST_TURN_S: Final = 600.0
"""How long one of several stores is filled before it is the next one's turn."""
_REMADE_AT_ONCE: Final = 4
"""Slices of the clock whose outdated fragments are made again in a round."""
_LATELY: Final = 4
"""Intervals between scans after which bags count as out of reach."""


@dataclass
class Backfill:
    """Stores the bags of one memory. Only `progress` may be called from several threads.

    Attributes:
        memory: the memory.
        filling: fills its store of columns; None without a store.
        helper: the command line of the program that stores a backlog (`ros2-memory index`);
            without it this program does.
        undecodable: by topic, why its messages cannot be decoded, as `precompute` last found.
    """

    memory: Memory
    filling: Filling | None
    helper: Sequence[str] = ()
    undecodable: dict[str, str] = field(default_factory=dict)
    _outdated: list[Ns] | None = None
    """Where slices of the clock begin whose fragments were made under other settings."""
    _pruned_s: float = -math.inf
    _gone_after_prune: int = 0
    """Stored bags that `prune` left, although they cannot be read or have changed."""
    _precomputed_of: int | None = None
    """How many bags were closed when `precompute` was last called."""

    async def fill(self) -> None:
        """Stores the closed bags of the moment. Raises nothing but cancellation."""
        try:
            await self._fill_round()
        except Exception:
            log.exception("filling_failed")

    async def _fill_round(self) -> None:
        in_thread = self._in_thread
        is_prune_due = time.monotonic() - self._pruned_s > PRUNE_INTERVAL_S
        await in_thread(partial(self.look_after, thorough=is_prune_due))
        store = None if self.filling is None else self.filling.store
        waiting, batches = await in_thread(self.waiting), await in_thread(self.batches)
        if self._needs_helper(waiting, batches) and await _run_helper(self.helper):
            # Bags that the helper could not store are tried here, and refused if they fail.
            waiting, batches = await in_thread(self.waiting), await in_thread(self.batches)
        if not waiting and store is not None:
            await in_thread(store.write_again)  # whether the disk works again
        stored = await self._store_batches(batches)
        await in_thread(self.follow)
        closed = (await in_thread(self.progress)).closed
        if (stored or closed != self._precomputed_of) and len(waiting) <= BACKLOG:
            await in_thread(self.precompute)
            self._precomputed_of = closed
        if is_prune_due or await in_thread(self.has_many_gone):
            await in_thread(self.prune)
        if is_prune_due:
            self._pruned_s = time.monotonic()

    def _needs_helper(self, waiting: Sequence[BagFile], batches: Sequence[Batch]) -> bool:
        """Returns whether so much waits that the helper shall store it."""
        # A store that is in memory cannot be filled by another process.
        if not self.helper or self.filling is None or self.filling.store.path is None:
            return False
        bags = sum(len(batch.bags) for batch in batches)
        return len(waiting) > BACKLOG or bags > _MERGED_HERE

    async def _store_batches(self, batches: Sequence[Batch]) -> int:
        """Stores the first batches, as many as a round may have; returns how many bags."""
        tried = stored = 0
        for batch in batches:
            if tried >= (BACKLOG if self.helper else _BACKLOG_ALONE):
                break
            tried += len(batch.bags)
            stored += await self._in_thread(partial(self.store, batch))
            if self.filling is not None and self.filling.store.is_failing:
                break
        return stored

    async def _in_thread(self, work: Callable[[], T]) -> T:
        """Runs `work` in a thread, which waits while others hold much of a bag."""

        def work_in_turn() -> T:
            with self.memory.large.during():
                return work()

        return await anyio.to_thread.run_sync(work_in_turn, abandon_on_cancel=True)

    def progress(self) -> Progress:
        """Returns how much is stored."""
        timeline = self.memory.snapshot().timeline
        if self.filling is None:
            return Progress(timeline.closed)
        return self.filling.progress(timeline)

    def _with_store(self, work: Callable[[Filling, Timeline], T], otherwise: T) -> T:
        """Returns the result of `work`; `otherwise` without a store or a bag directory.

        A missing bag directory is more likely a missing disk than an empty one.
        """
        snapshot = self.memory.snapshot()
        if self.filling is None or snapshot.problem is not None:
            return otherwise
        return work(self.filling, snapshot.timeline)

    def waiting(self) -> list[BagFile]:
        """Returns the bags whose columns are to be stored, the newest first."""
        return self._with_store(Filling.waiting, [])

    def batches(self) -> list[Batch]:
        """Returns the bags to be stored, as `Filling.batches`."""
        return self._with_store(Filling.batches, [])

    def store(self, batch: Batch) -> int:
        """Stores the columns of a batch of bags; returns how many bags, as `Filling.fill`."""
        return self._with_store(lambda filling, timeline: filling.fill(batch, timeline), 0)

    def follow(self) -> bool:
        """Makes the fragments of whole parts, and keeps the store within its limits.

        Also makes a few outdated fragments again, the newest first: those that were made under
        other settings.

        Returns:
            Whether there are more outdated ones.
        """
        return self._with_store(self._follow, otherwise=False)

    def _follow(self, filling: Filling, timeline: Timeline) -> bool:
        scanner = self.memory.scanner
        coverage = scanner.coverage(timeline)
        waiting = [] if coverage is None else coverage.starts_to_store()
        make_fragments(self.memory, filling.whole_since(), waiting)
        filling.thin()
        filling.trim()
        if self._outdated is None:
            self._outdated = scanner.fragments_of_others()
        remade, self._outdated = (
            self._outdated[:_REMADE_AT_ONCE],
            self._outdated[_REMADE_AT_ONCE:],
        )
        windows = [TimeWindow(start, start + PART_NS) for start in remade]
        make_fragments(self.memory, windows, [*waiting, *self._outdated])
        return bool(self._outdated)

    def look_after(self, *, thorough: bool = False) -> None:
        """Returns the store to its file, unless the bag directory itself is missing.

        Args:
            thorough: whether the whole file is read to check its integrity.
        """
        self._with_store(lambda filling, _: filling.store.look_after(thorough=thorough), None)

    def precompute(self) -> None:
        """Answers before a client asks which topics are recorded, and which cannot be decoded.

        This also counts the messages that overlapping recordings share, and remembers the result.
        """
        with suppress(EpisodicError):
            rows = list_recorded_topics(self.memory, Call())
            self.undecodable = {row.topic: row.undecodable for row in rows if row.undecodable}

    def has_many_gone(self) -> bool:
        """Returns whether many of the stored bags were deleted since the last `prune`."""
        gone, stored = self._with_store(Filling.count_gone, (0, 0))
        self._gone_after_prune = min(self._gone_after_prune, gone)
        return gone - self._gone_after_prune > _MOST_GONE * stored

    def prune(self) -> None:
        """Removes the columns of deleted files, and stores what each metadata.yaml lists now.

        Does nothing if there are no bags: their disk is missing more likely.
        """
        self._with_store(self._prune, None)

    def _prune(self, filling: Filling, timeline: Timeline) -> None:
        if timeline.bags:
            filling.prune(timeline)
            self._gone_after_prune, _ = filling.count_gone(timeline)
            self.memory.store_listings(self.memory.snapshot())


def make_fragments(
    memory: Memory, windows: Sequence[TimeWindow], waiting: Sequence[Ns] = ()
) -> None:
    """Makes the fragments of some windows, and stores them.

    They are joined by stretches of the clock, but for the stretches that still wait for bags.

    Args:
        memory: the memory.
        windows: of whole parts.
        waiting: the log times (ns) at which bags or slices begin that are not stored yet.
    """
    # Long windows in pieces, so that few fragments wait to be written; the newest first.
    pieces = [
        TimeWindow(max(window.start, stop - STRETCH_NS), stop)
        for window in windows
        for stop in range(window.stop, window.start, -STRETCH_NS)
    ]
    _make_in_each(memory, pieces, is_joined=False)
    # Their fragments are written by now, and can be read: not all are still in memory.
    _make_in_each(memory, _stretches_around(windows, waiting), is_joined=True)


def _make_in_each(memory: Memory, windows: Sequence[TimeWindow], *, is_joined: bool) -> None:
    """Makes and writes the fragments of each window; logs why some cannot be made."""
    unwritten: Ns = 0
    for window in windows:
        try:
            _make_fragments_in(memory, window, is_joined=is_joined)
        except EpisodicError as error:
            log.warning("fragments_not_made", reason=str(error))
        # Several at once: after a write all bags are looked up again.
        unwritten += window.stop - window.start
        if unwritten >= STRETCH_NS:
            memory.scanner.write_fragments()
            unwritten = 0
        memory.large.release()
    memory.scanner.write_fragments()


def _stretches_around(windows: Sequence[TimeWindow], waiting: Sequence[Ns]) -> Sequence[TimeWindow]:
    """Returns the stretches of the clock that windows touch and nothing waits for, newest first.

    Each is widened by a part: joining needs the parts that reach into the stretch, too.
    """
    numbers: set[int] = set()
    for window in windows:
        around = window.widened(PART_NS)
        numbers.update(range(around.start // STRETCH_NS, around.stop // STRETCH_NS + 1))
    numbers -= {start // STRETCH_NS for start in waiting}
    return [
        TimeWindow(number * STRETCH_NS, (number + 1) * STRETCH_NS).widened(PART_NS)
        for number in sorted(numbers, reverse=True)
    ]


def _make_fragments_in(memory: Memory, window: TimeWindow, *, is_joined: bool) -> None:
    """Makes the fragments of a window: of its parts, or those of a stretch that `is_joined`.

    Raises:
        EpisodicError: they cannot be made.
    """
    view = View(memory, Call(stored=True))
    deque(view.sessions.static_back(window), maxlen=0)
    for topic in (*view.static_topics, *view.moving_topics):
        deque(view.sessions.pairs_back(topic, window=window), maxlen=0)
    fragments = [
        make_drive_slices(view, window),
        make_tracks(view, window),
        make_events(view, window, topics_with_changes(view)),
        SightReader(view).make_sights(window, is_joined=is_joined),
    ]
    if not is_joined:
        fragments.append(memory.scanner.outlines_made(view.timeline, window))
    # All go back in time together, so that what one reads is still in memory for the others.
    deque(merge(*fragments, reverse=True), maxlen=0)


async def keep_backfilled(backfill: Backfill, every_s: float) -> None:
    """Stores closed bags every `every_s` seconds, until it is cancelled."""
    while True:
        await backfill.fill()
        await anyio.sleep(every_s)


async def keep_all_backfilled(backfills: Callable[[], Sequence[Backfill]], every_s: float) -> None:
    """Fills several stores, one after the other, until it is cancelled.

    A memory whose bags were not scanned lately is skipped: its disk may hang.
    """
    while True:
        for backfill in backfills():
            memory = backfill.memory
            published = memory.index.published
            if published is None or published.problem is not None:
                continue
            if memory.clock.now() - published.scanned_at > ns_from_unix(_LATELY * every_s):
                continue
            with anyio.move_on_after(LONGEST_TURN_S):
                await backfill.fill()
        await anyio.sleep(every_s)


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
