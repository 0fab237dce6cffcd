"""Where frames are in a target frame, at many times at once: tf2's rules over recorded transforms.

As in tf2 (`buffer_core.cpp`, `time_cache.cpp`, `static_cache.cpp` of ros2/geometry2):

- A child has one history, whatever its parents. At a message's own time that message is used;
  between two messages the transform is interpolated, unless they name different parents: then
  the earlier one is valid until the later. Of two messages for one time the later received is used.
- Nothing is extrapolated. tf2 forgets after 10 s, so it never interpolates across more; neither
  does this (`TF_CACHE_NS`).
- A leading slash of a frame name is dropped; a transform from a frame to itself or with an empty
  name is left out.

Different from tf2, because a memory holds more than one run of a robot: a static transform is valid
until the next one of its child, the first of them also before; a child that is published both ways
is dynamic wherever its dynamic messages reach, static elsewhere (tf2 keeps the kind received last);
and a time that went through a float of seconds is granted the slack of `timebase`.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import reduce
from itertools import takewhile
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.core.arrays import row_maxima, row_sums, stacked
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.geometry import multiply, rotate, slerp
from ros2_memory.core.model import StampedTransform, TimeWindow, Transform
from ros2_memory.core.text import listed, similar
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

Times: TypeAlias = "NDArray[np.int64]"
Floats: TypeAlias = "NDArray[np.float64]"
Mask: TypeAlias = "NDArray[np.bool_]"
Vectors: TypeAlias = "tuple[Floats, Floats, Floats]"
Rotations: TypeAlias = "tuple[Floats, Floats, Floats, Floats]"

TfClock: TypeAlias = Literal["stamp", "log"]
"""Which of a transform's two times is used: its header stamp, or when it was recorded."""

ClockOfTransforms: TypeAlias = Literal["auto", "stamp", "log"]
"""Which of the two is asked for; `auto`: as `agreeing_clock` finds."""

TF_CACHE_NS: Final = 10 * NS_PER_S
"""tf2's default buffer length: messages farther apart are never interpolated."""

AGREEMENT_NS: Final = 2 * NS_PER_S
"""How far stamps may be from log times and still be of the same clock.

Localisers date their transforms up to a second ahead (`transform_tolerance`); transports add some
tenths. Simulated and replayed clocks are off by far more.
"""

HOLD_NS: Final = 2 * NS_PER_S
"""How long tracks take a transform as valid beyond the times between which it is known.

Localisers date transforms up to a second ahead, and a robot's last second is no secret.
"""

_MAX_NAMES: Final = 12


class FramePoses(NamedTuple):
    """Poses of a frame in another at some times; numbers are only meaningful where `valid`."""

    translation: Vectors
    rotation: Rotations
    valid: Mask

    def points(self, points: Vectors) -> Vectors:
        """Returns points (m) of the frame, one for each time, in the other frame."""
        x, y, z = rotate(self.rotation, points)
        dx, dy, dz = self.translation
        return x + dx, y + dy, z + dz

    def at(self, nth: int | tuple[()] = ()) -> Transform:
        """Returns the pose at one of the times; of an array without dimensions at the only one."""
        x, y, z = (float(part[nth]) for part in self.translation)
        qx, qy, qz, qw = (float(part[nth]) for part in self.rotation)
        return Transform((x, y, z), (qx, qy, qz, qw))


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
        """Returns transforms, of which there is at least one, as arrays."""
        return cls(
            np.array([transform.stamp for transform in transforms], np.int64),
            np.array([transform.log_time for transform in transforms], np.int64),
            np.array([transform.transform.translation for transform in transforms], np.float64),
            np.array([transform.transform.rotation for transform in transforms], np.float64),
        )


Edges: TypeAlias = "Mapping[tuple[str, str], Edge]"
"""Transforms by parent and child, whose names have no leading slash."""


def edges_of(transforms: Iterable[StampedTransform]) -> dict[tuple[str, str], Edge]:
    """Returns transforms by their edges."""
    by_pair: dict[tuple[str, str], list[StampedTransform]] = defaultdict(list)
    for transform in transforms:
        by_pair[transform.parent.lstrip("/"), transform.child.lstrip("/")].append(transform)
    return {pair: Edge.of(transforms) for pair, transforms in by_pair.items() if is_edge(pair)}


def is_edge(pair: tuple[str, str]) -> bool:
    """Whether tf2 takes a parent and a child for an edge of the tree."""
    parent, child = (name.lstrip("/") for name in pair)
    return bool(parent and child) and parent != child


def joined_edges(parts: Sequence[Edges]) -> Edges:
    """Returns the transforms of several tables, each edge in the order of the tables."""
    by_pair: dict[tuple[str, str], list[Edge]] = defaultdict(list)
    for part in parts:
        for pair, edge in part.items():
            by_pair[pair].append(edge)
    return {pair: stacked(edges) for pair, edges in by_pair.items()}


class _History:
    """The transforms of one child: moving ones ascending, one for each time, then static ones.

    Args:
        child: its name.
        moving: by parent.
        static: in the order in which they were received.
        clock: which time of the moving ones counts.
        hold_ns: how long they are valid beyond the times between which they are known.
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
        # Of several for one time the last received counts.
        is_last = np.ones(count, np.bool_)
        is_last[:-1] = times[order[1:]] != times[order[:-1]]
        order = order[is_last]
        self._times = times[order]
        self._since = joined.log_times[count:] - AT_OR_BEFORE_SLACK_NS
        rows = np.concatenate((order, np.arange(count, len(joined.stamps))))
        self._translation = joined.translation[rows]
        self._rotation = joined.rotation[rows]
        self._parent = np.repeat([self.parents.index(name) for name in names], counts)[rows]

    def at(self, times: Times) -> FramePoses:
        """Returns the transforms at some times."""
        before, after, ratio, valid = self._bracket(times)
        x, y, z = self._translation[before].T
        to_x, to_y, to_z = self._translation[after].T
        moved = x + (to_x - x) * ratio, y + (to_y - y) * ratio, z + (to_z - z) * ratio
        qx, qy, qz, qw = self._rotation[before].T
        to_qx, to_qy, to_qz, to_qw = self._rotation[after].T
        turned = slerp((qx, qy, qz, qw), (to_qx, to_qy, to_qz, to_qw), ratio)
        return FramePoses(moved, turned, valid)

    def parents_at(self, times: Times) -> Times:
        """Returns which of the parents the child is in at some times, by their numbers."""
        return self._parent[self._bracket(times).before]

    def newest_parent(self) -> str:
        """Returns the parent where no time is given."""
        return self.parents[int(self._parent[len(self._times) - 1])]

    def nothing_at(self, time: Ns) -> NoDataError:
        """Returns why no transform is valid at a time: `OUTSIDE_RANGE` or `GAP`."""
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

    def _bracket(self, times: Times) -> _Bracket:
        count = len(self._times)
        # The first static transform holds before it was received, too.
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
    """The rows of a history between which each of some times lies; `ratio` 0 is at the former.

    Where nothing is interpolated, both are the row that counts. `valid`: whether one does.
    """

    before: Times
    after: Times
    ratio: Floats
    valid: Mask


class FrameTree:
    """Looks frames up in a target frame by the transforms of one session.

    Args:
        static: its static transforms in log-time order; each holds until the next one of its child.
        moving: the moving ones, in the times that are asked about and around these.
        target: the frame in which the others are looked up.
        clock: which time of the moving ones counts; `auto`: as `agreeing_clock` finds.
        hold_ns: how long a transform is valid beyond the times between which it is known.

    Attributes:
        target: the name of that frame.
        clock: which time counts, and which clock lookups are in.
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

    def reaches(self, frame: str) -> bool:
        """Returns whether transforms connect a frame with the target, at whatever time."""
        return frame.lstrip("/") in connected_with(self.target, self._pairs)

    def poses(self, frame: str, times: Times) -> FramePoses | None:
        """Returns the poses of a frame in the target at some times.

        Composed along the tree through their common ancestor, in either direction. None where no
        transform connects them at any time.
        """
        name = frame.lstrip("/")
        is_known = name == self.target or self.reaches(name)
        return self._compose(name, times) if is_known else None

    def carriers(self, frame: str, odometry: str) -> tuple[str, str] | None:
        """Returns what a frame is fixed to by static transforms, and the body that carries that.

        The body is the frame next to the world, which is the target, odometry, and what is above
        these. None of a frame of the world.
        """
        world = self._newest_chain(self.target)
        chain: list[str] = []
        for name in self._newest_chain(frame.lstrip("/")):
            is_odometry = name == odometry or name.rpartition("/")[2].startswith("odom")
            if name in world or is_odometry:
                break
            chain.append(name)
        if not chain:
            return None
        fixed = takewhile(lambda name: name not in self._moving, chain[:-1])
        return chain[sum(1 for _ in fixed)], chain[-1]

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
        # Of damaged bags, times may be centuries apart: they wrap, and are not near.
        with np.errstate(over="ignore"):
            pose = self._compose(name, np.array(time, np.int64))
            if not pose.valid:
                raise self._no_path_at(name, time)
        return pose.at()

    def _compose(self, name: str, times: Times) -> FramePoses:
        """Returns the poses by the chains of frames up to the common ancestor at each time."""
        up, down = self._chain(name, times), self._chain(self.target, times)
        common = next((frame for frame in up if frame in down), None)
        if common is not None:
            poses = self._pose_in_ancestor(common, up, times)
            if common == self.target:
                return poses
            return _product(_inverted(self._pose_in_ancestor(common, down, times)), poses)
        poses = _identity(times, valid=False)
        for rows in self._split_by_parent(times, (*up, *down)):
            part = self._compose(name, times[rows])
            for whole, part_column in zip(
                (*poses.translation, *poses.rotation, poses.valid),
                (*part.translation, *part.rotation, part.valid),
                strict=True,
            ):
                whole[rows] = part_column
        return poses

    def _chain(self, frame: str, times: Times) -> dict[str, None]:
        """Returns the frames from one upwards, as far as they are the same at some times."""
        chain = {frame: None}
        while len(parents := self._parents_at(frame, times)) == 1 and parents[0] not in chain:
            [frame] = parents
            chain[frame] = None
        return chain

    def _split_by_parent(self, times: Times, frames: Iterable[str]) -> list[Mask]:
        """Returns times apart in which the first frame that has several parents has one."""
        for frame in frames:
            if len(self._parents_at(frame, times)) > 1:
                numbers = self._histories[frame].parents_at(times)
                return [numbers == number for number in np.unique(numbers)]
        return []

    def _pose_in_ancestor(self, ancestor: str, chain: Iterable[str], times: Times) -> FramePoses:
        """Returns the pose of the first frame of a chain in one of the frames above it."""
        below = takewhile(lambda frame: frame != ancestor, chain)
        steps = [self._histories[frame].at(times) for frame in below]
        return reduce(_product, reversed(steps)) if steps else _identity(times)

    def _parents_at(self, child: str, times: Times) -> Sequence[str]:
        """Returns the parents that a frame has at some times; none, if it is a root."""
        history = self._history(child)
        if history is None:
            return ()
        if len(history.parents) == 1:
            return history.parents
        return [history.parents[number] for number in np.unique(history.parents_at(times))]

    def _history(self, child: str) -> _History | None:
        """Returns the transforms of a frame in those above it; None, if it is a root."""
        if child not in self._histories and (child in self._moving or child in self._static):
            moving, static = self._moving.get(child, {}), self._static.get(child, ())
            history = _History(child, moving, static, self.clock, self._hold_ns)
            self._histories[child] = history
        return self._histories.get(child)

    def _no_path_at(self, name: str, time: Ns) -> NoDataError:
        """Returns why there is no transform at a time, though both frames are known."""
        tree = connected_with(self.target, self._pairs)
        if name in tree:
            for frame, other in ((name, self.target), (self.target, name)):
                lacking = self._missing_link(frame, other, time)
                if lacking is not None:
                    return lacking
        # A root is, in a loop, the frame where it closes.
        pair = f"frames '{self.target}' and '{name}'"
        if name in tree:
            at = np.array(time, np.int64)
            target_root, root = ([*self._chain(frame, at)][-1] for frame in (self.target, name))
            detail = (
                f"{pair} were not connected at {_unix(time)}, because the tree changes or contains"
                f" a loop; then their roots were '{target_root}' and '{root}'; ask about another"
                " time"
            )
        else:
            target_root, root = ([*self._newest_chain(frame)][-1] for frame in (self.target, name))
            others = sorted(connected_with(name, self._pairs) - {name})
            detail = (
                f"{pair} are not connected: '{self.target}' is in the tree of '{target_root}',"
                f" '{name}' in that of '{root}', and no recorded transform joins them; connected"
                f" to '{name}': {listed(others, at_most=_MAX_NAMES)}"
            )
        return NoDataError(NoDataReason.FRAMES_NOT_CONNECTED, detail)

    def _missing_link(self, frame: str, other: str, time: Ns) -> NoDataError | None:
        """Returns why one frame's part of the way to another is broken at a time, if it is."""
        at = np.array(time, np.int64)
        beyond = self._chain(other, at)
        for above in takewhile(lambda name: name not in beyond, self._chain(frame, at)):
            history = self._history(above)
            if history is not None and not history.at(at).valid:
                return history.nothing_at(time)
        return None

    def _newest_chain(self, frame: str) -> dict[str, None]:
        """Returns the frames from one upwards to the newest known root, or once round a loop."""
        chain = {frame: None}
        while (history := self._history(frame)) is not None:
            frame = history.newest_parent()
            if frame in chain:
                break
            chain[frame] = None
        return chain


def agreeing_clock(moving: Edges) -> TfClock:
    """Returns `stamp` where header stamps of moving transforms agree with log time, else `log`.

    They agree when the median distance between the two is within `AGREEMENT_NS`. Without any:
    `stamp`.
    """
    if not moving:
        return "stamp"
    off = np.concatenate([np.abs(edge.log_times - edge.stamps) for edge in moving.values()])
    middle = (len(off) - 1) // 2
    return "stamp" if int(np.partition(off, middle)[middle]) <= AGREEMENT_NS else "log"


def connected_with(frame: str, pairs: Iterable[tuple[str, str]]) -> set[str]:
    """Returns the frames that pairs of a parent and a child lead to from one; itself, if any."""
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


def static_at(static: Iterable[StampedTransform], at: Ns) -> list[StampedTransform]:
    """Returns, of static transforms in log-time order, the newest of each child at a moment.

    A static transform holds at all times of its session. So where all of a child were received
    later, the first of them holds.
    """
    newest: dict[str, StampedTransform] = {}
    for transform in static:
        child = transform.child.lstrip("/")
        if child not in newest or transform.log_time <= at + AT_OR_BEFORE_SLACK_NS:
            newest[child] = transform
    return list(newest.values())


def static_in(static: Sequence[StampedTransform], window: TimeWindow) -> list[StampedTransform]:
    """Returns, of static transforms in log-time order, those that hold in a window."""
    received = (transform for transform in static if window.contains(transform.log_time))
    return [*static_at(static, window.start), *received]


def unit_quaternions(rotations: Floats) -> Floats:
    """Returns unit quaternions, N x 4; NaN where they are zero or not finite.

    Those that are of unit length within 1e-12 are left as they are.
    """
    with np.errstate(all="ignore"):
        is_unit = np.abs(row_sums(rotations * rotations) - 1) < 1e-12
        if is_unit.all():
            return rotations
        scaled = rotations / row_maxima(np.abs(rotations))[:, None]
        scaled /= np.sqrt(row_sums(scaled * scaled))[:, None]
        return np.where(is_unit[:, None], rotations, scaled)


def _identity(times: Times, *, valid: bool = True) -> FramePoses:
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
