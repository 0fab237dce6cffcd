"""The frames of a stretch of time: where each is in a target frame, at many times at once.

By the rules of `transform_tree`, over the transforms of one session as arrays. Where a frame has no
transform for longer than tf2 remembers, the last one before and the first one after are valid for
`HOLD_NS`: localisers date transforms up to a second ahead, and a robot's last second is no secret.

Chains whose frames keep one parent each, as nearly all do, are computed as arrays; any other is
looked up time by time.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.transform_tree import AGREEMENT_NS, TF_CACHE_NS, FrameGraph, TfClock
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.geometry import IDENTITY, alike, multiply, normalised
from ros2_memory.core.model import StampedTransform, Transform
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from typing import Literal

    from numpy.typing import NDArray

    from ros2_memory.core.model import Quaternion, Vector3

Times: TypeAlias = "NDArray[np.int64]"
Floats: TypeAlias = "NDArray[np.float64]"
Mask: TypeAlias = "NDArray[np.bool_]"
Vectors: TypeAlias = "tuple[Floats, Floats, Floats]"
Rotations: TypeAlias = "tuple[Floats, Floats, Floats, Floats]"

HOLD_NS: Final[Ns] = 2 * NS_PER_S
"""How long a transform of a frame is valid beyond the times between which it is known."""

_PARALLEL_COSINE: Final = 1 - 1e-10


class Poses(NamedTuple):
    """Poses of a frame in another at some times; numbers are only meaningful where `valid`."""

    translation: Vectors
    rotation: Rotations
    valid: Mask

    def points(self, points: Vectors) -> Vectors:
        """Returns points (m) of the frame, one for each time, in the other frame."""
        return _add(_rotate(self.rotation, points), self.translation)


@dataclass(frozen=True, slots=True)
class Edge:
    """Transforms of one child in one parent, in the order in which they were received.

    Attributes:
        stamps: of their headers (ns).
        log_times: ns.
        translation: metres, N x 3.
        rotation: unit quaternions (x, y, z, w), N x 4.
    """

    stamps: Times
    log_times: Times
    translation: Floats
    rotation: Floats

    @classmethod
    def of(cls, transforms: Sequence[StampedTransform]) -> Edge:
        """Returns transforms of one edge, of which there is at least one, as arrays."""
        return cls(
            np.array([each.stamp for each in transforms], np.int64),
            np.array([each.log_time for each in transforms], np.int64),
            np.array([each.transform.translation for each in transforms], np.float64),
            np.array([each.transform.rotation for each in transforms], np.float64),
        )


Edges: TypeAlias = "Mapping[tuple[str, str], Edge]"
"""Transforms by parent and child, whose names have no leading slash."""


def edges_of(transforms: Iterable[StampedTransform]) -> dict[tuple[str, str], Edge]:
    """Returns transforms by their edges."""
    found: dict[tuple[str, str], list[StampedTransform]] = defaultdict(list)
    for one in transforms:
        found[one.parent.lstrip("/"), one.child.lstrip("/")].append(one)
    return {pair: Edge.of(some) for pair, some in found.items() if all(pair) and pair[0] != pair[1]}


def joined_edges(parts: Sequence[Edges]) -> Edges:
    """Returns the transforms of several tables, each edge in the order of the tables."""
    if len(parts) == 1:
        return parts[0]
    found: dict[tuple[str, str], list[Edge]] = defaultdict(list)
    for part in parts:
        for pair, edge in part.items():
            found[pair].append(edge)
    return {
        pair: Edge(
            np.concatenate([one.stamps for one in some]),
            np.concatenate([one.log_times for one in some]),
            np.concatenate([one.translation for one in some]),
            np.concatenate([one.rotation for one in some]),
        )
        for pair, some in found.items()
    }


@dataclass(slots=True)
class _History:
    """The moving transforms of one child in its only parent, ascending, one for each time."""

    times: Times
    translation: Floats
    rotation: Floats
    static: Transform | None

    def at(self, times: Times) -> Poses:
        """Returns the transforms at some times, by tf2's rules and with `HOLD_NS` at the ends."""
        last = len(self.times) - 1
        after = np.searchsorted(self.times, times, side="right")
        before = np.clip(after - 1, 0, last)
        after = np.clip(after, 0, last)
        start, stop = self.times[before], self.times[after]
        span = np.maximum(stop - start, 1)
        ratio = np.where(start == stop, 0.0, (times - start) / span)
        exact = start == times
        inside = (after > before) & (stop - start <= TF_CACHE_NS)
        near = np.abs(times - start) <= np.abs(stop - times)
        held = np.minimum(np.abs(times - start), np.abs(stop - times)) <= HOLD_NS
        ratio = np.where(exact | ~inside, np.where(near | exact, 0.0, 1.0), ratio)
        a, b = self.translation[before], self.translation[after]
        moved = a + (b - a) * ratio[:, None]
        turned = _slerp(self.rotation[before], self.rotation[after], ratio)
        valid = exact | inside | held
        poses = Poses(_columns3(moved), _columns4(turned), valid)
        return poses if self.static is None else _filled(poses, self.static)


class Frames:
    """Looks frames up in a target frame by the transforms of one session.

    Args:
        static: its static transforms in log-time order; each holds until the next one of its child.
        moving: the moving ones, in the times that are asked about and around these.
        target: the frame in which the others are looked up.
        clock: which time of the transforms counts; None: as `agreeing_clock` finds.

    Attributes:
        target: the name of that frame.
        clock: which time counts.
    """

    def __init__(
        self,
        static: Sequence[StampedTransform],
        moving: Edges,
        target: str,
        clock: TfClock | None = None,
    ) -> None:
        self.target = target.lstrip("/")
        moving = {pair: edge for pair, edge in moving.items() if all(pair)}
        self.clock: TfClock = clock or _agreeing(moving.values())
        self._changes = static_changes(static)
        self._periods = [
            _Period(static_at(static, since), moving, self.target, self.clock)
            for since in (MIN_NS, *self._changes)
        ]

    def reaches(self, frame: str) -> bool:
        """Returns whether transforms connect a frame with the target, at whatever time."""
        return any(period.reaches(frame.lstrip("/")) for period in self._periods)

    def pose(self, frame: str, time: Ns) -> Transform | None:
        """Returns the pose of a frame in the target at one time; None where it is not known."""
        found = self.poses(frame, np.array([time], np.int64))
        if found is None or not found.valid[0]:
            return None
        x, y, z = (float(part[0]) for part in found.translation)
        qx, qy, qz, qw = (float(part[0]) for part in found.rotation)
        return Transform((x, y, z), (qx, qy, qz, qw))

    def poses(self, frame: str, times: Times) -> Poses | None:
        """Returns the poses of a frame in the target at some times.

        None where no transform connects them at any time.
        """
        name = frame.lstrip("/")
        if not self._changes:
            return self._periods[0].poses(name, times)
        found: Poses | None = None
        numbers = np.searchsorted(self._changes, times + AT_OR_BEFORE_SLACK_NS, side="right")
        for number in np.unique(numbers).tolist():
            then = np.flatnonzero(numbers == number)
            part = self._periods[number].poses(name, times[then])
            if part is None:
                continue
            if found is None:
                nowhere = _identity(len(times))
                found = Poses(nowhere.translation, nowhere.rotation, ~nowhere.valid)
            for whole, some in zip(
                (*found.translation, *found.rotation),
                (*part.translation, *part.rotation),
                strict=True,
            ):
                whole[then] = some
            found.valid[then] = part.valid
        return found


class _Period:
    """Frames while no static transform changes."""

    def __init__(
        self, static: Sequence[StampedTransform], moving: Edges, target: str, clock: TfClock
    ) -> None:
        self.target = target
        self._edges = moving
        self._clock = clock
        self._static = {
            each.child.lstrip("/"): each for each in static if normalised(each.transform.rotation)
        }
        self._parents: dict[str, set[str]] = defaultdict(set)
        for parent, child in self._edges:
            self._parents[child].add(parent)
        for child, each in self._static.items():
            self._parents[child].add(each.parent.lstrip("/"))
        self._histories: dict[str, _History | None] = {}
        self._graph: FrameGraph | None = None

    def reaches(self, frame: str) -> bool:
        """Returns whether transforms connect a frame with the target, at whatever time."""
        beside: dict[str, set[str]] = defaultdict(set)
        for child, parents in self._parents.items():
            for parent in parents:
                beside[child].add(parent)
                beside[parent].add(child)
        reached, waiting = {self.target}, [self.target]
        while waiting:
            fresh = beside[waiting.pop()] - reached
            reached |= fresh
            waiting += fresh
        return frame in reached

    def poses(self, name: str, times: Times) -> Poses | None:
        """Returns the poses of a frame at some times; None where nothing ever connects them."""
        if name == self.target:
            return _identity(len(times))
        if not self.reaches(name):
            return None
        up, down = self._chain(name), self._chain(self.target)
        if up is None or down is None:
            return self._one_by_one(name, times)
        common = next((each for each in up if each in set(down)), None)
        if common is None:
            return None
        source = self._along(up[: up.index(common)], times)
        target = self._along(down[: down.index(common)], times)
        return _compose(_invert(target), source)

    def _chain(self, frame: str) -> list[str] | None:
        """Returns the frames from one up to its root; None where a frame has several parents."""
        chain = [frame]
        while parents := self._parents.get(chain[-1]):
            [parent, *others] = parents
            if others or parent in chain:
                return None
            chain.append(parent)
        return chain

    def _along(self, chain: Sequence[str], times: Times) -> Poses:
        """Returns the pose of the first frame of a chain in the parent of its last."""
        poses = _identity(len(times))
        for child in chain:
            history = self._history(child)
            edge = _held(self._static[child].transform, len(times)) if history is None else None
            poses = _compose(history.at(times) if history else edge or poses, poses)
        return poses

    def _history(self, child: str) -> _History | None:
        """Returns the moving transforms of a child; None where it is only static."""
        if child not in self._histories:
            [parent] = self._parents[child]
            block = self._edges.get((parent, child))
            static = self._static.get(child)
            fixed = None if static is None else static.transform
            self._histories[child] = None if block is None else _history(block, self._clock, fixed)
        return self._histories[child]

    def _one_by_one(self, frame: str, times: Times) -> Poses:
        """Looks up each time by itself, as `transform_tree` does."""
        if self._graph is None:
            moving = [each for edge in self._edges.items() for each in _rows(*edge)]
            held = _with_held_ends(moving, self._clock)
            self._graph = FrameGraph([*self._static.values(), *held], self._clock)
        rows: list[tuple[float, ...]] = []
        valid: list[bool] = []
        for time in times.tolist():
            try:
                found = self._graph.lookup(self.target, frame, time)
            except NoDataError:
                found = None
            valid.append(found is not None)
            pose = IDENTITY if found is None else found
            rows.append((*pose.translation, *pose.rotation))
        table = np.array(rows, np.float64).reshape(len(rows), 7)
        return Poses(
            _columns3(table[:, :3]), _columns4(table[:, 3:]), np.array(valid, dtype=np.bool_)
        )


def _history(block: Edge, clock: TfClock, static: Transform | None) -> _History:
    times = block.stamps if clock == "stamp" else block.log_times
    order = np.lexsort((np.arange(len(times)), block.log_times, times))
    # Of several for one time the last received counts.
    ordered = times[order]
    last = np.append(ordered[1:] != ordered[:-1], [True])
    chosen = order[last]
    return _History(times[chosen], block.translation[chosen], block.rotation[chosen], static)


def _rows(edge: tuple[str, str], block: Edge) -> Iterable[StampedTransform]:
    """Yields the transforms of a block one by one."""
    columns = (block.stamps, block.log_times, block.translation, block.rotation)
    for stamp, log_time, (x, y, z), (qx, qy, qz, qw) in zip(
        *(each.tolist() for each in columns), strict=True
    ):
        yield StampedTransform(
            *edge, stamp, log_time, Transform((x, y, z), (qx, qy, qz, qw)), static=False
        )


def _with_held_ends(rows: Sequence[StampedTransform], clock: TfClock) -> list[StampedTransform]:
    """Returns transforms, those at each end and beside each gap repeated `HOLD_NS` beyond it."""
    by_child: dict[str, list[StampedTransform]] = defaultdict(list)
    for row in rows:
        by_child[row.child].append(row)
    time = attrgetter("stamp" if clock == "stamp" else "log_time")
    held: list[StampedTransform] = []
    for some in by_child.values():
        some.sort(key=time)
        ends = [(some[0], -HOLD_NS), (some[-1], HOLD_NS)]
        for before, after in pairwise(some):
            if time(after) - time(before) > TF_CACHE_NS:
                ends += [(before, HOLD_NS), (after, -HOLD_NS)]
        held += [
            replace(end, stamp=end.stamp + off, log_time=end.log_time + off) for end, off in ends
        ]
    return [*rows, *held]


def _agreeing(blocks: Iterable[Edge]) -> Literal["stamp", "log"]:
    """Returns the clock as `agreeing_clock` does."""
    off = [np.abs(block.log_times - block.stamps) for block in blocks]
    every = np.concatenate(off) if off else np.zeros(0, np.int64)
    if not len(every):
        return "stamp"
    middle = (len(every) - 1) // 2
    return "stamp" if int(np.partition(every, middle)[middle]) <= AGREEMENT_NS else "log"


def sorted_edges(edges: Edges) -> Edges:
    """Returns transforms by log time, as those of bags come in the order of these."""
    found: dict[tuple[str, str], Edge] = {}
    for pair, edge in edges.items():
        order = np.argsort(edge.log_times, kind="stable")
        found[pair] = Edge(
            edge.stamps[order],
            edge.log_times[order],
            edge.translation[order],
            edge.rotation[order],
        )
    return found


def static_at(static: Iterable[StampedTransform], at: Ns) -> list[StampedTransform]:
    """Returns, of static transforms in log-time order, the newest of each child at a moment.

    A static transform holds at all times of its session. So where all of a child were received
    later, the first of them holds.
    """
    newest: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        if child not in newest or each.log_time <= at + AT_OR_BEFORE_SLACK_NS:
            newest[child] = each
    return list(newest.values())


def static_changes(static: Sequence[StampedTransform]) -> list[Ns]:
    """Returns the log times at which a child's static transform differs from the one before."""
    changes: dict[Ns, None] = {}
    latest: dict[str, StampedTransform] = {}
    for each in static:
        child = each.child.lstrip("/")
        before = latest.get(child)
        if before is not None and not (
            before.parent.lstrip("/") == each.parent.lstrip("/")
            and alike(before.transform, each.transform)
        ):
            changes[each.log_time] = None
        latest[child] = each
    return [*changes]


def unit_quaternions(rotations: Floats) -> Floats:
    """Returns unit quaternions; those that are of unit length within 1e-12 are left as they are."""
    x, y, z, w = rotations.T
    off = np.abs(x * x + y * y + z * z + w * w - 1) >= 1e-12
    if not off.any():
        return rotations
    scaled = rotations[off] / np.abs(rotations[off]).max(axis=1)[:, None]
    x, y, z, w = scaled.T
    made = rotations.copy()
    made[off] = scaled / np.sqrt(x * x + y * y + z * z + w * w)[:, None]
    return made


def _slerp(a: Floats, b: Floats, ratio: Floats) -> Floats:
    cosine = (a * b).sum(axis=1)
    sign = np.where(cosine < 0, -1.0, 1.0)
    cosine = np.minimum(cosine * sign, 1.0)
    straight = cosine > _PARALLEL_COSINE
    angle = np.arccos(np.where(straight, 0.0, cosine))
    sine = np.where(straight, 1.0, np.sin(angle))
    from_a = np.where(straight, 1 - ratio, np.sin((1 - ratio) * angle) / sine)
    from_b = np.where(straight, ratio, np.sin(ratio * angle) / sine) * sign
    mixed = a * from_a[:, None] + b * from_b[:, None]
    made: Floats = mixed / np.sqrt((mixed * mixed).sum(axis=1))[:, None]
    return made


def _columns3(table: Floats) -> Vectors:
    return table[:, 0], table[:, 1], table[:, 2]


def _columns4(table: Floats) -> Rotations:
    return table[:, 0], table[:, 1], table[:, 2], table[:, 3]


def _identity(count: int) -> Poses:
    return _held(IDENTITY, count)


def _held(transform: Transform, count: int) -> Poses:
    """Returns one transform at all of some times."""
    vector: Vector3 = transform.translation
    turn: Quaternion = normalised(transform.rotation) or (0.0, 0.0, 0.0, 1.0)
    x, y, z = (np.full(count, each, np.float64) for each in vector)
    qx, qy, qz, qw = (np.full(count, each, np.float64) for each in turn)
    return Poses((x, y, z), (qx, qy, qz, qw), np.ones(count, np.bool_))


def _filled(poses: Poses, static: Transform) -> Poses:
    """Returns the poses with a static transform where they are not valid."""
    held = _held(static, len(poses.valid))
    x, y, z = (
        np.where(poses.valid, *pair)
        for pair in zip(poses.translation, held.translation, strict=True)
    )
    qx, qy, qz, qw = (
        np.where(poses.valid, *pair) for pair in zip(poses.rotation, held.rotation, strict=True)
    )
    return Poses((x, y, z), (qx, qy, qz, qw), held.valid)


def _rotate(q: Rotations, v: Vectors) -> Vectors:
    x, y, z, w = q
    vx, vy, vz = v
    cx, cy, cz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * cx + y * cz - z * cy,
        vy + w * cy + z * cx - x * cz,
        vz + w * cz + x * cy - y * cx,
    )


def _add(a: Vectors, b: Vectors) -> Vectors:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _compose(a: Poses, b: Poses) -> Poses:
    return Poses(a.points(b.translation), multiply(a.rotation, b.rotation), a.valid & b.valid)


def _invert(poses: Poses) -> Poses:
    x, y, z, w = poses.rotation
    back = (-x, -y, -z, w)
    tx, ty, tz = _rotate(back, poses.translation)
    return Poses((-tx, -ty, -tz), back, poses.valid)
