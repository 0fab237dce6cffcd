"""Runs slow jobs beside the recorder's loop: the disk may take seconds for one call."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

PATIENCE_S: Final = 8.0
"""How long a recorder that stops waits for jobs; the service manager allows 40 s."""

_log = get_logger(__name__)


class Background:
    """Runs jobs in threads, the jobs of one task in order, one after the other."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[str, deque[Callable[[], object]]] = {}
        self._faults: dict[str, str] = {}

    def add(self, task: str, job: Callable[[], object]) -> None:
        """Adds a job to a task; starts the task's thread if none runs."""
        with self._changed:
            if task in self._jobs:
                self._jobs[task].append(job)
                return
            self._jobs[task] = deque([job])
        threading.Thread(target=self._work, args=(task,), name=task, daemon=True).start()

    def is_under_way(self, task: str) -> bool:
        """Whether a job of a task has not ended."""
        return task in self._jobs

    def run(self, task: str, job: Callable[[], object]) -> None:
        """Runs a job in this thread, and remembers why it failed. Raises nothing."""
        try:
            job()
        except (EpisodicError, OSError) as error:
            self.note_failure(task, str(error))
        except Exception as error:  # noqa: BLE001 - or the thread would end silently
            _log.exception("housekeeping_faulty", task=task)
            self.note_failure(
                task, f"a fault in this program ({type(error).__name__}); see its log"
            )
        else:
            self._faults.pop(task, None)

    def note_failure(self, task: str, reason: str) -> None:
        """Remembers why the newest job of a task failed."""
        self._faults[task] = reason

    def faults(self) -> Mapping[str, str]:
        """Returns the reason for each task whose newest job failed."""
        return dict(self._faults)

    def wait(self, patience_s: float | None = PATIENCE_S) -> None:
        """Waits until all jobs have ended, for at most `patience_s`; None waits for ever."""
        with self._changed:
            self._changed.wait_for(lambda: not self._jobs, patience_s)

    def _work(self, task: str) -> None:
        jobs = self._jobs[task]
        while jobs:
            self.run(task, jobs[0])
            with self._changed:
                jobs.popleft()
                if not jobs:
                    del self._jobs[task]
                    self._changed.notify_all()
