"""Any value in a few words: for sentences and log events that must stay short whatever is given."""

from __future__ import annotations

import json
from itertools import islice
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

_DEEPEST: Final = 3
_MOST_ITEMS: Final = 8
_LONGEST_TEXT: Final = 80
_LONGEST_NUMBER_BITS: Final = 128
_MORE: Final = "…"


def abbreviate(value: object, max_chars: int = 80) -> str:
    """The value in the manner of JSON, of at most `max_chars` characters.

    Takes no longer for a value of any depth, length or number of digits than for a short one. What
    is left out is a `…`. NaN and infinities are shown as such; a lone surrogate is escaped.
    """
    text = json.dumps(_pruned(value, _DEEPEST), ensure_ascii=False, default=_named)
    sound = text.encode("utf-8", "backslashreplace").decode()
    return sound if len(sound) <= max_chars else sound[: max_chars - 1] + _MORE


def _pruned(value: object, levels: int) -> object:
    if isinstance(value, str):
        return value if len(value) <= _LONGEST_TEXT else value[:_LONGEST_TEXT] + _MORE
    if isinstance(value, int) and value.bit_length() > _LONGEST_NUMBER_BITS:
        # Python refuses to spell integers of thousands of digits.
        return f"a number of {value.bit_length() * 0.30103:.0f} digits"
    if isinstance(value, dict):
        return _pruned_object(value, levels)
    if isinstance(value, list | tuple):
        return _pruned_list(value, levels)
    return value


def _pruned_object(value: dict[object, object], levels: int) -> object:
    if not levels:
        return _MORE
    shown = {
        str(_pruned(key, 0)): _pruned(item, levels - 1)
        for key, item in islice(value.items(), _MOST_ITEMS)
    }
    return shown | {_MORE: _MORE} if len(value) > _MOST_ITEMS else shown


def _pruned_list(value: Iterable[object], levels: int) -> object:
    if not levels:
        return _MORE
    shown = [_pruned(item, levels - 1) for item in islice(value, _MOST_ITEMS + 1)]
    return [*shown[:_MOST_ITEMS], _MORE] if len(shown) > _MOST_ITEMS else shown


def _named(value: object) -> str:
    return f"a {type(value).__name__}"
