"""The port for recording, and its null adapter.

The docstrings of `Recorder` are the contract; one test suite checks every adapter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod


class Recorder(ABC):
    """Records the robot's topics into the bag directory until it is stopped.

    One thread starts, ticks and stops it. Other programs read its state from the heartbeat file
    (see `bag_dir.heartbeat`).
    """

    @abstractmethod
    def check(self) -> None:
        """Checks that recording can begin. Touches no bag and starts no recording.

        Raises:
            ConfigError: the list of topics is refused.
            RecorderError: nothing on this machine can record.
        """

    @abstractmethod
    def start(self) -> None:
        """Begins to record, and returns without waiting for the first message.

        From then on `tick` must be called several times a second. Starting a recorder that is
        running changes nothing. After `stop` it may be started again, into a new recording.

        Raises:
            ConfigError: the list of topics is refused.
            RecorderError: recording cannot begin; nothing is left running.
        """

    @abstractmethod
    def tick(self) -> None:
        """Runs the tasks that are due. Does not wait, and raises nothing."""

    @abstractmethod
    def stop(self) -> None:
        """Ends recording within a bounded time, and closes the files that can be closed.

        When it returns, no process of this recorder runs and `is_running` is False. Stopping a
        recorder that does not run does nothing, so it is safe in every clean-up. Raises nothing
        for a child process that ended badly: the next start repairs its files.
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
