"""One recording takes over from another: when each step is due, and the sidecars of both.

The new recorder is started beside the old one, and waits until it has subscribed to all topics of
the old one, but not for ever, since a publisher may be gone. Then both run for `BOTH_S`, since who
has subscribed receives nothing before the publishers discovered that. The cut lies in the middle of
those: messages published around it are in both recordings, so that a message in transit, or a clock
that is off by less than a second, loses and doubles nothing. A recorder that stalled meanwhile lost
what was published: `union` finds that in the other one.

Each sidecar (`handover.json`) is written before it can matter: the old recording names the new one
before that is started, the new one is marked as not counting as soon as it exists, and the cut is
written to the new one first. So a crash leaves a pair of sidecars that `union` can settle.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.handover_file import (
    LOG_CLOCK_NOTE,
    Counting,
    CutClock,
    Handover,
    Overlap,
    handover_to_change,
    write_handover,
    write_handovers,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.recorder.handover.union import cut_clock, intended
from ros2_memory.recorder.policies import ClockReading, set_back

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from ros2_memory.recorder.session import RecordingSession
    from ros2_memory.recorder.sessions import Orders

SUBSCRIBE_TIMEOUT_S: Final = 20.0
READY_TIMEOUT_S: Final = 120.0
"""A recorder that has not started to record after this time is given up."""
BOTH_S: Final = 5.0
"""Longer than the 3 s after which Fast DDS sends discovery again that was lost on the way."""
LATE_MESSAGES_NS: Final[Ns] = 30 * NS_PER_S
"""How long the old recorder may still receive messages after it was asked to end."""


class Step(Enum):
    """What a handover needs next."""

    WAIT = auto()
    COMPLETE = auto()
    # The new recorder does not begin, or the clock was set back: then no single cut separates the
    # messages published before it from those published after it.
    ABANDON = auto()


class Bounds(NamedTuple):
    """The times of a complete handover: both recorders received from `both` to `ended`."""

    began: Ns
    both: Ns
    cut: Ns
    ended: Ns


def pending(old_name: str) -> Handover:
    """Returns the new sidecar as soon as its directory exists: until the cut it does not count."""
    return Handover(state=Counting.PENDING, previous=old_name)


def complete_sidecars(
    old: Handover,
    old_name: str,
    new_name: str,
    bounds: Bounds,
    *,
    old_files: Collection[str],
    new_files: Collection[str],
    simulated: bool,
    clock: CutClock,
) -> tuple[Handover, Handover]:
    """Returns the sidecars of the old and of the new recording after a complete handover.

    The new one must be written first.

    Args:
        old: the present sidecar of the old recording.
        old_name: the old recording.
        new_name: the new recording.
        bounds: the times of the handover.
        old_files: the bag files of the old recording that were open at any time in it.
        new_files: the bag files of the new recording so far.
        simulated: whether log times are those of a simulated clock.
        clock: whether publish times differ from log times.
    """
    both, last = (None, None) if simulated else (bounds.both, bounds.ended + LATE_MESSAGES_NS)
    began, ended = (None, None) if simulated else (bounds.began, bounds.ended)
    notes = (LOG_CLOCK_NOTE,) if clock is CutClock.LOG else ()
    return (
        replace(
            old,
            clock=clock,
            next=new_name,
            counts_until=bounds.cut,
            end=Overlap(both, last, tuple(sorted(old_files))),
            notes=tuple(dict.fromkeys((*old.notes, *notes))),
        ),
        Handover(
            clock=clock,
            previous=old_name,
            counts_from=bounds.cut,
            begin=Overlap(began, ended, tuple(sorted(new_files))),
            notes=notes,
            compared=False,
        ),
    )


class HandoverTransfer:
    """A handover from one running session to another.

    Args:
        old: the session that records.
        new: the session that takes over.
        began: the time just before the new recorder was started.
        orders: what to record.
    """

    def __init__(
        self,
        old: RecordingSession,
        new: RecordingSession,
        began: ClockReading,
        orders: Orders,
    ) -> None:
        self._orders = orders
        self.old = old
        self.new = new
        self._began = self._last = began
        # Since when both record.
        self._both_since: ClockReading | None = None
        self._marked = False
        self._closed_before = old.splits.closed_names

    @staticmethod
    def announce(old: RecordingSession, new_name: str) -> None:
        """Writes the name of the new recording, which is about to be started, into the old sidecar.

        Raises:
            RecorderError: it cannot be written, or the one before that was given up is not settled.
        """
        directory = old.splits.directory
        before = handover_to_change(directory)
        if before.next is not None:
            raise RecorderError(f"{directory}: its handover to {before.next} is not settled yet")
        write_handover(directory, intended(before, new_name))

    @property
    def directories(self) -> tuple[Path, Path]:
        """The old and the new recording."""
        return self.old.splits.directory, self.new.splits.directory

    @property
    def missing(self) -> frozenset[str]:
        """Topics that the old recorder has subscribed to, and the new one has still to."""
        is_listed = self._orders.topics.selection.matches
        return frozenset(filter(is_listed, self.old.subscribed - self.new.subscribed))

    def advance(self, now: ClockReading) -> Step:
        """Returns the step that is due. Must be called several times a second.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if not self._marked and self.new.splits.exists:
            write_handover(self.new.splits.directory, pending(self.old.name))
            self._marked = True
        before, self._last = self._last, now
        if set_back(before, now):
            return Step.ABANDON
        is_ready = self._marked and self.new.is_recording
        age_s = now.monotonic_s - self._began.monotonic_s
        if self.missing and age_s < self._orders.subscribe_timeout_s:
            # Also if a publisher appears while both run: what it sends before the new recorder has
            # subscribed is in the old recording alone, and must not lie after the cut.
            self._both_since = None
        elif self._both_since is None and is_ready:
            self._both_since = now
        if self._both_since is None:
            return Step.WAIT if is_ready or age_s < READY_TIMEOUT_S else Step.ABANDON
        is_over = now.monotonic_s - self._both_since.monotonic_s >= BOTH_S
        return Step.COMPLETE if is_over else Step.WAIT

    def complete(self, now: ClockReading) -> bool:
        """Writes the cut if both recorders receive; returns False while they do not overlap.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if self._both_since is None:
            return False
        both, clock = self._both_since.wall, self._clock_of_cut()
        if self._orders.simulated and clock is CutClock.LOG:
            # No time of the wall clock separates them: the old one counts up to its end.
            return True
        old, new = complete_sidecars(
            handover_to_change(self.old.splits.directory),
            self.old.name,
            self.new.name,
            Bounds(self._began.wall, both, (both + now.wall) // 2, now.wall),
            old_files=self._old_files(),
            new_files=self.new.splits.names(),
            simulated=self._orders.simulated,
            clock=clock,
        )
        write_handovers({self.new.splits.directory: new, self.old.splits.directory: old})
        return True

    def add_late_splits(self) -> None:
        """Adds the splits that the old recorder opened after the cut, while it was ending.

        Raises:
            RecorderError: the sidecar cannot be written.
        """
        directory = self.old.splits.directory
        handover = handover_to_change(directory)
        if handover.end is not None:
            files = tuple(sorted(self._old_files() | frozenset(handover.end.files)))
            write_handover(directory, replace(handover, end=replace(handover.end, files=files)))

    def _old_files(self) -> frozenset[str]:
        return self.old.splits.names() - self._closed_before

    def _clock_of_cut(self) -> CutClock:
        closed = sorted(self.old.splits.closed_names)
        if not closed:
            return CutClock.PUBLISH
        return cut_clock(self.old.splits.directory / closed[-1], self._orders.reader)
