"""The planner's latest questions with their answers, in memory only, for the page.

Off by default; `server.keep_questions` sets how many are stored.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Final

from ros2_memory.core.text import abbreviate, shortened
from ros2_memory.core.timebase import Ns, ns_from_unix

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ros2_memory.core.telemetry import Answered

LONGEST_ANSWER: Final = 2_000
LONGEST_QUESTION: Final = 500


@dataclass(frozen=True, slots=True)
class KeptQuestion:
    """A tool call: when it came (wall clock), what was asked, and the begin of its reply."""

    asked: Ns
    tool: str
    arguments: str
    outcome: str
    duration_s: float
    answer: str


class QuestionLog:
    """Keeps the latest questions, `most` at most; none where that is 0. Thread-safe."""

    def __init__(self, most: int, wall: Callable[[], Ns] = time.time_ns) -> None:
        self._wall = wall
        self._kept: deque[KeptQuestion] = deque(maxlen=most)
        self._lock = Lock()
        self.is_on = most > 0
        self.count = 0

    def add(self, name: str, arguments: Mapping[str, object], done: Answered, answer: str) -> None:
        """Adds a call that is over, and drops the oldest one too many. Long texts are cut."""
        asked = self._wall() - ns_from_unix(done.duration_s)
        given = abbreviate(arguments, LONGEST_QUESTION)
        cut = shortened(answer, LONGEST_ANSWER)
        tool = name if done.tool == name else abbreviate(name)
        with self._lock:
            self.count += 1
            self._kept.append(KeptQuestion(asked, tool, given, done.outcome, done.duration_s, cut))

    def newest(self, most: int) -> tuple[KeptQuestion, ...]:
        """Returns the latest questions, the newest first."""
        with self._lock:
            return tuple(reversed(self._kept))[:most]
