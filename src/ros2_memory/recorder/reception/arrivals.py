"""Which topics have stopped, and how often the others come, by what closed splits have of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.recorder.reception.measure import Arrival, SplitMeasure

MEASURED_NS: Final[Ns] = 30 * NS_PER_S
"""Rates are those of the newest data of this length; a topic is regular after as long."""
SILENT_PERIODS: Final = 10
LEAST_SILENCE_NS: Final[Ns] = 10 * NS_PER_S
"""Shorter pauses are no silence, however often a topic comes: splits show no more."""
IRREGULAR_NS: Final[Ns] = 3600 * NS_PER_S
"""After a silence a topic does not count as regular for so long."""
_FEWEST: Final = 20
"""Messages that make a topic regular."""
_SET_BACK_NS: Final[Ns] = 60 * NS_PER_S
"""A newer split that ends so much earlier was recorded after the clock was set back."""


@dataclass(slots=True)
class _Topic:
    arrival: Arrival
    paused: Ns | None = None
    """When its last silence ended."""

    @property
    def patience(self) -> Ns:
        return max(LEAST_SILENCE_NS, SILENT_PERIODS * self.arrival.period)

    def is_regular(self, now: Ns) -> bool:
        arrival = self.arrival
        if arrival.messages < _FEWEST or arrival.last - arrival.first < MEASURED_NS:
            return False
        return self.paused is None or now - self.paused > IRREGULAR_NS


class Arrivals:
    """How the topics of closed splits came; times are log times, in ns."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._splits: list[SplitMeasure] = []
        self._newest: Ns = 0
        self._silent = set[str]()

    def measured(self, split: SplitMeasure) -> None:
        """Takes the next closed split."""
        if split.span is None:
            return
        end = split.span[1]
        self._newest = end if end < self._newest - _SET_BACK_NS else max(self._newest, end)
        self._splits = [
            each
            for each in (*self._splits, split)
            if each.span is not None and self._newest - MEASURED_NS < each.span[1] <= self._newest
        ]
        for topic, arrival in split.arrivals.items():
            known = self._topics.get(topic)
            if known is None or arrival.last < known.arrival.last - _SET_BACK_NS:
                self._topics[topic] = _Topic(arrival)
                continue
            joined = known.arrival.joined(arrival)
            if joined.last > known.arrival.last:
                self._silent.discard(topic)
            if max(arrival.pause, arrival.first - known.arrival.last) > known.patience:
                known.arrival, known.paused = arrival, arrival.first
            else:
                known.arrival = joined

    def silent(self, idle: Ns) -> frozenset[str]:
        """Returns the topics that came regularly, and have stopped.

        That is for ten periods, and 10 s at least. `idle`: for how long nothing has come at all.
        """
        now = self._newest + idle
        self._silent |= {
            name
            for name, topic in self._topics.items()
            if topic.is_regular(now) and now - topic.arrival.last > topic.patience
        }
        return frozenset(self._silent)

    def rates_hz(self, idle: Ns) -> Mapping[str, float]:
        """Returns the messages a second of each topic in the newest data; see `silent`."""
        starts = [each.span[0] for each in self._splits if each.span is not None]
        if not starts:
            return {}
        duration_s = max(self._newest + idle - min(starts), 1) / NS_PER_S
        counts: dict[str, int] = {}
        for split in self._splits:
            for name, arrival in split.arrivals.items():
                counts[name] = counts.get(name, 0) + arrival.messages
        return {name: count / duration_s for name, count in counts.items()}
