"""A robot whose map moves under its odometry: a localiser corrects it, now and then by a lot."""

import math
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from random import Random

from tests.support.bags import Msg, detections, mcap_content, odom, splits_of, tf, tf_of, transform

S = 10**9
MS = 10**6
BEGIN = 1_784_000_000 * S
_WAYPOINTS = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))


@dataclass
class MovingMap:
    """What is true: where the robot was in the map, 5 times a second; see `write_moving_map`."""

    times: list[int] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)

    def inside(self, x: float, y: float, radius: float) -> list[int]:
        """The times at which it was within a radius of a place."""
        return [
            at
            for at, place in zip(self.times, self.places, strict=True)
            if math.dist(place, (x, y)) <= radius
        ]


def moving_map(
    draw: Random,
    seconds: int,
    *,
    noise_m: float = 0.0,
    drift_m: float = 0.004,
    rate: int = 5,
) -> tuple[MovingMap, list[Msg]]:
    """Drives between waypoints and stands at each, while odometry drifts against the map.

    On each axis `noise_m` is the standard deviation of each pose of odometry, and `drift_m` that of
    what the map moves from one pose to the next; there are `rate` of these in a second.
    """
    truth, messages = MovingMap(), []
    x, y, heading, stands = 0.0, 0.0, 0.0, 30
    target = 1
    dx, dy, turn = 0.5, -0.3, 0.2
    messages.append(tf_of(BEGIN, "base_link", "cam", (0.2, 0, 0.5), topic="/tf_static"))
    stride = 0.4 / rate
    for step in range(seconds * rate):
        at = BEGIN + step * S // rate
        goal = _WAYPOINTS[target]
        if stands:
            stands -= 1
        elif math.dist((x, y), goal) < 0.1:
            stands, target = draw.randint(10, 60), draw.randrange(len(_WAYPOINTS))
        else:
            heading = math.atan2(goal[1] - y, goal[0] - x)
            x, y = x + stride * math.cos(heading), y + stride * math.sin(heading)
        dx, dy = dx + draw.gauss(0, drift_m), dy + draw.gauss(0, drift_m)
        turn += draw.gauss(0, drift_m / 2)
        if draw.random() < 0.003:
            dx += draw.uniform(-2, 2)
        truth.times.append(at)
        truth.places.append((x, y))
        # The robot's pose in odom: the correction taken off its pose in the map.
        cos, sin = math.cos(-turn), math.sin(-turn)
        ox = (x - dx) * cos - (y - dy) * sin
        oy = (x - dx) * sin + (y - dy) * cos
        if noise_m:
            ox, oy = draw.gauss(ox, noise_m), draw.gauss(oy, noise_m)
        messages.append(odom(at, ox, oy, heading - turn, vx=0.0 if stands else 0.4))
        base = transform(at, "odom", "base_link", (ox, oy, 0.0), heading - turn)
        messages.append(tf(at, base))
        ahead = at + round(0.3 * S)
        correction = transform(ahead, "map", "odom", (dx, dy, 0.0), turn)
        messages.append(tf(ahead, correction, log_time=at + 3 * MS))
        if step % rate == 0:
            messages.append(detections(at + MS, ["cup"], at=(1.0, 0.2, 0.1)))
    return truth, messages


def write_moving_map(
    bag_dir: Path, seed: int, *, seconds: int = 120, split_s: float = 10.0
) -> MovingMap:
    """Writes one recording in splits."""
    truth, files = _recorded(seed, seconds, split_s)
    (bag_dir / "rec").mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (bag_dir / "rec" / name).write_bytes(content)
    return truth


@cache
def _recorded(seed: int, seconds: int, split_s: float) -> tuple[MovingMap, dict[str, bytes]]:
    """What is true, and the content of each file: many tests ask about the same drive."""
    truth, messages = moving_map(Random(seed), seconds)
    return truth, {
        f"rec_{number}.mcap": mcap_content(some)
        for number, some in splits_of(messages, split_s).items()
    }
