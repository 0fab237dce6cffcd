"""The JSON of messages that differ by their numbers alone: one text with holes in it.

A message that has marks in place of its numbers is rendered once, with a token for each number.
Where each mark lies in the payload is known, so the numbers of thousands of payloads can be written
into the text without a walk over each message.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from itertools import repeat
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.messages.conversions import euler_of, xyzw
from ros2_memory.messages.to_json import ReplyJson

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.messages.fields import Array
    from ros2_memory.messages.to_json import NumberWriter

    Column: TypeAlias = "Callable[[int], np.ndarray[tuple[int], np.dtype[np.float64]]]"
    TimeColumn: TypeAlias = "Callable[[int], np.ndarray[tuple[int], np.dtype[np.int64]]]"

_TOKEN: Final = 7_390_154_826_180_273_645_991_208_463_517
"""Followed by the number of a hole; no 64 bits hold it, so no message has it as a number."""
_TOKENS: Final = re.compile(rf"{_TOKEN}(\d{{4}})")
_HOLES: Final = 10_000
_LONGEST: Final = 120
"""More characters than a number or a rotation takes."""
_JSON: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_ASCII: Final = json.JSONEncoder(separators=(",", ":")).encode


class Marks(NamedTuple):
    """Where the numbers of a marked message lie: the offset of each, and of each time (s)."""

    numbers: Mapping[float, int]
    times: Mapping[float, int]


class HoleKind(Enum):
    """How the numbers of a hole are written."""

    REAL = auto()
    METRIC = auto()
    SINGLE = auto()
    SECONDS = auto()
    ROTATION = auto()  # as an object of angles; x, y, z, w


class Hole(NamedTuple):
    """What belongs in one place of the text, and the offsets of its numbers in the payload."""

    kind: HoleKind
    offsets: tuple[int, ...]


class UnmarkedError(Exception):
    """A value has a number that is computed from others."""


class HoledJson(ReplyJson):
    """Renders a marked message as for a reply, with a token for each number that is a mark.

    Args:
        limit: as of `ReplyJson`.
        marks: of the message.

    Raises:
        UnmarkedError: while it renders; a number is none of the marks.
    """

    def __init__(self, limit: int, marks: Marks) -> None:
        super().__init__(limit)
        self._marks = marks
        self.holes: list[Hole] = []
        self.writer = self.write
        self.write = self.write._replace(
            real=partial(self._number, HoleKind.REAL),
            metric=partial(self._number, HoleKind.METRIC),
            single=partial(self._number, HoleKind.SINGLE),
            degrees=self._number_of_others,
            seconds=self._time,
        )

    def template(self, value: JsonValue, max_chars: int) -> JsonTemplate | None:
        """Returns what was rendered as a template; None if some texts may be longer than allowed.

        Also None where a text of the message looks like a token.
        """
        if len(_ASCII(value)) + _LONGEST * len(self.holes) > max_chars:
            return None
        parts = _TOKENS.split(_JSON(value))
        if [int(each) for each in parts[1::2]] != [*range(len(self.holes))]:
            return None
        return JsonTemplate(tuple(parts[::2]), tuple(self.holes), self.writer)

    def _hole(self, kind: HoleKind, offsets: tuple[int | None, ...]) -> JsonValue:
        known = tuple(each for each in offsets if each is not None)
        if len(known) < len(offsets) or len(self.holes) == _HOLES:
            raise UnmarkedError
        self.holes.append(Hole(kind, known))
        return _TOKEN * _HOLES + len(self.holes) - 1

    def _number(self, kind: HoleKind, number: float | np.float32) -> JsonValue:
        return self._hole(kind, (self._marks.numbers.get(float(number)),))

    def _number_of_others(self, _number: float) -> JsonValue:
        raise UnmarkedError

    def _time(self, time: Ns) -> JsonValue:
        return self._hole(HoleKind.SECONDS, (self._marks.times.get(time / 1e9),))

    def _rotation(self, node: object, _path: str) -> JsonValue:
        numbers = xyzw(node) or ()
        return self._hole(HoleKind.ROTATION, (*map(self._marks.numbers.get, numbers),))

    def _numbers(self, array: Array, path: str, /) -> JsonValue:
        if array.dtype.kind != "f":
            return super()._numbers(array, path)
        kind = HoleKind.SINGLE if array.dtype == np.float32 else HoleKind.REAL
        numbers: list[float] = array.tolist()
        return [self._number(kind, each) for each in self._elements(numbers, path)]


@dataclass(frozen=True, slots=True)
class JsonTemplate:
    """The text around the holes, one piece more than there are holes, and what writes numbers."""

    pieces: tuple[str, ...]
    holes: tuple[Hole, ...]
    writer: NumberWriter

    def texts(self, count: int, column: Column, times: TimeColumn) -> Iterable[str]:
        """Returns the JSON of `count` messages, given the numbers and times (ns) at an offset."""
        pattern, varied = [self.pieces[0]], []
        for hole, piece in zip(self.holes, self.pieces[1:], strict=True):
            texts = self._texts(hole, column, times)
            if len(texts) == 1:
                pattern[-1] += texts[0] + piece
            else:
                varied.append(texts)
                pattern.append(piece)
        if not varied:
            return repeat(pattern[0], count)
        fill = "%s".join(each.replace("%", "%%") for each in pattern).__mod__
        return map(fill, zip(*varied, strict=True))

    def _texts(self, hole: Hole, column: Column, times: TimeColumn) -> list[str]:
        """Returns the text of each message; one only where all have the same."""
        first, *_ = hole.offsets
        write = self.writer
        if hole.kind is HoleKind.SECONDS:
            return [_text(write.seconds(each)) for each in _distinct(times(first)).tolist()]
        if hole.kind is HoleKind.ROTATION:
            columns = [_distinct(column(each)).tolist() for each in hole.offsets]
            most = max(map(len, columns))
            x, y, z, w = (each * most if len(each) < most else each for each in columns)
            return [*map(self._angles, zip(x, y, z, w, strict=True))]
        numbers = _distinct(column(first))
        if hole.kind is HoleKind.SINGLE:
            return [_text(write.single(each)) for each in numbers.astype(np.float32)]
        plain = write.metric if hole.kind is HoleKind.METRIC else write.real
        return [_text(plain(each)) for each in numbers.tolist()]

    def _angles(self, numbers: tuple[float, float, float, float]) -> str:
        angles = euler_of(numbers)
        if angles is None:
            return "null"
        degrees = self.writer.degrees
        inner = ",".join([f'"{name}":{_text(degrees(each))}' for name, each in angles.items()])
        return f"{{{inner}}}"


def _distinct(column: Array) -> Array:
    """Returns one number where all are the same to the bit, else the column."""
    bits = column.view(np.int64)
    return column[:1] if bool((bits == bits[0]).all()) else column


def _text(number: JsonValue) -> str:
    """Returns a number that a reply has as JSON."""
    return "null" if number is None else repr(number)
