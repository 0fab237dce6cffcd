"""Groups poses near a point into dwells: when each began and ended, and how near the robot came."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from ros2_memory.core.model import TimeWindow

FLICKER_NS: Final[Ns] = 3 * NS_PER_S
"""A robot that is outside for less than this did not leave."""


class Approach(NamedTuple):
    """A distance (m, in the plane) from the point, and when; the lesser of two is the closer."""

    distance_m: float
    time: Ns


class Unread(NamedTuple):
    """A time in which every pose is within the radius, and none is closer than the bound.

    `target` is the point (m) in the frame of these poses.
    """

    bound: Approach
    window: TimeWindow
    target: tuple[float, float]


@dataclass(slots=True)
class Dwell:
    """A visit, which is read from its end backwards.

    `closest` is the closest of the poses read one by one; `unread` are the times of the others.
    `outside`: before it, as far as is known, the robot was elsewhere; `begun`: its begin is known.
    `entered`: the last pose before it was elsewhere. `left`: the first one after it was; None where
    that pose was not taken.
    """

    departed: Ns
    arrived: Ns
    closest: Approach | None = None
    unread: list[Unread] = field(default_factory=list)
    outside: bool = False
    begun: bool = False
    entered: bool = False
    left: bool | None = None


class DwellBuilder:
    """Takes poses from the newest on, near the point or not.

    Attributes:
        all: the dwells so far, newest first.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.all: list[Dwell] = []
        self._open: Dwell | None = None
        self._away_from: Ns | None = None

    def near(self, approach: Approach, last: Ns | None = None) -> None:
        """Takes a pose within the radius; with `last`, all until then are at that place."""
        dwell = self._at(approach.time, approach.time if last is None else last)
        dwell.closest = approach if dwell.closest is None else min(approach, dwell.closest)

    def near_throughout(self, first: Ns, last: Ns, unread: Unread) -> None:
        """Takes a time in which every pose is within the radius, none long after another."""
        self._at(first, last).unread.append(unread)

    def _at(self, first: Ns, last: Ns) -> Dwell:
        """Returns the dwell that goes on from `first` to `last`."""
        dwell = self._open
        if dwell is not None:
            allowed = FLICKER_NS if dwell.outside else SILENCE_NS
            if dwell.arrived - last > allowed:
                self.end()
                dwell = None
        if dwell is None:
            is_left = self._away_from is not None and self._away_from - last <= SILENCE_NS
            self._open = dwell = Dwell(last, first, left=is_left or None)
            self.all.append(dwell)
        dwell.arrived = first
        dwell.outside = dwell.entered = False
        self._away_from = None
        return dwell

    def away(self, at: Ns, last: Ns | None = None) -> bool:
        """Takes a pose that is elsewhere; returns whether a dwell may still go on further back.

        With `last`, all poses until then are elsewhere.
        """
        self._away_from = at
        if self._open is not None:
            if not self._open.outside:
                after = self._open.arrived - (at if last is None else last)
                self._open.entered = after <= SILENCE_NS
            self._open.outside = True
            if self._open.arrived - at > FLICKER_NS:
                self.end()
        return self._open is not None

    def end(self) -> None:
        """Ends the dwell: what comes next belongs to another."""
        if self._open is not None:
            self._open.begun = True
            self._open = None

    @property
    def under_way(self) -> bool:
        """Whether a dwell may go on further back."""
        return self._open is not None

    @property
    def enough(self) -> bool:
        """Whether no older pose can change the newest dwells."""
        return len(self.all) > self._limit and all(dwell.begun for dwell in self.all[: self._limit])
