"""What the real recorder does with SIGINT and SIGTERM.

Until it has a directory they kill it. Then the first of them ends the recording; those after it
wait until the files are complete, and then SIGINT kills it. A SIGINT that was ignored when the
process began stays ignored.
"""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType


class Signals:
    """The signals that came since `take_over`."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self._ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        if not self._ignored:
            signal.signal(signal.SIGINT, signal.SIG_DFL)

    def take_over(self) -> None:
        """From here on signals are noted."""
        signal.signal(signal.SIGTERM, self._note)
        if not self._ignored:
            signal.signal(signal.SIGINT, self._note)

    def give_in(self) -> None:
        """Dies by SIGINT where more than one signal came."""
        if len(self.received) > 1:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGINT)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.received.append(signum)
