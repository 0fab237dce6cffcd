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
from ros2_memory.core.arrays import concatenated, distinct, distinct_rows
from ros2_memory.core.model import StampedTransform, Transform

if TYPE_CHECKING:
    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import IntArray, Mask

Pair = tuple[str, str]

_LIST: Final = "transforms"
_PARENT: Final = "header.frame_id"
_CHILD: Final = "child_frame_id"
_STAMP: Final = "header.stamp"
_TRANSLATION: Final = tuple(f"transform.translation.{axis}" for axis in "xyz")
_ROTATION: Final = tuple(f"transform.rotation.{part}" for part in "xyzw")


def edges_in(table: Table, times: IntArray, index: IntArray | None) -> Edges | None:
    """Returns the transforms in some rows of a table; None if their messages have to be read.

    Numbers are rounded as the store rounds them, so that a part and a bag have the same ones.

    Args:
        table: has the rows.
        times: the log times (ns) of the rows.
        index: the positions of the rows in the table, ascending; None for all.
    """
    transforms = _transforms_of(table)
    if transforms is None:
        return None
    read = partial(_edges_of, transforms, times, index)
    return table.remember("edges", read, _bytes_of) if index is None else read()


def _edges_of(transforms: Elements, times: IntArray, index: IntArray | None) -> Edges:
    if index is not None:
        transforms = transforms.rows(index)
    pairs, codes = _coded_pairs(transforms)
    translation = _rounded_rows(transforms, _TRANSLATION, METRES)
    rotation = _rounded_rows(transforms, _ROTATION, QUATERNION)
    stamps = np.asarray(transforms.columns[_STAMP], np.int64)
    # tf2 refuses what is not finite, and rotations that are not unit quaternions.
    is_valid = (codes >= 0) & np.isfinite(translation).all(axis=1)
    is_valid &= np.isfinite(rotation).all(axis=1) & (rotation != 0).any(axis=1)
    edges: dict[Pair, Edge] = {}
    for nth, pair in enumerate(pairs):
        rows = np.flatnonzero(is_valid & (codes == nth))
        if rows.size:
            turned = unit_quaternions(rotation[rows])
            edges[pair] = Edge(
                stamps[rows], times[transforms.owners[rows]], translation[rows], turned
            )
    return edges


def _bytes_of(edges: Edges) -> int:
    return 1000 + sum(500 + 72 * edge.stamps.size for edge in edges.values())


def pairs_in(table: Table, index: IntArray | None = None) -> frozenset[Pair] | None:
    """Returns the parents and children of the valid transforms in some rows of a table.

    Returns None if the messages have to be read.

    Args:
        table: has the rows.
        index: the positions of the rows, ascending; None for all.
    """
    transforms = _transforms_of(table)
    if transforms is None:
        return None
    if index is None and _has_finite_numbers(table):
        pairs, codes = _coded_pairs(transforms)
        counts = np.bincount(codes[_are_rotations(transforms)] + 1, minlength=len(pairs) + 1)
        return frozenset(compress(pairs, counts[1:]))
    times = np.zeros(len(table) if index is None else index.size, np.int64)
    return frozenset(_edges_of(transforms, times, index))


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


def static_times(table: Table, times: IntArray, index: IntArray | None) -> IntArray | None:
    """Returns the log times (ns) at which a transform differs from the previous one of its child.

    Returns None if the messages have to be read. The arguments are as for `edges_in`.
    """
    edges = edges_in(table, times, index)
    if edges is None:
        return None
    parents = Counter(child for _, child in edges)
    changes: list[IntArray] = []
    for (_, child), edge in edges.items():
        is_new = np.ones(edge.log_times.size, np.bool_)
        if parents[child] == 1:  # else its transforms may alternate between parents
            numbers = np.column_stack((edge.translation, edge.rotation))
            is_new[1:] = (numbers[1:] != numbers[:-1]).any(axis=1)
        changes.append(edge.log_times[is_new])
    return distinct(concatenated(changes))


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


def stamped_between(
    table: Table, index: IntArray | None, earliest: Ns, latest: Ns
) -> IntArray | None:
    """Returns the places in `index` of the rows that have a transform stamped in a span.

    Returns None if the messages have to be read.

    Args:
        table: has the rows.
        index: the positions of the rows, ascending; None for all.
        earliest: stamp (ns), inclusive.
        latest: stamp (ns), inclusive.
    """
    transforms = _transforms_of(table)
    if transforms is None:
        return None
    stamps = np.asarray(transforms.columns[_STAMP], np.int64)
    rows = distinct(transforms.owners[(stamps >= earliest) & (stamps <= latest)])
    return rows if index is None else np.flatnonzero(np.isin(index, rows))


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
