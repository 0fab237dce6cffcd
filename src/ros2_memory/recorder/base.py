"""The port for recording. The docstrings are the contract; one suite holds every adapter."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Recorder(ABC):
    """Records the robot's topics into the bag directory until it is stopped.

    A recorder is driven from one thread: the one that starts it also stops it. What it is doing
    meanwhile stands in the heartbeat file (see `heartbeat`), for whoever else wants to know.
    """

    @abstractmethod
    def start(self) -> None:
        """Begins to record, and returns without waiting for the first message.

        A recorder that is running goes on as it is: a second `start` changes nothing. After `stop`
        it may be started again, and goes on in a new recording.

        Raises:
            RecorderError: recording cannot begin; nothing is left running.
        """

    @abstractmethod
    def stop(self) -> None:
        """Ends recording within a bounded time, and closes what can be closed.

        When it returns nothing of this recorder runs any more, and `is_running` is False. Stopping
        what does not run does nothing, so it is safe in every clean-up. Raises nothing for a child
        process that ended badly: what it left behind is repaired at the next start.
        """

    @abstractmethod
    def is_running(self) -> bool:
        """Whether topics are being recorded at this moment. Cheap, and raises nothing."""
