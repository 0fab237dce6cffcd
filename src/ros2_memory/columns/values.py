"""Reads the leaves of extracted values from the columns of a table.

A `Leaf` says where a number, boolean or text of a value comes from; `Values` reads it for all rows
(or elements) of one table at once, with the same numbers as the conversions of `messages/` give
for each message. Where the table does not hold them `UnknownShapeError` is raised: then the bag has
to be read.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.analysis.frames import unit_quaternions
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import IN_PART, MAX_NUMBERS, Column, Elements, Table, Texts, Zone
from ros2_memory.columns.zones import Zones
from ros2_memory.core.arrays import Floats, row_sums
from ros2_memory.core.geometry import GIMBAL_LOCK_SINE
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.messages.conversions import ANGLES, euler_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.storage.base import IntArray, Mask

    Numeric: TypeAlias = Floats


T = TypeVar("T")

ZoneOf: TypeAlias = "Callable[[T], Zone | Zones | None]"
"""Returns what is known of a column or leaf without reading it, of one part or of several."""

_EXACT_BELOW: Final = 2**53
"""Whole numbers below this are floats."""
_ROUNDING_DEG: Final = 1e-9
"""More than numpy's arcsine and arctangent differ from those of the mathematical library."""
_TURN_ERRORS: Final = 8.0
"""An angle (rad) is off by at most this, times the error of the quaternion's parts, over the cosine
of pitch: each argument of the arctangent is a sum of four products of two parts of at most 1, and
scaling to unit length doubles that."""
_LEAST_COSINE: Final = 1e-3
"""Of a pitch so steep that roll and yaw say little."""


class UnknownShapeError(Exception):
    """Columns do not settle it, or the value differs in shape by message: the messages decide."""


class Kind(Enum):
    """What a leaf is."""

    BOOLEAN = auto()
    INTEGER = auto()
    REAL = auto()
    TEXT = auto()


NUMBERS: Final = frozenset({Kind.INTEGER, Kind.REAL})


class Conversion(Enum):
    """How a leaf comes out of its sources."""

    STORED = auto()  # the column itself
    SECONDS = auto()  # of nanoseconds
    ROLL = auto()  # degrees, of x, y, z, w; NaN where that is no rotation
    PITCH = auto()
    YAW = auto()


_ANGLES: Final = {Conversion.ROLL: 0, Conversion.PITCH: 1, Conversion.YAW: 2}


class Level(NamedTuple):
    """Where values lie: in the rows of a table (no parent), or in the elements of a sequence.

    `name` is the sequence's dot-path in the parent.
    """

    parent: Level | None
    name: str

    def full(self, path: str) -> str:
        """Returns the dot-path, from the message on, of a column of this level."""
        level = self
        while level.parent is not None:
            path = f"{level.name}.{path}" if path else level.name
            level = level.parent
        return path


ROWS: Final = Level(None, "")


class Leaf(NamedTuple):
    """A number, a boolean or a text of each row or element of a level.

    Attributes:
        level: where it lies.
        sources: dot-paths in that level of what it is made of.
        kind: what it is.
        conversion: how its value comes out of the sources.
        json_depth: of a text that may be JSON, how deep detections of a low score are looked for in
            it; 0 for not at all.
        limits: which rows or elements have it in the extracted value.
    """

    level: Level
    sources: tuple[str, ...]
    kind: Kind
    conversion: Conversion = Conversion.STORED
    json_depth: int = 0
    limits: tuple[Limit, ...] = ()

    @property
    def is_number(self) -> bool:
        """Whether it is a number, and no boolean."""
        return self.kind in NUMBERS

    @property
    def is_of_array(self) -> bool:
        """Whether it is an element of an array of numbers, which a table may hold in part."""
        return (
            self.sources == ("",)
            and self.conversion is Conversion.STORED
            and self.kind is not Kind.TEXT
        )


class LeafNumbers(NamedTuple):
    """The numbers or booleans of a leaf; null is NaN.

    Attributes:
        values: one for each row or element; of angles, as numpy computes them.
        error: the most by which they are off, of all or of each; 0 where they are exact.
        exactly: returns some of them as the conversions compute them, where those may differ from
            `values` by `error`; None where only the bag can say.
    """

    values: Numeric
    error: float | Floats
    exactly: Callable[[IntArray], Floats] | None = None


class Values:
    """Reads one table; unpacks a column when it is first asked for.

    Args:
        table: the table.

    Attributes:
        table: the table.
        rows: how many it has.
    """

    def __init__(self, table: Table) -> None:
        self.table = table
        self.rows = len(table.log_times)
        self._kept: dict[object, object] = {}

    def once(self, key: object, make: Callable[[Values], T]) -> T:
        """Returns what is made of the table under a key; it is made once."""
        if key not in self._kept:
            self._kept[key] = make(self)
        return cast("T", self._kept[key])  # by key: each has one type

    def elements(self, level: Level) -> Elements:
        """Returns the elements of a sequence.

        Raises:
            UnknownShapeError: the table does not hold them.
        """
        elements = self._rows(level)
        if not isinstance(elements, Elements):
            raise UnknownShapeError(f"{level.name} is not held")
        return elements

    def size(self, level: Level) -> int:
        """Returns how many rows or elements a level has; raises as `elements`."""
        return self.rows if level.parent is None else len(self.elements(level))

    def _rows(self, level: Level) -> Table | Elements | None:
        if level.parent is None:
            return self.table
        around = self._rows(level.parent)
        return None if around is None else around.elements.get(level.name)

    def places(self, level: Level, positions: IntArray, *, from_end: bool) -> IntArray:
        """Returns the places of some elements in their lists: 0, 1, ... or -1, -2, ..."""
        owners = self.elements(level).owners
        edge = np.searchsorted(owners, owners[positions], side="right" if from_end else "left")
        return positions - edge

    def _column(self, level: Level, path: str) -> Column | None:
        rows = self._rows(level)
        return None if rows is None else rows.columns.get(path)

    def texts(self, leaf: Leaf) -> Texts:
        """Returns the texts of a leaf.

        Raises:
            UnknownShapeError: the table does not hold them.
        """
        column = self._column(leaf.level, leaf.sources[0])
        if not isinstance(column, Texts):
            raise UnknownShapeError(f"{leaf.sources[0]} is not held")
        return column

    def letters(self, leaf: Leaf, text: str) -> Mask | None:
        """Returns which texts of a leaf may have a casefolded text; None where that is not known.

        They surely have it if it is one row of letters.
        """
        if leaf.level is not ROWS or not isinstance(self.table, StoredTable):
            return None
        zone = self.table.zone(leaf.sources[0])
        if zone is None or not (zone.words or "").startswith(IN_PART):
            return None  # then outlines have none, either
        outline = self.table.outline()
        letters = None if outline is None else outline.letters.get(leaf.sources[0])
        return None if letters is None else letters.may_have(text)

    def numeric(self, level: Level, path: str) -> Numeric | None:
        """Returns a column of numbers or booleans; None where the table does not hold it."""
        column = self._column(level, path)
        return None if isinstance(column, Texts) else cast("Numeric | None", column)

    def numbers(self, leaf: Leaf) -> LeafNumbers:
        """Returns the numbers or booleans of a leaf.

        Raises:
            UnknownShapeError: the table does not hold them.
        """
        columns = [self.numeric(leaf.level, path) for path in leaf.sources]
        held = [column for column in columns if column is not None]
        if len(held) < len(columns):
            raise UnknownShapeError(f"{leaf.sources} are not held")
        if leaf.conversion in _ANGLES:
            return self._angle(leaf, held)
        column, error = held[0], self.error(leaf)
        if leaf.conversion is Conversion.SECONDS:
            return LeafNumbers(seconds(column), error / NS_PER_S)
        is_real = leaf.kind is Kind.REAL and column.dtype.kind in "iu"
        return LeafNumbers(column.astype(np.float64) if is_real else column, error)

    def floats(self, leaf: Leaf) -> tuple[Floats, float]:
        """Returns the numbers of a leaf, and the most by which any is off.

        Raises:
            UnknownShapeError: the table does not hold them, or each is off by another number.
        """
        numbers, error, _ = self.numbers(leaf)
        if not isinstance(error, float):
            raise UnknownShapeError("each angle has an error of its own")
        return numbers.astype(np.float64, copy=False), error

    def holds_all(self, leaf: Leaf) -> bool:
        """Returns whether no array that a leaf is an element of is too long to be held."""
        if not leaf.is_of_array or leaf.level.parent is None:
            return True
        lengths = self.numeric(leaf.level.parent, f"{leaf.level.name}.length")
        return lengths is None or not (lengths > MAX_NUMBERS).any()

    def error(self, leaf: Leaf) -> float:
        """Returns the greatest error of the columns of a leaf, in their own unit."""
        return max((self.table.error(leaf.level.full(path)) for path in leaf.sources), default=0.0)

    def zone(self, leaf: Leaf) -> Zone | None:
        """Returns what is known of a leaf without reading it."""
        zone = zone_of(leaf, self.table.zone)
        return zone if isinstance(zone, Zone) else None

    def _angle(self, leaf: Leaf, parts: Sequence[Numeric]) -> LeafNumbers:
        """Returns one of the angles (degrees) of quaternions."""
        key = (leaf.level, leaf.sources)
        floats = [part.astype(np.float64, copy=False) for part in parts]
        turn = self.once(key, lambda _: _euler(floats))
        which = _ANGLES[leaf.conversion]
        angles, error = turn.degrees[which], self.error(leaf)
        if error:
            return LeafNumbers(angles, _angle_error(error, turn.length, turn.cosine, angles))

        def exactly(positions: IntArray) -> Floats:
            angle_of: dict[tuple[float, float, float, float], float] = {}
            exact = np.empty(len(positions))
            rows = zip(*(part[positions].tolist() for part in floats), strict=True)
            for nth, numbers in enumerate(rows):
                if numbers not in angle_of:
                    euler = euler_of(numbers)
                    angle_of[numbers] = math.nan if euler is None else euler[ANGLES[which]]
                exact[nth] = angle_of[numbers]
            return exact

        # Zero is zero everywhere, and a robot in the plane has nothing else.
        off = np.where(angles == 0.0, 0.0, _ROUNDING_DEG)
        return LeafNumbers(angles, off, exactly)


def zone_of(leaf: Leaf, zone: ZoneOf[str]) -> Zone | Zones | None:
    """Returns what is known of a leaf by the zones of its sources.

    Args:
        leaf: the leaf.
        zone: returns the zone of a column of a table, or its zones in some parts, by its path.
    """
    if leaf.conversion in _ANGLES:
        most = 90.0 if leaf.conversion is Conversion.PITCH else 180.0
        return Zone(-most - _ROUNDING_DEG, most + _ROUNDING_DEG)
    source_zone = zone(leaf.level.full(leaf.sources[0]))
    if source_zone is None:
        return None
    if leaf.is_of_array and leaf.level.parent is not None:
        lengths = zone(leaf.level.parent.full(f"{leaf.level.name}.length"))
        return None if lengths is None else _with_long_arrays(source_zone, lengths)
    if leaf.conversion is Conversion.SECONDS:
        return source_zone.divided(NS_PER_S)
    return source_zone


def _with_long_arrays(numbers: Zone | Zones, lengths: Zone | Zones) -> Zone | Zones | None:
    """Returns the zone of all arrays: without bounds where some are too long to be held."""
    are_long = lengths.reaches(MAX_NUMBERS, above=True)
    if isinstance(numbers, Zones):
        low = np.where(are_long, -math.inf, numbers.low)
        return numbers._replace(low=low, high=np.where(are_long, math.inf, numbers.high))
    return None if are_long else numbers


def seconds(times: Numeric) -> Floats:
    """Returns nanoseconds as seconds, each as `unix_from_ns` rounds it."""
    # A float that is divided was rounded before where it has more than 53 bits. Whole seconds and
    # the rest are both exact, and their sum is rounded once: the rest is never so near to the
    # middle between two floats that its own rounding decides.
    whole = times // NS_PER_S
    parts = whole.astype(np.float64) + (times - whole * NS_PER_S) / NS_PER_S
    return np.where(np.abs(times) < _EXACT_BELOW, times / NS_PER_S, parts)


class _Turns(NamedTuple):
    """Quaternions as angles.

    Attributes:
        degrees: roll, pitch and yaw.
        length: of the quaternions.
        cosine: of pitch.
    """

    degrees: tuple[Floats, Floats, Floats]
    length: Floats
    cosine: Floats


def _euler(parts: Sequence[Floats]) -> _Turns:
    """Returns quaternions as angles, as `conversions.unit` and `geometry.rpy` compute them."""
    turns = np.stack(parts, axis=1)
    x, y, z, w = unit_quaternions(turns).T
    with np.errstate(all="ignore"):
        sine = np.clip(2 * (w * y - z * x), -1.0, 1.0)
        is_locked = np.abs(sine) > GIMBAL_LOCK_SINE
        at_lock = 2 * np.arctan2(z, w)
        at_lock -= math.tau * np.rint(at_lock / math.tau)
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        roll = np.where(is_locked, 0.0, roll)
        yaw = np.where(is_locked, at_lock, yaw)
        degrees = np.degrees(roll), np.degrees(np.arcsin(sine)), np.degrees(yaw)
        return _Turns(degrees, np.sqrt(row_sums(turns * turns)), np.sqrt(1 - sine * sine))


def _angle_error(error: float, length: Floats, cosine: Floats, angles: Floats) -> Floats:
    """Returns by how much (degrees) angles may be off, given that of the quaternion's parts."""
    with np.errstate(all="ignore"):
        # Relative to the length: a quaternion need not be a unit one.
        off = np.degrees(_TURN_ERRORS * error / (length * cosine)) + _ROUNDING_DEG
        is_unsure = ~((cosine > _LEAST_COSINE) & (error < 1e-2 * length))
        # Across the half turn an angle becomes its opposite.
        return np.where(is_unsure | (180.0 - np.abs(angles) <= off), math.inf, off)


class TruthValues(NamedTuple):
    """Of some rows or elements: which surely have a field, and which may have it."""

    surely: Mask
    perhaps: Mask

    @classmethod
    def known(cls, stands: Mask) -> TruthValues:
        """Returns that these have it and no others."""
        return cls(stands, stands)

    @property
    def unsure(self) -> Mask:
        """Which may have it or not."""
        return self.perhaps & ~self.surely

    @property
    def is_settled(self) -> bool:
        """Whether it is known everywhere."""
        return not self.unsure.any()

    @property
    def is_none(self) -> bool:
        """Whether none has it."""
        return not self.perhaps.any()


def nowhere(size: int) -> TruthValues:
    """Returns that so many rows or elements do not have a value."""
    return TruthValues(np.zeros(size, np.bool_), np.zeros(size, np.bool_))


def unknown(size: int) -> TruthValues:
    """Returns that nothing is known of so many rows or elements."""
    return TruthValues(np.zeros(size, np.bool_), np.ones(size, np.bool_))


class Limit(NamedTuple):
    """Which rows or elements of a level have a field in the extracted value.

    Attributes:
        level: the level that it is about.
        find: returns which of some rows or elements of the level have it; may raise
            `UnknownShapeError`.
    """

    level: Level
    find: Callable[[Values, IntArray], TruthValues]

    def kept(self, values: Values, positions: IntArray) -> TruthValues:
        """Returns which of some rows or elements of the level have it."""
        try:
            return self.find(values, positions)
        except UnknownShapeError:
            return unknown(len(positions))


def at_place(level: Level, place: int) -> Limit:
    """Returns the limit to the element at this place of each list; negative from the end."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        return TruthValues.known(values.places(level, positions, from_end=place < 0) == place)

    return Limit(level, find)


def at_name(level: Level, names: Leaf, name: str, nth: int | None = None) -> Limit:
    """Returns the limit to the element that has this name in the list of names beside it.

    Of an array of fixed length, whose elements are columns of their own: to rows where it is `nth`.
    """

    def find(values: Values, positions: IntArray) -> TruthValues:
        texts, owners = values.texts(names), values.elements(names.level).owners
        has_name = np.array([word == name for word in texts.words], np.bool_)[texts.codes]
        found = np.flatnonzero(has_name)[::-1]  # the first of a row is written last
        places = np.full(values.rows, -1)
        places[owners[found]] = values.places(names.level, found, from_end=False)
        if nth is not None:
            return TruthValues.known(places[positions] == nth)
        at = values.places(level, positions, from_end=False)
        return TruthValues.known(at == places[values.elements(level).owners[positions]])

    return Limit(level, find)


def where_longer(level: Level, sequence: str, count: int, *, is_longer: bool) -> Limit:
    """Returns the limit to sequences of more numbers than this, or else of no more."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        lengths = values.numeric(level, f"{sequence}.length")
        if lengths is None:
            return unknown(len(positions))
        return TruthValues.known((lengths[positions] > count) == is_longer)

    return Limit(level, find)


def placed(
    values: Values, level: Level, positions: IntArray, limits: Sequence[Limit], *, surely: bool
) -> tuple[IntArray, IntArray]:
    """Returns which of some rows or elements have a field, and the row of each.

    Args:
        values: of the table.
        level: of the rows or elements.
        positions: their positions.
        limits: on which have it.
        surely: whether those that may have it or not are left out.
    """
    current, kept, owners = level, positions, positions
    while True:
        for limit in limits:
            if limit.level == current and len(kept):
                mask = limit.kept(values, owners)[0 if surely else 1]
                kept, owners = kept[mask], owners[mask]
        if current.parent is None:
            return kept, owners
        owners, current = values.elements(current).owners[owners], current.parent
