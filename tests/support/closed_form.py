"""Where the simulated robot of recordings was, in closed form.

A circle of radius 2 m at 0.5 m/s, t seconds after its start: from (0, 0) facing +x, turning left
about (0, 2).
"""

import math

TURN_RATE = 0.25  # rad/s
RADIUS = 2.0  # m


def position(t: float) -> tuple[float, float]:
    """x and y in the odom frame (m)."""
    angle = TURN_RATE * t
    return RADIUS * math.sin(angle), RADIUS * (1 - math.cos(angle))
