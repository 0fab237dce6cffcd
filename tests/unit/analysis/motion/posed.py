"""Poses as arrays, and what is measured of them in slices of the clock."""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ros2_memory.analysis.motion.standstills import (
    BESIDE_NS,
    BLOCK_NS,
    SpeedDrop,
    Standstill,
    stands_of,
    standstills_of,
)
from ros2_memory.analysis.motion.trajectory import SLICE_NS, PathSlice, joined_slices, path_slice
from ros2_memory.analysis.poses import FrameCodes, Poses
from ros2_memory.core.model import Quaternion, Vector3


def posed(
    rows: Iterable[tuple[int, Vector3 | list[float]]], turns: Sequence[Quaternion] | None = None
) -> Poses:
    """Poses at log times (ns), with unit quaternions where given."""
    times, positions = zip(*rows, strict=True) if (rows := [*rows]) else ((), ())
    count = len(times)
    return Poses(
        np.array(times, np.int64),
        np.array(positions, np.float64).reshape(-1, 3),
        np.full((count, 4), math.nan) if turns is None else np.array(turns, np.float64),
        FrameCodes(np.zeros(count, np.uint32), ("odom",)),
        np.full(count, math.nan),
    )


def way_of(poses: Poses, fastest_mps: float, cuts: Sequence[int] | None = None) -> PathSlice:
    """The path of poses, measured in slices of the clock, or in parts cut at some poses."""
    if cuts is None:
        numbers = poses.times // SLICE_NS
        cuts = (np.flatnonzero(np.diff(numbers)) + 1).tolist()
    parts = pairwise(sorted({0, *cuts, len(poses)}))
    slices = [path_slice(poses.rows(np.arange(*part)), fastest_mps) for part in parts]
    return joined_slices(slices or [path_slice(poses, fastest_mps)], fastest_mps)


def stood_in(
    poses: Poses, *, blocks: int = SLICE_NS // BLOCK_NS
) -> tuple[tuple[Standstill, ...], list[SpeedDrop]]:
    """Standstills and sudden losses of speed, found in slices of so many blocks."""
    length = blocks * BLOCK_NS
    stands = [
        stands_of(
            poses.between(number * length - BESIDE_NS, (number + 1) * length + BESIDE_NS),
            number * length,
            (number + 1) * length,
        )
        for number in np.unique(poses.times // length).tolist()
    ]
    drops = [drop for stand in stands for drop in stand.drops]
    return standstills_of([each.blocks for each in stands]), drops


def off_line(
    path: NDArray[np.float64], points: NDArray[np.float64], begins: Iterable[int] = ()
) -> NDArray[np.float64]:
    """How far each point is from the nearest line of a path; none leads to what `begins` anew."""
    to = np.setdiff1d(np.arange(len(path)), [*begins])
    starts = path[np.maximum(to - 1, 0)]
    ways, offs = path[to] - starts, points[:, None] - starts
    shares = (offs * ways).sum(axis=2) / np.maximum((ways * ways).sum(axis=1), 1e-300)
    away = offs - shares.clip(0, 1)[..., None] * ways
    nearest: NDArray[np.float64] = np.linalg.norm(away, axis=2).min(axis=1)
    return nearest
