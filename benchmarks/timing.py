"""Times several ways to the same answer, side by side in one process.

In every run each side is timed once, in an order that turns from run to run, so that a slow spell
of the machine meets all of them. Before each the garbage of the others is collected; while it runs
the collector stays on, as it does in use. What a side prepares is not timed.
"""

from __future__ import annotations

import gc
import math
import statistics
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

OURS: Final = "ours"
PLAIN: Final = "plain"
FLOOR: Final = "floor"
"""The names of the sides."""

Ask: TypeAlias = "Callable[[], object]"
"""What is timed; it gives its answer in a form that can be compared between sides."""
Side: TypeAlias = "Callable[[], Sequence[Ask]]"
"""Prepares one run: what is then asked, one after the other, each timed for itself."""


class DisagreementError(Exception):
    """Two sides gave different answers: their times say nothing then."""


@dataclass(slots=True)
class Timed:
    """The seconds that each ask of a side took, over all runs, and the answers of the last run."""

    seconds: list[float] = field(default_factory=list)
    answers: list[object] = field(default_factory=list)

    @property
    def median(self) -> float:
        """The median of all asks, in seconds."""
        return statistics.median(self.seconds)

    def quantile(self, share: float) -> float:
        """The time within which this share of the asks was answered (nearest rank)."""
        return sorted(self.seconds)[max(math.ceil(share * len(self.seconds)), 1) - 1]


def timed(sides: Mapping[str, Side], runs: int, *, at_most_s: float = math.inf) -> dict[str, Timed]:
    """Times each side so many runs.

    A side that has taken `at_most_s` in all is left out of further runs; each gets one at least.
    """
    names = list(sides)
    found = {name: Timed() for name in names}
    for run in range(runs):
        turn = run % len(names)
        for name in names[turn:] + names[:turn]:
            one = found[name]
            if one.seconds and sum(one.seconds) >= at_most_s:
                continue
            asks = sides[name]()
            gc.collect()
            one.answers = []
            for ask in asks:
                begun = time.perf_counter()
                answer = ask()
                one.seconds.append(time.perf_counter() - begun)
                one.answers.append(answer)
    return found


def agreed(found: Mapping[str, Timed], *, silent: Collection[str] = ()) -> None:
    """Holds the sides to one answer, but for those that give none.

    Raises:
        DisagreementError: two do not agree; floats may differ by 0.0001, as replies round.
    """
    told = {name: each.answers for name, each in found.items() if name not in silent}
    names = list(told)
    for name in names[1:]:
        if not alike(told[names[0]], told[name]):
            first, other = repr(told[names[0]])[:200], repr(told[name])[:200]
            raise DisagreementError(f"{names[0]} answers {first}, {name} answers {other}")


def alike(one: object, other: object) -> bool:
    """Whether two answers are the same, floats to within a ten-thousandth."""
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-4)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    return one == other
