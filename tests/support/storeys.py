"""A house of two storeys, whose bedroom is above its kitchen, over the same x and y.

The robot drives in the kitchen, goes up in the lift, and drives over the same x and y above.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from ros2_memory.core.regions import Place, Rectangle, Region, Storey
from ros2_memory.history.context import Memory
from tests.support.bags import Msg, detected, odom, text

S = 10**9
BEGIN = 1_784_000_000
UP_M = 2.7
ROOM = Rectangle(-1.0, 4.0, -1.0, 1.0)
HOUSE: dict[str, Region] = {
    "kitchen": Storey(ROOM, -0.5, 1.0),
    "bedroom": Storey(ROOM, 2.0, math.inf),
    "column": ROOM,
}
LEG_S = 60
"""How long it is on each storey; the lift takes 9 s."""


def way() -> Iterator[tuple[float, float]]:
    """Its x and z (m) at each fifth of a second: to and fro below, up in the lift, and above."""
    for nth in range(LEG_S * 5):
        yield 1.5 - 1.5 * math.cos(nth / 50), 0.0
    for nth in range(45):
        yield 0.06, UP_M * nth / 45
    for nth in range(LEG_S * 5):
        yield 0.06 + 0.5 * math.sin(nth / 50), UP_M


WAY = [*way()]
TIMES = [BEGIN * S + nth * S // 5 for nth in range(len(WAY))]
END = TIMES[-1] / S


def times_in(name: str) -> list[int]:
    """At which of the times it is in a place: it never leaves the plan of the two rooms."""
    low, high = {"kitchen": (-0.5, 1.0), "bedroom": (2.0, 9.0), "column": (-9.0, 9.0)}[name]
    return [at for at, (_, z) in zip(TIMES, WAY, strict=True) if low <= z <= high]


def house() -> list[Msg]:
    """Poses, a word a second, and a cup in each room, the one above the other."""
    messages: list[Msg] = []
    for nth, (at, (x, z)) in enumerate(zip(TIMES, WAY, strict=True)):
        messages.append(odom(at, x, z=z))
        if nth % 5 == 0:
            cup = ("cup", 0.9, (2.0, 0.5, 0.8 if z < UP_M / 2 else UP_M + 0.8))
            messages += [text(at, "hello"), detected(at, [cup], frame="odom")]
    return messages


def with_places(
    memory: Memory, places: Mapping[str, Region] = HOUSE, frame: str = "odom"
) -> Memory:
    named = tuple(Place(name, frame, region) for name, region in places.items())
    return replace(memory, limits=replace(memory.limits, places=named))
