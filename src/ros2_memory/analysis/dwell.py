"""Poses near a place as stays: when each began and ended, and how near the robot came."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from ros2_memory.core.model import TimeWindow

FLICKER_NS: Final[Ns] = 3 * NS_PER_S
"""A robot that is outside for less did not leave."""


class Approach(NamedTuple):
    """A distance (m, in the plane) from the place, and when; the lesser of two is the closer."""

    distance_m: float
    time: Ns


class Unread(NamedTuple):
    """A time in which every pose is within the radius, and none is closer than the bound.

    `here` is where the place is (m) in the frame of these poses.
    """

    bound: Approach
    window: TimeWindow
    here: tuple[float, float]


@dataclass(slots=True)
class Dwell:
    """A visit that is gone through from its end.

    `closest` is that of the poses read one by one; `unread` are the times of the others. `left`:
    before it, so far as it is known, the robot was elsewhere; `begun`: it began here.
    """

    departed: Ns
    arrived: Ns
    closest: Approach | None = None
    unread: list[Unread] = field(default_factory=list)
    left: bool = False
    begun: bool = False


class DwellBuilder:
    """Takes poses from the newest on, near the place or not.

    Attributes:
        all: the stays so far, newest first.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.all: list[Dwell] = []
        self._open: Dwell | None = None

    def near(self, approach: Approach, last: Ns | None = None) -> None:
        """A pose is within the radius; with `last`, every one until then is, at the same place."""
        stay = self._at(approach.time, approach.time if last is None else last)
        stay.closest = approach if stay.closest is None else min(approach, stay.closest)

    def near_throughout(self, first: Ns, last: Ns, unread: Unread) -> None:
        """Every pose from `first` to `last` is within the radius, none long after another."""
        self._at(first, last).unread.append(unread)

    def _at(self, first: Ns, last: Ns) -> Dwell:
        """The stay that goes on from `first` to `last`."""
        stay = self._open
        if stay is not None:
            allowed = FLICKER_NS if stay.left else SILENCE_NS
            if stay.arrived - last > allowed:
                self.end()
                stay = None
        if stay is None:
            self._open = stay = Dwell(last, first)
            self.all.append(stay)
        stay.arrived = first
        stay.left = False
        return stay

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
