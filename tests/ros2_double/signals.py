"""What the real recorder does with SIGINT and SIGTERM.

Until it has a directory they kill it. Then the first of them ends the recording, and those after it
change nothing until the files are complete. A SIGINT that was ignored when the process began stays
ignored until then, and no longer.
"""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType


class Signals:
    """The signals that came since `take_over`."""

    def __init__(self) -> None:
        self.received: list[int] = []
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_DFL)

    def take_over(self) -> None:
        """From here on signals are noted."""
        signal.signal(signal.SIGTERM, self._note)
        signal.signal(signal.SIGINT, self._note)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.received.append(signum)
