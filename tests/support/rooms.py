"""A robot that drives from room to room along a line, drawn by a seed: what is true each second.

It is where it is at whole seconds, half a step (0.25 m) or more from every wall, so that a wall is
crossed half a second after the last message in the room before.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from random import Random
from typing import NamedTuple

from ros2_memory.core.regions import Place, Rectangle
from ros2_memory.history.context import Memory
from tests.support.bags import Msg, detected, odom, text, write_splits
from tests.support.memories import memory_of, with_store

S = 10**9
BEGIN = 1_784_000_000
SEEN = "/vision/scene/scene_objects"
STEP_M = 0.5
ROOMS = {"kitchen": (0.0, 3.0), "hall": (3.0, 6.0), "den": (9.0, 12.0)}
"""From which x to which; between hall and den there is none."""
_TARGETS = (1.25, 4.25, 7.25, 10.25)
PLACES = {"cup": (1.5, 0.5), "cat": (4.5, 0.5), "cat bed": (10.5, 0.5)}
"""Where things are (m, in odom), by label."""


class Run(NamedTuple):
    """Consecutive seconds, both ends inclusive."""

    first: int
    last: int

    @property
    def messages(self) -> int:
        """How many messages of one a second it has."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class World:
    """Where the robot was (x, m) at each second, and which labels its detector said then."""

    x: tuple[float, ...]
    seen: tuple[tuple[tuple[str, float], ...], ...]

    def room(self, second: int) -> str | None:
        """The room that it was in."""
        at = self.x[second]
        return next((name for name, (low, high) in ROOMS.items() if low <= at <= high), None)

    def runs_in(self, *rooms: str) -> list[Run]:
        """When it was in one of these rooms, in order."""
        return runs_of(nth for nth in range(len(self.x)) if self.room(nth) in rooms)

    def metres_in(self, *rooms: str) -> float:
        """How far it drove there: half a step lies on each side of a wall."""
        metres = 0.0
        for nth in range(1, len(self.x)):
            step = abs(self.x[nth] - self.x[nth - 1])
            metres += step / 2 * sum(self.room(each) in rooms for each in (nth - 1, nth))
        return metres


def runs_of(seconds: Iterable[int]) -> list[Run]:
    """Consecutive numbers among some that ascend."""
    groups = groupby(enumerate(seconds), lambda pair: pair[1] - pair[0])
    found = [[second for _, second in group] for _, group in groups]
    return [Run(some[0], some[-1]) for some in found]


def draw(seed: int, seconds: int) -> World:
    """A world of so many seconds."""
    chance = Random(seed)
    x, target, stands = 1.25, 1.25, 8
    places: list[float] = []
    seen: list[tuple[tuple[str, float], ...]] = []
    for _ in range(seconds):
        if stands:
            stands -= 1
        elif x == target:
            target, stands = chance.choice(_TARGETS), chance.randint(6, 20)
        else:
            x += STEP_M if target > x else -STEP_M
        places.append(x)
        labels = [each for each in PLACES for _ in range(chance.choice((0, 0, 1, 2)))]
        seen.append(tuple((label, chance.randint(30, 99) / 100) for label in labels))
    return World(tuple(places), tuple(seen))


def write(world: World, folder: Path, *, begin: int = BEGIN) -> None:
    """Writes a pose, a text and a message of the detector for each second, in splits of 20."""
    messages: list[Msg] = []
    for nth, x in enumerate(world.x):
        at = (begin + nth) * S
        things = [(label, score, (*PLACES[label], 0.0)) for label, score in world.seen[nth]]
        messages += [odom(at, x, 0.0), text(at, "hello"), detected(at, things, frame="odom")]
    write_splits(folder, messages, 20)


def rooms_named(memory: Memory) -> Memory:
    """The memory with the rooms as named places."""
    places = tuple(
        Place(name, "odom", Rectangle(low, high, -1.0, 1.0)) for name, (low, high) in ROOMS.items()
    )
    return replace(memory, limits=replace(memory.limits, places=places))


def asked_of(folder: Path, *, stored: bool) -> Memory:
    """The memory over a folder with the rooms as named places, with a store of columns or not."""
    memory = rooms_named(memory_of(folder))
    return with_store(memory, folder) if stored else memory


def bounds(*rooms: str) -> dict[str, dict[str, list[float]]]:
    """The argument `where` that gives these rooms by their bounds."""
    return {each: {"x": [*ROOMS[each]], "y": [-1.0, 1.0]} for each in rooms}
