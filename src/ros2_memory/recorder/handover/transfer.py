"""Writes the sidecars (`handover.json`) of two recordings while one takes over from the other.

Each is written before it can matter: the old recording names the new one before that is started,
the new one is marked as not counting as soon as it exists, and the cut is written to the new one
first. So a crash leaves a pair of sidecars that `settle_handover` can complete.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.handover_file import (
    CutClock,
    handover_to_change,
    write_handover,
    write_handovers,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.handover.plan import complete_sidecars, intended, pending, void
from ros2_memory.recorder.handover.union import cut_clock

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.recorder.handover.plan import ClockReading, HandoverPlan, Step
    from ros2_memory.recorder.session import RecordingSession
    from ros2_memory.storage.base import BagReader


class HandoverTransfer:
    """A handover from one running session to another.

    Args:
        old: the session that records.
        new: the session that takes over.
        plan: decides when each step is due.
        reader: reads splits that are closed.
        simulated: whether log times come from a simulated clock.
        is_listed: whether the new session is to record a topic.
    """

    def __init__(
        self,
        old: RecordingSession,
        new: RecordingSession,
        plan: HandoverPlan,
        reader: BagReader,
        *,
        simulated: bool,
        is_listed: Callable[[str], bool],
    ) -> None:
        self._is_listed = is_listed
        self.old = old
        self.new = new
        self._plan = plan
        self._reader = reader
        self._simulated = simulated
        self._marked = False
        self._closed_before = old.splits.closed_names

    @staticmethod
    def announce(old: RecordingSession, new_name: str | None) -> None:
        """Writes the name of the new recording, which is about to be started, into the old sidecar.

        None in place of the name withdraws it, if the old directory still exists.

        Raises:
            RecorderError: it cannot be written.
        """
        directory = old.splits.directory
        if new_name is not None or _is_there(directory):
            write_handover(directory, intended(handover_to_change(directory), new_name))

    @property
    def directories(self) -> tuple[Path, Path]:
        """The old and the new recording."""
        return self.old.splits.directory, self.new.splits.directory

    @property
    def missing(self) -> frozenset[str]:
        """Topics that the old recorder has subscribed to, and the new one has still to."""
        return frozenset(filter(self._is_listed, self.old.subscribed - self.new.subscribed))

    def advance(self, now: ClockReading) -> Step:
        """Returns the step that is due at this moment.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if not self._marked and self.new.splits.exists:
            write_handover(self.new.splits.directory, pending(self.old.name))
            self._marked = True
        ready = self._marked and self.new.is_recording
        return self._plan.advance(now, ready=ready, missing=self.missing)

    def complete(self, now: ClockReading) -> bool:
        """Writes the cut if both recorders receive; returns False while they do not overlap.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        bounds = self._plan.bounds(now)
        if bounds is None:
            return False
        clock = self._clock()
        if self._simulated and clock is CutClock.LOG:
            # No time of the wall clock separates them: the old one counts up to its end.
            return True
        old, new = complete_sidecars(
            handover_to_change(self.old.splits.directory),
            self.old.name,
            self.new.name,
            bounds,
            old_files=self._old_files(),
            new_files=self.new.splits.names(),
            simulated=self._simulated,
            clock=clock,
        )
        write_handovers({self.new.splits.directory: new, self.old.splits.directory: old})
        return True

    def abandon(self) -> None:
        """Marks the new recording as not counting: the old one continues.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if _is_there(self.new.splits.directory):
            write_handover(self.new.splits.directory, void(self.old.name))
        self.announce(self.old, None)

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

    def _clock(self) -> CutClock:
        closed = sorted(self.old.splits.closed_names)
        if not closed:
            return CutClock.PUBLISH
        return cut_clock(self.old.splits.directory / closed[-1], self._reader)


def _is_there(recording: Path) -> bool:
    """Whether the directory of a recording exists.

    Raises:
        RecorderError: it cannot be looked at.
    """
    try:
        return recording.is_dir()
    except OSError as error:
        raise RecorderError(f"{recording}: {error.strerror or error}") from error
