"""Text for people: counts and names in sentences, values in few characters, globs over names."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from fnmatch import translate
from itertools import islice
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

MAX_NAMED: Final = 3
"""How many names a sentence lists before it counts the rest."""
_MAX_NAME_CHARS: Final = 160
_MAX_DEPTH: Final = 3
_MAX_ITEMS: Final = 8
_MAX_TEXT_CHARS: Final = 80
_MAX_INTEGER_BITS: Final = 128
_ELLIPSIS: Final = "…"


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """Returns a number and its noun: `1 jump`, `2 jumps`."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def listed(names: Sequence[str], count: int | None = None, at_most: int = MAX_NAMED) -> str:
    """Returns the first few names, and how many more there are of `count` (or of the names)."""
    more = (len(names) if count is None else count) - min(len(names), at_most)
    shown = ", ".join(shortened(name) for name in names[:at_most])
    return f"{shown} and {more} more" if more > 0 else shown


def shortened(text: str, max_chars: int = _MAX_NAME_CHARS) -> str:
    """Returns the text, cut to `max_chars` with an ellipsis."""
    return text if len(text) <= max_chars else text[: max_chars - 1] + _ELLIPSIS


def encodable(text: str) -> str:
    """Returns the text with lone surrogates, which UTF-8 cannot hold, escaped as in JSON."""
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


@dataclass(frozen=True, slots=True)
class Reason:
    """A fault that several things can share, reported in one sentence.

    Attributes:
        what: the sentence after its subject; `many` where that differs for several.
        noun: what the things are; `plural` where that is not `noun` with an s.
        of: precedes the noun or the name, such as "messages of ".
    """

    what: str
    noun: str
    plural: str | None = None
    of: str = ""
    many: str | None = None

    def sentence(self, things: Mapping[str, str]) -> str:
        """Returns the sentence on these things, by name; each has a detail or an empty text."""
        [name, detail], *others = sorted(things.items())
        if not others:
            return f"{self.of}{name} {self.what}" + (f": {detail}" if detail else "")
        named = [f"{each} ({why})" if why else each for each, why in sorted(things.items())]
        subject = f"{self.of}{counted(len(things), self.noun, self.plural)}"
        return f"{subject} {self.many or self.what}: {listed(named)}"


def match_topics(names: Iterable[str], glob: str) -> list[str]:
    """Returns the names that a glob matches, in their order.

    `*`, `?` and `[...]` work as in a shell, except that a slash is a character like any other.
    Upper and lower case differ. `fnmatch.filter` matches likewise, but caches 32,768 globs: clients
    could fill memory with them.
    """
    matches = re.compile(translate(glob)).match
    return [name for name in names if matches(name)]


def abbreviate(value: object, max_chars: int = 80) -> str:
    """Returns the value in the manner of JSON, in at most `max_chars` characters.

    Takes no longer for a value of any depth, length or number of digits than for a short one. An
    ellipsis marks what is left out. NaN and infinities are shown as such; a lone surrogate is
    escaped.
    """
    text = json.dumps(_pruned(value, _MAX_DEPTH), ensure_ascii=False, default=_type_name)
    return shortened(text.encode("utf-8", "backslashreplace").decode(), max_chars)


def _pruned(value: object, levels: int) -> object:
    """Returns the value without what is too deep, too long or too many."""
    if isinstance(value, str):
        return value if len(value) <= _MAX_TEXT_CHARS else value[:_MAX_TEXT_CHARS] + _ELLIPSIS
    if isinstance(value, int) and value.bit_length() > _MAX_INTEGER_BITS:
        # Python refuses to convert integers of thousands of digits to decimal.
        return f"a number of {value.bit_length() * 0.30103:.0f} digits"
    if not isinstance(value, dict | list | tuple):
        return value
    if not levels:
        return _ELLIPSIS
    is_longer = len(value) > _MAX_ITEMS
    if isinstance(value, dict):
        shown = {
            str(_pruned(key, 0)): _pruned(item, levels - 1)
            for key, item in islice(value.items(), _MAX_ITEMS)
        }
        return shown | {_ELLIPSIS: _ELLIPSIS} if is_longer else shown
    items = [_pruned(item, levels - 1) for item in value[:_MAX_ITEMS]]
    return [*items, _ELLIPSIS] if is_longer else items


def _type_name(value: object) -> str:
    return f"a {type(value).__name__}"
