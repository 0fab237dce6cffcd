"""The port for recording and its null adapter, and what a recorder asks of its housekeeper.

The docstrings of `Recorder` are the contract; one test suite checks every adapter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from ros2_memory.bag_dir.state_files import Interruption
    from ros2_memory.core.timebase import Ns


class Recorder(ABC):
    """Records the robot's topics into the bag directory until it is stopped.

    A recorder is driven from one thread: the one that starts it also ticks and stops it. Other
    programs read what it does from the heartbeat file (see `bag_dir.heartbeat`).
    """

    @abstractmethod
    def check(self) -> None:
        """Checks that recording can begin. Touches no bag and starts no recording.

        Raises:
            ConfigError: the configuration of what is recorded is refused.
            RecorderError: nothing on this machine can record.
        """

    @abstractmethod
    def start(self) -> None:
        """Begins to record, and returns without waiting for the first message.

        From then on `tick` must be called several times a second. Starting a recorder that is
        running changes nothing. After `stop` it may be started again, into a new recording.

        Raises:
            ConfigError: the configuration of what is recorded is refused.
            RecorderError: recording cannot begin; nothing is left running.
        """

    @abstractmethod
    def tick(self) -> None:
        """Does what is due at this moment. Does not wait, and raises nothing."""

    @abstractmethod
    def stop(self) -> None:
        """Ends recording within a bounded time, and closes what can be closed.

        When it returns, nothing of this recorder runs and `is_running` is False. Stopping a
        recorder that does not run does nothing, so it is safe in every clean-up. Raises nothing
        for a child process that ended badly: the next start repairs what it left.
        """

    @abstractmethod
    def is_running(self) -> bool:
        """Whether topics are being recorded at this moment. Cheap, and raises nothing."""


class NullRecorder(Recorder):
    """Records nothing and touches no file: `recorder=none`, for bags that come from elsewhere."""

    def check(self) -> None:
        """Does nothing."""

    def start(self) -> None:
        """Does nothing; `is_running` remains False."""

    def tick(self) -> None:
        """Does nothing."""

    def stop(self) -> None:
        """Does nothing."""

    def is_running(self) -> bool:
        """Always False."""
        return False


class HouseStatus(NamedTuple):
    """What the heartbeat shows of a housekeeper's work, under the same names.

    Attributes:
        age_held: describes the bags that are kept although their dates make them too old, or None.
        unshipped: describes the bags that were deleted before they were shipped, as they had to be,
            or None.
        counted_bytes: the bytes that the budget counts; None before the first pass.
        state_bytes: those of them that are no recording.
        held_back: describes the splits that are not served for a fault, or None.
        failing_rules: each rule of `recording.exclude_when` that cannot be evaluated.
    """

    age_held: str | None = None
    unshipped: str | None = None
    counted_bytes: int | None = None
    state_bytes: int = 0
    held_back: str | None = None
    failing_rules: tuple[str, ...] = ()


class Housekeeper:
    """Repairs what crashes left and deletes what exceeds the limits. This base class does nothing.

    The recorder calls it between two ticks, so a call should return at once; the work may
    continue in the background.
    """

    def prepare(self) -> None:
        """Notes what a crash cut short. Called once, before anything is recorded.

        Raises:
            EpisodicError: that cannot be noted.
            OSError: the bag directory cannot be read.
        """

    def make_room(self, free_bytes_wanted: int) -> None:
        """Deletes the oldest bags beyond the budget's needs until so much of the disk is free."""

    def is_making_room(self) -> bool:
        """Whether an earlier `make_room` is still under way."""
        return False

    def apply(self) -> None:
        """Deletes what exceeds the budget or the maximum age."""

    def keep_moments(self) -> None:
        """Saves the moments that were asked for. Called about once a second."""

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        """Counts recorded time, by which recordings age where the wall clock is wrong.

        Called several times a second, with no recordings while nothing is recorded.

        Args:
            recordings: the directories being written, relative to the bag directory.
            bytes_written: the bytes that all recordings wrote since the recorder started.
            monotonic_s: the monotonic clock, in seconds.
        """

    def note_restart(self, first: Ns, how: Interruption) -> None:
        """Records that a recording ended unexpectedly, or was paused until now.

        It last grew at the wall time `first`; `how` is a key of `INTERRUPTIONS`.
        """

    def announce(self, recording: str) -> None:
        """Records that a recording is about to start; no file of it exists yet.

        Raises:
            RecorderError: it must not begin, since what is to be excluded of it could be served.
        """

    def screen(self, live: Collection[str]) -> None:
        """Cuts out of closed splits what is to be excluded, and releases them.

        Called about every two seconds, from the thread that begins recordings; `live` are those
        that are being written.
        """

    def finish(self) -> None:
        """Releases what can be, now that nothing is recorded any more. May take some seconds."""

    def status(self) -> HouseStatus:
        """Returns what the heartbeat shows. Cheap, and raises nothing."""
        return HouseStatus()

    def excluded_latched(self) -> frozenset[str]:
        """Returns the latched topics whose newest message is excluded whenever it is received."""
        return frozenset()

    def faults(self) -> Mapping[str, str]:
        """Maps each task that failed in the background, such as `apply`, to the reason."""
        return {}
