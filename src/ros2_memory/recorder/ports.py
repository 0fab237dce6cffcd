"""What the recorder asks of others: a process that records, and someone who keeps order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path


class RecorderProcess(Protocol):
    """A running `ros2 bag record`, as `child.Child` is."""

    @property
    def pid(self) -> int:
        """Its process number."""

    def take_lines(self) -> list[str]:
        """What it printed since the last call, oldest first."""

    def exit_status(self) -> int | None:
        """None while it runs; then its exit code, or minus the number of the signal it died by."""

    def end(self) -> int | None:
        """Has it end, without waiting: to be called again until there is an exit status."""

    @property
    def patience_s(self) -> float:
        """For how long `end` is worth calling; after that nothing ends it."""


class Housekeeper(Protocol):
    """Repairs what a crash left, and deletes what the limits do not allow to keep.

    It is asked between two looks at the running recorder, so it should return at once, and may go
    on in the background. What it raises from the error tree is reported and stops nothing.
    """

    def repair(self, bag_dir: Path) -> None:
        """Puts right what a crash left. Called once, before anything is recorded."""

    def make_room(self, bag_dir: Path, free_bytes_wanted: int) -> None:
        """Deletes more than the budget asks, oldest first, until so much of the disk is free.

        Where that cannot be reached it deletes what it may.
        """

    def making_room(self) -> bool:
        """Whether room that was asked for is still being made."""

    def apply(self, bag_dir: Path) -> None:
        """Deletes what is beyond the budget or too old. Called when splits have been closed."""

    def keep_moments(self, bag_dir: Path) -> None:
        """Keeps from deletion what somebody asks to keep. Called about once a second."""

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        """Counts the time for which recordings are written: their age where clocks are wrong.

        Called some times a second, with none while nothing is recorded.

        Args:
            recordings: the directories being written, relative to the bag directory.
            bytes_written: how much all recordings wrote since the recorder started.
            monotonic_s: the monotonic clock, in seconds.
        """

    def age_held(self) -> str | None:
        """Which bags are too old by their dates and stay, and why; None where there are none."""

    def faults(self) -> Mapping[str, str]:
        """By task, such as `apply`, why it failed the last time, where it went on unseen."""


class NoHousekeeping:
    """Repairs and deletes nothing."""

    def repair(self, bag_dir: Path) -> None:
        """Does nothing."""

    def make_room(self, bag_dir: Path, free_bytes_wanted: int) -> None:
        """Does nothing."""

    def making_room(self) -> bool:
        """Never."""
        return False

    def apply(self, bag_dir: Path) -> None:
        """Does nothing."""

    def keep_moments(self, bag_dir: Path) -> None:
        """Does nothing."""

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        """Does nothing."""

    def age_held(self) -> str | None:
        """None."""
        return None

    def faults(self) -> Mapping[str, str]:
        """None."""
        return {}
