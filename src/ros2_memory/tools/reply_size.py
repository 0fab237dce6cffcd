"""Keeps a reply under its size: thins rows first, then arrays, then cuts texts, and notes it.

A planner's context is small, and a client cuts a text that is too long in the middle of a number.
So a reply is shortened here, evenly if its rows are along time. Its notes name what was left out
and how to see it.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_left
from typing import TYPE_CHECKING, Final

from ros2_memory.core.text import shortened
from ros2_memory.messages.to_json import evenly, without_surrogates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

QUOTED: Final = "quoted"
"""The key that lists where a reply repeats texts of messages; it is short, and stays whole."""
EVENLY_THINNED: Final = frozenset({"samples", "rows", "waypoints", "value"})
"""Rows along time: a few of every part say more than all of one part. Other rows lose their end."""

HEADERS: Final = ("columns", "fields")
"""Keys of the names of a table's columns; the cells are in `rows` and, summed up, in `all`."""
_TABLES: Final = frozenset({"rows", "windows.rows"})
_WHOLE: Final = frozenset({"notes", "all", QUOTED, *HEADERS})
"""Lists that stay whole; each cell belongs to its column."""
_FEWEST_ROWS: Final = 2
_CHARS_OF_ELEMENT: Final = 40
_KEYS_OF_ELEMENT: Final = 4
"""For each element that arrays may have, texts have so many characters and objects so many keys."""
_MAX_NOTES: Final = 12
_LONGEST_NOTE: Final = 600
_LONGEST_OUTLINED: Final = 80
_MAX_NAMES: Final = 8


def to_json_text(value: JsonValue) -> str:
    """Returns the shortest JSON text of a value.

    What JSON or UTF-8 cannot represent is replaced: NaN and infinities by null, a lone surrogate by
    a question mark, -0.0 by 0.0.
    """
    return json.dumps(
        _representable(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def fit_reply(reply: JsonObject, max_chars: int) -> str:
    """Returns the reply as valid JSON text of at most `max_chars` characters.

    A longer reply loses rows first (along time evenly, with first and last), then elements of the
    arrays inside, then texts are cut and objects lose keys. `notes` says what was left out and how
    to see it. `max_chars` must be at least 500.
    """
    text = to_json_text(reply)
    if len(text) <= max_chars:
        return text
    bounded = _fewer_rows(_with_few_notes(reply), max_chars)
    text = to_json_text(bounded)
    if len(text) <= max_chars:
        return text
    text = to_json_text(_shorter_values(bounded, max_chars))
    return text if len(text) <= max_chars else to_json_text(_outline(reply, max_chars))


def _representable(value: JsonValue) -> JsonValue:
    if isinstance(value, str):
        return without_surrogates(value)
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None  # a sum with 0.0 is never -0.0
    if isinstance(value, list):
        return [_representable(item) for item in value]
    if isinstance(value, dict):
        return {without_surrogates(key): _representable(item) for key, item in value.items()}
    return value


def _notes(reply: JsonObject) -> list[JsonValue]:
    notes = reply.get("notes")
    return notes if isinstance(notes, list) else []


def _with_note(reply: JsonObject, sentence: str) -> JsonObject:
    """Returns the reply with one more note; `notes` stays its last key."""
    rest = {key: item for key, item in reply.items() if key != "notes"}
    return {**rest, "notes": [*_notes(reply), sentence]}


def _with_few_notes(reply: JsonObject) -> JsonObject:
    notes = _notes(reply)
    if not notes:
        return reply
    few = [
        shortened(note, _LONGEST_NOTE) if isinstance(note, str) else note
        for note in notes[:_MAX_NOTES]
    ]
    if len(notes) > _MAX_NOTES:
        few.append(f"and {len(notes) - _MAX_NOTES} more notes")
    return {**reply, "notes": few}


def _outline(reply: JsonObject, max_chars: int) -> JsonObject:
    """Returns the short values of the reply's first level, if nothing else fits."""
    outline: JsonObject = {key: reply[key] for key in (QUOTED,) if key in reply}
    for key, item in reply.items():
        is_short = not isinstance(item, list | dict) and len(to_json_text(item)) < _LONGEST_OUTLINED
        extended = {**outline, key: item}
        if key != "notes" and is_short and len(to_json_text(extended)) < max_chars // 2:
            outline = extended
    return _with_note(
        outline,
        f"the answer does not fit into {max_chars} characters; name parts of it in fields, or ask "
        "a narrower question",
    )


def _fewer_rows(reply: JsonObject, max_chars: int) -> JsonObject:
    """Thins the longest lists of the reply's first level until it fits or few rows are left."""
    lists = {
        key: item for key, item in reply.items() if isinstance(item, list) and key not in _WHOLE
    }
    for key in sorted(lists, key=lambda key: len(to_json_text(lists[key])), reverse=True):
        rows = lists[key]
        if len(to_json_text(reply)) <= max_chars or len(rows) <= _FEWEST_ROWS:
            continue
        sizes = [len(to_json_text(row)) + 1 for row in rows]
        empty = _with_note({**reply, key: []}, _rows_note(key, len(rows), len(rows), max_chars))
        indices = _rows_that_fit(key, sizes, max_chars - len(to_json_text(empty)))
        reply = _with_note(
            {**reply, key: [rows[index] for index in indices]},
            _rows_note(key, len(indices), len(rows), max_chars),
        )
    return reply


def _rows_that_fit(key: str, sizes: Sequence[int], max_chars: int) -> list[int]:
    """Returns the indices of as many rows as fit into `max_chars`, but at least two.

    Args:
        key: the key of the rows, which tells whether they are along time.
        sizes: the characters of each row.
        max_chars: for all rows.
    """

    def choose(count: int) -> list[int]:
        return evenly(len(sizes), count) if key in EVENLY_THINNED else list(range(count))

    def fits(count: int) -> bool:
        return sum(sizes[index] for index in choose(count)) <= max_chars

    return choose(largest(_FEWEST_ROWS, len(sizes), fits) or _FEWEST_ROWS)


def _rows_note(key: str, kept: int, total: int, max_chars: int) -> str:
    if key in EVENLY_THINNED:
        how, more = "evenly spaced", "ask for a shorter window or for fewer fields to see more"
    else:
        how, more = "from the beginning", "ask a narrower question to see others"
    return (
        f"{key}: {kept} of {total} kept, {how}, to keep the reply under {max_chars} "
        f"characters; {more}"
    )


def _shorter_values(reply: JsonObject, max_chars: int) -> JsonObject:
    """Thins the arrays inside the rows, cuts texts and drops keys, no more than it takes."""
    # Some of it is for the note; of a small reply a third.
    room = max_chars - _LONGEST_NOTE if max_chars > 3 * _LONGEST_NOTE else max_chars * 2 // 3

    def fits(most: int) -> bool:
        return len(to_json_text(_Shortener(most).shorten(reply))) <= room

    shortener = _Shortener(largest(1, max_chars, fits) or 1)
    shorter = shortener.shorten(reply)
    losses: list[str] = []
    for (path, how), (remaining, total) in shortener.losses.items():
        # As the `fields` argument takes it: relative to a sample's value.
        name = path.removeprefix("samples.").removeprefix("value.")
        count = f": {remaining} of {total} kept" if total else ""
        losses.append(f"{name} ({how}{count})")
    if len(losses) > _MAX_NAMES:
        losses[_MAX_NAMES:] = [f"and {len(losses) - _MAX_NAMES} more"]
    sentence = (
        f"shortened to keep the reply under {max_chars} characters: {', '.join(losses)}; "
        "name one of them in fields to see more of it"
    )
    return _with_note(shorter, shortened(sentence, _LONGEST_NOTE - 50))


class _Shortener:
    """Shortens arrays to `most` elements, and texts and objects accordingly.

    Attributes:
        losses: by dot-path without indices and the way of shortening, how many elements or keys
            remain, and how many there were; of the longest value at the path. (0, 0) for texts.
    """

    def __init__(self, most: int) -> None:
        self.losses: dict[tuple[str, str], tuple[int, int]] = {}
        self._most = most
        self._most_chars = most * _CHARS_OF_ELEMENT
        self._most_keys = most * _KEYS_OF_ELEMENT
        self._columns: list[JsonValue] = []

    def shorten(self, reply: JsonObject) -> JsonObject:
        """Returns the reply with short values; it has all its rows, and `_WHOLE` lists stay."""
        for name in HEADERS:
            header = reply.get(name)
            if isinstance(header, list):
                self._columns = header
                break
        shorter: JsonObject = {}
        for key, item in reply.items():
            if isinstance(item, list) and key not in _WHOLE:
                shorter[key] = [self._row(row, key) for row in item]
            else:
                shorter[key] = self._part(key, item, key)
        return shorter

    def _part(self, key: str, item: JsonValue, path: str) -> JsonValue:
        """Shortens the value of a key, unless it is a list that stays whole."""
        is_whole = isinstance(item, list) and key in _WHOLE and path in {key, f"windows.{key}"}
        return item if is_whole else self._value(item, path)

    def _row(self, row: JsonValue, path: str) -> JsonValue:
        """Shortens an element of a list; a row of a table has all its cells."""
        if isinstance(row, list) and path in _TABLES:
            named = zip(self._columns, row, strict=False)
            return [self._value(cell, str(name)) for name, cell in named]
        return self._value(row, path)

    def _value(self, value: JsonValue, path: str) -> JsonValue:
        if isinstance(value, str) and len(value) > self._most_chars:
            self.losses[path, "texts cut"] = (0, 0)
            return shortened(value, self._most_chars)
        if isinstance(value, list):
            indices = evenly(len(value), self._most)
            self._note_loss(path, "evenly thinned", len(indices), len(value))
            return [self._row(value[index], path) for index in indices]
        if isinstance(value, dict):
            items = list(value.items())[: self._most_keys]
            self._note_loss(path, "keys left out", len(items), len(value))
            return {
                shortened(key, self._most_chars): self._part(key, item, f"{path}.{key}")
                for key, item in items
            }
        return value

    def _note_loss(self, path: str, how: str, remaining: int, total: int) -> None:
        _, longest = self.losses.get((path, how), (0, 0))
        if remaining < total and total > longest:
            self.losses[path, how] = (remaining, total)


def largest(low: int, high: int, fits: Callable[[int], bool]) -> int | None:
    """Returns the largest number from `low` to `high` that fits; None if none does.

    Bisects: every number below one that fits must fit, too.
    """
    if not fits(low):
        return None
    return low + bisect_left(range(low + 1, high + 1), True, key=lambda number: not fits(number))
