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
from ros2_memory.core.model import BagFile, BagState, TimeWindow
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
"""A child process stores more bags than these, so that answers stay fast."""
_MERGED_HERE: Final = 100
"""And if it is more with those that are stored again with others: an hour of short splits is."""
_BACKLOG_ALONE: Final = 256
"""Bags of a lake that are stored in a round: no child process knows them."""
PRUNE_INTERVAL_S: Final = 600.0
"""How often what is stored of deleted files is removed, and the file of the store is checked."""
_MOST_GONE: Final = 1 / 64
"""Share of the stored bags; where more are gone, what is stored of them is removed at once."""

LONGEST_TURN_S: Final = 600.0
"""How long one of several stores is filled before it is the next one's turn."""
_AGAIN: Final = 4
"""Slices of the clock of which what follows is made again in a round."""
_LATELY: Final = 4
"""Intervals between scans after which bags count as out of reach."""


@dataclass
class Backfill:
    """Stores the bags of one memory. Only `progress` may be called from several threads.

    Attributes:
        helper: the command line of the program that stores a backlog (`ros2-memory index`);
            without it that is stored here.
        undecodable: by topic, why its messages cannot be decoded, as `precompute` last found.
    """

    memory: Memory
    filling: Filling | None
    helper: Sequence[str] = ()
    undecodable: dict[str, str] = field(default_factory=dict)
    _of_others: list[Ns] | None = None
    _pruned_s: float = -math.inf
    _left: int = 0
    _is_precomputed: bool = False

    async def fill(self) -> None:
        """Stores the closed bags that there are. Raises nothing but cancellation."""
        try:
            await self._fill_round()
        except Exception:
            log.exception("filling_failed")

    async def _fill_round(self) -> None:
        due, in_thread = time.monotonic() - self._pruned_s > PRUNE_INTERVAL_S, self._in_thread
        await in_thread(partial(self.look_after, thorough=due))
        waiting, batches = await in_thread(self.waiting), await in_thread(self.batches)
        store = None if self.filling is None else self.filling.store
        # A store that is in memory cannot be filled by another process.
        has_file = store is not None and store.path is not None
        is_much = len(waiting) > BACKLOG or sum(len(batch.bags) for batch in batches) > _MERGED_HERE
        if self.helper and is_much and has_file and await _run_helper(self.helper):
            # Bags that the helper could not store are tried here, and refused if they fail.
            waiting, batches = await in_thread(self.waiting), await in_thread(self.batches)
        if not waiting and store is not None:
            await in_thread(store.write_again)  # whether the disk works again
        done = tried = 0
        for batch in batches:
            if tried >= (BACKLOG if self.helper else _BACKLOG_ALONE):
                break
            tried += len(batch.bags)
            done += await in_thread(partial(self.store, batch))
            if store is not None and store.is_failing:
                break
        await in_thread(self.follow)
        if (done or not self._is_precomputed) and len(waiting) <= BACKLOG:
            await in_thread(self.precompute)
            self._is_precomputed = True
        if due or await in_thread(self.has_many_gone):
            await in_thread(self.prune)
        if due:
            self._pruned_s = time.monotonic()

    async def _in_thread(self, work: Callable[[], T]) -> T:
        """Returns what `work` returns, in a thread that waits while others hold much of a bag."""

        def work_in_turn() -> T:
            with self.memory.large.during():
                return work()

        return await anyio.to_thread.run_sync(work_in_turn, abandon_on_cancel=True)

    def progress(self) -> Progress:
        """Returns how much is stored."""
        timeline = self.memory.index.snapshot().timeline
        if self.filling is None:
            return Progress(sum(bag.state is BagState.CLOSED for bag in timeline.bags))
        return self.filling.progress(timeline)

    def _filled(self, work: Callable[[Filling, Timeline], T], otherwise: T) -> T:
        """Returns what `work` does with the store and the bags, where there are both.

        A missing bag directory is more likely a missing disk than an empty one.
        """
        snapshot = self.memory.index.snapshot()
        if self.filling is None or snapshot.problem is not None:
            return otherwise
        return work(self.filling, snapshot.timeline)

    def waiting(self) -> list[BagFile]:
        """Returns the bags of which columns are to be stored, the newest first."""
        return self._filled(Filling.waiting, [])

    def batches(self) -> list[Batch]:
        """Returns the bags to be stored, as `Filling.batches`."""
        return self._filled(Filling.batches, [])

    def store(self, batch: Batch) -> int:
        """Stores the columns of a batch of bags; returns how many bags, as `Filling.fill`."""
        return self._filled(lambda filling, timeline: filling.fill(batch, timeline), 0)

    def follow(self) -> bool:
        """Makes what follows from whole parts, and keeps the store within what it may take.

        Then makes again, a few at a time, the newest first, what followed from parts under other
        settings.

        Returns:
            Whether there is more of that.
        """
        return self._filled(self._follow, otherwise=False)

    def _follow(self, filling: Filling, timeline: Timeline) -> bool:
        columns = self.memory.scanner
        coverage = columns.coverage(timeline)
        waiting = [] if coverage is None else coverage.starts_to_store()
        make_fragments(self.memory, filling.whole_since(), waiting)
        filling.thin()
        filling.trim()
        if self._of_others is None:
            self._of_others = columns.fragments_of_others()
        now, self._of_others = self._of_others[:_AGAIN], self._of_others[_AGAIN:]
        windows = [TimeWindow(start, start + PART_NS) for start in now]
        make_fragments(self.memory, windows, [*waiting, *self._of_others])
        return bool(self._of_others)

    def look_after(self, *, thorough: bool = False) -> None:
        """Returns the store to its file, unless the bag directory itself is missing.

        Args:
            thorough: whether the whole file is read to check its integrity.
        """
        self._filled(lambda filling, _: filling.store.look_after(thorough=thorough), None)

    def precompute(self) -> None:
        """Finds out what cannot be decoded, and counts what overlapping recordings hold together.

        Before a client asks.
        """
        with suppress(EpisodicError):
            rows = list_recorded_topics(self.memory, Call())
            self.undecodable = {row.topic: row.undecodable for row in rows if row.undecodable}

    def has_many_gone(self) -> bool:
        """Returns whether many of the stored bags were deleted since `prune`: it looks at all."""
        gone, stored = self._filled(Filling.count_gone, (0, 0))
        self._left = min(self._left, gone)
        return gone - self._left > _MOST_GONE * stored

    def prune(self) -> None:
        """Removes what is stored of deleted files; stores what each metadata.yaml lists now.

        Does nothing where there are no bags, for the same reason.
        """

        def of_deleted(filling: Filling, timeline: Timeline) -> None:
            if timeline.bags:
                filling.prune(timeline)
                # Some that are still there cannot be read, or have changed.
                self._left, _ = filling.count_gone(timeline)
                self.memory.store_listings(self.memory.index.snapshot())

        self._filled(of_deleted, None)


def make_fragments(
    memory: Memory, windows: Sequence[TimeWindow], waiting: Sequence[Ns] = ()
) -> None:
    """Makes what follows from the parts of some times; stores it, and what questions made of it.

    It is joined by stretches of the clock, but for those in which bags or slices are `waiting`: log
    times (ns) where they begin.
    """
    stretches = _stretches_around(windows, waiting)
    # The newest `STRETCH_NS` of a window, and so on: few fragments wait to be written.
    pieces = [
        TimeWindow(max(window.start, stop - STRETCH_NS), stop)
        for window in windows
        for stop in range(window.stop, window.start, -STRETCH_NS)
    ]
    _make_each(memory, pieces, is_joined=False)
    # What these are joined of is written by now: not all of it is still remembered.
    _make_each(memory, stretches, is_joined=True)


def _make_each(memory: Memory, windows: Sequence[TimeWindow], *, is_joined: bool) -> None:
    unwritten: Ns = 0
    for window in windows:
        try:
            _make_fragments_in(memory, window, is_joined=is_joined)
        except EpisodicError as error:
            log.warning("fragments_not_made", reason=str(error))
        # Of a store that has changed, all bags are looked up again: so several at once.
        unwritten += window.stop - window.start
        if unwritten >= STRETCH_NS:
            memory.scanner.write_fragments()
            unwritten = 0
        memory.large.release()
    memory.scanner.write_fragments()


def _stretches_around(windows: Sequence[TimeWindow], waiting: Sequence[Ns]) -> Sequence[TimeWindow]:
    """Returns the stretches that windows touch and in which nothing is waiting, the newest first.

    What is joined of a stretch needs all parts of it, and those that reach into it.
    """
    around = [window.widened(PART_NS) for window in windows]
    ends = {(window.start // STRETCH_NS, window.stop // STRETCH_NS) for window in around}
    touched = {number for first, last in ends for number in range(first, last + 1)}
    touched -= {start // STRETCH_NS for start in waiting}
    return [
        TimeWindow(number * STRETCH_NS, (number + 1) * STRETCH_NS).widened(PART_NS)
        for number in sorted(touched, reverse=True)
    ]


def _make_fragments_in(memory: Memory, window: TimeWindow, *, is_joined: bool) -> None:
    """Makes the fragments of a window; outlines where these are not joined of others.

    Raises:
        EpisodicError: they cannot be made.
    """
    view = View(memory, Call(stored=True))
    deque(view.sessions.static_back(window), maxlen=0)
    fragments = [
        make_drive_slices(view, window),
        make_tracks(view, window),
        make_events(view, window, topics_with_changes(view)),
        SightReader(view).make_sights(window, is_joined=is_joined),
    ]
    if not is_joined:
        fragments.append(memory.scanner.outlines_made(view.timeline, window))
    # Each goes back in time as far as the others: what they read is still remembered.
    deque(merge(*fragments, reverse=True), maxlen=0)


async def keep_backfilled(backfill: Backfill, every_s: float) -> None:
    """Stores closed bags every `every_s` seconds, until it is cancelled."""
    while True:
        await backfill.fill()
        await anyio.sleep(every_s)


async def keep_all_backfilled(backfills: Callable[[], Sequence[Backfill]], every_s: float) -> None:
    """Fills several stores, one after the other, until it is cancelled.

    A memory whose bags were not scanned lately is passed over: its disk may hang.
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
