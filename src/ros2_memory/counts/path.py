"""How far the robot drove in each bin of a window.

Whole bags count by the digests of their poses. Of a bag in which a bin ends, the length is shared
out by its drawn path, whose corners have times: the metres of all bins add up to those of the
window.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import TYPE_CHECKING

import numpy as np

from ros2_memory.analysis.bulk_decode import motion_decoder
from ros2_memory.analysis.motion.odometry import Motion, MotionTotals, TimedPosition
from ros2_memory.analysis.motion.trajectory import PoseCollector
from ros2_memory.core.geometry import distance
from ros2_memory.counts.bins import BinnedWindow
from ros2_memory.counts.segment_fold import SegmentFold
from ros2_memory.history.driven_path import POSES, add_poses
from ros2_memory.history.no_data import no_data_between, resolve_pose_topic, undecodable, with_notes
from ros2_memory.history.robots import require_one_robot
from ros2_memory.history.view import open_span

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ros2_memory.analysis.motion.odometry import PoseDigest
    from ros2_memory.core.errors import UndecodableError
    from ros2_memory.core.timebase import Ns
    from ros2_memory.counts.bins import By
    from ros2_memory.counts.segment_fold import Digested
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import TimeRange
    from ros2_memory.results import Bins


@dataclass(frozen=True, slots=True)
class _Driven:
    """What was driven from one time on: metres in the piece of that time and those that follow."""

    first: Ns
    metres: tuple[float, ...]
    totals: MotionTotals


def count_path(
    memory: Memory, call: Call, span: TimeRange, by: By, *, topic: str | None = None
) -> Bins:
    """Returns how many metres were driven in each bin of a window.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position, or there are too many
            bins.
        NoDataError: there are no poses in the window.
        QueryTimeoutError: the call's time runs out before any result.
    """
    view, asked = open_span(memory, call, span)
    name = resolve_pose_topic(view, topic)
    binned = BinnedWindow(view, asked, by, (name,))
    edges = binned.bins.edges[1:-1].tolist()
    fastest = memory.limits.max_plausible_speed_mps
    failures: list[UndecodableError] = []
    decoder = motion_decoder(memory.reader, memory.extractor)

    def collect(messages: Iterable[StoredMessage]) -> tuple[PoseDigest, Span | None]:
        collector = PoseCollector(fastest)
        found = add_poses(view, collector.add, decoder, messages, failures)
        return collector.digest(), found

    fold = SegmentFold(
        POSES,
        collect,
        lambda found: _driven(found, edges, fastest),
        name="driven",
        edges=edges,
        failures=failures,
    )
    folded = fold.over(view, name, binned.counted)
    if not folded.parts:
        if failures:
            raise with_notes(view, asked, undecodable(failures[0]))
        raise no_data_between(view, (name,), asked)
    if failures:
        view.notes.complete = False
        view.notes.add(
            f"poses left out, since they cannot be decoded: {len(failures)} ({failures[0].reason})"
        )
    binned.count_since(folded.since)
    metres = _joined(folded.parts, binned.bins.edges, fastest)
    totals = metres @ binned.bins.member
    binned.add("metres", "metres", totals.tolist(), float(metres.sum()))
    require_one_robot(view, name, asked)
    return binned.answer()


def _driven(
    found: Sequence[Digested[PoseDigest]], edges: Sequence[Ns], fastest_mps: float
) -> _Driven:
    """Joins the digests of poses, and shares out what each of them adds."""
    motion = Motion(fastest_mps)
    first = found[0].first
    inner = edges[bisect_right(edges, first) : bisect_right(edges, found[-1].last)]
    metres = [0.0] * (len(inner) + 1)
    before = 0.0
    for digest, _, last in found:
        if digest.totals.head is not None:
            motion.join(digest.totals)
        elif digest.vertices:
            motion.add([TimedPosition(each[0], each[1]) for each in digest.vertices])
        after = motion.totals.distance_m
        piece = bisect_right(inner, _first_time(digest, last))
        cuts = inner[piece : bisect_right(inner, last)]
        for at, share in enumerate(_shares(digest, cuts), piece):
            metres[min(at, len(metres) - 1)] += (after - before) * share
        before = after
    return _Driven(first, tuple(metres), motion.totals)


def _first_time(digest: PoseDigest, otherwise: Ns) -> Ns:
    """Returns the time of the first valid pose of a digest."""
    return digest.vertices[0][0] if digest.vertices else otherwise


def _shares(digest: PoseDigest, cuts: Sequence[Ns]) -> list[float]:
    """Returns which share of a drawn path lies before, between and after some times."""
    if not cuts or len(digest.vertices) < 2:
        return [1.0]
    steps = [distance(here[1], there[1]) for here, there in pairwise(digest.vertices)]
    # Nothing is driven to and from what parts two pieces of the path, which has no time either.
    is_vertex = [not math.isnan(position[0]) for _, position, _ in digest.vertices]
    along = np.concatenate(([0.0], np.cumsum(np.nan_to_num(steps))))[is_vertex]
    times = [each[0] for each in compress(digest.vertices, is_vertex)]
    if along[-1] <= 0:
        return [1.0]
    at = np.interp([each - times[0] for each in cuts], [each - times[0] for each in times], along)
    return [float(each) for each in np.diff(np.concatenate(([0.0], at, along[-1:]))) / along[-1]]


def _joined(
    parts: Sequence[_Driven], edges: NDArray[np.int64], fastest_mps: float
) -> NDArray[np.float64]:
    """Returns the metres of each piece; what a part adds besides its own is of its beginning."""
    metres = np.zeros(len(edges) - 1)
    motion = Motion(fastest_mps)
    before = 0.0
    for part in parts:
        motion.join(part.totals)
        after = motion.totals.distance_m
        piece = int(
            np.clip(np.searchsorted(edges, part.first, side="right") - 1, 0, len(metres) - 1)
        )
        own = np.array(part.metres[: len(metres) - piece])
        metres[piece : piece + len(own)] += own
        metres[piece] += after - before - own.sum()
        before = after
    return metres
