"""Has the housekeeper do what is due; recording goes on, whatever comes of it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import EpisodicError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.ports import Housekeeper

HOUSE_S: Final = 10.0
QUIET_HOUSE_S: Final = 60.0
"""How often the house is kept when no split is closed: what is there grows old all the same."""


class Chores:
    """Asks a housekeeper, and reports once what fails for as long as it does.

    Attributes:
        splits_closed: whether splits were closed since the house was kept.
    """

    def __init__(
        self, bag_dir: Path, housekeeper: Housekeeper, journal: EventLog, now_s: float
    ) -> None:
        self._bag_dir = bag_dir
        self._housekeeper = housekeeper
        self._journal = journal
        self._house_kept_s = now_s
        self.splits_closed = False

    def make_room(self, free_bytes_wanted: int) -> None:
        """Has more deleted than the budget asks, until so much of the disk is free."""
        self._do(
            "make_room", partial(self._housekeeper.make_room, self._bag_dir, free_bytes_wanted)
        )

    def making_room(self) -> bool:
        """Whether room that was asked for is still being made."""
        return self._housekeeper.making_room()

    def keep_house(self, now_s: float) -> None:
        """Has deleted what is beyond the limits, where it is time for that."""
        every_s = HOUSE_S if self.splits_closed else QUIET_HOUSE_S
        if now_s - self._house_kept_s < every_s:
            return
        self._house_kept_s = now_s
        self.splits_closed = False
        self._do("apply", partial(self._housekeeper.apply, self._bag_dir))

    def keep_moments(self) -> None:
        """Has kept what somebody asks to keep."""
        self._do("keep_moments", partial(self._housekeeper.keep_moments, self._bag_dir))

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        """Has counted the time for which recordings are written."""
        self._housekeeper.note_recorded(recordings, bytes_written, monotonic_s)

    def tell(self) -> None:
        """Reports what could not be done where nobody waited for it."""
        for task, sentence in self._housekeeper.faults().items():
            self._journal.fail_once("housekeeping_failed", task, sentence, task=task)

    def _do(self, task: str, do: Callable[[], None]) -> None:
        try:
            do()
        except (EpisodicError, OSError) as error:
            self._journal.fail_once("housekeeping_failed", task, str(error), task=task)
        else:
            if task not in self._housekeeper.faults():
                self._journal.over("housekeeping_failed", task)
