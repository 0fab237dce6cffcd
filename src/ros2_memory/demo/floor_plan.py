"""A small flat: three rooms in a row, the walls between them, and the objects in them.

All coordinates are metres in the frame `map`: x points east, y north, z up. The living room is in
the west, the kitchen in the east, the hall between them; its front door is in the north wall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from ros2_memory.core.model import Vector3

_HALL_WEST: Final = 5.0
_HALL_EAST: Final = 7.0
_EAST: Final = 11.0
_NORTH: Final = 4.0
_WALLS: Final = np.array(
    [
        # x0, y0, x1, y1
        (0.0, 0.0, _EAST, 0.0),
        (_EAST, 0.0, _EAST, _NORTH),
        (_EAST, _NORTH, 0.0, _NORTH),
        (0.0, _NORTH, 0.0, 0.0),
        (_HALL_WEST, 0.0, _HALL_WEST, 1.5),
        (_HALL_WEST, 2.5, _HALL_WEST, _NORTH),
        (_HALL_EAST, 0.0, _HALL_EAST, 1.5),
        (_HALL_EAST, 2.5, _HALL_EAST, _NORTH),
    ]
)

THINGS: Final[Mapping[str, Vector3]] = {
    "sofa": (2.8, 3.6, 0.4),
    "television": (0.1, 2.4, 1.0),
    "plant": (4.6, 0.5, 0.6),
    "toy car": (3.6, 1.4, 0.05),
    "shoes": (5.6, 3.9, 0.1),
    "front door": (6.0, 3.95, 1.0),
    "umbrella": (6.4, 3.9, 0.4),
    "cup": (9.7, 3.8, 0.95),
    "scissors": (10.2, 3.8, 0.95),
    "table": (8.8, 0.9, 0.7),
    "fridge": (10.7, 2.0, 1.0),
}
"""The position of each object (m); nothing moves."""


ROOMS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "living room": (0.0, _HALL_WEST, 0.0, _NORTH),
    "hall": (_HALL_WEST, _HALL_EAST, 0.0, _NORTH),
    "kitchen": (_HALL_EAST, _EAST, 0.0, _NORTH),
}
"""The rooms: from and to which x, and from and to which y (m)."""


def room_at(x: float) -> str:
    """Returns the name of the room at `x` (the rooms lie in a row from west to east)."""
    if x < _HALL_WEST:
        return "living room"
    return "hall" if x < _HALL_EAST else "kitchen"


def wall_distances(x: float, y: float, bearings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the distance (m) from (x, y) to the nearest wall along each bearing (rad, from east).

    Ray and segment: with ray o + r d and wall p + s (q - p), r = (p - o) x (q - p) / d x (q - p)
    and s = (p - o) x d / d x (q - p). Walls are met from inside the flat, so every ray ends.
    """
    cos, sin = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    from_x, from_y = _WALLS[:, 0] - x, _WALLS[:, 1] - y
    along_x, along_y = _WALLS[:, 2] - _WALLS[:, 0], _WALLS[:, 3] - _WALLS[:, 1]
    across = cos * along_y - sin * along_x
    with np.errstate(divide="ignore", invalid="ignore"):
        ray = (from_x * along_y - from_y * along_x) / across
        wall = (from_x * sin - from_y * cos) / across
    met = (across != 0.0) & (ray > 0.0) & (wall >= 0.0) & (wall <= 1.0)
    nearest: NDArray[np.float64] = np.where(met, ray, np.inf).min(axis=1)
    return nearest
