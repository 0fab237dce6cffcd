"""The people of the flat: asleep at night, about by day, two of them out for a part of it."""

from typing import Final, NamedTuple

from tests.home.days import Scale
from tests.home.flat import HALL_X, ROOMS
from tests.home.paths import Knots, Path, finished
from tests.home.things import DAY, HOUR


class Person(NamedTuple):
    """A person's way, and when they are out of the flat."""

    path: Path
    out: tuple[tuple[float, float], ...]


_BEDS: Final = ((9.0, 7.8), (10.2, 7.8), (0.8, 1.6))
_OUT_H: Final = ((8.5, 17.1), None, (9.2, 12.5))


def people(scale: Scale) -> list[Person]:
    """Returns the three people who live here: asleep at night, about by day, two of them out."""
    return [
        _person(scale, nth, bed, out)
        for nth, (bed, out) in enumerate(zip(_BEDS, _OUT_H, strict=True))
    ]


def _person(
    scale: Scale, nth: int, bed: tuple[float, float], out_h: tuple[float, float] | None
) -> Person:
    chance = scale.chance(2, nth)
    at = Knots(-10.0, *bed)
    out = []
    for day in range(scale.days):
        start = day * DAY
        at.until(start + 7.0 * HOUR + float(chance.uniform(0.0, 1200.0)))
        while at.t < start + 22.7 * HOUR:
            if out_h is not None and start + out_h[0] * HOUR < at.t < start + out_h[1] * HOUR:
                at.walk(HALL_X, 8.8)
                out.append((at.t, start + out_h[1] * HOUR))
                at.until(start + out_h[1] * HOUR)
            room = ROOMS[str(chance.choice(list(ROOMS)))]
            x = float(chance.uniform(room.x0 + 0.5, room.x1 - 0.5))
            y = float(chance.uniform(room.y0 + 0.5, room.y1 - 0.5))
            at.walk(x, y)
            brief = chance.random() < 0.5
            at.wait(float(chance.uniform(15, 90) if brief else chance.uniform(300, 1800)))
        at.walk(*bed)
    at.until(scale.days * DAY + 60.0)
    return Person(finished(at), tuple(out))
