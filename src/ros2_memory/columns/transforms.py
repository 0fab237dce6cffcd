"""Reads transforms from the columns of a table, as `SchemaExtractor.transforms` from a message."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.frames import Edge, Edges, Floats, unit_quaternions
from ros2_memory.columns.fragments import FragmentKind
from ros2_memory.columns.pack import METRES, QUATERNION, Step
from ros2_memory.columns.table import Elements, Table, Texts
from ros2_memory.core.arrays import concatenated, distinct_rows
from ros2_memory.core.model import StampedTransform, Transform

if TYPE_CHECKING:
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray, Mask

Pair = tuple[str, str]

_LIST: Final = "transforms"
_PARENT: Final = "header.frame_id"
_CHILD: Final = "child_frame_id"
_STAMP: Final = "header.stamp"
_TRANSLATION: Final = tuple(f"transform.translation.{axis}" for axis in "xyz")
_ROTATION: Final = tuple(f"transform.rotation.{part}" for part in "xyzw")


def edges_in(rows: Rows) -> Edges | None:
    """Returns the transforms in rows; None if their messages have to be read.

    Numbers are rounded as the store rounds them, so that a part and a bag have the same ones.
    """
    transforms = _transforms_of(rows.table)
    if transforms is None:
        return None
    read = partial(_edges_of, transforms, rows)
    return rows.table.remember("edges", read, _bytes_of) if rows.index is None else read()


def _edges_of(transforms: Elements, rows: Rows) -> Edges:
    if rows.index is not None:
        transforms = transforms.rows(rows.index)
    pairs, codes = _coded_pairs(transforms)
    translation = _rounded_rows(transforms, _TRANSLATION, METRES)
    rotation = _rounded_rows(transforms, _ROTATION, QUATERNION)
    stamps = np.asarray(transforms.columns[_STAMP], np.int64)
    # tf2 refuses what is not finite, and rotations that are not unit quaternions.
    is_valid = (codes >= 0) & np.isfinite(translation).all(axis=1)
    is_valid &= np.isfinite(rotation).all(axis=1) & (rotation != 0).any(axis=1)
    log_times = rows.times[transforms.owners]
    edges: dict[Pair, Edge] = {}
    for nth, pair in enumerate(pairs):
        of_pair = np.flatnonzero(is_valid & (codes == nth))
        if of_pair.size:
            turned = unit_quaternions(rotation[of_pair])
            edges[pair] = Edge(stamps[of_pair], log_times[of_pair], translation[of_pair], turned)
    return edges


def _bytes_of(edges: Edges) -> int:
    return 1000 + sum(500 + 72 * edge.stamps.size for edge in edges.values())


def pairs_in(rows: Rows) -> frozenset[Pair] | None:
    """Returns the parents and children of the valid transforms in rows.

    Returns None if the messages have to be read.
    """
    transforms = _transforms_of(rows.table)
    if transforms is None:
        return None
    if rows.index is None and _has_finite_numbers(rows.table):
        pairs, codes = _coded_pairs(transforms)
        counts = np.bincount(codes[_are_rotations(transforms)] + 1, minlength=len(pairs) + 1)
        return frozenset(compress(pairs, counts[1:]))
    return frozenset(_edges_of(transforms, rows))


def _has_finite_numbers(table: Table) -> bool:
    """Returns whether the numbers of all transforms are finite, by the zones of their columns."""
    zones = [table.zone(f"{_LIST}.{path}") for path in (*_TRANSLATION, *_ROTATION)]
    return all(zone and not zone.nulls and math.isfinite(zone.high - zone.low) for zone in zones)


def _are_rotations(transforms: Elements) -> Mask:
    """Returns which transforms have a quaternion that is not zero, as far as it is stored."""
    are_rotations = np.zeros(len(transforms), np.bool_)
    for part in reversed(_ROTATION):  # mostly w tells
        are_rotations |= _rounded_rows(transforms, (part,), QUATERNION)[:, 0] != 0
        if are_rotations.all():
            break
    return are_rotations


def changing_rows(rows: Rows) -> Rows:
    """Returns the rows at whose log times a transform differs from the last one of its child.

    Returns all rows if the messages have to be read.
    """
    edges = edges_in(rows)
    if edges is None:
        return rows
    parents = Counter(child for _, child in edges)
    changes: list[IntArray] = []
    for (_, child), edge in edges.items():
        is_new = np.ones(edge.log_times.size, np.bool_)
        if parents[child] == 1:  # else its transforms may alternate between parents
            numbers = np.column_stack((edge.translation, edge.rotation))
            is_new[1:] = (numbers[1:] != numbers[:-1]).any(axis=1)
        changes.append(edge.log_times[is_new])
    return rows.some(np.flatnonzero(np.isin(rows.times, concatenated(changes))))


@dataclass(frozen=True, slots=True)
class Statics:
    """The static transforms of a part.

    Attributes:
        recording: the path of the recording's folder, as `columns.store.relative` returns it.
        transforms: those that differ from the previous one of their child, in order of log time.
    """

    recording: str
    transforms: tuple[StampedTransform, ...]

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 200 + 600 * len(self.transforms)


STATICS: Final[FragmentKind[Statics]] = FragmentKind(
    "statics", (Statics, StampedTransform, Transform)
)
"""The static transforms of a part, exact."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """The parents and children of the valid transforms of a part."""

    pairs: tuple[Pair, ...]

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 200 + 200 * len(self.pairs)


PAIRS: Final[FragmentKind[Pairs]] = FragmentKind("pairs", (Pairs,))


def stamped_between(rows: Rows, earliest: Ns, latest: Ns) -> Rows | None:
    """Returns the rows that have a transform stamped in a span (ns, inclusive).

    Returns None if the messages have to be read.
    """
    transforms = _transforms_of(rows.table)
    if transforms is None:
        return None
    stamps = np.asarray(transforms.columns[_STAMP], np.int64)
    stamped = transforms.owners[(stamps >= earliest) & (stamps <= latest)]
    return rows.some(np.flatnonzero(np.isin(rows.positions, stamped)))


def _transforms_of(table: Table) -> Elements | None:
    """Returns the transforms of a table; None if it lacks one of their columns."""
    transforms = table.elements.get(_LIST)
    if transforms is None or any(not path or path.startswith(_LIST) for path in table.left_out):
        return None
    needed = {_PARENT, _CHILD, _STAMP, *_TRANSLATION, *_ROTATION}
    return transforms if needed <= transforms.columns.keys() else None


def _coded_pairs(transforms: Elements) -> tuple[list[Pair], IntArray]:
    """Returns the distinct edges, and the place of each transform's edge among them.

    The place is -1 if a transform has no child, or leads from a frame to itself.
    """
    parents, children = transforms.columns[_PARENT], transforms.columns[_CHILD]
    if not isinstance(parents, Texts) or not isinstance(children, Texts):
        return [], np.full(len(transforms), -1)
    used, codes = distinct_rows((parents.codes, children.codes))
    place_of: dict[Pair, int] = {}
    places: list[int] = []
    for parent_code, child_code in used.tolist():
        parent = parents.words[parent_code].removeprefix("/")
        child = children.words[child_code].removeprefix("/")
        is_edge = bool(child) and parent != child
        places.append(place_of.setdefault((parent, child), len(place_of)) if is_edge else -1)
    return [*place_of], np.array(places, np.int64)[codes]


def _rounded_rows(transforms: Elements, paths: tuple[str, ...], step: Step) -> Floats:
    columns = [np.asarray(transforms.columns[path], np.float64) for path in paths]
    return step.nearest(np.stack(columns, axis=1))
