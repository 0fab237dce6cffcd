"""The flat: five rooms and a hall, the doors between them, and what can be seen from where.

All coordinates are metres in the frame `map`: x points east, y north, z up. The hall runs from the
dock in the south to the front door in the north; all other rooms open into it.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats


class Room(NamedTuple):
    """A rectangle; `doorway` is a point inside, in front of its door, None for the hall."""

    x0: float
    x1: float
    y0: float
    y1: float
    doorway: tuple[float, float] | None = None


class Spot(NamedTuple):
    """A point where the robot stops and looks around."""

    name: str
    room: str
    x: float
    y: float


HALL = "hall"
ROOMS: Mapping[str, Room] = {
    "living room": Room(0.0, 5.0, 0.0, 5.0, (4.3, 2.5)),
    "kitchen": Room(0.0, 5.0, 5.0, 9.0, (4.3, 7.0)),
    HALL: Room(5.0, 7.0, 0.0, 9.0),
    "bedroom": Room(7.0, 12.0, 5.0, 9.0, (7.7, 7.0)),
    "study": Room(7.0, 12.0, 2.0, 5.0, (7.7, 3.5)),
    "bathroom": Room(7.0, 12.0, 0.0, 2.0, (7.7, 1.1)),
}
HALL_X = 6.0
"""The line along which everybody walks through the hall."""
DOCK = (6.0, 0.6, np.pi / 2)
"""Where the robot stands while it is docked: x, y (m) and yaw (rad)."""
DOCK_RADIUS_M = 0.4
FRONT_DOOR = (6.0, 8.3)

SPOTS = (
    Spot("sofa corner", "living room", 3.2, 1.6),
    Spot("bookshelf", "living room", 1.8, 3.4),
    Spot("kitchen table", "kitchen", 3.2, 7.0),
    Spot("middle of the hall", HALL, 6.0, 5.0),
    Spot("front door", HALL, *FRONT_DOOR),
    Spot("bed", "bedroom", 9.4, 7.0),
    Spot("desk", "study", 9.4, 3.4),
    Spot("bath", "bathroom", 9.2, 1.0),
)

DINING_CORNER = ((0.2, 5.4), (2.8, 5.4), (2.8, 7.2), (1.6, 8.6), (0.2, 8.6))
"""A polygon around the dining table, inside the kitchen."""

_DOOR_M = 1.0


def _walls() -> NDArray[np.float64]:
    """Returns the ends of every wall: x0, y0, x1, y1."""
    walls = [(0.0, 0.0, 12.0, 0.0), (12.0, 0.0, 12.0, 9.0), (12.0, 9.0, 0.0, 9.0)]
    walls += [(0.0, 9.0, 0.0, 0.0), (0.0, 5.0, 5.0, 5.0), (7.0, 5.0, 12.0, 5.0)]
    walls.append((7.0, 2.0, 12.0, 2.0))
    for x in (5.0, 7.0):
        for room in ROOMS.values():
            if room.doorway is None or x not in {room.x0, room.x1}:
                continue
            y = room.doorway[1]
            walls.append((x, room.y0, x, y - _DOOR_M / 2))
            walls.append((x, y + _DOOR_M / 2, x, room.y1))
    return np.array(walls)


WALLS = _walls()


def room_at(x: float, y: float) -> str | None:
    """Returns the name of the room at a point; None outside the flat."""
    for name, room in ROOMS.items():
        if room.x0 <= x < room.x1 and room.y0 <= y < room.y1:
            return name
    return None


def way(start: tuple[float, float], goal: tuple[float, float]) -> list[tuple[float, float]]:
    """Returns the corners of the way from a point to another one, the goal included.

    Raises:
        ValueError: one of the points is in no room.
    """
    rooms = [room_at(*point) for point in (start, goal)]
    if None in rooms:
        raise ValueError(f"{start} or {goal} is outside the flat")
    if rooms[0] == rooms[1]:
        return [goal]
    corners: list[tuple[float, float]] = []
    for name, leaving in ((rooms[0], True), (rooms[1], False)):
        door = ROOMS[name or HALL].doorway
        if door is None:
            continue
        hall_side = (HALL_X, door[1])
        corners += [door, hall_side] if leaving else [hall_side, door]
    return [*corners, goal]


def clear_lines(from_x: Floats, from_y: Floats, to_x: Floats, to_y: Floats) -> NDArray[np.bool_]:
    """Returns whether no wall lies between each pair of points."""
    clear = np.ones(len(from_x), dtype=np.bool_)
    along_x, along_y = to_x - from_x, to_y - from_y
    for x0, y0, x1, y1 in WALLS.tolist():
        side_from = (x1 - x0) * (from_y - y0) - (y1 - y0) * (from_x - x0)
        side_to = (x1 - x0) * (to_y - y0) - (y1 - y0) * (to_x - x0)
        side_start = along_x * (y0 - from_y) - along_y * (x0 - from_x)
        side_stop = along_x * (y1 - from_y) - along_y * (x1 - from_x)
        clear &= ~((side_from * side_to < 0) & (side_start * side_stop < 0))
    return clear
