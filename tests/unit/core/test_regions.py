"""Regions of the plane, and when a path is inside of one."""

from random import Random

import numpy as np
import pytest

from ros2_memory.core.regions import (
    Circle,
    Place,
    Polygon,
    Rectangle,
    Region,
    Steps,
    clipped,
    places_at,
)

CIRCLE = Circle(1.0, 2.0, 1.5)
BOX = Rectangle(-1.0, 2.0, 0.0, 3.0)
SQUARE = Polygon(((-1.0, 0.0), (2.0, 0.0), (2.0, 3.0), (-1.0, 3.0)))
HORSESHOE = Polygon(
    ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (3.0, 4.0), (3.0, 1.0), (1.0, 1.0), (1.0, 4.0), (0.0, 4.0))
)


def steps(draw: Random, count: int = 300) -> Steps:
    points = np.array([(draw.uniform(-3, 6), draw.uniform(-3, 6)) for _ in range(count + 1)])
    points[5] = points[4]  # the robot stands
    return Steps(points[:-1, 0], points[:-1, 1], points[1:, 0], points[1:, 1])


@pytest.mark.parametrize(
    "region", [CIRCLE, BOX, SQUARE, HORSESHOE], ids=lambda each: repr(each)[:6]
)
@pytest.mark.parametrize("seed", range(5))
def test_the_parts_inside_are_those_whose_points_are(region: Region, seed: int) -> None:
    draw = Random(seed)
    path = steps(draw)
    parts = clipped(region, path)
    assert (parts.start <= parts.stop).all()
    for _ in range(500):
        step, share = draw.randrange(len(path.x)), draw.random()
        x = path.x[step] + (path.to_x[step] - path.x[step]) * share
        y = path.y[step] + (path.to_y[step] - path.y[step]) * share
        mine = parts.step == step
        apart = np.abs(np.concatenate((parts.start[mine], parts.stop[mine])) - share)
        if len(apart) and apart.min() < 1e-9:
            continue  # on the border
        inside = bool(((parts.start[mine] <= share) & (share <= parts.stop[mine])).any())
        assert inside == region.contains(x, y)


def test_of_places_within_each_other_the_smallest_is_named() -> None:
    places = (
        Place("kitchen", "map", Rectangle(0, 5, 0, 5)),
        Place("dock", "map", Circle(1, 1, 0.5)),
        Place("yard", "odom", Rectangle(0, 5, 0, 5)),
    )
    assert places_at(places, "map", 1.2, 1.0) == ("dock", "kitchen")
    assert places_at(places, "map", 3.0, 1.0) == ("kitchen",)
    assert places_at(places, "map", 7.0, 1.0) == ()
    assert places_at(places, "odom", 3.0, 1.0) == ("yard",)
