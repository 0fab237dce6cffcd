"""Rounds of all habits against one server, with what it held after each."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from tests.soak import clients
from tests.soak.server import Held, Served
from tests.support.processes import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.soak.clients import Habit

SHORT: Final[tuple[Habit, ...]] = (
    clients.all_tools,
    clients.many_calls_at_once,
    clients.hostile,
    clients.too_large,
    clients.leaving,
    clients.coming_and_going,
)
SLOW: Final[tuple[Habit, ...]] = (
    clients.slow_loris,
    clients.endless_bodies,
    clients.never_reading,
)
"""What the server lets go on for seconds."""


@dataclass
class Soak:
    """What clients saw, and what the server held: at the start, after each round, at the end."""

    start: Held
    rounds: list[Held] = field(default_factory=list)
    end: Held | None = None
    seen: dict[str, Counter[str]] = field(default_factory=dict)
    most: Held | None = None

    @property
    def growth_mb(self) -> float:
        """How much more memory the second half of the rounds took than the first, at most."""
        half = len(self.rounds) // 2
        first, second = self.rounds[:half], self.rounds[half:]
        return max(each.rss_mb for each in second) - max(each.rss_mb for each in first)

    def saw(self, habit: Habit, seen: Counter[str]) -> None:
        """Adds what a client saw."""
        name = getattr(habit, "__name__", "")
        self.seen.setdefault(name, Counter()).update(seen)


async def soaked(
    served: Served,
    seconds: float,
    tell: Callable[[float, Held], None] = lambda *_: None,
    slow: tuple[Habit, ...] = SLOW,
) -> Soak:
    """Runs rounds for so long, at least two after the first, which only warms the server up."""
    await _round(served, Soak(served.held()), (*SHORT, clients.never_reading))
    await clients.crowd(served.port)
    soak = Soak(await asyncio.to_thread(_settled, served))
    begun = time.monotonic()
    waited_for = asyncio.ensure_future(_round(served, soak, slow))
    watch = asyncio.create_task(_watch(served, soak))
    while len(soak.rounds) < 2 or time.monotonic() - begun < seconds:
        await _round(served, soak, SHORT)
        soak.rounds.append(served.held())
        tell(time.monotonic() - begun, soak.rounds[-1])
        if waited_for.done():
            await waited_for
            await _one(served, soak, clients.crowd)
            if time.monotonic() - begun < seconds:
                waited_for = asyncio.ensure_future(_round(served, soak, slow))
    await waited_for
    watch.cancel()
    soak.end = await asyncio.to_thread(served.came_back_to, soak.start)
    return soak


async def _round(served: Served, soak: Soak, habits: tuple[Habit, ...]) -> None:
    """All habits at once."""
    await asyncio.gather(*(_one(served, soak, habit) for habit in habits))


async def _one(served: Served, soak: Soak, habit: Habit) -> None:
    soak.saw(habit, await habit(served.port))


async def _watch(served: Served, soak: Soak) -> None:
    """The most of each that was ever seen held."""
    while True:
        held = served.held()
        most = soak.most or held
        soak.most = Held(
            max(most.rss_mb, held.rss_mb),
            max(most.threads, held.threads),
            max(most.files, held.files),
        )
        await asyncio.sleep(0.05)


def _settled(served: Served) -> Held:
    """What it holds when nothing has changed for a while: connections of the warm-up are over."""
    alike, held = 0, served.held()
    give_up = time.monotonic() + PATIENCE_S
    while alike < 20 and time.monotonic() < give_up:
        time.sleep(0.1)
        before, held = held, served.held()
        alike = alike + 1 if before.files == held.files and before.threads == held.threads else 0
    return held
