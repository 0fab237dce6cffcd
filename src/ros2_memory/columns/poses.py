"""Reads the poses of a table from its columns.

They are those that `SchemaExtractor.pose` and `twist` return for each message, rounded as the store
rounds them: to 0.1 mm, and rotations to 0.1 mrad. So poses (below 1e9 m) do not depend on what is
stored.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, cast

import numpy as np

from ros2_memory.analysis.frames import unit_quaternions
from ros2_memory.analysis.poses import FrameCodes, Poses
from ros2_memory.columns.pack import EXACT, METRES, QUATERNION, RADIANS, VELOCITY, Step
from ros2_memory.columns.shown import ByType, Listing, Node, Shape, xyzw_of
from ros2_memory.columns.table import Table, Texts
from ros2_memory.columns.values import ROWS, Conversion, Kind, Leaf, UnknownShapeError
from ros2_memory.core.arrays import Flags, Floats, Vectors, row_maxima, row_sums
from ros2_memory.extract import (
    AT_ORIGIN_M,
    FRAME,
    FRAMES_OF_TYPES,
    NOWHERE,
    POSE_FRAMES,
    UNMAPPED,
    Plan,
    PlanarPose,
    PointPose,
    SchemaExtractor,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ros2_memory.storage.base import IntArray


_ABOUT_UNIT: Final = 1e-2
_MOST_ROUNDED: Final = 1e9
"""Larger numbers of metres are no places, and are not rounded."""


class PoseColumns:
    """Reads the poses of tables; remembers in which columns of a type they are.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._columns = ByType(
            extractor, lambda shape: _columns_of(extractor.plan(shape.type), shape)
        )

    def of(self, table: Table, times: IntArray, index: IntArray | None) -> Poses | None:
        """Returns the poses of some rows of a table; None if their messages have to be read.

        Args:
            table: has the rows.
            times: the log times (ns) of the rows.
            index: the positions of the rows in the table; None for all.

        Raises:
            NoPoseError: messages of this type have no pose.
        """
        columns = self._columns.of(table)
        if columns is None:
            return None
        if not columns.axes:
            raise NoPoseError
        try:
            return _read(_RoundedRows(table, index), columns, times)
        except UnknownShapeError:
            return None


class NoPoseError(Exception):
    """Messages of a type have no pose."""


class _Columns(NamedTuple):
    """The dot-paths of the columns that have a pose.

    Attributes:
        axes: of x, y and, unless z is always 0, z (m); empty if there is no pose.
        turn: of x, y, z and w, or of a heading alone (rad); empty if there is no rotation.
        frame: of the frame in the header, or "".
        numbered_frame: of PX4's number of the frame, or "".
        usual_frame: the name of the frame itself, where a message has none; or "".
        velocity: of the one to three components of the linear velocity (m/s); empty without one.
    """

    axes: tuple[str, ...] = ()
    turn: tuple[str, ...] = ()
    frame: str = ""
    numbered_frame: str = ""
    usual_frame: str = ""
    velocity: tuple[str, ...] = ()


def _columns_of(plan: Plan, shape: Shape) -> _Columns:
    """Returns where poses are in messages of a type; without axes where they have none.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    pose: _Columns | None = None
    for route in plan.poses:
        pose = _planar(route, shape) if isinstance(route, PlanarPose) else _point(route, shape)
        if pose is not None:
            break
    if pose is None:
        return _Columns()
    frame = shape.at(FRAME.segments)
    has_frame = isinstance(frame, Leaf) and frame.kind is Kind.TEXT
    numbered = plan.pose_frame and _number(shape.at(plan.pose_frame.segments))
    return pose._replace(
        frame=".".join(FRAME.segments) if has_frame else "",
        numbered_frame=numbered or "",
        usual_frame=FRAMES_OF_TYPES.get(shape.type, ""),
        velocity=_velocity(plan, shape),
    )


def _number(node: Node | None) -> str:
    """Returns the path of a number; "" for anything else.

    Raises:
        UnknownShapeError: it is in a list.
    """
    if not isinstance(node, Leaf) or not node.is_number or node.conversion is not Conversion.STORED:
        return ""
    if node.level != ROWS:
        raise UnknownShapeError("a path leads through a list")
    return node.sources[0]


def _numbers(node: Node | None, names: str) -> tuple[str, ...]:
    """Returns the paths of the fields with these names; none unless all of them are numbers.

    Raises:
        UnknownShapeError: the object is in a list.
    """
    if isinstance(node, Listing) and isinstance(node.element, dict):
        raise UnknownShapeError("a path leads through a list")
    if not isinstance(node, dict):
        return ()
    xyzw = xyzw_of(node) if names == "xyzw" else []
    paths = [*map(_number, xyzw or map(node.get, names))]
    return tuple(paths) if all(paths) else ()


def _elements(node: Node | None, count: int) -> tuple[str, ...]:
    """Returns the paths of the numbers of an array; none unless it has `count` numbers.

    Raises:
        UnknownShapeError: it has another length in each message.
    """
    if isinstance(node, Listing):
        raise UnknownShapeError("an array has another length in each message")
    paths = [*map(_number, node)] if isinstance(node, list) else []
    return tuple(paths) if len(paths) == count and all(paths) else ()


def _point(route: PointPose, shape: Shape) -> _Columns | None:
    """Returns the columns of a point and its rotation; None if there is no point.

    Raises:
        UnknownShapeError: one is in a list, or an array of another length in each message.
    """
    position = shape.at(route.position.segments)
    orientation = shape.at(route.orientation.segments)
    axes, turn = _numbers(position, "xyz"), _numbers(orientation, "xyzw")
    if route.arrays and not axes:
        axes = _elements(position, 3)
    if route.arrays and not turn:
        wxyz = _elements(orientation, 4)  # as PX4 writes it
        turn = (*wxyz[1:], *wxyz[:1])
    return _Columns(axes, turn) if axes else None


def _planar(route: PlanarPose, shape: Shape) -> _Columns | None:
    """Returns the columns of x, y, z and a heading; None without x and y.

    Raises:
        UnknownShapeError: one is in a list.
    """
    x, y, z = (_number(shape.at(axis.segments)) for axis in (route.x, route.y, route.z))
    heading_node = shape.at(route.heading.segments)
    heading = _number(heading_node)
    if not x or not y or (route.is_needed and heading_node is None):
        return None
    return _Columns((x, y, z) if z else (x, y), (heading,) if heading else ())


def _velocity(plan: Plan, shape: Shape) -> tuple[str, ...]:
    """Returns the paths of the first linear velocity that has an angular one beside it."""
    for linear_route, angular_route in plan.twists:
        linear_node, angular_node = (
            shape.at(linear_route.segments),
            shape.at(angular_route.segments),
        )
        linear, angular = _numbers(linear_node, "xyz"), _numbers(angular_node, "xyz")
        if not linear and plan is not UNMAPPED:
            linear, angular = _number_or_array(linear_node), _number_or_array(angular_node)
        if linear and angular:
            return linear
    return ()


def _number_or_array(node: Node | None) -> tuple[str, ...]:
    """Returns the path of a number, or the paths of an array of three."""
    path = _number(node)
    return (path,) if path else _elements(node, 3)


class _RoundedRows:
    """Some rows of a table, with their numbers as the store rounds them."""

    def __init__(self, table: Table, index: IntArray | None) -> None:
        self._table = table
        self._index = index

    def floats(self, path: str, step: Step) -> Floats:
        """Returns a column of numbers, rounded.

        Raises:
            UnknownShapeError: the table does not have it.
        """
        column = self._table.columns.get(path)
        if column is None or isinstance(column, Texts):
            raise UnknownShapeError(f"{path} has no column")
        values = cast("Floats", column if self._index is None else column[self._index])
        return rounded(values.astype(np.float64), step)

    def texts(self, path: str) -> Texts:
        """Returns a column of texts; raises as `floats`."""
        column = self._table.columns.get(path)
        if not isinstance(column, Texts):
            raise UnknownShapeError(f"{path} has no column")
        return column if self._index is None else column[self._index]


def rounded(values: NDArray[np.float64], step: Step) -> NDArray[np.float64]:
    """Returns numbers rounded to multiples of a step, but for those beyond `_MOST_ROUNDED`."""
    if not step.per_unit:
        return values
    with np.errstate(all="ignore"):
        return np.where(np.abs(values) < _MOST_ROUNDED, step.nearest(values), values)


def _read(rows: _RoundedRows, columns: _Columns, times: IntArray) -> Poses:
    positions = np.zeros((times.size, 3))
    for axis, path in enumerate(columns.axes):
        positions[:, axis] = rows.floats(path, METRES)
    positions[_are_null(rows, columns, positions)] = NOWHERE
    speeds = np.full(times.size, np.nan)
    if columns.velocity:
        speeds = np.abs(rows.floats(columns.velocity[0], VELOCITY))
        for path in columns.velocity[1:]:
            speeds = np.hypot(speeds, rows.floats(path, VELOCITY))
    turns, frames = _turns(rows, columns, times.size), _frames_of(rows, columns, times.size)
    return Poses(times, positions, turns, FrameCodes(frames.codes, frames.words), speeds)


def _are_null(rows: _RoundedRows, columns: _Columns, positions: Vectors) -> Flags:
    """Returns which poses are null: position and quaternion are zero, as where tracking is lost."""
    are_null: Flags = row_maxima(np.abs(positions)) <= AT_ORIGIN_M
    if len(columns.turn) < 4:  # a heading of 0 is one
        return np.zeros_like(are_null)
    if are_null.any():
        for path in columns.turn:
            are_null &= rows.floats(path, EXACT) == 0
    return are_null


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
    """Returns quaternions, as rows, at unit length; NaN if they are zero or not finite.

    Those of about unit length are rounded first; rounding would change the rotation of shorter ones
    by more than 0.1 mrad.
    """
    with np.errstate(all="ignore"):
        is_about_unit = np.abs(row_sums(turns * turns) - 1) < _ABOUT_UNIT
    turns = np.where(is_about_unit[:, None], rounded(turns, QUATERNION), turns)
    return unit_quaternions(turns)


def _frames_of(rows: _RoundedRows, columns: _Columns, count: int) -> Texts:
    """Returns the frames in the headers, or PX4's frames where these are empty."""
    frames = Texts(np.zeros(count, np.uint32), (columns.usual_frame,) if count else ())
    if columns.frame:
        frames = rows.texts(columns.frame)
    if not columns.numbered_frame or all(frames.words):
        return frames
    numbers = rows.floats(columns.numbered_frame, METRES).astype(np.int64)
    px4_frames = [POSE_FRAMES.get(number, "") for number in numbers.tolist()]
    both = zip(frames.values(), px4_frames, strict=True)
    return Texts.of([frame or px4_frame for frame, px4_frame in both])
