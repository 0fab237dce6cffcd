"""Which differences between a recorded reply and another matter.

Texts, integers and booleans are exact. Numbers with decimals, also within sentences, may differ by
one unit of the last decimal that is shown, as another processor may round them. Notes are sets.
"""

import math
import re
from collections.abc import Iterator
from typing import Any, Final

from tests.oracle.replies.asking import Call

_UNORDERED: Final = frozenset({"notes", "problems", "lines"})
_NUMBER: Final = re.compile(r"(?<![\w:.])-?\d+\.\d+(?![\w:.]*[-:])")
"""A number with decimals in a sentence, and no part of a time or a version."""


def differences(call: Call, recorded: Any, got: Any) -> list[str]:
    """What differs that matters, with both values."""
    return [
        f"{call}\n  {path}: recorded {_short(one)}, got {_short(other)}"
        for path, one, other in differing(recorded, got)
    ]


def differing(recorded: Any, got: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yields the paths at which two replies differ, with both values."""
    if isinstance(recorded, dict) and isinstance(got, dict):
        for key in dict.fromkeys([*recorded, *got]):
            one, other = (reply.get(key, "(absent)") for reply in (recorded, got))
            yield from differing(one, other, f"{path}/{key}")
    elif isinstance(recorded, list) and isinstance(got, list) and len(recorded) == len(got):
        if path.rpartition("/")[2] in _UNORDERED:
            recorded, got = (sorted(each, key=_skeleton) for each in (recorded, got))
        for number, (one, other) in enumerate(zip(recorded, got, strict=True)):
            yield from differing(one, other, f"{path}/{number}")
    elif not _same(recorded, got):
        yield path, recorded, got


def _same(recorded: Any, got: Any) -> bool:
    if isinstance(recorded, str) and isinstance(got, str):
        ours, theirs = _NUMBER.findall(recorded), _NUMBER.findall(got)
        return recorded == got or (
            _skeleton(recorded) == _skeleton(got) and all(map(_nearly, ours, theirs))
        )
    if isinstance(recorded, float) and isinstance(got, float):
        return _nearly(repr(recorded), repr(got))
    return type(recorded) is type(got) and bool(recorded == got)


def _nearly(recorded: str, got: str) -> bool:
    """Whether two numbers differ by no more than a unit of their last decimal."""
    if "e" in recorded + got:
        return math.isclose(float(recorded), float(got), rel_tol=1e-9)
    decimals = max(len(each.partition(".")[2]) for each in (recorded, got))
    return abs(float(recorded) - float(got)) <= 1.01 * 10.0**-decimals


def _skeleton(sentence: Any) -> str:
    return _NUMBER.sub("#", str(sentence))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 400 else f"{text[:400]}... ({len(text)} characters)"
