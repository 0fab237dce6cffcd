"""Where frames are in a target frame, at many times at once: tf2's rules over recorded transforms.

As in tf2 (`buffer_core.cpp`, `time_cache.cpp`, `static_cache.cpp` of ros2/geometry2):

- A child has one history, whatever its parents. At a message's own time that message is used;
  between two messages the transform is interpolated, unless they name different parents: then
  the earlier one is valid until the later. Of two messages for one time the later received is used.
- Nothing is extrapolated. tf2 forgets after 10 s, so it never interpolates across more; neither
  does this (`TF_CACHE_NS`).
- A leading slash of a frame name is dropped. A transform from a frame to itself, or with an empty
  name, is left out.

A memory holds more than one run of a robot, so some rules differ from tf2:

- A static transform is valid until the next one of its child. The first one is also valid before.
- A child that is published both ways is dynamic as far as its dynamic messages reach, and static
  elsewhere. (In tf2 the kind received last decides.)
- A time that went through a float of seconds is granted `AT_OR_BEFORE_SLACK_NS`.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import reduce
from itertools import takewhile
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import Flags, Ints, row_maxima, row_sums, stacked
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.geometry import multiply, rotate, slerp
from ros2_memory.core.model import StampedTransform, TimeWindow, Transform
from ros2_memory.core.text import listed, similar
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"
Vectors: TypeAlias = "tuple[Floats, Floats, Floats]"
Rotations: TypeAlias = "tuple[Floats, Floats, Floats, Floats]"

TfClock: TypeAlias = Literal["stamp", "log"]
"""The time of a transform: its header stamp, or its log time."""

ClockOfTransforms: TypeAlias = Literal["auto", "stamp", "log"]
"""The setting for `TfClock`; with `auto`, `agreeing_clock` decides."""

TF_CACHE_NS: Final = 10 * NS_PER_S
"""tf2's default buffer length: messages farther apart are never interpolated."""

AGREEMENT_NS: Final = 2 * NS_PER_S
"""How far stamps may be from log times and still be of the same clock.

Localisers date their transforms up to a second ahead (`transform_tolerance`); transports add some
tenths. Simulated and replayed clocks are off by far more.
"""

HOLD_NS: Final = 2 * NS_PER_S
"""How long a transform stays valid before the first and after the last message, for tracks.

Localisers date transforms up to a second ahead. So the robot's last second can be placed, too.
"""

_MAX_NAMES: Final = 12
"""How many frames an error lists."""


class FramePoses(NamedTuple):
    """Poses of a frame in another at some times (m, unit quaternions); only `valid` ones count."""

    translation: Vectors
    rotation: Rotations
    valid: Flags

    def points(self, points: Vectors) -> Vectors:
        """Returns points (m) of the frame, one for each time, in the other frame."""
        x, y, z = rotate(self.rotation, points)
        dx, dy, dz = self.translation
        return x + dx, y + dy, z + dz

    def at(self, nth: int | tuple[()] = ()) -> Transform:
        """Returns the pose at the nth time; at the only one, if the arrays have no dimensions."""
        x, y, z = (float(part[nth]) for part in self.translation)
        qx, qy, qz, qw = (float(part[nth]) for part in self.rotation)
        return Transform((x, y, z), (qx, qy, qz, qw))


@dataclass(frozen=True, slots=True)
class Edge:
    """Transforms of one child in one parent, in the order in which they were received.

    Attributes:
        stamps: header stamps (ns).
        log_times: log times (ns).
        translation: metres, N x 3.
        rotation: unit quaternions (x, y, z, w), N x 4.
    """

    stamps: Ints
    log_times: Ints
    translation: Floats
    rotation: Floats

    @classmethod
    def of(cls, transforms: Sequence[StampedTransform]) -> Edge:
        """Returns one or more transforms as arrays."""
        return cls(
            np.array([transform.stamp for transform in transforms], np.int64),
            np.array([transform.log_time for transform in transforms], np.int64),
            np.array([transform.transform.translation for transform in transforms], np.float64),
            np.array([transform.transform.rotation for transform in transforms], np.float64),
        )


Edges: TypeAlias = "Mapping[tuple[str, str], Edge]"
"""Transforms by parent and child, whose names have no leading slash."""


def edges_of(transforms: Iterable[StampedTransform]) -> dict[tuple[str, str], Edge]:
    """Returns transforms by parent and child."""
    by_pair: dict[tuple[str, str], list[StampedTransform]] = defaultdict(list)
    for transform in transforms:
        by_pair[transform.parent.lstrip("/"), transform.child.lstrip("/")].append(transform)
    return {pair: Edge.of(transforms) for pair, transforms in by_pair.items() if is_edge(pair)}


def is_edge(pair: tuple[str, str]) -> bool:
    """Returns whether tf2 accepts a transform between a parent and a child."""
    parent, child = (name.lstrip("/") for name in pair)
    return bool(parent and child) and parent != child


def is_odometry(frame: str) -> bool:
    """Whether a frame is one of odometry, by its name."""
    return frame.rpartition("/")[2].startswith("odom")


def joined_edges(parts: Sequence[Edges]) -> Edges:
    """Returns the transforms of several tables; those of one edge in the order of the tables."""
    by_pair: dict[tuple[str, str], list[Edge]] = defaultdict(list)
    for part in parts:
        for pair, edge in part.items():
            by_pair[pair].append(edge)
    return {pair: stacked(edges) for pair, edges in by_pair.items()}


class _History:
    """The transforms of one child, as rows of arrays.

    Moving transforms come first, in order of time, one for each time. Static ones follow.

    Args:
        child: the name of the child.
        moving: its moving transforms by parent.
        static: its static transforms, in the order in which they were received.
        clock: which time of moving transforms counts.
        hold_ns: how long a moving transform is valid before the first and after the last one.

    Attributes:
        parents: the names of all its parents.
    """

    def __init__(
        self,
        child: str,
        moving: Mapping[str, Edge],
        static: Sequence[StampedTransform],
        clock: TfClock,
        hold_ns: Ns,
    ) -> None:
        self._child = child
        self._hold_ns = hold_ns
        names = [*moving, *(transform.parent.lstrip("/") for transform in static)]
        counts = [*(len(edge.stamps) for edge in moving.values()), *(1 for _ in static)]
        self.parents = list(dict.fromkeys(names))
        joined = stacked([*moving.values(), *([Edge.of(static)] if static else [])])
        count = len(joined.stamps) - len(static)
        times = (joined.stamps if clock == "stamp" else joined.log_times)[:count]
        order = np.lexsort((joined.log_times[:count], times))
        # Of several transforms for one time, the one received last counts.
        is_last = np.ones(count, np.bool_)
        is_last[:-1] = times[order[1:]] != times[order[:-1]]
        order = order[is_last]
        self._times = times[order]
        self._since = joined.log_times[count:] - AT_OR_BEFORE_SLACK_NS
        rows = np.concatenate((order, np.arange(count, len(joined.stamps))))
        self._translation = joined.translation[rows]
        self._rotation = joined.rotation[rows]
        self._parent = np.repeat([self.parents.index(name) for name in names], counts)[rows]

    def at(self, times: Ints) -> FramePoses:
        """Returns the poses of the child in its parent at some times (ns)."""
        before, after, ratio, valid = self._bracket(times)
        x, y, z = self._translation[before].T
        to_x, to_y, to_z = self._translation[after].T
        moved = x + (to_x - x) * ratio, y + (to_y - y) * ratio, z + (to_z - z) * ratio
        qx, qy, qz, qw = self._rotation[before].T
        to_qx, to_qy, to_qz, to_qw = self._rotation[after].T
        turned = slerp((qx, qy, qz, qw), (to_qx, to_qy, to_qz, to_qw), ratio)
        return FramePoses(moved, turned, valid)

    def parents_at(self, times: Ints) -> Ints:
        """Returns the parent at some times (ns), as indices into `parents`."""
        return self._parent[self._bracket(times).before]

    def newest_parent(self) -> str:
        """Returns the parent in the newest moving transform, or else in the newest static one."""
        return self.parents[int(self._parent[len(self._times) - 1])]

    def lookup_error(self, time: Ns) -> NoDataError:
        """Returns the error for a time (ns) without a transform: `OUTSIDE_RANGE` or `GAP`."""
        later = int(self._times.searchsorted(time, "right"))
        nearest = min(max(later - 1, 0), len(self._times) - 1)
        parent, times = self.parents[self._parent[nearest]], self._times.tolist()
        if 0 < later < len(times):
            before, after = times[later - 1], times[later]
            return NoDataError(
                NoDataReason.GAP,
                f"no transform of '{self._child}' in '{parent}' at {_unix(time)}: the nearest are"
                f" at {_unix(before)} ({_s(time - before)} before) and {_unix(after)}"
                f" ({_s(after - time)} after), and a gap longer than {_s(TF_CACHE_NS)} is not"
                " interpolated; ask for one of these two times",
            )
        first, last = times[0], times[-1]
        off = f"{_s(first - time)} after" if time < first else f"{_s(time - last)} before"
        span = f"only at {_unix(first)}" if first == last else f"{_unix(first)} to {_unix(last)}"
        return NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            f"no transform of '{self._child}' in '{parent}' at {_unix(time)}: around then it is"
            f" recorded {span} (Unix seconds), {off} the time asked, and nothing is"
            " extrapolated; ask for a time in that range",
        )

    def _bracket(self, times: Ints) -> _Bracket:
        """Returns the rows between which the child is interpolated at some times (ns)."""
        count = len(self._times)
        # The first static transform is valid before it was received, too.
        static = count - 1 + np.maximum(self._since.searchsorted(times, "right"), 1)
        if not count:
            return _Bracket(static, static, 0.0 * static, static >= 0)
        after = self._times.searchsorted(times, "right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, count - 1)
        start, stop = self._times[before], self._times[after]
        since, until = abs(times - start), abs(stop - times)
        is_between = (after > before) & (stop - start <= TF_CACHE_NS)
        valid = is_between | (np.minimum(since, until) <= self._hold_ns)
        nearest = np.where(is_between | (since <= until), before, after)
        is_mixed = is_between & (since > 0) & (self._parent[before] == self._parent[after])
        ratio = is_mixed * since / np.maximum(stop - start, 1)
        if len(self._since):
            nearest, valid = np.where(valid, nearest, static), static >= 0
        return _Bracket(nearest, np.where(is_mixed, after, nearest), ratio, valid)


class _Bracket(NamedTuple):
    """How the transform of a child follows from the rows of its history, at each of some times.

    Attributes:
        before: the row before; if nothing is interpolated, the row whose transform is valid.
        after: the row after; if nothing is interpolated, the same as `before`.
        ratio: 0 at the row before, 1 at the row after.
        valid: whether a transform is valid.
    """

    before: Ints
    after: Ints
    ratio: Floats
    valid: Flags


class FrameTree:
    """Looks frames up in a target frame by the transforms of one session.

    Args:
        static: the static transforms in log-time order; each holds until the next of its child.
        moving: the moving transforms around the times that are looked up.
        target: the frame in which the others are looked up.
        clock: which time of moving transforms counts; with `auto`, `agreeing_clock` decides.
        hold_ns: how long a moving transform is valid before the first and after the last one.

    Attributes:
        target: the name of the target frame.
        clock: the clock of transforms, and so of the times that are looked up.
    """

    def __init__(
        self,
        static: Iterable[StampedTransform],
        moving: Edges,
        target: str,
        clock: ClockOfTransforms = "auto",
        hold_ns: Ns = HOLD_NS,
    ) -> None:
        self.target = target.lstrip("/")
        self.clock: TfClock = agreeing_clock(moving) if clock == "auto" else clock
        self._hold_ns = hold_ns
        self._moving: defaultdict[str, dict[str, Edge]] = defaultdict(dict)
        self._static: defaultdict[str, list[StampedTransform]] = defaultdict(list)
        self._pairs = dict.fromkeys(filter(is_edge, moving))
        for parent, child in self._pairs:
            self._moving[child][parent] = moving[parent, child]
        for transform in static:
            parent, child = transform.parent.lstrip("/"), transform.child.lstrip("/")
            if is_edge((parent, child)):
                self._static[child].append(transform)
                self._pairs[parent, child] = None
        self._histories: dict[str, _History] = {}

    @property
    def late_ns(self) -> Ns:
        """The median time from the stamps of moving transforms to their log times (ns)."""
        edges = [edge for parents in self._moving.values() for edge in parents.values()]
        late = [edge.log_times - edge.stamps for edge in edges]
        return int(np.median(np.concatenate(late))) if late else 0

    def reaches(self, frame: str) -> bool:
        """Returns whether transforms connect a frame with the target at some time."""
        return frame.lstrip("/") in connected_with(self.target, self._pairs)

    def poses(self, frame: str, times: Ints) -> FramePoses | None:
        """Returns the poses of a frame in the target at some times (ns).

        They are composed along the tree, up and down, through the common ancestor. None if no
        transforms connect the two frames at any time.
        """
        name = frame.lstrip("/")
        is_known = name == self.target or self.reaches(name)
        return self._compose(name, times) if is_known else None

    def carriers(self, frame: str, odometry: str) -> tuple[str, str] | None:
        """Returns the frame that carries a frame by static transforms, and the robot's body.

        The body is the last frame on the way up to the world: the target, odometry, and all frames
        above them. None if the frame is one of the world.
        """
        world = self._newest_chain(self.target)
        chain: list[str] = []
        for name in self._newest_chain(frame.lstrip("/")):
            if name in world or name == odometry or is_odometry(name):
                break
            chain.append(name)
        if not chain:
            return None
        body = chain[-1]
        carrier = next((name for name in chain if name in self._moving), body)
        return carrier, body

    def lookup(self, frame: str, time: Ns) -> Transform:
        """Returns the pose of a frame in the target at one time (tf2: source and target).

        Raises:
            NoDataError: `FRAME_UNKNOWN`, `FRAMES_NOT_CONNECTED`, `OUTSIDE_RANGE` or `GAP`.
        """
        name = frame.lstrip("/")
        frames = {name for pair in self._pairs for name in pair}
        for named in (self.target, name):
            if named not in frames:
                raise _unknown_frame(named, sorted(frames))
        # In damaged bags times may be centuries apart: differences wrap around, and are not small.
        with np.errstate(over="ignore"):
            pose = self._compose(name, np.array(time, np.int64))
            if not pose.valid:
                raise self._no_path_at(name, time)
        return pose.at()

    def _compose(self, name: str, times: Ints) -> FramePoses:
        """Returns the poses of a frame in the target, through the common ancestor at each time.

        If the tree changes during the times, they are split until it does not.
        """
        up, down = self._chain(name, times), self._chain(self.target, times)
        common = next((frame for frame in up if frame in down), None)
        if common is not None:
            poses = self._pose_in_ancestor(common, up, times)
            if common == self.target:
                return poses
            return _product(_inverted(self._pose_in_ancestor(common, down, times)), poses)
        whole = _identity(times, valid=False)
        for rows in self._split_by_parent(times, (*up, *down)):
            part = self._compose(name, times[rows])
            whole.valid[rows] = part.valid
            for axis, part_axis in zip(whole.translation, part.translation, strict=True):
                axis[rows] = part_axis
            for axis, part_axis in zip(whole.rotation, part.rotation, strict=True):
                axis[rows] = part_axis
        return whole

    def _chain(self, frame: str, times: Ints) -> dict[str, None]:
        """Returns a frame and its ancestors, as far up as they are the same at all times."""
        chain = {frame: None}
        parents = self._parents_at(frame, times)
        while len(parents) == 1 and parents[0] not in chain:
            chain[parents[0]] = None
            parents = self._parents_at(parents[0], times)
        return chain

    def _split_by_parent(self, times: Ints, frames: Iterable[str]) -> list[Flags]:
        """Splits times so that the first frame with several parents has one parent in each mask.

        Empty if no frame has several.
        """
        for frame in frames:
            if len(self._parents_at(frame, times)) > 1:
                numbers = self._histories[frame].parents_at(times)
                return [numbers == number for number in np.unique(numbers)]
        return []

    def _pose_in_ancestor(self, ancestor: str, chain: Iterable[str], times: Ints) -> FramePoses:
        """Returns the poses of the first frame of a chain in one of its ancestors."""
        below = takewhile(lambda frame: frame != ancestor, chain)
        steps = [self._histories[frame].at(times) for frame in below]
        return reduce(_product, reversed(steps)) if steps else _identity(times)

    def _parents_at(self, child: str, times: Ints) -> Sequence[str]:
        """Returns all parents that a frame has at some times; none, if it is a root."""
        history = self._history(child)
        if history is None:
            return ()
        if len(history.parents) == 1:
            return history.parents
        return [history.parents[number] for number in np.unique(history.parents_at(times))]

    def _history(self, child: str) -> _History | None:
        """Returns the transforms of a frame in its parents; None, if it is a root."""
        if child not in self._histories and (child in self._moving or child in self._static):
            moving, static = self._moving.get(child, {}), self._static.get(child, ())
            history = _History(child, moving, static, self.clock, self._hold_ns)
            self._histories[child] = history
        return self._histories.get(child)

    def _no_path_at(self, name: str, time: Ns) -> NoDataError:
        """Returns the error for two known frames without a transform between them at a time."""
        if not self.reaches(name):
            return self._never_connected(name)
        link_error = self._link_error(name, self.target, time)
        link_error = link_error or self._link_error(self.target, name, time)
        if link_error is not None:
            return link_error
        at = np.array(time, np.int64)
        target_root, root = (self._root_at(frame, at) for frame in (self.target, name))
        return NoDataError(
            NoDataReason.FRAMES_NOT_CONNECTED,
            f"frames '{self.target}' and '{name}' were not connected at {_unix(time)}, because "
            f"{self._frame_in_both({target_root, root}, at)}; then their roots were "
            f"'{target_root}' and '{root}'; ask about another time",
        )

    def _root_at(self, frame: str, at: Ints) -> str:
        """Returns the last frame of a chain; in a loop, the one before the loop closes."""
        return [*self._chain(frame, at)][-1]

    def _frame_in_both(self, roots: set[str], at: Ints) -> str:
        """Returns which frame has parents in the trees of all roots around then, if one has."""
        for frame in sorted(self._moving):
            history = self._history(frame)
            parents = [] if history is None else sorted(history.parents)
            if len(parents) > 1 and roots <= {self._root_at(parent, at) for parent in parents}:
                named = listed([f"'{parent}'" for parent in parents])
                return f"'{frame}' has the parents {named} around then, as where two nodes place it"
        return "the tree changes or contains a loop"

    def _never_connected(self, name: str) -> NoDataError:
        """Returns the error for two known frames that are in different trees at all times."""
        target_root, root = ([*self._newest_chain(frame)][-1] for frame in (self.target, name))
        others = sorted(connected_with(name, self._pairs) - {name})
        return NoDataError(
            NoDataReason.FRAMES_NOT_CONNECTED,
            f"frames '{self.target}' and '{name}' are not connected: '{self.target}' is in the tree"
            f" of '{target_root}', '{name}' in that of '{root}', and no recorded transform joins"
            f" them; connected to '{name}': {listed(others, at_most=_MAX_NAMES)}",
        )

    def _link_error(self, frame: str, other: str, time: Ns) -> NoDataError | None:
        """Returns the error of the first link that has no transform at a time, if there is one.

        Links are looked at from a frame up to the first ancestor of the other one.
        """
        at = np.array(time, np.int64)
        ancestors = self._chain(other, at)
        for below in takewhile(lambda name: name not in ancestors, self._chain(frame, at)):
            history = self._history(below)
            if history is not None and not history.at(at).valid:
                return history.lookup_error(time)
        return None

    def _newest_chain(self, frame: str) -> dict[str, None]:
        """Returns a frame and its ancestors by its newest transforms; a loop is walked once."""
        chain = {frame: None}
        while (history := self._history(frame)) is not None:
            frame = history.newest_parent()
            if frame in chain:
                break
            chain[frame] = None
        return chain


def agreeing_clock(moving: Edges) -> TfClock:
    """Returns `stamp` if header stamps of moving transforms agree with log time, else `log`.

    They agree if the median of their distances is at most `AGREEMENT_NS`, or if there are none.
    """
    if not moving:
        return "stamp"
    off = np.concatenate([np.abs(edge.log_times - edge.stamps) for edge in moving.values()])
    middle = (len(off) - 1) // 2
    return "stamp" if int(np.partition(off, middle)[middle]) <= AGREEMENT_NS else "log"


def connected_with(frame: str, pairs: Iterable[tuple[str, str]]) -> set[str]:
    """Returns all frames of the tree that a frame is in; empty if no pair has the frame.

    `pairs` are the parent and the child of each edge.
    """
    beside: defaultdict[str, set[str]] = defaultdict(set)
    for parent, child in pairs:
        beside[parent].add(child)
        beside[child].add(parent)
    frames: set[str] = set()
    waiting = [frame]
    while waiting:
        fresh = beside[waiting.pop()] - frames
        frames |= fresh
        waiting += fresh
    return frames


def without_repeats(static: Iterable[StampedTransform]) -> list[StampedTransform]:
    """Returns transforms by log time, without those that repeat the one before of their child."""
    latest: dict[str, StampedTransform] = {}
    changes: list[StampedTransform] = []
    for transform in sorted(static, key=lambda transform: transform.log_time):
        child = transform.child.lstrip("/")
        last = latest.get(child)
        if last is None or (last.parent, last.transform) != (transform.parent, transform.transform):
            latest[child] = transform
            changes.append(transform)
    return changes


def static_at(static: Iterable[StampedTransform], at: Ns) -> list[StampedTransform]:
    """Returns the static transform of each child that is valid at a log time.

    It is the newest one received by then; if all were received later, the first one. `static` is in
    log-time order.
    """
    newest: dict[str, StampedTransform] = {}
    for transform in static:
        child = transform.child.lstrip("/")
        if child not in newest or transform.log_time <= at + AT_OR_BEFORE_SLACK_NS:
            newest[child] = transform
    return list(newest.values())


def static_in(static: Sequence[StampedTransform], window: TimeWindow) -> list[StampedTransform]:
    """Returns the static transforms that are valid in a window; `static` is in log-time order."""
    received = (transform for transform in static if window.contains(transform.log_time))
    return [*static_at(static, window.start), *received]


def unit_quaternions(rotations: Floats) -> Floats:
    """Returns rotations scaled to unit quaternions, N x 4; NaN if they are zero or not finite.

    Rotations whose squared length is within 1e-12 of 1 are left as they are.
    """
    with np.errstate(all="ignore"):
        is_unit = np.abs(row_sums(rotations * rotations) - 1) < 1e-12
        if is_unit.all():
            return rotations
        scaled = rotations / row_maxima(np.abs(rotations))[:, None]
        scaled /= np.sqrt(row_sums(scaled * scaled))[:, None]
        return np.where(is_unit[:, None], rotations, scaled)


def _identity(times: Ints, *, valid: bool = True) -> FramePoses:
    x, y, z, qx, qy, qz = np.zeros((6, *times.shape))
    return FramePoses((x, y, z), (qx, qy, qz, np.ones(times.shape)), np.full(times.shape, valid))


def _product(a: FramePoses, b: FramePoses) -> FramePoses:
    return FramePoses(a.points(b.translation), multiply(a.rotation, b.rotation), a.valid & b.valid)


def _inverted(poses: FramePoses) -> FramePoses:
    x, y, z, w = poses.rotation
    back = (-x, -y, -z, w)
    tx, ty, tz = rotate(back, poses.translation)
    return FramePoses((-tx, -ty, -tz), back, poses.valid)


def _unknown_frame(name: str, frames: Sequence[str]) -> NoDataError:
    if not frames:
        detail = f"frame '{name}' is unknown: no transforms are recorded there"
    elif near := similar(name, frames):
        detail = f"no transform names a frame '{name}'; similar: {listed(near)}"
    else:
        names = listed(frames, at_most=_MAX_NAMES)
        detail = f"no transform names a frame '{name}'; there are: {names}"
    return NoDataError(NoDataReason.FRAME_UNKNOWN, detail)


def _unix(moment: Ns) -> str:
    return f"{unix_from_ns(moment):.6f}"


def _s(duration: Ns) -> str:
    return f"{unix_from_ns(duration):.3f} s"
