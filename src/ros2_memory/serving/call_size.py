"""How many values one call may hold, checked before anything of it is parsed.

The arguments of a call are some dozen short values. Parsing hundreds of thousands of them, or
validating them against a schema, blocks the event loop for half a second, in which no client is
served.
"""

from __future__ import annotations

import re
from typing import Final

MAX_VALUES: Final = 10_000
"""Keys and values of one message, counted by its commas and brackets."""
MAX_DEPTH: Final = 64
_MAX_QUOTES: Final = 4 * MAX_VALUES
"""A key and a value that is a string have four."""

# Possessive quantifiers: a string that does not end takes the rest of the message, and no byte is
# looked at twice, whatever a client sends.
_STRING: Final = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?$)', re.DOTALL)
_ALL_BUT_STRUCTURE: Final = bytes(set(range(256)) - set(b"[]{},"))
_OPENING: Final = b"[{"


def excess_in_json(text: bytes) -> str | None:
    """Returns why a JSON message is refused; None if it may be parsed.

    The message need not be well-formed, but must be UTF-8, as RFC 8259 demands: another encoding
    could not be searched as bytes.
    """
    if b"\0" in text:
        return "The request is no JSON in UTF-8.\n"
    if text.count(b'"') > _MAX_QUOTES:
        return f"The request holds more than {_MAX_QUOTES} quotation marks.\n"
    structure = _STRING.sub(b"", text).translate(None, _ALL_BUT_STRUCTURE)
    if len(structure) > MAX_VALUES:
        return f"The request holds more than {MAX_VALUES} values.\n"
    depth = 0
    for bracket in structure.translate(None, b","):
        depth += 1 if bracket in _OPENING else -1
        if depth > MAX_DEPTH:
            return f"The request is nested deeper than {MAX_DEPTH} levels.\n"
    return None
