"""Where the benchmark's robot is: rounds through the aisles of a store, for as long as it takes.

The aisles enclose two blocks of shelves of 16 m by 12 m, so `NOWHERE`, the middle of one, lies
inside the area that the robot covers and 6 m from every place it has been.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

NOWHERE: Final = (8.0, 6.0)
"""A place (m) that the robot never comes near."""

_ROUND: Final = ((0, 0), (16, 0), (16, 12), (32, 12), (32, 0), (16, 0), (16, 12), (0, 12), (0, 0))
_MEAN_SPEED: Final = 0.5
_STOP_AND_GO_S: Final = 20.0
_STOP_AND_GO: Final = 0.8
_TURN_M: Final = 0.25  # half of the way on which a corner is turned


class Motion(NamedTuple):
    """Poses (m, rad) and velocities (m/s, rad/s) at some moments, one array each."""

    x: Floats
    y: Floats
    yaw: Floats
    speed: Floats
    turning: Floats


def motion(t: Floats) -> Motion:
    """The robot's motion at the times `t` (s since its start); speeds lie in 0.1 to 0.9 m/s."""
    phase = 2.0 * math.pi * t / _STOP_AND_GO_S
    speed = _MEAN_SPEED * (1.0 - _STOP_AND_GO * np.cos(phase))
    wave = _STOP_AND_GO * _STOP_AND_GO_S / (2.0 * math.pi)
    driven = (_MEAN_SPEED * (t - wave * np.sin(phase))) % _LENGTH
    yaw = np.interp(driven, _YAW_AT, _YAW)
    ahead = np.interp(driven + 0.01, _YAW_AT, _YAW)
    return Motion(
        np.interp(driven, _CORNER_AT, _CORNERS[:, 0]),
        np.interp(driven, _CORNER_AT, _CORNERS[:, 1]),
        yaw,
        speed,
        (ahead - yaw) / 0.01 * speed,
    )


def _headings() -> tuple[Floats, Floats]:
    """Where along a round which yaw holds, unwrapped: constant in an aisle, even in a turn."""
    steps = np.diff(_CORNERS, axis=0)
    yaw = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    at = np.column_stack([_CORNER_AT[:-1] + _TURN_M, _CORNER_AT[1:] - _TURN_M])
    return at.ravel(), np.repeat(yaw, 2)


_CORNERS: Final = np.array(_ROUND, dtype=np.float64)
_CORNER_AT: Final = np.concatenate(
    [[0.0], np.cumsum(np.hypot(*np.diff(_CORNERS, axis=0).transpose()))]
)
_LENGTH: Final = float(_CORNER_AT[-1])
_YAW_AT, _YAW = _headings()
