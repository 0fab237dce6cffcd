"""A message in the extracted view as JSON: exactly, for conditions, or shown, for replies.

Shown means: thinned evenly, cut, rounded by context, finite, and each loss noted once for its
path. Exact means the whole value, NaN included; only what is not for reading (the data of images
and their like, long byte arrays, a million numbers) is a summary there too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.timebase import unix_from_ns, unix_rounded_up
from ros2_memory.messages import rounding
from ros2_memory.messages.conversions import (
    Degrees,
    Metric,
    ValueKind,
    euler,
    kind_of,
    nanoseconds,
    summaries_of,
    xyz,
)
from ros2_memory.messages.downsample import array_note, evenly
from ros2_memory.messages.fields import ABSENT, field_table_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Ns
    from ros2_memory.messages.fields import Array

MAX_DEPTH: Final = 24
MAX_NOTES: Final = 20
MAX_SQUEEZE: Final = 64
MAX_EXACT_NUMBERS: Final = 1_000_000
"""A longer array is no list to look for something in, and as one takes ten times its memory."""
MAX_TEXT: Final = 2000
"""Characters of one string that leave in a reply."""


class Rendering(ABC):
    """One walk over one message. Never raises because of what the message holds."""

    def __init__(self, limit: int) -> None:
        self._limit = limit

    def value(self, node: object, path: str, depth: int = 0) -> JsonValue:
        """The node as JSON; `path` is how a note would call it."""
        if isinstance(node, str):
            return self._text(node, path)
        if node is None or node is ABSENT or isinstance(node, bool):
            return node if isinstance(node, bool) else None
        if isinstance(node, int):
            return self._integer(int(node))
        if isinstance(node, float):
            return self._float(node)
        if depth >= MAX_DEPTH:
            note = f"{_called(path)}: what lies deeper than {MAX_DEPTH} levels is left out"
            self.say("depth", path, note)
            return None
        return self._container(node, path, depth + 1)

    def _float(self, number: float) -> JsonValue:
        if isinstance(number, Metric):
            return self._metric(number)
        return self._degrees(number) if isinstance(number, Degrees) else self._real(number)

    def _container(self, node: object, path: str, depth: int) -> JsonValue:
        if isinstance(node, list | tuple):
            return [self.value(one, path, depth) for one in self._kept(node, path)]
        if isinstance(node, np.ndarray):
            return self._array(node, path, depth)
        if isinstance(node, np.generic):
            return self._scalar(node, path)
        if isinstance(node, dict):
            entries = self._entries(node, path)
            return {name: self.value(node, _join(path, name), depth) for name, node in entries}
        if isinstance(node, bytes | bytearray):
            return self._array(np.frombuffer(node, dtype=np.uint8), path, depth)
        return self._message(node, path, depth)

    def _message(self, node: object, path: str, depth: int) -> JsonValue:
        kind = kind_of(node)
        if kind is ValueKind.QUATERNION:
            return self._rotation(node, path)
        if kind is ValueKind.TIME:
            time = nanoseconds(node)
            return None if time is None else self._seconds(time)
        vector = xyz(node) if kind is ValueKind.VECTOR else None
        if vector is not None:
            x, y, z = vector
            return {"x": self._metric(x), "y": self._metric(y), "z": self._metric(z)}
        layout = field_table_of(node)
        if layout is None:
            return self._text(f"<{type(node).__name__}>", path)
        summaries = summaries_of(layout)
        shown: dict[str, JsonValue] = {}
        for name, attribute in layout.attributes.items():
            found: object = getattr(node, attribute, ABSENT)
            if name in summaries:
                found = summaries[name](node, found)
            shown[name] = self.value(found, _join(path, name), depth)
        return shown

    def _rotation(self, node: object, path: str) -> JsonValue:
        angles = euler(node)
        if angles is None:
            note = f"{_called(path)}: no rotation (a zero or NaN quaternion)"
            self.say("rotation", path, note)
            return None
        return {name: self._degrees(angle) for name, angle in angles.items()}

    def _array(self, array: Array, path: str, depth: int) -> JsonValue:
        if array.ndim == 0:
            return self.value(array[()], path, MAX_DEPTH - 1)
        if array.dtype == np.uint8 and array.size > self._limit:
            return {"bytes": int(array.size)}
        if array.ndim > 1 or array.dtype.kind not in "biuf":
            return [self.value(row, path, depth) for row in self._kept(list(array), path)]
        return self._numbers(array, path)

    def _scalar(self, scalar: np.generic[object], path: str) -> JsonValue:
        if isinstance(scalar, np.float32):
            return self._single(scalar)
        if isinstance(scalar, np.floating):
            return self._real(float(scalar))
        plain = scalar.item()
        known = isinstance(plain, bool | int | bytes)
        return self.value(plain if known else str(plain), path, MAX_DEPTH - 1)

    @abstractmethod
    def _text(self, text: str, path: str, /) -> JsonValue: ...

    @abstractmethod
    def _integer(self, number: int) -> JsonValue: ...

    @abstractmethod
    def _real(self, number: float) -> JsonValue: ...

    @abstractmethod
    def _metric(self, number: float) -> JsonValue: ...

    @abstractmethod
    def _degrees(self, number: float) -> JsonValue: ...

    @abstractmethod
    def _single(self, number: np.float32) -> JsonValue: ...

    @abstractmethod
    def _seconds(self, time: Ns) -> JsonValue: ...

    @abstractmethod
    def _numbers(self, array: Array, path: str, /) -> JsonValue: ...

    @abstractmethod
    def _kept(self, nodes: Sequence[object], path: str, /) -> Sequence[object]: ...

    @abstractmethod
    def _entries(self, node: Mapping[object, object], path: str, /) -> list[tuple[str, object]]: ...

    @abstractmethod
    def say(self, kind: str, path: str, note: str, weight: int = 0, /) -> None:
        """Notes a loss at a path; of several of one kind there, the weightiest counts."""


class ExactJson(Rendering):
    """Everything as it is."""

    def _text(self, text: str, _path: str, /) -> JsonValue:
        return str(text)

    def _integer(self, number: int) -> JsonValue:
        return number

    def _real(self, number: float) -> JsonValue:
        return float(number)

    def _metric(self, number: float) -> JsonValue:
        return float(number)

    def _degrees(self, number: float) -> JsonValue:
        return float(number)

    def _single(self, number: np.float32) -> JsonValue:
        return float(number)

    def _seconds(self, time: Ns) -> JsonValue:
        return unix_from_ns(time)

    def _numbers(self, array: Array, _path: str, /) -> JsonValue:
        if array.size > MAX_EXACT_NUMBERS:
            return {"numbers": int(array.size)}
        numbers: JsonValue = _standard(array).tolist()
        return numbers

    def _kept(self, nodes: Sequence[object], _path: str, /) -> Sequence[object]:
        return nodes

    def _entries(self, node: Mapping[object, object], _path: str, /) -> list[tuple[str, object]]:
        return [(str(name), value) for name, value in node.items()]

    def say(self, _kind: str, _path: str, _note: str, _weight: int = 0, /) -> None:
        """Nothing is lost here that is not said of `exact`."""


class ReplyJson(Rendering):
    """What leaves in a reply, and the notes on what does not.

    `squeeze` divides what a string may hold and bounds JSON objects too, for messages that would
    fill a reply alone; `notes` stands when the walk is done.
    """

    def __init__(self, limit: int, squeeze: int = 1) -> None:
        super().__init__(limit)
        self._max_text = max(MAX_TEXT // squeeze, MAX_TEXT // MAX_SQUEEZE)
        self._max_entries = limit if squeeze > 1 else None
        self._notes: dict[tuple[str, str], tuple[int, str]] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence for each path and loss; of several, that of the greatest."""
        notes = [note for _, note in self._notes.values()]
        more = len(notes) - MAX_NOTES
        return (
            (*notes[:MAX_NOTES], f"and {more} more notes of this kind") if more > 0 else (*notes,)
        )

    def _text(self, text: str, path: str, /) -> JsonValue:
        if len(text) > self._max_text:
            note = f"{_called(path)}: the first {self._max_text} of {len(text)} characters"
            self.say("text", path, note, len(text))
            text = text[: self._max_text]
        return str(text) if text.isascii() else _clean(text)

    def _integer(self, number: int) -> JsonValue:
        return rounding.integer(number)

    def _real(self, number: float) -> JsonValue:
        return rounding.real(number)

    def _metric(self, number: float) -> JsonValue:
        return rounding.metric(number)

    def _degrees(self, number: float) -> JsonValue:
        return rounding.degrees(number)

    def _single(self, number: np.float32) -> JsonValue:
        return rounding.single(number)

    def _seconds(self, time: Ns) -> JsonValue:
        return rounding.short(unix_rounded_up(time))

    def _numbers(self, array: Array, path: str, /) -> JsonValue:
        if array.size > self._limit:
            self._thinned(array.size, path)
            array = array[evenly(array.size, self._limit)]
        if array.dtype == np.float32:
            return [rounding.single(number) for number in array]
        if array.dtype.kind == "f":
            return [rounding.real(number) for number in _standard(array).tolist()]
        numbers: JsonValue = array.tolist()
        return numbers

    def _kept(self, nodes: Sequence[object], path: str, /) -> Sequence[object]:
        if len(nodes) <= self._limit:
            return nodes
        self._thinned(len(nodes), path)
        return [nodes[at] for at in evenly(len(nodes), self._limit)]

    def _thinned(self, total: int, path: str) -> None:
        self.say("array", path, array_note(_called(path), self._limit, total), total)

    def _entries(self, node: Mapping[object, object], path: str, /) -> list[tuple[str, object]]:
        entries = [(_clean(str(name)), value) for name, value in node.items()]
        if self._max_entries is None or len(entries) <= self._max_entries:
            return entries
        note = f"{_called(path)}: the first {self._max_entries} of {len(entries)} entries"
        self.say("entries", path, note, len(entries))
        return entries[: self._max_entries]

    def say(self, kind: str, path: str, note: str, weight: int = 0, /) -> None:
        """Notes a loss at a path; of several of one kind there, the weightiest counts."""
        said = self._notes.get((kind, path))
        if said is None or said[0] < weight:
            self._notes[kind, path] = (weight, note)


def _standard(array: Array) -> Array:
    """The array in a dtype that Python's own numbers hold: float128 is not."""
    return array.astype(np.float64) if array.dtype.itemsize > 8 else array


def _clean(text: str) -> str:
    """The text without lone surrogates, which no encoding of JSON carries."""
    return text.encode("utf-8", "replace").decode()


def _called(path: str) -> str:
    return path or "value"


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
