"""Keeps a reply under its size: thins rows first, then shortens what is in them, and notes it.

A planner's context is small, and a client cuts a text that is too long in the middle of a number.
So a reply is shortened here, evenly if its rows are along time. Its notes say what was left out
and how to see it.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_left
from itertools import islice
from typing import TYPE_CHECKING, Final

from ros2_memory.core.reply import JsonObject, with_notes
from ros2_memory.core.text import shortened
from ros2_memory.messages.to_json import evenly, without_surrogates

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ros2_memory.core.model import JsonValue

QUOTED: Final = "quoted"
"""The key that lists where a reply repeats texts of messages; it is short, and stays whole."""
_EVENLY_THINNED: Final = frozenset({"samples", "rows", "waypoints", "value"})
"""Rows along time: a few of every part say more than all of one part. Other rows lose their end."""
HEADERS: Final = ("columns", "fields")
"""Keys of the names of a table's columns; the cells are in `rows` and, summed up, in `all`."""
_WHOLE: Final = frozenset({"notes", "all", QUOTED, *HEADERS})
"""Lists that stay whole."""
_FEWEST_ROWS: Final = 2
_CHARS_OF_ELEMENT: Final = 40
_KEYS_OF_ELEMENT: Final = 4
"""For each element that lists may have, texts have so many characters and objects so many keys."""
_MAX_NOTES: Final = 12
_LONGEST_NOTE: Final = 600
_LONGEST_OUTLINED: Final = 80


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
    lists inside, characters of texts and keys of objects. `notes` says what was left out and how to
    see it. `max_chars` must be at least 500.
    """
    text = to_json_text(reply)
    if len(text) <= max_chars:
        return text
    bounded = _with_few_notes(reply)
    for shorten, least in ((_fewer_rows, _FEWEST_ROWS), (_shorter_values, 1)):
        bounded = _shortened_by(shorten, bounded, least, max_chars)
        text = to_json_text(bounded)
        if len(text) <= max_chars:
            return text
    return to_json_text(_outline(reply, max_chars))


def _shortened_by(
    shorten: Callable[[JsonObject, int, int], JsonObject],
    reply: JsonObject,
    least: int,
    max_chars: int,
) -> JsonObject:
    """Returns the reply with as many elements as fit, or with `least` if these are too many."""

    def fits(most: int) -> bool:
        return len(to_json_text(shorten(reply, most, max_chars))) <= max_chars

    return shorten(reply, largest(least, max_chars, fits) or least, max_chars)


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


def add_notes(reply: JsonObject, notes: Iterable[str]) -> JsonObject:
    """Returns the reply with more notes; `notes` stays its last key."""
    rest = {key: item for key, item in reply.items() if key != "notes"}
    return with_notes(rest, [*notes_in(reply), *notes])


def notes_in(reply: JsonObject) -> list[str]:
    """Returns the notes of a reply."""
    notes = reply.get("notes")
    return [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []


def _with_few_notes(reply: JsonObject) -> JsonObject:
    notes = notes_in(reply)
    few = [shortened(note, _LONGEST_NOTE) for note in notes[:_MAX_NOTES]]
    if len(notes) > _MAX_NOTES:
        few.append(f"and {len(notes) - _MAX_NOTES} more notes")
    return add_notes({**reply, "notes": []}, few)


def _outline(reply: JsonObject, max_chars: int) -> JsonObject:
    """Returns the short values of the reply's first level, if nothing else fits."""
    outline: JsonObject = {}
    for key, item in reply.items():
        is_short = not isinstance(item, list | dict) and len(to_json_text(item)) < _LONGEST_OUTLINED
        extended = {**outline, key: item}
        if key == QUOTED or (is_short and len(to_json_text(extended)) < max_chars // 2):
            outline = extended
    note = (
        f"the answer does not fit into {max_chars} characters; name parts of it in fields, or ask "
        "a narrower question"
    )
    return add_notes(outline, [note])


def _fewer_rows(reply: JsonObject, most: int, max_chars: int) -> JsonObject:
    """Returns the reply with at most so many elements of each list of its first level."""
    shorter = {**reply}
    notes: list[str] = []
    for key, rows in reply.items():
        if key in _WHOLE or not isinstance(rows, list) or len(rows) <= most:
            continue
        is_even = key in _EVENLY_THINNED
        shorter[key] = [rows[nth] for nth in evenly(len(rows), most)] if is_even else rows[:most]
        how = "evenly spaced" if is_even else "from the beginning"
        notes.append(
            f"{key}: {most} of {len(rows)} kept, {how}, to keep the reply under {max_chars} "
            "characters; ask a narrower question, or for fewer fields, to see more"
        )
    return add_notes(shorter, notes)


def _shorter_values(reply: JsonObject, most: int, max_chars: int) -> JsonObject:
    """Returns the reply with all its rows, in which lists have at most so many elements."""
    shorter = {
        key: [_shorter_row(row, most) for row in item]
        if isinstance(item, list) and key not in _WHOLE
        else _shorter_part(key, item, most)
        for key, item in reply.items()
    }
    note = (
        f"shortened to keep the reply under {max_chars} characters: lists to {most} elements, "
        f"texts to {most * _CHARS_OF_ELEMENT} characters, objects to {most * _KEYS_OF_ELEMENT} "
        "keys; name a part in fields to see more of it"
    )
    return add_notes(shorter, [note])


def _shorter_part(key: str, item: JsonValue, most: int) -> JsonValue:
    """Returns the value of a key shortened, unless it is a list that stays whole."""
    return item if isinstance(item, list) and key in _WHOLE else _shorter(item, most)


def _shorter_row(row: JsonValue, most: int) -> JsonValue:
    """Returns an element of a list shortened; a row of a table has all its cells."""
    if isinstance(row, list):
        return [_shorter(cell, most) for cell in row]
    return _shorter(row, most)


def _shorter(value: JsonValue, most: int) -> JsonValue:
    if isinstance(value, str):
        return shortened(value, most * _CHARS_OF_ELEMENT)
    if isinstance(value, list):
        return [_shorter_row(value[nth], most) for nth in evenly(len(value), most)]
    if isinstance(value, dict):
        return {
            shortened(key, most * _CHARS_OF_ELEMENT): _shorter_part(key, item, most)
            for key, item in islice(value.items(), most * _KEYS_OF_ELEMENT)
        }
    return value


def largest(low: int, high: int, fits: Callable[[int], bool]) -> int | None:
    """Returns the largest number from `low` to `high` that fits; None if none does.

    Bisects: every number below one that fits must fit, too.
    """
    if not fits(low):
        return None
    return low + bisect_left(range(low + 1, high + 1), True, key=lambda number: not fits(number))
