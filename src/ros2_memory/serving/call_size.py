"""How much one call may hold, told before anything of it is parsed or checked.

The arguments of a call are some dozen short values. Parsing hundreds of thousands of them, or
checking them against a schema, takes the event loop half a second, in which nobody is served.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

MOST_VALUES: Final = 10_000
"""Names and values of one message, as its commas and brackets tell."""
DEEPEST: Final = 64
_MOST_QUOTES: Final = 4 * MOST_VALUES
"""Each begins a text to be skipped; a name and a value that is a text have four."""

# An unfinished text ends with the message: nothing of it is looked at twice, whatever stands there.
_TEXT: Final = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?$)', re.DOTALL)
_ALL_BUT_STRUCTURE: Final = bytes(set(range(256)) - set(b"[]{},"))
_OPENING: Final = b"[{"


def too_much_in(text: bytes) -> str | None:
    """Why a message in JSON is not taken in; None where it may be.

    It need not be well-formed; but its encoding must be UTF-8, as RFC 8259 has it, since in
    another one it could not be looked through as bytes.
    """
    if b"\0" in text:
        return "The request is no JSON in UTF-8.\n"
    if text.count(b'"') > _MOST_QUOTES:
        return f"The request holds more than {_MOST_QUOTES} quotation marks.\n"
    structure = _TEXT.sub(b"", text).translate(None, _ALL_BUT_STRUCTURE)
    if len(structure) > MOST_VALUES:
        return f"The request holds more than {MOST_VALUES} values.\n"
    depth = 0
    for bracket in structure.translate(None, b","):
        depth += 1 if bracket in _OPENING else -1
        if depth > DEEPEST:
            return f"The request is nested deeper than {DEEPEST} levels.\n"
    return None


def too_much_of(given: Mapping[str, object]) -> str | None:
    """What is too much of the arguments of a call, naming one; None where all is well.

    Takes no longer for more than is allowed than for what is.
    """
    left = MOST_VALUES - len(given)
    if left < 0:
        return f"more than {MOST_VALUES} arguments were given; a call has a few"
    for name, argument in given.items():
        waiting: list[tuple[object, int]] = [(argument, 1)]
        while waiting:
            value, depth = waiting.pop()
            if not isinstance(value, dict | list | tuple):
                continue
            left -= len(value)
            if left < 0:
                return f"{name[:80]} holds more than {MOST_VALUES} values; a call needs a few"
            if depth >= DEEPEST:
                return f"{name[:80]} is nested deeper than {DEEPEST} levels"
            inner = value.values() if isinstance(value, dict) else value
            waiting.extend((each, depth + 1) for each in inner)
    return None
