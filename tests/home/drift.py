"""The frames `map` and `odom`: how odometry drifts, and how the localiser corrects it.

`true` is where `odom` really lies in `map`; it moves with every metre driven, and jumps where the
wheels slip. `believed` is what the localiser publishes: the truth at its last correction, with a
small error of its own. After a slip it takes the localiser some seconds to notice.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.arrays import Floats
from tests.home.days import SLIP_M, Life, Scale
from tests.home.paths import Pose

_STEP_S = 1.0
_DRIFT_M = 0.006
_DRIFT_RAD = math.radians(0.3)
_ERROR_M = 0.012
_ERROR_RAD = math.radians(0.25)
_UPDATE_M = 0.25
_UPDATE_RAD = 0.2
NOTICED_S = 6.0
"""How long the localiser needs to notice a slip."""
AHEAD_S = 0.2
"""How far ahead the localiser dates its transforms."""


class Frame(NamedTuple):
    """A pose of `odom` in `map`."""

    x: float
    y: float
    yaw: float

    def turned(self, by: float, x: float, y: float) -> "Frame":
        """Returns the frame turned about a point of the map."""
        cos, sin = math.cos(by), math.sin(by)
        east, north = self.x - x, self.y - y
        return Frame(x + cos * east - sin * north, y + sin * east + cos * north, self.yaw + by)

    def shifted(self, x: float, y: float) -> "Frame":
        """Returns the frame moved by so many metres."""
        return Frame(self.x + x, self.y + y, self.yaw)


@dataclass(frozen=True)
class Drift:
    """Both frames, as steps: row n holds from `times[n]` to the next."""

    times: Floats
    true: NDArray[np.float64]
    believed: NDArray[np.float64]

    def at(self, t: Floats, *, believed: bool) -> Pose:
        """Returns the frame that was true, or believed in, at each moment."""
        rows = (self.believed if believed else self.true)[
            np.maximum(np.searchsorted(self.times, t, side="right") - 1, 0)
        ]
        return Pose(rows[:, 0], rows[:, 1], rows[:, 2])


def drift(scale: Scale, life: Life, moving: Sequence[tuple[float, float]]) -> Drift:
    """Returns how the frames drift; `moving`: the times in which the robot may move."""
    chance = scale.chance(3)
    grid = np.concatenate([np.arange(start, stop, _STEP_S) for start, stop in moving])
    slips = sorted(life.bumps)
    pose, gone = life.path.at(grid), life.path.driven(grid)
    start = life.path.at(np.array([-1.0]))
    true = believed = Frame(float(start.x[0]), float(start.y[0]), float(start.yaw[0]))
    rows, steps = [(-10.0, true, believed)], np.diff(gone, prepend=gone[0])
    done_at, done_yaw, blind_until, rebooted = 0.0, 0.0, -math.inf, False
    for nth, t in enumerate(grid.tolist()):
        x, y, yaw = float(pose.x[nth]), float(pose.y[nth]), float(pose.yaw[nth])
        if not rebooted and t >= life.power_cut[1] > 0.0:
            rebooted = True
            true = believed = Frame(x, y, yaw)
            rows.append((life.power_cut[1], true, believed))
        length = float(steps[nth])
        if 0.0 < length < 2.0:
            turn, east, north = (chance.normal(size=3) * math.sqrt(length)).tolist()
            true = true.turned(_DRIFT_RAD * turn, x, y)
            true = true.shifted(_DRIFT_M * east, _DRIFT_M * north)
        if slips and t >= slips[0]:
            way = float(chance.uniform(-math.pi, math.pi))
            true = true.shifted(SLIP_M * math.cos(way), SLIP_M * math.sin(way))
            blind_until = slips.pop(0) + NOTICED_S
        moved = abs(gone[nth] - done_at) >= _UPDATE_M or abs(yaw - done_yaw) >= _UPDATE_RAD
        if moved and t >= blind_until:
            turn, east, north = chance.normal(size=3).tolist()
            believed = true.turned(_ERROR_RAD * turn, x, y)
            believed = believed.shifted(_ERROR_M * east, _ERROR_M * north)
            done_at, done_yaw = float(gone[nth]), yaw
        if rows[-1][1:] != (true, believed):
            rows.append((t, true, believed))
    return Drift(*map(np.array, zip(*rows, strict=True)))
