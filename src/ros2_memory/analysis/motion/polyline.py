"""The drawn path of a robot: few vertices, no pose far from them, and no line across a jump.

It is drawn in space and time: where the robot turned back, or stopped, there is a vertex too.

Built vertex by vertex in bounded memory. Where a robot jumped (a localisation that was corrected, a
simulator that was reset) the path is split into pieces: both ends of the jump are kept, and nothing
is drawn between them.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.core.geometry import distance, simplify_to, simplifying
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.model import Vector3

Vertex: TypeAlias = "tuple[Ns, Vector3, float | None]"
"""A pose on a drawn path: log time (ns), place (m), and a number that is carried along.

Of most this is the heading (rad), if it is known.
"""

_BLOCK: Final = 4096
_MAX_VERTICES: Final = 20_000
_MAX_PIECES: Final = 1000
_STOP_NS: Final[Ns] = NS_PER_S
"""The end of a stop that is longer is a vertex too."""


class Drawn(NamedTuple):
    """The pieces of a path, none empty, and how far (m) any pose is from them at most."""

    pieces: list[list[Vertex]]
    error_m: float


class DrawnPath:
    """Draws a path with few vertices, and bounds how far any pose is from it.

    Simplifies a simplification: the deviations add up and do no more, since a vertex that the
    second drops is beside the same kept segment as its neighbours. A quarter of the tolerance goes
    to merging small steps, a quarter to the blocks, and the rest to the whole; paths that are
    drawn already have used some of it. Where too many vertices remain, the first two
    quarters are doubled.
    """

    def __init__(self, tolerance_m: float) -> None:
        self._tolerance_m = tolerance_m
        self._stage_m = tolerance_m / 4
        self._done: list[list[Vertex]] = []
        self._kept: list[Vertex] = []
        self._block: list[Vertex] = []
        self._merged: Vertex | None = None
        self._merged_m = 0.0
        self._dropped_m = 0.0
        self._given_m = 0.0

    @property
    def size(self) -> int:
        """How many vertices are held."""
        return sum(map(len, self._done)) + len(self._kept) + len(self._block)

    def add(self, vertex: Vertex) -> None:
        """Takes the next pose."""
        if self._block:
            off = distance(self._block[-1][1], vertex[1])
            if off <= self._stage_m:
                self._merged_m = max(self._merged_m, off)
                self._merged = vertex
                return
        if self._merged is not None and self._merged[0] - self._block[-1][0] > _STOP_NS:
            self._block.append(self._merged)  # where a stop ends
        self._merged = None
        self._block.append(vertex)
        if len(self._block) >= _BLOCK:
            self._block = self._close_block()[-1:]
            self._kept.pop()

    def part(self) -> None:
        """Ends a piece: the robot jumps from the last pose to the next one.

        Of a path in very many pieces the later jumps are drawn as if they were driven.
        """
        if not self._block or len(self._done) >= _MAX_PIECES:
            return
        self._close_block()
        if self._merged is not None:
            self._kept.append(self._merged)
        self._done.append(self._kept)
        self._kept, self._block, self._merged = [], [], None

    def extend(self, row: Iterable[Vertex], error_m: float) -> None:
        """Takes a path that is drawn already, from which poses are `error_m` off at most."""
        self._given_m = max(self._given_m, error_m)
        for vertex in row:
            self.add(vertex)

    def drawn(self, at_most: int) -> Drawn:
        """Returns the path with so many vertices at most; then only the longest jumps split it."""
        last = [*self._kept, *self._block]
        if self._merged is not None:
            last.append(self._merged)
        pieces = _joined([*self._done, last] if last else self._done, at_most)
        so_far = self._given_m + self._merged_m + self._dropped_m
        tolerance_m = max(self._tolerance_m - so_far, self._tolerance_m / 4)
        kept, error_m = _drawn(pieces, tolerance_m, at_most)
        return Drawn(kept, so_far + error_m)

    def _close_block(self) -> list[Vertex]:
        """Keeps the vertices that draw the block, and returns them."""
        kept, error = _thinned(self._block, self._stage_m, _BLOCK)
        self._dropped_m = max(self._dropped_m, error)
        self._kept += kept
        while self.size - len(self._block) > _MAX_VERTICES:
            self._thin_all()
        return kept

    def _thin_all(self) -> None:
        while self.size - len(self._block) > _MAX_VERTICES // 2:
            self._stage_m *= 2
            thinned = [
                _thinned(piece, self._stage_m, len(piece)) for piece in (*self._done, self._kept)
            ]
            *self._done, self._kept = (kept for kept, _ in thinned)
            self._dropped_m += max(error for _, error in thinned)


def _joined(pieces: Sequence[list[Vertex]], at_most: int) -> list[list[Vertex]]:
    """Joins pieces across the shortest jumps until two vertices for each are not too many."""
    jumps = [
        (distance(before[-1][1], after[0][1]), number)
        for number, (before, after) in enumerate(pairwise(pieces), 1)
    ]
    parted = {number for _, number in sorted(jumps, reverse=True)[: at_most // 2 - 1]}
    joined: list[list[Vertex]] = []
    for number, piece in enumerate(pieces):
        if number in parted or not joined:
            joined.append([*piece])
        else:
            joined[-1] += piece
    return joined


def _drawn(
    pieces: Sequence[list[Vertex]], tolerance_m: float, at_most: int
) -> tuple[list[list[Vertex]], float]:
    """Simplifies each piece; all to one tolerance, which is widened until they fit."""
    if len(pieces) == 1:
        kept, error = _thinned(pieces[0], tolerance_m, at_most)
        return [kept], error
    # One more than are allowed is enough to know that a tolerance is too narrow.
    steps = [_thinning(piece, tolerance_m, at_most + 1) for piece in pieces]
    while True:
        numbers = [_fewest(off, tolerance_m) for _, off in steps]
        chosen = [kept[:number] for (kept, _), number in zip(steps, numbers, strict=True)]
        if None not in numbers and sum(map(len, chosen)) <= at_most:
            thinned = [
                [piece[index] for index in sorted(kept)]
                for piece, kept in zip(pieces, chosen, strict=True)
            ]
            errors = (
                off[max(len(kept) - 2, 0)] for (_, off), kept in zip(steps, chosen, strict=True)
            )
            return thinned, max(errors, default=0.0)
        tolerance_m *= 1.5


def _fewest(off: Sequence[float], tolerance_m: float) -> int | None:
    """Returns how many vertices draw a piece within a tolerance; None where more are needed."""
    return next((nth for nth, each in enumerate(off, 2) if each <= tolerance_m), None)


def _thinned(
    vertices: list[Vertex], tolerance_m: float, at_most: int
) -> tuple[list[Vertex], float]:
    points = [vertex[1] for vertex in vertices]
    kept, error = simplify_to(points, tolerance_m, max(at_most, 2), _seconds(vertices))
    return [vertices[index] for index in kept], error


def _thinning(
    vertices: list[Vertex], tolerance_m: float, at_most: int
) -> tuple[list[int], list[float]]:
    points = [vertex[1] for vertex in vertices]
    return simplifying(points, tolerance_m, at_most, _seconds(vertices))


def _seconds(vertices: Sequence[Vertex]) -> list[float]:
    since = vertices[0][0] if vertices else 0
    return [unix_from_ns(vertex[0] - since) for vertex in vertices]
