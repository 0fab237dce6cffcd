"""Finds holes in a topic by what its messages state: a counter, or the cadence of header stamps.

Pure. No message is decoded: the first fields of a message lie at places that its definition gives
(CDR, little-endian; alignment counts from behind the 4 bytes of encapsulation).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from statistics import fmean, median_low
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.storage.base import Schema

FEWEST: Final = 10
"""Messages that show a cadence."""
REGULAR: Final = 0.9
"""The part of all steps that must be of one length, or nothing is expected."""
LONGEST_NS: Final[Ns] = 5 * NS_PER_S
"""A longer hole is a publisher that was silent, and reported as that."""
MOST_MISSING: Final = 10_000
_TOLERANCE: Final = 0.25
_HEADERS: Final = frozenset({"std_msgs/Header", "std_msgs/msg/Header", "Header"})
_TIMES: Final = frozenset(
    f"builtin_interfaces/{middle}{name}" for middle in ("", "msg/") for name in ("Time", "Duration")
)
_COUNTERS: Final = frozenset(
    {
        "seq",
        "sequence",
        "sequence_number",
        "sequence_id",
        "seq_num",
        "seq_id",
        "counter",
        "msg_counter",
        "message_counter",
        "packet_counter",
        "frame_counter",
        "frame_number",
    }
)
_SIZES: Final = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
_UNSIGNED: Final = {"uint16": "<H", "uint32": "<I", "uint64": "<Q", "int32": "<i", "int64": "<q"}

Kind = Literal["counter", "stamps"]


class Position(NamedTuple):
    """Where one message lies: its counter or stamp (ns), and its log time."""

    value: int
    log_time: Ns


@dataclass(frozen=True, slots=True)
class Hole:
    """Messages that are missing between two that are not.

    An open one may still turn out to be a late message: too few follow to tell.
    """

    before: Position
    after: Position
    missing: int
    is_open: bool = False


def reader_of(schema: Schema) -> tuple[Kind, Callable[[bytes], int]] | None:
    """Returns what shows holes in messages of this type; None where nothing does.

    The returned function takes a payload, and raises `struct.error` for one that does not fit.
    """
    if schema.encoding != "ros2msg":
        return None
    fields = _fields(schema.text.decode(errors="replace"))
    before: list[str] = []
    for kind, name in fields:
        if name in _COUNTERS and kind in _UNSIGNED:
            return "counter", partial(_counter, before=tuple(before), form=_UNSIGNED[kind])
        if kind not in {"string", *_SIZES, *_HEADERS, *_TIMES}:
            break
        before.append(kind)
    if fields and fields[0][0] in _HEADERS:
        return "stamps", _stamp
    return None


def holes(positions: Sequence[Position], kind: Kind) -> list[Hole] | None:
    """Returns the holes between messages, in the order of their positions.

    None where no cadence is to be seen, so that nothing can be expected: few messages, irregular
    ones, or several publishers.

    A message that was stamped late leaves a wide step, too, but then the next ones follow in a
    burst. So what counts is how far behind the cadence the messages after the step remain.
    """
    if len(positions) < FEWEST:
        return None
    if sum(one.value >= other.value for one, other in pairwise(positions)) > 1:
        return None
    steps = [(one, other, other.value - one.value) for one, other in pairwise(positions)]
    lengths = [length for _, _, length in steps if length > 0]
    usual = 1 if kind == "counter" else median_low(lengths or [0])
    allowed = 0.0 if kind == "counter" else _TOLERANCE * usual
    regular = [length for length in lengths if abs(length - usual) <= allowed]
    if usual <= 0 or len(regular) < REGULAR * len(steps):
        return None
    period = fmean(regular)  # Jitter cancels out in it, and does not in a median.
    found: list[Hole] = []
    for index, (one, other, length) in enumerate(steps):
        missing = round(length / period) - 1
        wide = length > (2 - _TOLERANCE) * period
        short = other.log_time - one.log_time <= LONGEST_NS and missing <= MOST_MISSING
        if not (wide and short):
            continue
        enough = 1 if kind == "counter" else missing + FEWEST
        later = positions[index + 1 : index + 1 + enough]
        behind = min(each.value - nth * period for nth, each in enumerate(later, 1)) - one.value
        if (missing := round(behind / period)) > 0:
            found.append(Hole(one, other, missing, len(later) < enough))
    return found


def _fields(text: str) -> list[tuple[str, str]]:
    """Returns type and name of each field of the message itself."""
    found: list[tuple[str, str]] = []
    for raw in text.splitlines():
        line = raw.partition("#")[0].strip()
        if line.startswith("==="):
            break
        words = line.split()
        if len(words) >= 2 and "=" not in "".join(words[1:3]):
            found.append((words[0], words[1]))
    return found


def _stamp(payload: bytes) -> int:
    seconds, nanoseconds = struct.unpack_from("<iI", payload, 4)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _counter(payload: bytes, before: Sequence[str], form: str) -> int:
    at = 0
    for kind in before:
        if kind in _SIZES:
            at = _aligned(at, _SIZES[kind]) + _SIZES[kind]
            continue
        at = _aligned(at, 4)
        if kind != "string":
            at += 8
        if kind == "string" or kind in _HEADERS:
            at += 4 + int(struct.unpack_from("<I", payload, 4 + at)[0])
    return int(struct.unpack_from(form, payload, 4 + _aligned(at, struct.calcsize(form)))[0])


def _aligned(at: int, size: int) -> int:
    return -(-at // size) * size
