"""What the tests of the supervisor share: a housekeeper for tests, and assertions."""

from __future__ import annotations

from collections.abc import Collection, MutableMapping
from typing import Any

from ros2_memory.recorder.base import Housekeeper
from tests.support.simulated_recorders import PERIOD, World


def events(logs: list[MutableMapping[str, Any]], name: str) -> list[MutableMapping[str, Any]]:
    return [each for each in logs if each["event"] == name]


def assert_each_counts_once(world: World) -> None:
    """Whatever stands in any bag counts exactly once, and nothing is missing in between."""
    stands, counts = world.published(counting=False), world.published(counting=True)
    assert set(counts) == set(stands)
    assert [moment for moment, times in counts.items() if times != 1] == []
    assert len(stands) == (max(stands) - min(stands)) // PERIOD + 1


class PlayedHousekeeper(Housekeeper):
    """Records what it is asked for, and frees what the test sets."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.world: World | None = None
        self.frees_to = 0
        self.making = False
        self.moments_kept = 0
        self.failed: dict[str, str] = {}
        self.recorded: list[tuple[tuple[str, ...], int, float]] = []
        self.held: str | None = None

    def make_room(self, free_bytes_wanted: int) -> None:
        self.asked.append(f"room {free_bytes_wanted}")
        if self.world is not None:
            self.world.free = max(self.world.free, self.frees_to)

    def is_making_room(self) -> bool:
        return self.making

    def apply(self) -> None:
        self.asked.append("apply")

    def keep_moments(self) -> None:
        self.moments_kept += 1

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        self.recorded.append((tuple(recordings), bytes_written, monotonic_s))

    def age_held(self) -> str | None:
        return self.held

    def faults(self) -> dict[str, str]:
        return self.failed
