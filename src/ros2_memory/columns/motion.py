"""How the slices of a robot's motion are stored as fragments."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final, Never, cast

import numpy as np

from ros2_memory.analysis.motion.odometry import Leg, MotionTotals, NearbyMotion, TimedPosition
from ros2_memory.analysis.motion.path_length import Creep, End
from ros2_memory.analysis.motion.speed_drops import SpeedDrop
from ros2_memory.analysis.motion.standstills import Blocks, Stands
from ros2_memory.analysis.motion.trajectory import Line, PathSlice
from ros2_memory.analysis.poses import Frames, Poses
from ros2_memory.columns.fragments import Fragment, Kind
from ros2_memory.core.arrays import stacked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import Vector3


def _path_fragment(path: PathSlice) -> Fragment:
    totals = [getattr(path.totals, field.name) for field in fields(path.totals)]
    numbers = [path.first, path.last, path.poses, path.invalid, path.step_mps, path.twist]
    words = None if path.few is None else path.few.frames.words
    head = json.dumps([numbers, path.error_m, totals, path.frames, words])
    arrays = {field.name: getattr(path.line, field.name) for field in fields(path.line)}
    if path.few is not None:
        few = {field.name: getattr(path.few, field.name) for field in fields(path.few)}
        few["frames"] = path.few.frames.codes
        arrays |= {f"few {name}": array for name, array in few.items()}
    return Fragment(head, arrays)


def _path_of(fragment: Fragment) -> PathSlice:
    numbers, error_m, totals, frames, words = json.loads(fragment.head)
    first, last, poses, invalid, step_mps, twist = numbers
    line = Line(
        fragment.integers("times"),
        fragment.floats("metres"),
        fragment.vectors("places"),
        fragment.floats("headings"),
        fragment.marks("jumps"),
    )
    few = None
    if words is not None:
        codes = fragment.integers("few frames").astype(np.uint32)
        few = Poses(
            fragment.integers("few times"),
            fragment.vectors("few positions"),
            fragment.vectors("few turns"),
            Frames(codes, tuple(words)),
            fragment.floats("few speeds"),
        )
    return PathSlice(
        first,
        last,
        poses,
        invalid,
        _totals_of(MotionTotals(*totals)),
        step_mps,
        twist,
        tuple(frames),
        line,
        error_m,
        few,
    )


def _totals_of(totals: MotionTotals) -> MotionTotals:
    """Returns the same totals, with tuples in place of JSON's lists."""
    head, tail = _leg_of(totals.head), _leg_of(totals.tail)
    return replace(totals, head=head, tail=tail, resets=tuple(totals.resets))


def _leg_of(stored: Leg | None) -> Leg | None:
    if stored is None:
        return None
    first, last, poses, period_ns, length_m, sum_m, head, tail, still, *near = stored
    return Leg(
        TimedPosition(first[0], _vector(first[1])),
        TimedPosition(last[0], _vector(last[1])),
        poses,
        period_ns,
        length_m,
        sum_m,
        _end_of(head),
        _end_of(tail),
        still,
        *(NearbyMotion(*motion) for motion in near),
    )


def _end_of(stored: End) -> End:
    pace_m, noise_m, plain, creep = stored
    if creep is not None:
        start, second, middle_m, end, reach_m = creep
        second = None if second is None else _vector(second)
        creep = Creep(_vector(start), second, middle_m, _vector(end), reach_m)
    return End(pace_m, noise_m, plain, creep)


def _vector(numbers: Vector3) -> Vector3:
    x, y, z = numbers
    return x, y, z


def _stands_fragment(stands: Stands) -> Fragment:
    arrays = {each.name: getattr(stands.blocks, each.name) for each in fields(stands.blocks)}
    return Fragment(json.dumps([stands.drops, stands.last]), arrays)


def _stands_of(fragment: Fragment) -> Stands:
    drops, last = json.loads(fragment.head)
    arrays = {each.name: fragment.arrays[each.name] for each in fields(Blocks)}
    # By name: each array has one type.
    blocks = Blocks(**cast("dict[str, Never]", arrays))
    return Stands(blocks, tuple(SpeedDrop(*drop) for drop in drops), last)


PATHS: Final = Kind("path", _path_fragment, _path_of)
"""The path of the poses of a topic in a slice of the clock."""


def _joined_stands(found: Sequence[Stands]) -> Sequence[Stands]:
    drops = tuple(drop for stands in found for drop in stands.drops)
    blocks = stacked([stands.blocks for stands in found])
    return [Stands(blocks, drops, max(stands.last for stands in found))]


STANDS: Final = Kind("stands", _stands_fragment, _stands_of, _joined_stands)
"""Where the robot may have stood in a slice of the clock, by the poses of a topic."""
