"""Where a thing that moves usually is: at which hours of the day, and how likely now.

What is known is where it was last seen in each hour of each day. A place is the likelier, the more
often the thing was there around the same hour of the day; the place where it was last seen counts
by how often the thing was still there after as long a time. Usual places are returned only where,
before each known hour, they would have predicted the thing's place better than its last place did,
and better than without hours. The measure is Brier's score: the squared error of the probabilities.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.counts.bins import Offset, local_offset
from ros2_memory.results import UsualPlace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.sights import Floats
    from ros2_memory.core.arrays import Flags, Ints


_HOUR_NS: Final = 3600 * NS_PER_S
_DAY_H: Final = 24
_MM: Final = 1000.0
_ONE_PLACE_MM: Final = 1000.0
_FEWEST_HOURS: Final = 24
"""Fewer known hours make no routine."""
_FEWEST_DAYS: Final = 4
_LEARNED_DAYS: Final = 2
"""The first days are learned from only."""
_AROUND_H: Final = 1.0
"""Standard deviation of the hour at which somebody does the same on another day."""
_AGES_H: Final = (1.5, 3.0, 6.0, 12.0, 24.0)
"""How long ago it was seen last, in classes: between them differs how often it is still there."""
_SIGMAS: Final = 2.0
_LEAST_SHARE: Final = 0.05
_MOST_PLACES: Final = 4
_AT_ONCE: Final = 256
"""Hours that are compared with all before them together."""


class _HourlyPlaces(NamedTuple):
    """The last sighting in each hour.

    Attributes:
        hours: of local time since the epoch, ascending.
        places: the number of the place of each, of `size`.
    """

    hours: Floats
    places: Ints
    size: int

    def shares(self, rows: Ints) -> Floats:
        """Returns how often it was at each place before each of some rows; none is impossible."""
        return _normalised(self._before(rows) @ self.are_at() + 1.0 / self.size)

    def around(self, rows: Ints, hours: Floats) -> Floats:
        """Returns how likely each place is at hours of the day, by what lies before some rows."""
        apart = np.abs((self.hours - hours[:, None] + _DAY_H / 2) % _DAY_H - _DAY_H / 2)
        weights = np.exp(-((apart / _AROUND_H) ** 2) / 2) * self._before(rows)
        return _normalised(weights @ self.are_at() + self.shares(rows))

    def still_there(self, rows: Ints, ages_h: Floats) -> Floats:
        """Returns how likely it is where it was seen so long before each of some rows."""
        ages = np.digitize(np.diff(self.hours), _AGES_H)
        is_as_old = (ages == np.digitize(ages_h, _AGES_H)[:, None]) & self._before(rows)[:, 1:]
        stayed = is_as_old & (np.diff(self.places) == 0)
        likely: Floats = (stayed.sum(axis=1) + 1.0) / (is_as_old.sum(axis=1) + 2.0)
        return likely

    def likely(self, rows: Ints, hours: Floats) -> tuple[Floats, Floats]:
        """Returns how likely each place is at later hours, by what lies before each of some rows.

        And how likely without what is known of hours.
        """
        shares, nth, last = self.shares(rows), np.arange(len(rows)), self.places[rows - 1]
        stays, others = self.still_there(rows, hours - self.hours[rows - 1]), 1 - shares[nth, last]
        moves = np.divide(1 - stays, others, out=np.zeros(len(rows)), where=others > 0)
        prior = shares * moves[:, None]
        prior[nth, last] = stays
        return _normalised(prior * (self.around(rows, hours) / shares)), _normalised(prior)

    def _before(self, rows: Ints) -> Flags:
        return np.arange(len(self.hours)) < rows[:, None]

    def are_at(self) -> Floats:
        """Returns whether it was at each place (column), by hour: 0 or 1."""
        are_at: Floats = (self.places[:, None] == np.arange(self.size)).astype(np.float64)
        return are_at


def _normalised(weights: Floats) -> Floats:
    shares: Floats = weights / weights.sum(axis=1, keepdims=True)
    return shares


def usual_places(
    times: Ints, xy_mm: Ints, now: Ns, offset: Offset = local_offset
) -> tuple[UsualPlace, ...] | None:
    """Returns where a thing usually is, the likeliest place now first; none without a routine.

    None where it was seen at one place alone, or too rarely to say.

    Args:
        times: when it was seen (N, ns), ascending.
        xy_mm: where (N x 2).
        now: the time that is asked about.
        offset: of local time.
    """
    last = np.flatnonzero(np.diff(times // _HOUR_NS, append=-1) != 0)
    hours = np.array([_local_hour(at, offset) for at in times[last].tolist()])
    places, centres = _places(xy_mm[last])
    hourly = _HourlyPlaces(hours, places, len(centres))
    days = hours // _DAY_H
    learned = int(np.searchsorted(days, days[0] + _LEARNED_DAYS))
    if hourly.size < 2 or len(days) - learned < _FEWEST_HOURS or days[-1] - days[0] < _FEWEST_DAYS:
        return None
    if not _has_routine(hourly, learned):
        return ()
    every = np.array([len(hours)])
    [likely], _ = hourly.likely(every, np.array([max(_local_hour(now, offset), hours[-1])]))
    shares = np.bincount(places, minlength=hourly.size) / len(places)
    by_hour = hourly.around(np.repeat(every, _DAY_H), np.arange(0.5, _DAY_H))
    is_known = np.isin(np.arange(_DAY_H), hours % _DAY_H // 1)
    best = np.where(is_known, by_hour.argmax(axis=1), -1)
    order = [place for place in np.argsort(-likely).tolist() if shares[place] >= _LEAST_SHARE]
    return tuple(
        UsualPlace(
            (*(centres[place] / _MM).tolist(), 0.0),
            (),
            float(shares[place]),
            _hours_text(np.flatnonzero(best == place).tolist()),
            float(likely[place]),
        )
        for place in order[:_MOST_PLACES]
    )


def _hours_text(hours: Sequence[int]) -> str:
    """Returns hours of the day as stretches: "07-09" is until 09:00."""
    begins = [hour for hour in hours if hour - 1 not in hours]
    ends = [hour + 1 for hour in hours if hour + 1 not in hours]
    return ", ".join(f"{begin:02}-{end:02}" for begin, end in zip(begins, ends, strict=True))


def _local_hour(at: Ns, offset: Offset) -> float:
    """Returns the hours of local time since the epoch."""
    return (at + offset(at // NS_PER_S) * NS_PER_S) / _HOUR_NS


def _places(xy_mm: Ints) -> tuple[Ints, Floats]:
    """Returns the number of the place of each position, and the mean of each place."""
    numbers = np.zeros(len(xy_mm), np.int64)
    sums: list[Floats] = []
    for row, position in enumerate(xy_mm):
        apart = [math.dist(xyn[:2] / xyn[2], position) for xyn in sums]
        place = int(np.argmin(apart)) if apart and min(apart) <= _ONE_PLACE_MM else len(sums)
        if place == len(sums):
            sums.append(np.zeros(3))
        sums[place] += (*position, 1.0)
        numbers[row] = place
    totals = np.array(sums)
    return numbers, totals[:, :2] / totals[:, 2:]


def _has_routine(hourly: _HourlyPlaces, learned: int) -> bool:
    """Returns whether the hours say more of where it was than the last place, and than shares.

    Of the first sightings, so many are `learned` from only.
    """
    count, parts = len(hourly.hours), []
    for begin in range(learned, count, _AT_ONCE):
        rows = np.arange(begin, min(begin + _AT_ONCE, count))
        stayed = 2.0 * (np.diff(hourly.places)[rows - 1] != 0)
        score, without_hours = (
            ((likely - hourly.are_at()[rows]) ** 2).sum(axis=1)
            for likely in hourly.likely(rows, hourly.hours[rows])
        )
        parts.append(np.stack((stayed - score, without_hours - score), axis=1))
    gains = np.concatenate(parts)
    mean = np.mean(gains, axis=0)
    error = np.std(gains, axis=0) / math.sqrt(len(gains))
    return bool((mean > _SIGMAS * error).all())
