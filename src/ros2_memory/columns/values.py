"""Reads the leaves of extracted values from the columns of a table.

A `Leaf` says where a number, boolean or text of a value comes from. `Values` reads it for all rows
or elements of one table at once, with the numbers that the conversions of `messages/` return for
each message. Where the table has no column for it, `UnknownShapeError` is raised: then the bag has
to be read.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from ros2_memory.analysis.frames import unit_quaternions
from ros2_memory.columns.stored import StoredTable, Zones
from ros2_memory.columns.table import IN_PART, MAX_NUMBERS, Column, Elements, Table, Texts, Zone
from ros2_memory.core.arrays import Floats, row_sums
from ros2_memory.core.geometry import GIMBAL_LOCK_SINE
from ros2_memory.core.text import looks_like_json
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.messages.conversions import ANGLES, Selector, euler_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.storage.base import IntArray, Mask

    Numeric: TypeAlias = Floats
    """Numbers or booleans of any dtype."""


T = TypeVar("T")

ZonesOf: TypeAlias = "Callable[[T], Zones | None]"
"""Returns the zones of a column or leaf in one part or in several; None if they are unknown."""

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
    """Columns do not settle it: the messages have to be read."""


class Kind(Enum):
    """What a leaf is."""

    BOOLEAN = auto()
    INTEGER = auto()
    REAL = auto()
    TEXT = auto()


NUMBERS: Final = frozenset({Kind.INTEGER, Kind.REAL})


class Conversion(Enum):
    """How the value of a leaf is computed from its sources."""

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
        sources: dot-paths, in that level, of the columns that it is computed from.
        kind: what it is.
        conversion: how it is computed from the sources.
        json_depth: how deep detections of a low score are looked for in a text that may be JSON; 0
            for not at all.
        limits: which rows or elements have it in the extracted value.
        names: of a number that is a label, the constants that name its values.
    """

    level: Level
    sources: tuple[str, ...]
    kind: Kind
    conversion: Conversion = Conversion.STORED
    json_depth: int = 0
    limits: tuple[Limit, ...] = ()
    names: tuple[tuple[int, str], ...] = ()

    @property
    def is_number(self) -> bool:
        """Whether it is a number, and no boolean."""
        return self.kind in NUMBERS

    @property
    def is_of_array(self) -> bool:
        """Whether it is an element of an array of numbers; long arrays have no column."""
        return (
            self.sources == ("",)
            and self.conversion is Conversion.STORED
            and self.kind is not Kind.TEXT
        )


class LeafNumbers(NamedTuple):
    """The numbers or booleans of a leaf; null is NaN.

    Attributes:
        values: one for each row or element; angles as numpy computes them.
        errors: the most by which each of them is off.
        exactly: returns the values at some positions as the conversions compute them; None if only
            the bag can say, or `values` are exact.
    """

    values: Numeric
    errors: Floats
    exactly: Callable[[IntArray], Floats] | None = None


class Values:
    """Reads one table; unpacks a column when it is first asked for.

    Args:
        table: the table.

    Attributes:
        table: the table.
        rows: how many rows it has.
    """

    def __init__(self, table: Table) -> None:
        self.table = table
        self.rows = len(table.log_times)
        self._computed: dict[object, object] = {}

    def once(self, key: object, compute: Callable[[Values], T]) -> T:
        """Returns what is computed from the table under a key; it is computed once."""
        if key not in self._computed:
            self._computed[key] = compute(self)
        return cast("T", self._computed[key])  # by key: each has one type

    def elements(self, level: Level) -> Elements:
        """Returns the elements of a sequence.

        Raises:
            UnknownShapeError: the table has no columns for them.
        """
        elements = self._rows(level)
        if not isinstance(elements, Elements):
            raise UnknownShapeError(f"{level.name} has no columns")
        return elements

    def counts(self, level: Level) -> IntArray:
        """Returns how many elements each row, or each element around it, has; raises as above."""
        around = level.parent
        rows = self.rows if around is None else self.size(around)
        return np.bincount(self.elements(level).owners, minlength=rows)

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
            UnknownShapeError: the table has no column for them.
        """
        column = self._column(leaf.level, leaf.sources[0])
        if not isinstance(column, Texts):
            raise UnknownShapeError(f"{leaf.sources[0]} has no column")
        return column

    def letters(self, leaf: Leaf, text: str) -> Mask | None:
        """Returns which texts of a leaf may contain a casefolded text, by the part's outline.

        They surely contain it if it is one run of letters. Returns None if the outline does not
        say it.
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
        """Returns a column of numbers or booleans; None if the table does not have it."""
        column = self._column(level, path)
        return None if isinstance(column, Texts) else cast("Numeric | None", column)

    def numbers(self, leaf: Leaf) -> LeafNumbers:
        """Returns the numbers or booleans of a leaf.

        Raises:
            UnknownShapeError: the table has no column for them.
        """
        columns: list[Numeric] = []
        for path in leaf.sources:
            source = self.numeric(leaf.level, path)
            if source is None:
                raise UnknownShapeError(f"{path} has no column")
            columns.append(source)
        if leaf.conversion in _ANGLES:
            return self._angle(leaf, columns)
        column, error = columns[0], self.error(leaf)
        if leaf.conversion is Conversion.SECONDS:
            column, error = seconds(column), error / NS_PER_S
        elif leaf.kind is Kind.REAL and column.dtype.kind in "iu":
            column = column.astype(np.float64)
        return LeafNumbers(column, np.broadcast_to(error, len(column)))

    def floats(self, leaf: Leaf) -> tuple[Floats, float]:
        """Returns the numbers of a leaf, and the most by which any of them is off.

        Raises:
            UnknownShapeError: the table has no column for them.
        """
        numbers, errors, _ = self.numbers(leaf)
        return numbers.astype(np.float64, copy=False), float(errors.max(initial=0.0))

    def holds_all(self, leaf: Leaf) -> bool:
        """Returns whether each array that a leaf is an element of surely has a column."""
        if not leaf.is_of_array or leaf.level.parent is None:
            return True
        lengths = self.numeric(leaf.level.parent, f"{leaf.level.name}.length")
        if lengths is None or self._rows(leaf.level) is None:
            return False
        return not (lengths > self.counts(leaf.level)).any()

    def error(self, leaf: Leaf) -> float:
        """Returns the greatest error of the columns of a leaf, in their own unit."""
        return max(self.table.error(leaf.level.full(path)) for path in leaf.sources)

    def zone(self, leaf: Leaf) -> Zone | None:
        """Returns the zone of the first source of a leaf; None if it is not known."""
        return self.table.zone(leaf.level.full(leaf.sources[0]))

    def zones(self, leaf: Leaf) -> Zones | None:
        """Returns the zone of a leaf, as that of a single part; None if it is not known."""

        def of_column(path: str) -> Zones | None:
            zone = self.table.zone(path)
            return None if zone is None else Zones.of([0], [zone])

        return zones_of(leaf, of_column)

    def _angle(self, leaf: Leaf, parts: Sequence[Numeric]) -> LeafNumbers:
        """Returns one of the angles (degrees) of quaternions."""
        quaternions = [part.astype(np.float64, copy=False) for part in parts]
        euler = self.once((leaf.level, leaf.sources), lambda _: _euler(quaternions))
        which = _ANGLES[leaf.conversion]
        angles, error = euler.degrees[which], self.error(leaf)
        if error:
            return LeafNumbers(angles, _angle_error(error, euler.length, euler.cosine, angles))
        # Zero is zero everywhere, and a robot in the plane has nothing else.
        errors = np.where(angles == 0.0, 0.0, _ROUNDING_DEG)
        name = ANGLES[which]
        return LeafNumbers(angles, errors, lambda at: _exact_angles(quaternions, at, name))


def _exact_angles(quaternions: Sequence[Floats], positions: IntArray, name: str) -> Floats:
    """Returns an angle (degrees) of the quaternions at some positions, as conversions compute it.

    Args:
        quaternions: x, y, z and w, a column each.
        positions: in these columns.
        name: of the angle, one of `ANGLES`.
    """
    angle_of: dict[tuple[float, float, float, float], float] = {}
    angles = np.empty(len(positions))
    rows = zip(*(part[positions].tolist() for part in quaternions), strict=True)
    for nth, quaternion in enumerate(rows):
        if quaternion not in angle_of:
            euler = euler_of(quaternion)
            angle_of[quaternion] = math.nan if euler is None else euler[name]
        angles[nth] = angle_of[quaternion]
    return angles


def zones_of(leaf: Leaf, of_column: ZonesOf[str]) -> Zones | None:
    """Returns the zones of a leaf by those of its sources; None if they are not known.

    Args:
        leaf: the leaf.
        of_column: returns the zones of a column by its path.
    """
    zones = of_column(leaf.level.full(leaf.sources[0]))
    if zones is None:
        return None
    if leaf.conversion in _ANGLES:
        most = (90.0 if leaf.conversion is Conversion.PITCH else 180.0) + _ROUNDING_DEG
        bounds = np.full(zones.parts.size, most)
        return zones._replace(low=-bounds, high=bounds)
    if leaf.is_of_array and leaf.level.parent is not None:
        lengths = of_column(leaf.level.parent.full(f"{leaf.level.name}.length"))
        if lengths is None:
            return None
        # Where some arrays are too long for the column, they may have any number.
        are_long = lengths.reaches(MAX_NUMBERS, above=True)
        low = np.where(are_long, -math.inf, zones.low)
        return zones._replace(low=low, high=np.where(are_long, math.inf, zones.high))
    if leaf.conversion is Conversion.SECONDS:
        return zones.divided(NS_PER_S)
    return zones


def seconds(times: Numeric) -> Floats:
    """Returns nanoseconds as seconds, each as `unix_from_ns` rounds it."""
    # A float that is divided was rounded before where it has more than 53 bits. Whole seconds and
    # the rest are both exact, and their sum is rounded once: the rest is never so near to the
    # middle between two floats that its own rounding decides.
    whole = times // NS_PER_S
    parts = whole.astype(np.float64) + (times - whole * NS_PER_S) / NS_PER_S
    return np.where(np.abs(times) < _EXACT_BELOW, times / NS_PER_S, parts)


class _Euler(NamedTuple):
    """Quaternions as angles.

    Attributes:
        degrees: roll, pitch and yaw.
        length: the length of each quaternion.
        cosine: the cosine of each pitch.
    """

    degrees: tuple[Floats, Floats, Floats]
    length: Floats
    cosine: Floats


def _euler(parts: Sequence[Floats]) -> _Euler:
    """Returns quaternions as angles, as `conversions.unit` and `geometry.rpy` compute them."""
    quaternions = np.stack(parts, axis=1)
    x, y, z, w = unit_quaternions(quaternions).T
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
        lengths = np.sqrt(row_sums(quaternions * quaternions))
        return _Euler(degrees, lengths, np.sqrt(1 - sine * sine))


def _angle_error(error: float, length: Floats, cosine: Floats, angles: Floats) -> Floats:
    """Returns the most by which each angle is off (degrees).

    Args:
        error: the most by which a part of the quaternions is off.
        length: of each quaternion.
        cosine: of each pitch.
        angles: the angles (degrees).
    """
    with np.errstate(all="ignore"):
        # Relative to the length: a quaternion need not be a unit one.
        off = np.degrees(_TURN_ERRORS * error / (length * cosine)) + _ROUNDING_DEG
        is_unsure = ~((cosine > _LEAST_COSINE) & (error < 1e-2 * length))
        # Across the half turn an angle becomes its opposite.
        return np.where(is_unsure | (180.0 - np.abs(angles) <= off), math.inf, off)


class TruthValues(NamedTuple):
    """Which rows or elements meet something.

    Attributes:
        surely: those that meet it.
        perhaps: those that meet it or may meet it.
    """

    surely: Mask
    perhaps: Mask

    @classmethod
    def known(cls, mask: Mask) -> TruthValues:
        """Returns that the rows of a mask meet it, and no others."""
        return cls(mask, mask)

    @property
    def unsure(self) -> Mask:
        """The rows of which it is not known."""
        return self.perhaps & ~self.surely

    @property
    def is_settled(self) -> bool:
        """Whether it is known of all rows."""
        return not self.unsure.any()

    @property
    def is_none(self) -> bool:
        """Whether surely no row meets it."""
        return not self.perhaps.any()


def nowhere(size: int) -> TruthValues:
    """Returns that none of so many rows or elements meets it."""
    return TruthValues(np.zeros(size, np.bool_), np.zeros(size, np.bool_))


def unknown(size: int) -> TruthValues:
    """Returns that nothing is known of so many rows or elements."""
    return TruthValues(np.zeros(size, np.bool_), np.ones(size, np.bool_))


class Limit(NamedTuple):
    """Which rows or elements of a level have a field in the extracted value.

    Attributes:
        level: of the elements.
        find: returns which of the elements at some positions have it; may raise
            `UnknownShapeError`.
    """

    level: Level
    find: Callable[[Values, IntArray], TruthValues]

    def truth(self, values: Values, positions: IntArray) -> TruthValues:
        """Returns which of the elements at some positions have the field."""
        try:
            return self.find(values, positions)
        except UnknownShapeError:
            return unknown(len(positions))


def at_place(level: Level, place: int) -> Limit:
    """Returns the limit to the element at a place of each list; -1 is the last element."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        return TruthValues.known(values.places(level, positions, from_end=place < 0) == place)

    return Limit(level, find)


def at_name(level: Level, names: Leaf, name: str, nth: int | None = None) -> Limit:
    """Returns the limit to the element of an array that has a name in the list of names beside it.

    Args:
        level: of the elements; of the rows, if each element of the array has a column of its own.
        names: the names in the list.
        name: the one that is asked for.
        nth: the place of the element in an array whose elements have columns of their own.
    """

    def find(values: Values, positions: IntArray) -> TruthValues:
        texts, owners = values.texts(names), values.elements(names.level).owners
        has_name = texts.are(lambda word: word == name)
        named = np.flatnonzero(has_name)[::-1]  # the first of a row is written last
        place_in_row = np.full(values.rows, -1)
        place_in_row[owners[named]] = values.places(names.level, named, from_end=False)
        if nth is not None:
            return TruthValues.known(place_in_row[positions] == nth)
        rows = values.elements(level).owners[positions]
        places = values.places(level, positions, from_end=False)
        return TruthValues.known(places == place_in_row[rows])

    return Limit(level, find)


def where_selected(leaf: Leaf, selector: Selector) -> Limit:
    """Returns the limit to the elements of which a leaf has the value that a selector wants."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        if leaf.kind is Kind.TEXT:
            texts = values.texts(leaf)
            are_accepted = texts.are(selector.accepts)[positions]
            # JSON may lose detections of a low score, and is another text then.
            may_change = texts.are(looks_like_json)[positions] & (leaf.json_depth > 0)
            return TruthValues(are_accepted & ~may_change, are_accepted | may_change)
        numbers = values.numbers(leaf).values
        if leaf.kind is Kind.REAL or numbers.dtype.kind == "f":
            raise UnknownShapeError(f"{leaf.sources[0]} may be rounded, or null")
        names, kind = dict(leaf.names), bool if leaf.kind is Kind.BOOLEAN else int
        distinct, nth = np.unique(numbers[positions], return_inverse=True)
        are_selected = [
            selector.accepts(kind(value)) or names.get(int(value)) == selector.wanted
            for value in distinct.tolist()
        ]
        return TruthValues.known(np.array(are_selected, np.bool_)[nth])

    return Limit(leaf.level, find)


def where_longer(level: Level, sequence: str, count: int, *, is_longer: bool) -> Limit:
    """Returns the limit to sequences of more than `count` numbers, or of no more if not longer."""

    def find(values: Values, positions: IntArray) -> TruthValues:
        lengths = values.numeric(level, f"{sequence}.length")
        if lengths is None:
            return unknown(len(positions))
        return TruthValues.known((lengths[positions] > count) == is_longer)

    return Limit(level, find)


def within_limits(
    values: Values, level: Level, positions: IntArray, limits: Sequence[Limit], *, surely: bool
) -> tuple[IntArray, IntArray]:
    """Returns the positions of the elements that meet all limits, and the row of each.

    Args:
        values: of the table.
        level: of the elements; a limit may be on it, or on a level around it.
        positions: of the elements that are asked about.
        limits: to meet.
        surely: whether to leave out the elements that may meet them or not.
    """
    current, owners = level, positions
    while True:
        for limit in limits:
            if limit.level == current and len(positions):
                truth = limit.truth(values, owners)
                mask = truth.surely if surely else truth.perhaps
                positions, owners = positions[mask], owners[mask]
        if current.parent is None:
            return positions, owners
        owners, current = values.elements(current).owners[owners], current.parent
