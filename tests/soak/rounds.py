"""Rounds of all habits against one server, with what it held after each."""

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from tests.soak import clients
from tests.soak.clients import Habit
from tests.soak.server import Held, came_back_to, held
from tests.support.examples import LONG
from tests.support.processes import PATIENCE_S
from tests.support.served import Served

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
    clients.never_reading,
    *LONG * (clients.endless_bodies,),
)
"""What the server lets go on for seconds."""


@dataclass
class Soak:
    """What clients saw, and what the server held: at the start, after each round, at the end."""

    start: Held
    rounds: list[Held] = field(default_factory=list)
    end: Held | None = None
    seen: dict[str, Counter[str]] = field(default_factory=dict)

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


async def soaked(served: Served, seconds: float) -> Soak:
    """Runs rounds for so long, at least two after the first, which only warms the server up."""
    await _round(served, Soak(held(served)), (*SHORT, clients.never_reading))
    await clients.crowd(served.port)
    soak = Soak(await asyncio.to_thread(_settled, served))
    begun = time.monotonic()
    waited_for = asyncio.ensure_future(_round(served, soak, SLOW))
    while len(soak.rounds) < 2 or time.monotonic() - begun < seconds:
        await _round(served, soak, SHORT)
        soak.rounds.append(held(served))
        if waited_for.done():
            await waited_for
            await _one(served, soak, clients.crowd)
            if time.monotonic() - begun < seconds:
                waited_for = asyncio.ensure_future(_round(served, soak, SLOW))
    await waited_for
    soak.end = await asyncio.to_thread(came_back_to, served, soak.start)
    return soak


async def _round(served: Served, soak: Soak, habits: tuple[Habit, ...]) -> None:
    """All habits at once."""
    await asyncio.gather(*(_one(served, soak, habit) for habit in habits))


async def _one(served: Served, soak: Soak, habit: Habit) -> None:
    soak.saw(habit, await habit(served.port))


def _settled(served: Served) -> Held:
    """What it holds when nothing has changed for a while: connections of the warm-up are over."""
    alike, now = 0, held(served)
    give_up = time.monotonic() + PATIENCE_S
    while alike < 20 and time.monotonic() < give_up:
        time.sleep(0.1)
        before, now = now, held(served)
        alike = alike + 1 if before.files == now.files and before.threads == now.threads else 0
    return now
