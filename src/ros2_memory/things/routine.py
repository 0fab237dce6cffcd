"""Where a thing that moves usually is: at which hours of the day, and how likely now.

The last sighting in each hour of each day is known. A place is the likelier, the more often the
thing was there around the same hour of the day. How likely its last place is follows from how often
the thing was still there after as long a time.

Usual places are returned only if they would have predicted the place in each known hour, from all
hours before, better than the last place alone does, and better than without the hour of the day.
The measure is Brier's score: the squared error of the probabilities.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.sights import STOREY_MM
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
"""The first days are only learned from, and not predicted."""
_AROUND_H: Final = 1.0
"""Standard deviation of the hour at which somebody does the same on another day."""
_AGES_H: Final = (1.5, 3.0, 6.0, 12.0, 24.0)
"""The bounds of classes of times since the last sighting: each has its own chance of staying."""
_SIGMAS: Final = 2.0
_LEAST_SHARE: Final = 0.05
_MOST_PLACES: Final = 4
_AT_ONCE: Final = 256
"""Hours that are compared with all before them together."""


class _HourlyPlaces(NamedTuple):
    """The last sighting in each hour.

    Attributes:
        hours: hours of local time since the epoch, ascending.
        places: the number of each hour's place, below `size`.
    """

    hours: Floats
    places: Ints
    size: int

    def place_shares(self, rows: Ints) -> Floats:
        """Returns the share of each place in the hours before each row; no share is 0."""
        return _normalised(self._sums_at_places(self._are_before(rows)) + 1.0 / self.size)

    def likely_by_hour(self, rows: Ints, hours: Floats) -> Floats:
        """Returns how likely each place is at an hour of the day, by the hours before each row."""
        apart = np.abs((self.hours - hours[:, None] + _DAY_H / 2) % _DAY_H - _DAY_H / 2)
        weights = np.exp(-((apart / _AROUND_H) ** 2) / 2) * self._are_before(rows)
        return _normalised(self._sums_at_places(weights) + self.place_shares(rows))

    def chances_to_stay(self, rows: Ints, ages_h: Floats) -> Floats:
        """Returns how likely a thing is still where it was, by the hours before each row.

        It was there `ages_h` hours ago. Each class of ages begins with one time that it stayed, and
        one that it did not.
        """
        ages = np.digitize(np.diff(self.hours), _AGES_H)
        is_alike = ages == np.digitize(ages_h, _AGES_H)[:, None]
        is_alike &= self._are_before(rows)[:, 1:]
        stayed = is_alike & (np.diff(self.places) == 0)
        chances: Floats = (stayed.sum(axis=1) + 1.0) / (is_alike.sum(axis=1) + 2.0)
        return chances

    def predict(self, rows: Ints, hours: Floats) -> tuple[Floats, Floats]:
        """Returns how likely each place is at later hours, by the hours before each row.

        First with the hour of the day, then without.
        """
        shares, nth, last = self.place_shares(rows), np.arange(len(rows)), self.places[rows - 1]
        stays = self.chances_to_stay(rows, hours - self.hours[rows - 1])
        # If it left, it is at the other places by their shares.
        others = 1 - shares[nth, last]
        moves = np.divide(1 - stays, others, out=np.zeros(len(rows)), where=others > 0)
        prior = shares * moves[:, None]
        prior[nth, last] = stays
        by_hour = self.likely_by_hour(rows, hours)
        return _normalised(prior * (by_hour / shares)), _normalised(prior)

    def _are_before(self, rows: Ints) -> Flags:
        """Returns which hours (columns) are before each row."""
        return np.arange(len(self.hours)) < rows[:, None]

    def _sums_at_places(self, weights: Floats | Flags) -> Floats:
        """Returns for each row the sum of the weights of the hours (columns) at each place."""
        cells = np.arange(len(weights))[:, None] * self.size + self.places
        sums = np.bincount(cells.ravel(), weights.ravel(), len(weights) * self.size)
        return sums.reshape(-1, self.size).astype(np.float64)


def _normalised(weights: Floats) -> Floats:
    shares: Floats = weights / weights.sum(axis=1, keepdims=True)
    return shares


def usual_places(
    times: Ints, places_mm: Ints, now: Ns, offset: Offset = local_offset
) -> tuple[UsualPlace, ...] | None:
    """Returns where a thing usually is, the likeliest place now first; empty without a routine.

    None if it was seen at one place only, or too rarely to say.

    Args:
        times: when it was seen (N, ns), ascending.
        places_mm: where it was seen (N x 3, mm).
        now: the time that is asked about (ns).
        offset: of local time.
    """
    last_in_hour = np.flatnonzero(np.diff(times // _HOUR_NS, append=-1) != 0)
    hours = np.array([_local_hour(at, offset) for at in times[last_in_hour].tolist()])
    places, centres = _cluster_places(places_mm[last_in_hour])
    hourly = _HourlyPlaces(hours, places, len(centres))
    days = hours // _DAY_H
    learned = int(np.searchsorted(days, days[0] + _LEARNED_DAYS))
    if hourly.size < 2 or len(days) - learned < _FEWEST_HOURS or days[-1] - days[0] < _FEWEST_DAYS:
        return None
    if not _has_routine(hourly, learned):
        return ()
    every = np.array([len(hours)])
    [likely_now], _ = hourly.predict(every, np.array([max(_local_hour(now, offset), hours[-1])]))
    shares = np.bincount(places, minlength=hourly.size) / len(places)
    by_hour = hourly.likely_by_hour(np.repeat(every, _DAY_H), np.arange(0.5, _DAY_H))
    is_known = np.isin(np.arange(_DAY_H), hours % _DAY_H // 1)
    best_of_hour = np.where(is_known, by_hour.argmax(axis=1), -1)
    order = [place for place in np.argsort(-likely_now).tolist() if shares[place] >= _LEAST_SHARE]
    usual = []
    for place in order[:_MOST_PLACES]:
        x, y, z = (centres[place] / _MM).tolist()
        best_hours = np.flatnonzero(best_of_hour == place).tolist()
        share, chance = float(shares[place]), float(likely_now[place])
        usual.append(UsualPlace((x, y, z), (), share, _hours_text(best_hours), chance))
    return tuple(usual)


def _hours_text(hours: Sequence[int]) -> str:
    """Returns hours of the day as spans: "07-09" ends at 09:00."""
    begins = [hour for hour in hours if hour - 1 not in hours]
    ends = [hour + 1 for hour in hours if hour + 1 not in hours]
    return ", ".join(f"{begin:02}-{end:02}" for begin, end in zip(begins, ends, strict=True))


def _local_hour(at: Ns, offset: Offset) -> float:
    """Returns the hours of local time since the epoch."""
    return (at + offset(at // NS_PER_S) * NS_PER_S) / _HOUR_NS


def _cluster_places(places_mm: Ints) -> tuple[Ints, Floats]:
    """Returns the number of each position's place, and the mean of each place (mm).

    A position joins the nearest place of its storey within a metre, else it begins a new one.
    """
    numbers = np.zeros(len(places_mm), np.int64)
    totals = np.zeros((len(places_mm), 4))  # x, y, z and the number of positions of each place
    size = 0
    for row, position in enumerate(places_mm):
        x, y, z = (totals[:size, :3] / totals[:size, 3:] - position).T
        apart = np.where(np.abs(z) > STOREY_MM, np.inf, np.hypot(x, y))
        place = int(np.argmin(apart)) if size and apart.min() <= _ONE_PLACE_MM else size
        size = max(size, place + 1)
        totals[place] += (*position, 1.0)
        numbers[row] = place
    return numbers, totals[:size, :3] / totals[:size, 3:]


def _has_routine(hourly: _HourlyPlaces, learned: int) -> bool:
    """Returns whether predictions with hours beat the last place, and those without hours.

    The first `learned` hours are not predicted. Both gains must be beyond chance.
    """
    count, gains = len(hourly.hours), []
    for begin in range(learned, count, _AT_ONCE):
        rows = np.arange(begin, min(begin + _AT_ONCE, count))
        # A wrong place is off by 1, and so is the right one, which got nothing.
        error_of_last_place = 2.0 * (np.diff(hourly.places)[rows - 1] != 0)
        earlier = hourly._replace(hours=hourly.hours[: rows[-1]], places=hourly.places[: rows[-1]])
        are_there = hourly.places[rows, None] == np.arange(hourly.size)
        error, error_without_hours = (
            ((likely - are_there) ** 2).sum(axis=1)
            for likely in earlier.predict(rows, hourly.hours[rows])
        )
        gains.append(np.stack((error_of_last_place - error, error_without_hours - error), axis=1))
    every = np.concatenate(gains)
    standard_error = np.std(every, axis=0) / math.sqrt(len(every))
    return bool((np.mean(every, axis=0) > _SIGMAS * standard_error).all())
