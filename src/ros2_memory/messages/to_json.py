"""Renders a decoded message as JSON: exactly, for conditions, or shortened, for replies.

`ReplyJson` thins arrays evenly, cuts strings, rounds numbers by what they measure, writes NaN and
infinity as null, and notes each loss once for its path. `ExactJson` keeps the whole value, NaN
included. Both summarize what nobody reads: the data of images and point clouds, long byte arrays, a
million numbers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ros2_memory.core.text import dotted
from ros2_memory.core.timebase import Ns, unix_from_ns, unix_rounded_up
from ros2_memory.messages.conversions import (
    ABSENT,
    Array,
    Degrees,
    Layout,
    Metric,
    NamedNumber,
    Summary,
    ValueKind,
    euler,
    layout_of,
    layout_of_class,
    nanoseconds,
    xyz,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

T = TypeVar("T")

MAX_DEPTH: Final = 24
MAX_NOTES: Final = 20
MAX_SQUEEZE: Final = 64
MAX_EXACT_NUMBERS: Final = 1_000_000
"""A longer array is not searched by any condition, and as a list takes ten times its memory."""
MAX_TEXT: Final = 2000
"""Characters of one string in a reply."""

_COVARIANCE: Final = "covariance"
_METRIC_DECIMALS: Final = 4
"""Of metres, m/s and rad/s."""
_DEGREE_DECIMALS: Final = 2
_SIGNIFICANT_DIGITS: Final = 11
"""Of a number of unknown unit: 1e-8 of a degree, also at a longitude of three digits."""
_LEAST_DECIMALS: Final = 6
"""Of a number of unknown unit: a time in Unix seconds keeps its microseconds."""
_REALS: Final = (int, float)  # as a tuple: a union is made anew with each call
_LARGEST_WHOLE: Final = 10**15
_LARGEST_SINGLE: Final = float(np.finfo(np.float32).max)


def round_single(number: np.float32) -> JsonValue:
    """Returns a float32 as the shortest decimal that reads back as the same float32."""
    return _whole_or_null(float(str(number)))


def round_real(number: float) -> JsonValue:
    """Rounds a float of unknown unit to 11 significant digits, or to six decimals.

    rosbags decodes a scalar float32 to a Python float. Such a number is recognised by its value: it
    is exactly a float32 and needs more digits than these, which happens to a measured float64 once
    in 2**29. It is rounded as by `round_single`.
    """
    if not math.isfinite(number) or number == int(number):
        return _whole_or_null(number)
    exponent = math.floor(math.log10(abs(number)))
    decimal = round(number, max(_SIGNIFICANT_DIGITS - 1 - exponent, _LEAST_DECIMALS))
    if decimal != number and abs(number) <= _LARGEST_SINGLE:
        nearest = np.float32(number)
        if float(nearest) == number:
            return round_single(nearest)
    return _whole_or_null(decimal)


def round_integer(number: int) -> JsonValue:
    """Returns an int of at most 64 bits; a longer one, which only JSON can hold, as a float."""
    if number.bit_length() <= 64:
        return number
    try:
        return float(number)
    except OverflowError:
        return None


def _whole_or_null(number: float) -> JsonValue:
    """Returns an int if the number is integral (so -0.0 is 0), and None if it is not finite."""
    if number % 1.0 > 0.0:  # finite and not integral, as most are
        return float(number)
    if not math.isfinite(number):
        return None
    whole = int(number)
    return whole if whole == number and abs(whole) < _LARGEST_WHOLE else float(number)


def evenly(count: int, at_most: int) -> list[int]:
    """Returns at most `at_most` evenly spaced indices into `count` values, strictly increasing.

    The first and the last index are among them, and distances between neighbours differ by at most
    one. A single index is the last: the newest value.
    """
    if count <= at_most:
        return list(range(count))
    if at_most == 1:
        return [count - 1]
    return [nth * (count - 1) // (at_most - 1) for nth in range(at_most)]


class ExactJson:
    """Renders one message in full. Never raises because of its content.

    Args:
        limit: a byte array of more bytes is summarized.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit

    def value(self, node: object, path: str, depth: int = 0) -> JsonValue:
        """Renders a node; `path` is its name in notes."""
        if isinstance(node, str):
            return self._text(node, path)
        if node is None or node is ABSENT or isinstance(node, bool):
            return node if isinstance(node, bool) else None
        if isinstance(node, _REALS):
            return node if type(node) is NamedNumber else self._number(node)
        if depth >= MAX_DEPTH:
            note = f"{_named(path)}: parts deeper than {MAX_DEPTH} levels are left out"
            self.note("depth", path, note)
            return None
        return self._container(node, path, depth + 1)

    def _container(self, node: object, path: str, depth: int) -> JsonValue:
        """Renders anything but plain texts, numbers and None."""
        cls: type = type(node)
        layout = layout_of_class(cls) or layout_of(node)  # mostly the first, which is quicker
        if layout is not None:
            return self._message(node, layout, path, depth)
        if isinstance(node, bytes | bytearray):
            node = np.frombuffer(node, dtype=np.uint8)
        if isinstance(node, np.ndarray):
            return self._array(node, path, depth)
        if isinstance(node, np.generic):
            return self._scalar(node, path)
        if isinstance(node, list | tuple):
            return [self.value(element, path, depth) for element in self._elements(node, path)]
        if isinstance(node, dict):
            rendered = {
                name: self.value(inner, dotted(path, name), depth)
                for name, inner in self._entries(node, path)
            }
            return Summary(rendered) if isinstance(node, Summary) else rendered
        return self._text(f"<{type(node).__name__}>", path)

    def _message(self, node: object, layout: Layout, path: str, depth: int) -> JsonValue:
        kind = layout.kind
        if kind is ValueKind.QUATERNION:
            return self._rotation(node, path)
        if kind is ValueKind.TIME:
            time = nanoseconds(node)
            return None if time is None else self._seconds(time)
        vector = xyz(node) if kind is ValueKind.VECTOR else None
        if vector is not None:
            x, y, z = map(self._number, map(Metric, vector))
            return {"x": x, "y": y, "z": z}
        fields: JsonObject = {}
        for name, (attribute, convert) in layout.fields.items():
            value: object = getattr(node, attribute, ABSENT)
            if convert is not None:
                value = convert(node, value)
            fields[name] = self.value(value, f"{path}.{name}" if path else name, depth)
        return fields

    def _rotation(self, node: object, path: str) -> JsonValue:
        angles = euler(node)
        if angles is None:
            note = f"{_named(path)}: no rotation (a zero or NaN quaternion)"
            self.note("rotation", path, note)
            return None
        return {name: self._number(angle) for name, angle in angles.items()}

    def _array(self, array: Array, path: str, depth: int) -> JsonValue:
        if array.ndim == 0:
            return self.value(array[()], path, MAX_DEPTH - 1)
        if array.dtype == np.uint8 and array.size > self._limit:
            return Summary({"bytes": int(array.size)})
        if array.ndim > 1 or array.dtype.kind not in "biuf":
            return [self.value(row, path, depth) for row in self._elements(list(array), path)]
        return self._numbers(array, path)

    def _scalar(self, scalar: np.generic[object], path: str) -> JsonValue:
        if isinstance(scalar, np.float32):
            return self._number(scalar)
        if isinstance(scalar, np.floating):
            return self._number(float(scalar))
        plain = scalar.item()
        is_plain = isinstance(plain, bool | int | bytes)
        return self.value(plain if is_plain else str(plain), path, MAX_DEPTH - 1)

    # What a reply rounds, shortens or leaves out, and notes.

    def _number(self, number: float | np.float32, /) -> JsonValue:
        return int(number) if isinstance(number, int) else float(number)

    def _seconds(self, time: Ns, /) -> JsonValue:
        return unix_from_ns(time)

    def _text(self, text: str, _path: str, /) -> JsonValue:
        return str(text)

    def _numbers(self, array: Array, _path: str, /) -> JsonValue:
        if array.size > MAX_EXACT_NUMBERS:
            return Summary({"numbers": int(array.size)})
        numbers: JsonValue = _at_most_64_bits(array).tolist()
        return numbers

    def _elements(self, nodes: Sequence[T], _path: str, /) -> Sequence[T]:
        return nodes

    def _entries(self, node: Mapping[object, object], _path: str, /) -> list[tuple[str, object]]:
        return [(str(name), value) for name, value in node.items()]

    def note(self, kind: str, path: str, note: str, weight: int = 0, /) -> None:
        """Notes a loss at a path. Nothing reads notes on an exact rendering, so none is kept."""


class ReplyJson(ExactJson):
    """Renders one message for a reply, and notes what it leaves out.

    Args:
        limit: how many elements of an array are written.
        squeeze: above 1 for messages that would fill a reply alone: strings are cut to that part of
            their usual length, and JSON objects to `limit` entries.
    """

    def __init__(self, limit: int, squeeze: int = 1) -> None:
        super().__init__(limit)
        self._max_text = max(MAX_TEXT // squeeze, MAX_TEXT // MAX_SQUEEZE)
        self._max_entries = limit if squeeze > 1 else None
        self._notes: dict[tuple[str, str], tuple[int, str]] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence for each path and kind of loss, after the message was rendered."""
        notes = [note for _, note in self._notes.values()]
        more = len(notes) - MAX_NOTES
        if more > 0:
            notes[MAX_NOTES:] = [f"and {more} more notes of this kind"]
        return tuple(notes)

    def _message(self, node: object, layout: Layout, path: str, depth: int) -> JsonValue:
        shown = super()._message(node, layout, path, depth)
        if isinstance(shown, dict):
            for name in [name for name in shown if name.endswith(_COVARIANCE)]:
                numbers = shown[name]
                # All zeros, or NaN, say that it is not known.
                if isinstance(numbers, list) and not any(numbers):
                    del shown[name]
        return shown

    def _number(self, number: float | np.float32, /) -> JsonValue:
        if isinstance(number, int):
            return round_integer(int(number))
        if isinstance(number, Metric):
            return _whole_or_null(round(number, _METRIC_DECIMALS))
        if isinstance(number, Degrees):
            return _whole_or_null(round(number, _DEGREE_DECIMALS))
        # A float of numpy warns of the remainder of infinity.
        return round_single(number) if isinstance(number, np.float32) else round_real(float(number))

    def _seconds(self, time: Ns, /) -> JsonValue:
        return _whole_or_null(unix_rounded_up(time))

    def _text(self, text: str, path: str, /) -> JsonValue:
        if len(text) > self._max_text:
            note = f"{_named(path)}: the first {self._max_text} of {len(text)} characters"
            self.note("text", path, note, len(text))
            text = text[: self._max_text]
        return without_surrogates(text)

    def _numbers(self, array: Array, path: str, /) -> JsonValue:
        if array.size > self._limit:
            self._note_thinned(array.size, path)
            array = array[evenly(array.size, self._limit)]
        if array.dtype == np.float32:
            return [round_single(number) for number in array]
        if array.dtype.kind == "f":
            return [round_real(number) for number in _at_most_64_bits(array).tolist()]
        numbers: JsonValue = array.tolist()
        return numbers

    def _elements(self, nodes: Sequence[T], path: str, /) -> Sequence[T]:
        if len(nodes) <= self._limit:
            return nodes
        self._note_thinned(len(nodes), path)
        return [nodes[index] for index in evenly(len(nodes), self._limit)]

    def _note_thinned(self, total: int, path: str) -> None:
        note = f"{_named(path)}: {self._limit} of {total} values, evenly spaced"
        self.note("array", path, note, total)

    def _entries(self, node: Mapping[object, object], path: str, /) -> list[tuple[str, object]]:
        entries = [(without_surrogates(str(name)), value) for name, value in node.items()]
        if self._max_entries is None or len(entries) <= self._max_entries:
            return entries
        note = f"{_named(path)}: the first {self._max_entries} of {len(entries)} entries"
        self.note("entries", path, note, len(entries))
        return entries[: self._max_entries]

    def note(self, kind: str, path: str, note: str, weight: int = 0, /) -> None:
        """Notes a loss at a path. Of several of one kind, the note of the greatest weight stays."""
        noted = self._notes.get((kind, path))
        if noted is None or noted[0] < weight:
            self._notes[kind, path] = (weight, note)


def _at_most_64_bits(array: Array) -> Array:
    """Returns an array of float128 as float64, which Python's own numbers can hold."""
    return array.astype(np.float64) if array.dtype.itemsize > 8 else array


def without_surrogates(text: str) -> str:
    """Returns a plain `str` with `?` for lone surrogates, which no encoding of JSON carries."""
    return str(text) if text.isascii() else text.encode("utf-8", "replace").decode()


def _named(path: str) -> str:
    return path or "value"
