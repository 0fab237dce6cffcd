"""Where the robot suddenly slowed down: pose by pose, or a whole bag at once.

Of every slot of `SLOT_NS`, counted from the epoch, the first pose counts. A robot moves clearly
where it goes `MOVING_MPS` or faster from slot to slot. It slows down suddenly where its speed
falls, from one slot to the next but one, to `FRACTION` of that or less, and stays there for two
slots. A robot that turns meanwhile is taken to do so on purpose: nearly all slow down to turn.

That depends on the first poses of `_ROWS` slots in a row, which are rounded alike everywhere; so it
is the same however a history is cut into bags. Poses that come less often than once a slot, and a
position that jumps for a moment, show no drop.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.core.model import Quaternion, Vector3

SLOT_NS: Final[Ns] = NS_PER_S // 2
MOVING_MPS: Final = 0.15
FRACTION: Final = 0.4
TURNS_RAD: Final = 0.35
_ROWS: Final = 7
"""Slots that decide whether there is a drop at the fourth of them, and none at the third."""
_STEP: Final = 1e-3
"""What positions (m) and times (s) are rounded to."""
_TURN: Final = 0.01
"""What headings (rad) are rounded to."""
_STEP_NS: Final[Ns] = NS_PER_S // 1000
_NO_HEADING: Final = -(2**31)


class SpeedDrop(NamedTuple):
    """A sudden loss of speed: when it began, and the speeds (m/s) before and after."""

    time: Ns
    before_mps: float
    after_mps: float


class _Row(NamedTuple):
    """The first pose of a slot, its time and place rounded; `turn` may be a rounded heading."""

    time: Ns
    x: int
    y: int
    turn: Quaternion | int | None

    @property
    def heading(self) -> int:
        """About Z, rounded; computed for few of the slots, since most show no drop."""
        if isinstance(self.turn, int):
            return self.turn
        unit = None if self.turn is None else normalised(self.turn)
        return _NO_HEADING if unit is None else round(yaw(unit) / _TURN)


@dataclass(frozen=True, slots=True)
class SpeedDropDigest:
    """The drops of one bag, to be joined with the bags before and after.

    Attributes:
        head: the first slots of the bag, encoded; all of them where there are no more.
        tail: the last ones; empty where `head` has all.
        drops: those that no other bag's poses decide.
    """

    head: bytes = b""
    tail: bytes = b""
    drops: tuple[SpeedDrop, ...] = ()


NO_DROPS: Final = SpeedDropDigest()


class _Finder:
    """Takes slots in order, and finds the drops among them."""

    def __init__(self) -> None:
        self.rows: deque[_Row] = deque(maxlen=_ROWS)

    def is_new(self, time: Ns) -> bool:
        """Returns whether a pose is the first of its slot."""
        return not self.rows or time // SLOT_NS > self.rows[-1].time // SLOT_NS

    def add(self, row: _Row) -> SpeedDrop | None:
        """Takes the next slot; returns the drop that it completes."""
        self.rows.append(row)
        rows = self.rows
        if len(rows) < _ROWS or rows[-1].time // SLOT_NS - rows[0].time // SLOT_NS >= _ROWS:
            return None
        if _speed(rows[1], rows[2]) < MOVING_MPS:  # as it mostly is: nothing falls from there
            return None
        speeds = [_speed(rows[nth], rows[nth + 1]) for nth in range(_ROWS - 1)]
        if not _falls(speeds[1:]) or _falls(speeds[:-1]):
            return None
        before, after = rows[2].heading, rows[6].heading
        if _NO_HEADING not in {before, after} and (
            abs(math.remainder((after - before) * _TURN, math.tau)) > TURNS_RAD
        ):
            return None
        return SpeedDrop(rows[3].time, min(speeds[1:3]), max(speeds[4:]))


def _speed(before: _Row, after: _Row) -> float:
    moved = math.hypot(after.x - before.x, after.y - before.y) * _STEP
    return moved / unix_from_ns(after.time - before.time)


def _falls(speeds: Sequence[float]) -> bool:
    """Returns whether a robot that moved clearly is slow from the fourth of five speeds on."""
    before = min(speeds[:2])
    return before >= MOVING_MPS and max(speeds[3:]) <= FRACTION * before


class SpeedDropCollector:
    """Builds the digest of one bag's poses, which come in log-time order."""

    def __init__(self) -> None:
        self._finder = _Finder()
        self._head: list[_Row] = []
        self._count = 0
        self._drops: list[SpeedDrop] = []

    def add(self, time: Ns, position: Vector3, turn: Quaternion | None = None) -> None:
        """Takes the next pose (m), which must be finite."""
        if not self._finder.is_new(time):
            return
        row = _row(time, position, turn)
        drop = self._finder.add(row)
        # Another bag may have the first pose of the first slot.
        if drop is not None and self._count >= _ROWS:
            self._drops.append(drop)
        self._count += 1
        if len(self._head) < _ROWS:
            self._head.append(row)

    def digest(self) -> SpeedDropDigest:
        """Returns the digest."""
        # The next slot completes them.
        tail = _encode([*self._finder.rows][1:]) if self._count > _ROWS else b""
        return SpeedDropDigest(_encode(self._head), tail, tuple(self._drops))


class SpeedDropBuilder:
    """Finds the drops in poses, or whole bags of them, in log-time order.

    Attributes:
        drops: so far.
    """

    def __init__(self) -> None:
        self._finder = _Finder()
        self.drops: list[SpeedDrop] = []

    def add(self, time: Ns, position: Vector3, turn: Quaternion | None = None) -> None:
        """Takes the next pose (m), which must be finite."""
        if self._finder.is_new(time):
            self._add(_row(time, position, turn))

    def join(self, bag: SpeedDropDigest) -> None:
        """Takes all poses of a bag that come next, as if they were added one by one."""
        for row in _decode(bag.head):
            if self._finder.is_new(row.time):
                self._add(row)
        self.drops += bag.drops
        if bag.tail:
            self.go_on_after(bag)

    def go_on_after(self, bag: SpeedDropDigest) -> None:
        """Goes on as after a bag, which must have a tail, whatever came before it."""
        self._finder.rows = deque(_decode(bag.tail), _ROWS)

    def _add(self, row: _Row) -> None:
        drop = self._finder.add(row)
        if drop is not None:
            self.drops.append(drop)


def _row(time: Ns, position: Vector3, turn: Quaternion | None) -> _Row:
    # Down, so that a time stays in its slot.
    at = time // _STEP_NS * _STEP_NS
    return _Row(at, round(position[0] / _STEP), round(position[1] / _STEP), turn)


def _encode(rows: Iterable[_Row]) -> bytes:
    """Encodes rows column by column as differences, which compress well."""
    table = [(each.time, each.x, each.y, each.heading) for each in rows]
    columns = np.array(table, "<i8").reshape(-1, len(_Row._fields)).T
    columns[0] //= _STEP_NS
    return np.diff(columns, prepend=0).tobytes()


def _decode(packed: bytes) -> list[_Row]:
    columns = np.frombuffer(packed, "<i8").reshape(len(_Row._fields), -1).cumsum(axis=1)
    columns[0] *= _STEP_NS
    return [_Row(*row) for row in columns.T.tolist()]
