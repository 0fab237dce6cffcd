"""The poses of a table, from its columns alone.

The same as `SchemaExtractor.pose` and `twist` give for each message, rounded alike everywhere: to
0.1 mm and what the store keeps of rotations. So what is stored changes no pose below 1e9 m.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast

import numpy as np

from ros2_memory.analysis.poses import FrameCodes, Poses
from ros2_memory.columns.plan import fields_at
from ros2_memory.columns.shown import ByType
from ros2_memory.columns.steps import EXACT, METRES, QUATERNION, RADIANS, VELOCITY, Step
from ros2_memory.columns.table import Table, Texts
from ros2_memory.columns.values import UnknownShapeError
from ros2_memory.core.arrays import row_maxima, row_sums
from ros2_memory.extract import (
    FRAME,
    POSE_FRAMES,
    UNMAPPED,
    Plan,
    PlanarPose,
    PointPose,
    SchemaExtractor,
)
from ros2_memory.storage.base import SEQUENCE, Definition, IntArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.columns.values import Floats
    from ros2_memory.messages.conversions import Segments

    Vectors: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"

_UNIT_TOLERANCE: Final = 1e-12
_ABOUT_UNIT: Final = 1e-2
_MOST_STEPPED: Final = 1e9
"""Larger numbers of metres are no places, and are not rounded here."""
_TEXTS: Final = frozenset({"string", "wstring"})


class PoseColumns:
    """Reads the poses of tables; remembers which columns of a type they are.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._columns = ByType(
            extractor, lambda shape: _columns_of(extractor.plan(shape.type), shape.definition)
        )

    def of(self, table: Table, times: IntArray, index: IntArray | None) -> Poses | None:
        """Returns the poses of some rows of a table; None where their messages have to be read.

        Args:
            table: of messages of one type.
            times: the log times of these rows.
            index: their positions in the table; None for all.

        Raises:
            NoPoseError: messages of this type have no pose.
        """
        columns = self._columns.of(table)
        if columns is None:
            return None
        if not columns.axes:
            raise NoPoseError
        try:
            if index is not None:
                return _read(_RoundedRows(table, index), columns, times)
            return table.remember(
                "poses", lambda: _read(_RoundedRows(table, None), columns, times), _bytes_of
            )
        except UnknownShapeError:
            return None


def _bytes_of(poses: Poses) -> int:
    return 1000 + 80 * len(poses)


class NoPoseError(Exception):
    """Messages of a type have no pose."""


class _Columns(NamedTuple):
    """Which columns a pose is in, by their dot-paths.

    Attributes:
        axes: of x, y and, unless it is 0, z; or none.
        turn: of x, y, z, w; or of a heading (rad); or none.
        frame: of the frame in the header; empty without one.
        numbered_frame: of PX4's number of the frame; empty without one.
        velocity: of the linear velocity's one to three components; or none.
    """

    axes: tuple[str, ...] = ()
    turn: tuple[str, ...] = ()
    frame: str = ""
    numbered_frame: str = ""
    velocity: tuple[str, ...] = ()


class _Field(NamedTuple):
    path: str
    kind: str | Definition
    length: int | None

    @property
    def is_number(self) -> bool:
        return self.length is None and self._has_numbers

    @property
    def _has_numbers(self) -> bool:
        return isinstance(self.kind, str) and self.kind != "bool" and self.kind not in _TEXTS

    def parts(self, names: str) -> tuple[str, ...]:
        """Returns the paths of its fields with these names; none unless all are numbers."""
        if self.length is not None or not isinstance(self.kind, Definition):
            return ()
        fields = [_field_at(self.kind, (name,)) for name in names]
        paths = tuple(f"{self.path}.{part.path}" for part in fields if part and part.is_number)
        return paths if len(paths) == len(names) else ()

    def elements(self, count: int) -> tuple[str, ...]:
        """Returns the paths of its elements; none unless it is an array of so many numbers.

        Raises:
            UnknownShapeError: it has another length in each message.
        """
        if self.length == SEQUENCE and self._has_numbers:
            raise UnknownShapeError(f"{self.path} has another length in each message")
        if self.length != count or not self._has_numbers:
            return ()
        return tuple(f"{self.path}.{nth}" for nth in range(count))


def _field_at(definition: Definition, path: Segments) -> _Field | None:
    """Returns the field at a path; None where there is none.

    Raises:
        UnknownShapeError: it leads through a list.
    """
    fields = fields_at(definition, path)
    if any(entry.length is not None for entry in fields[: len(path) - 1]):
        raise UnknownShapeError(f"{'.'.join(path)} leads through a list")
    if len(fields) < len(path):
        return None
    return _Field(".".join(path), fields[-1].kind, fields[-1].length)


def _columns_of(plan: Plan, definition: Definition) -> _Columns:
    """Returns where poses are in messages of a type; without axes where they have none."""
    pose = _pose(plan, definition)
    if pose is None:
        return _Columns()
    frame = _field_at(definition, FRAME.segments)
    is_named = frame is not None and frame.length is None and frame.kind in _TEXTS
    numbered = plan.pose_frame and _field_at(definition, plan.pose_frame.segments)
    return pose._replace(
        frame=frame.path if frame is not None and is_named else "",
        numbered_frame=numbered.path if numbered and numbered.is_number else "",
        velocity=_velocity(plan, definition),
    )


def _pose(plan: Plan, definition: Definition) -> _Columns | None:
    """Returns the paths of the first route by which messages of a type have a pose."""
    for route in plan.poses:
        if isinstance(route, PlanarPose):
            paths = _planar(route, definition)
        else:
            paths = _point(route, definition)
        if paths is not None:
            return paths
    return None


def _point(route: PointPose, definition: Definition) -> _Columns | None:
    position = _field_at(definition, route.position.segments)
    orientation = _field_at(definition, route.orientation.segments)
    axes = position.parts("xyz") if position else ()
    turn = orientation.parts("xyzw") if orientation else ()
    if route.arrays:
        axes = axes or (position.elements(3) if position else ())
        # PX4 writes w first.
        elements = orientation.elements(4) if orientation and not turn else ()
        turn = turn or (*elements[1:], *elements[:1])
    return _Columns(axes, turn) if axes else None


def _planar(route: PlanarPose, definition: Definition) -> _Columns | None:
    routes = (route.x, route.y, route.z, route.heading)
    fields = [_field_at(definition, axis.segments) for axis in routes]
    x, y, z, heading = (entry.path if entry and entry.is_number else "" for entry in fields)
    if not x or not y or (route.is_needed and fields[-1] is None):
        return None
    return _Columns((x, y, z) if z else (x, y), (heading,) if heading else ())


def _velocity(plan: Plan, definition: Definition) -> tuple[str, ...]:
    """Returns the paths of the first linear velocity that an angular one stands beside."""
    for linear_route, angular_route in plan.twists:
        linear = _field_at(definition, linear_route.segments)
        angular = _field_at(definition, angular_route.segments)
        if linear is None or angular is None:
            continue
        velocity, turning = linear.parts("xyz"), angular.parts("xyz")
        if not velocity and plan is not UNMAPPED:
            velocity, turning = (
                (entry.path,) if entry.is_number else entry.elements(3)
                for entry in (linear, angular)
            )
        if velocity and turning:
            return velocity
    return ()


class _RoundedRows:
    """Some rows of a table, with their numbers as the store rounds them."""

    def __init__(self, table: Table, index: IntArray | None) -> None:
        self._table = table
        self._index = index

    def floats(self, path: str, step: Step) -> Floats:
        """Returns a column of numbers, rounded.

        Raises:
            UnknownShapeError: the table does not hold it.
        """
        column = self._table.columns.get(path)
        if column is None or isinstance(column, Texts):
            raise UnknownShapeError(f"{path} is not held")
        values = cast("Floats", column if self._index is None else column[self._index])
        return rounded(values.astype(np.float64), step)

    def texts(self, path: str) -> Texts:
        """Returns a column of texts; raises as `floats`."""
        column = self._table.columns.get(path)
        if not isinstance(column, Texts):
            raise UnknownShapeError(f"{path} is not held")
        return column if self._index is None else column.rows(self._index)


def rounded(values: NDArray[np.float64], step: Step) -> NDArray[np.float64]:
    """Returns numbers as the nearest multiples of a step; those for which it is too fine, as is."""
    if not step.per_unit:
        return values
    with np.errstate(all="ignore"):
        return np.where(np.abs(values) < _MOST_STEPPED, step.nearest(values), values)


def _read(rows: _RoundedRows, columns: _Columns, times: IntArray) -> Poses:
    positions = np.zeros((times.size, 3))
    for axis, path in enumerate(columns.axes):
        positions[:, axis] = rows.floats(path, METRES)
    speeds = np.full(times.size, np.nan)
    if columns.velocity:
        speeds = np.abs(rows.floats(columns.velocity[0], VELOCITY))
        for path in columns.velocity[1:]:
            speeds = np.hypot(speeds, rows.floats(path, VELOCITY))
    turns, frames = _turns(rows, columns, times.size), _frames_of(rows, columns, times.size)
    return Poses(times, positions, turns, FrameCodes(frames.codes, frames.words), speeds)


def _turns(rows: _RoundedRows, columns: _Columns, count: int) -> Vectors:
    turns = np.full((count, 4), np.nan)
    if len(columns.turn) == 1:
        halves = rows.floats(columns.turn[0], RADIANS) / 2
        is_known = np.isfinite(halves)
        turns[is_known, :2] = 0.0
        turns[is_known, 2], turns[is_known, 3] = np.sin(halves[is_known]), np.cos(halves[is_known])
    elif columns.turn:
        for part, path in enumerate(columns.turn):
            turns[:, part] = rows.floats(path, EXACT)
        turns = _at_unit_length(turns)
    return turns


def _at_unit_length(turns: Vectors) -> Vectors:
    """Returns quaternions (as rows) at unit length; NaN where they are zero or not finite.

    Rounded where that is their length already: of others rounding would change the rotation more.
    """
    with np.errstate(all="ignore"):
        off = np.abs(row_sums(turns * turns) - 1)
        turns = np.where((off < _ABOUT_UNIT)[:, None], rounded(turns, QUATERNION), turns)
        largest = row_maxima(np.abs(turns))
        is_turn = np.isfinite(largest) & (largest > 0)
        scaled = turns / largest[:, None]
        scaled /= np.sqrt(row_sums(scaled * scaled))[:, None]
        is_unit = np.abs(row_sums(turns * turns) - 1) < _UNIT_TOLERANCE
        return np.where(is_unit[:, None], turns, np.where(is_turn[:, None], scaled, np.nan))


def _frames_of(rows: _RoundedRows, columns: _Columns, count: int) -> Texts:
    """Returns the frames: those of the headers, and PX4's where these are empty."""
    frames = Texts(np.zeros(count, np.uint32), ("",) if count else ())
    if columns.frame:
        frames = rows.texts(columns.frame)
    if not columns.numbered_frame or all(frames.words):
        return frames
    numbers = rows.floats(columns.numbered_frame, METRES).astype(np.int64)
    px4_frames = [POSE_FRAMES.get(number, "") for number in numbers.tolist()]
    both = zip(frames.values(), px4_frames, strict=True)
    return Texts.of([frame or px4_frame for frame, px4_frame in both])
