"""Poses near a place as stays: when each began and ended, and how near the robot came."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ros2_memory.presences import SILENCE_NS
from ros2_memory.timebase import NS_PER_S, Ns

FLICKER_NS: Final[Ns] = 3 * NS_PER_S
"""A robot that is outside for less did not leave."""


@dataclass(slots=True)
class Stay:
    """A visit that is gone through from its end.

    `left`: before it, so far as it is known, the robot was elsewhere; `begun`: it began here.
    """

    departed: Ns
    arrived: Ns
    closest_m: float
    closest_at: Ns
    left: bool = False
    begun: bool = False


class Stays:
    """Takes poses from the newest on, near the place or not.

    Attributes:
        all: the stays so far, newest first.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.all: list[Stay] = []
        self._open: Stay | None = None

    def near(self, first: Ns, last: Ns, closest: tuple[float, Ns]) -> None:
        """The robot was within the radius from `first` to `last`."""
        stay = self._open
        if stay is not None:
            allowed = FLICKER_NS if stay.left else SILENCE_NS
            if stay.arrived - last > allowed:
                self.end()
                stay = None
        if stay is None:
            self._open = stay = Stay(last, first, *closest)
            self.all.append(stay)
        elif closest[0] <= stay.closest_m:
            stay.closest_m, stay.closest_at = closest
        stay.arrived = first
        stay.left = False

    def away(self, at: Ns) -> bool:
        """The robot was elsewhere then; gives whether a stay may still go on further back."""
        if self._open is not None:
            self._open.left = True
            if self._open.arrived - at > FLICKER_NS:
                self.end()
        return self._open is not None

    def end(self) -> None:
        """What comes next belongs to another visit."""
        if self._open is not None:
            self._open.begun = True
            self._open = None

    @property
    def under_way(self) -> bool:
        """Whether a visit may go on further back."""
        return self._open is not None

    @property
    def enough(self) -> bool:
        """Whether nothing that comes can change the newest visits."""
        return len(self.all) > self._limit and all(stay.begun for stay in self.all[: self._limit])
