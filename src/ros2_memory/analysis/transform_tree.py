"""Looks up transforms between frames, with tf2's semantics over recorded transforms.

As in tf2 (`buffer_core.cpp`, `time_cache.cpp`, `static_cache.cpp` of ros2/geometry2):

- A child has one history, whatever its parents. At a message's own time that message is used;
  between two messages the transform is interpolated, unless they name different parents: then
  the earlier one is valid until the later. Of two messages for one time the later received is used.
- Nothing is extrapolated. tf2 forgets after 10 s, so it never interpolates across more; neither
  does this (`TF_CACHE_NS`).
- A static transform is valid at all times; of several for one child, the newest received is used.
- A leading slash of a frame name is dropped; a transform from a frame to itself, with an empty
  name or with a NaN is left out.

Different from tf2, because a memory holds more than one run of a robot: a child that is published
both ways is dynamic wherever its dynamic messages reach, static elsewhere (tf2 keeps the kind
received last); quaternions that are not of unit length are normalised rather than refused; and a
time that went through a float of seconds is granted the slack of `timebase`.
"""

from __future__ import annotations

import difflib
import math
import statistics
from bisect import bisect_right
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.geometry import (
    IDENTITY,
    compose,
    interpolate,
    invert,
    normalised,
)
from ros2_memory.core.model import StampedTransform, Transform
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    NS_PER_S,
    Ns,
    unix_from_ns,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

TfClock: TypeAlias = Literal["stamp", "log"]
"""Which of a transform's two times is used: its header stamp, or when it was recorded."""

TF_CACHE_NS: Final[Ns] = 10 * NS_PER_S
"""tf2's default buffer length: messages farther apart are never interpolated."""

AGREEMENT_NS: Final[Ns] = 2 * NS_PER_S
"""How far stamps may be from log times and still be of the same clock.

Localisers date their transforms up to a second ahead (`transform_tolerance`); transports add some
tenths. Simulated and replayed clocks are off by far more.
"""

_MAX_NAMES: Final = 12


@dataclass(frozen=True, slots=True)
class FrameEdge:
    """A parent and child pair; `static` where no dynamic message names the pair."""

    parent: str
    child: str
    static: bool


@dataclass(frozen=True, slots=True)
class _Edge:
    parent: str
    transform: Transform


@dataclass(slots=True)
class _History:
    """The transforms of one child: messages ascending in time, one for each time."""

    child: str
    times: list[Ns] = field(default_factory=list)
    edges: list[_Edge] = field(default_factory=list)
    static: _Edge | None = None

    def newest(self) -> _Edge | None:
        """Returns the edge that represents this child where no time is given."""
        return self.edges[-1] if self.edges else self.static

    def parents(self) -> set[str]:
        """Returns every parent this child ever had."""
        return {edge.parent for edge in (*self.edges, self.static) if edge is not None}

    def at(self, time: Ns) -> _Edge:
        """Returns the edge at a time.

        Raises:
            NoDataError: `OUTSIDE_RANGE` or `GAP`.
        """
        later = bisect_right(self.times, time)
        if later > 0 and self.times[later - 1] == time:
            return self.edges[later - 1]
        if 0 < later < len(self.times):
            start, stop = self.times[later - 1], self.times[later]
            if stop - start <= TF_CACHE_NS:
                return self._between(later, (time - start) / (stop - start))
        for index in (later - 1, later):
            if 0 <= index < len(self.times):
                off = abs(self.times[index] - time)
                if off <= AT_OR_BEFORE_SLACK_NS:
                    return self.edges[index]
        if self.static is not None:
            return self.static
        raise self._nothing_at(time, later)

    def _between(self, later: int, ratio: float) -> _Edge:
        before, after = self.edges[later - 1], self.edges[later]
        if before.parent != after.parent:
            return before
        return _Edge(before.parent, interpolate(before.transform, after.transform, ratio))

    def _nothing_at(self, time: Ns, later: int) -> NoDataError:
        first, last = self.times[0], self.times[-1]
        if 0 < later < len(self.times):
            before, after = self.times[later - 1], self.times[later]
            return NoDataError(
                NoDataReason.GAP,
                f"no transform of '{self.child}' in '{self.edges[later - 1].parent}' at"
                f" {_unix(time)}: the nearest are at {_unix(before)} ({_s(time - before)} before)"
                f" and {_unix(after)} ({_s(after - time)} after), and a gap longer than"
                f" {_s(TF_CACHE_NS)} is not interpolated; ask for one of these two times",
            )
        parent = self.edges[0 if time < first else -1].parent
        off = f"{_s(first - time)} after" if time < first else f"{_s(time - last)} before"
        span = f"only at {_unix(first)}" if first == last else f"{_unix(first)} to {_unix(last)}"
        return NoDataError(
            NoDataReason.OUTSIDE_RANGE,
            f"no transform of '{self.child}' in '{parent}' at {_unix(time)}: around then it is"
            f" recorded {span} (Unix seconds), {off} the time asked, and nothing is"
            " extrapolated; ask for a time in that range",
        )


class FrameGraph:
    """Looks up transforms between any two frames that the given transforms connect.

    Args:
        transforms: in any order.
        clock: which time of the transforms is used, and which clock lookups are in.
    """

    def __init__(self, transforms: Iterable[StampedTransform], clock: TfClock = "stamp") -> None:
        self.clock: TfClock = clock
        self._histories = self._histories_of(transforms)
        self._neighbours: defaultdict[str, set[str]] = defaultdict(set)
        for history in self._histories.values():
            for parent in history.parents():
                self._neighbours[parent].add(history.child)
                self._neighbours[history.child].add(parent)

    def names(self) -> list[str]:
        """Returns every frame, sorted."""
        return sorted(self._neighbours)

    def lookup(self, parent: str, child: str, time: Ns) -> Transform:
        """Returns the pose of `child` in `parent` at a time (tf2: target and source).

        Composed along the tree through their common ancestor, in either direction.

        Raises:
            NoDataError: `FRAME_UNKNOWN`, `FRAMES_NOT_CONNECTED`, `OUTSIDE_RANGE` or `GAP`.
        """
        target, source = _bare(parent), _bare(child)
        for name in (target, source):
            if name not in self._neighbours:
                raise self._unknown(name)
        source_in, source_end = self._walk(source, time)
        target_in, target_end = self._walk(target, time)
        for frame, pose in source_in.items():
            if frame in target_in:
                return compose(invert(target_in[frame]), pose)
        lack = source_end or target_end
        if lack is not None and source in self._tree_of(target):
            raise lack
        raise self._not_connected(target, source, time)

    def _histories_of(self, transforms: Iterable[StampedTransform]) -> dict[str, _History]:
        dynamic: defaultdict[str, list[tuple[Ns, Ns, int, _Edge]]] = defaultdict(list)
        static: dict[str, tuple[Ns, _Edge]] = {}
        for order, entry in enumerate(transforms):
            edge, child = _usable(entry), _bare(entry.child)
            if edge is None:
                continue
            if entry.static:
                if child not in static or static[child][0] <= entry.log_time:
                    static[child] = (entry.log_time, edge)
            else:
                time = entry.stamp if self.clock == "stamp" else entry.log_time
                dynamic[child].append((time, entry.log_time, order, edge))
        histories = {child: _History(child, static=edge) for child, (_, edge) in static.items()}
        for child, entries in dynamic.items():
            # Ascending, so that of several messages for one time the last received wins.
            newest = {time: edge for time, _, _, edge in sorted(entries, key=lambda e: e[:3])}
            history = histories.setdefault(child, _History(child))
            history.times, history.edges = list(newest), list(newest.values())
        return histories

    def _walk(self, frame: str, time: Ns) -> tuple[dict[str, Transform], NoDataError | None]:
        """Walks up to the root, the first edge without a transform at `time`, or into a loop.

        Returns the pose of the frame in each frame passed, itself first, and which transform is
        lacking, if that is why the walk ends.
        """
        poses = {frame: IDENTITY}
        while (history := self._histories.get(frame)) is not None:
            try:
                edge = history.at(time)
            except NoDataError as nothing:
                return poses, nothing
            if edge.parent in poses:
                break
            poses[edge.parent] = compose(edge.transform, poses[frame])
            frame = edge.parent
        return poses, None

    def _tree_of(self, frame: str) -> set[str]:
        """Returns every frame that some transform, at whatever time, connects to this one."""
        found, waiting = {frame}, [frame]
        while waiting:
            fresh = self._neighbours[waiting.pop()] - found
            found |= fresh
            waiting.extend(fresh)
        return found

    def _root_of(self, frame: str) -> str:
        """Returns the newest known root above a frame; in a loop, the frame where it closes."""
        seen: set[str] = set()
        while frame not in seen and (history := self._histories.get(frame)) is not None:
            seen.add(frame)
            newest = history.newest()
            frame = newest.parent if newest is not None else frame
        return frame

    def _unknown(self, name: str) -> NoDataError:
        known = self.names()
        if not known:
            detail = f"frame '{name}' is unknown: no transforms are recorded there"
        elif similar := _similar(name, known):
            detail = f"no transform names a frame '{name}'; similar: {listed(similar)}"
        else:
            names = listed(known, at_most=_MAX_NAMES)
            detail = f"no transform names a frame '{name}'; there are: {names}"
        return NoDataError(NoDataReason.FRAME_UNKNOWN, detail)

    def _not_connected(self, target: str, source: str, time: Ns) -> NoDataError:
        roots = self._root_of(target), self._root_of(source)
        tree = self._tree_of(target)
        if source not in tree:
            others = listed(sorted(self._tree_of(source) - {source}), at_most=_MAX_NAMES)
            detail = (
                f"frames '{target}' and '{source}' are not connected: '{target}' is in the"
                f" tree of '{roots[0]}', '{source}' in that of '{roots[1]}', and no recorded"
                f" transform joins them; connected to '{source}': {others}"
            )
        else:
            detail = (
                f"frames '{target}' and '{source}' were not connected at {_unix(time)}, because"
                f" the tree changes or contains a loop; the newest known roots are"
                f" '{roots[0]}' and '{roots[1]}'; ask about another time"
            )
        return NoDataError(NoDataReason.FRAMES_NOT_CONNECTED, detail)


def agreeing_clock(transforms: Iterable[StampedTransform]) -> TfClock:
    """Returns `stamp` where header stamps agree with log time, else `log`.

    They agree when the median distance between the two is within `AGREEMENT_NS`; only dynamic
    transforms count, since a static one is stamped once and is valid for ever. With none, `stamp`.
    """
    off = [abs(entry.log_time - entry.stamp) for entry in transforms if not entry.static]
    return "stamp" if not off or statistics.median_low(off) <= AGREEMENT_NS else "log"


def _usable(entry: StampedTransform) -> _Edge | None:
    """Returns the edge of a transform; None where tf2 would refuse it."""
    parent, rotation = _bare(entry.parent), normalised(entry.transform.rotation)
    x, y, z = entry.transform.translation
    if rotation is None or not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return None
    if not parent or parent == _bare(entry.child) or not _bare(entry.child):
        return None
    return _Edge(parent, Transform((x, y, z), rotation))


def _bare(name: str) -> str:
    return name.lstrip("/")


def _similar(name: str, known: Sequence[str]) -> list[str]:
    """Returns names that contain this one or are part of it, then those spelled alike."""
    asked = name.casefold()
    by_fold = {frame.casefold(): frame for frame in known}
    parts = [frame for fold, frame in by_fold.items() if asked and (asked in fold or fold in asked)]
    alike = difflib.get_close_matches(asked, list(by_fold), n=3, cutoff=0.6)
    return list(dict.fromkeys([*parts[:3], *(by_fold[fold] for fold in alike)]))[:3]


def _unix(moment: Ns) -> str:
    return f"{unix_from_ns(moment):.6f}"


def _s(duration: Ns) -> str:
    return f"{unix_from_ns(duration):.3f} s"
