"""Plans how one recording takes over from another: when each step is due, and the sidecars. Pure.

The new recorder is started beside the old one, and waits until it has subscribed to all topics of
the old one, but not for ever, since a publisher may be gone. Then both run for `BOTH_S`, since who
has subscribed receives nothing before the publishers discovered that. The cut lies in the middle of
those: messages published around it are in both recordings, so that a message in transit, or a clock
that is off by less than a second, loses and doubles nothing. A recorder that stalled meanwhile lost
what was published: `union` finds that in the other one.
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
)
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Collection

SUBSCRIBE_TIMEOUT_S: Final = 20.0
READY_TIMEOUT_S: Final = 120.0
"""A recorder that has not started to record after this time is given up."""
BOTH_S: Final = 5.0
"""Longer than the 3 s after which Fast DDS sends discovery again that was lost on the way."""
STEP_NS: Final[Ns] = 100 * NS_PER_MS
"""A clock that falls behind by so much at once was set back; a slewed one falls behind slowly."""

LATE_MESSAGES_NS: Final[Ns] = 30 * NS_PER_S
"""How long the old recorder may still receive messages after it was asked to end."""


class ClockReading(NamedTuple):
    """Both clocks, read at the same time: seconds that never step, and the wall clock."""

    monotonic_s: float
    wall: Ns


def set_back(earlier: ClockReading, later: ClockReading, by_ns: Ns = STEP_NS) -> bool:
    """Whether the wall clock was set back by more than `by_ns` between two readings close together.

    A clock that is set forward does no harm: messages published before and after the step are still
    on either side of one cut.
    """
    passed = round((later.monotonic_s - earlier.monotonic_s) * NS_PER_S)
    return passed - (later.wall - earlier.wall) > by_ns


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


class HandoverPlan:
    """A handover under way, since just before the new recorder was started."""

    def __init__(
        self,
        began: ClockReading,
        *,
        subscribe_timeout_s: float = SUBSCRIBE_TIMEOUT_S,
    ) -> None:
        self.began = began
        self._timeout_s = subscribe_timeout_s
        self._both: ClockReading | None = None
        self._last = began

    def advance(self, now: ClockReading, *, ready: bool, missing: Collection[str]) -> Step:
        """Returns the step that is due. Must be called several times a second.

        Args:
            now: the present time.
            ready: whether the new recorder records, into a directory that exists.
            missing: the topics that the old one has subscribed to and the new one has not.
        """
        before, self._last = self._last, now
        if set_back(before, now):
            return Step.ABANDON
        age_s = now.monotonic_s - self.began.monotonic_s
        if missing and age_s < self._timeout_s:
            # Also if a publisher appears while both run: what it sends before the new recorder has
            # subscribed is in the old recording alone, and must not lie after the cut.
            self._both = None
        elif self._both is None and ready:
            self._both = now
        if self._both is None:
            return Step.WAIT if ready or age_s < READY_TIMEOUT_S else Step.ABANDON
        over = now.monotonic_s - self._both.monotonic_s >= BOTH_S
        return Step.COMPLETE if over else Step.WAIT

    def bounds(self, now: ClockReading) -> Bounds | None:
        """Returns the times of a handover completed now; None while the two do not overlap."""
        if self._both is None:
            return None
        middle = (self._both.wall + now.wall) // 2
        return Bounds(self.began.wall, self._both.wall, middle, now.wall)


def intended(old: Handover, new_name: str | None) -> Handover:
    """Returns the old sidecar before the new recording is started, as a crash may come any time.

    None in place of its name withdraws it: the new recording did not take over.
    """
    return replace(old, next=new_name, counts_until=None, end=None)


def pending(old_name: str) -> Handover:
    """Returns the new sidecar as soon as its directory exists: until the cut it does not count."""
    return Handover(state=Counting.PENDING, previous=old_name)


def void(old_name: str) -> Handover:
    """Returns the sidecar of a new recording that did not take over: the old one went on."""
    return Handover(state=Counting.VOID, previous=old_name, compared=False)


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
