"""Keeps a reply under its size: rows first, then arrays, then texts, and a note for what went.

A planner's context is small, and a client cuts what is too long in the middle of a number. So what
is too long is made shorter here, evenly, and says so.
"""

from __future__ import annotations

import json
import math
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.messages.downsample import evenly

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue

JsonObject: TypeAlias = "dict[str, JsonValue]"

EVENLY_THINNED: Final = frozenset({"samples", "waypoints", "value"})
"""Rows along time: some of all of it say more than all of some of it. Others lose their end."""

_FEWEST_ROWS: Final = 2
_SHORTEST_TEXT: Final = 200
_ARRAY_STEPS: Final = (50, 25, 12, 6, 3, 2)
_KEY_STEPS: Final = (200, 50, 12, 4)
_MOST_NOTES: Final = 12
_LONGEST_NOTE: Final = 600
_MOST_NAMES: Final = 8
_CUT: Final = "…"


def to_json_text(value: JsonValue) -> str:
    """The shortest JSON text of a value.

    What JSON or UTF-8 cannot carry does not leave: NaN and infinities become null, a lone
    surrogate a question mark; -0.0 becomes 0.0.
    """
    return json.dumps(_sound(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def fit_reply(reply: JsonObject, max_chars: int) -> str:
    """The reply as JSON text of at most `max_chars` characters, always valid.

    Where it would be longer, its lists of rows are thinned (along time evenly, first and last
    kept), then the arrays inside, then texts are cut and objects lose keys; `notes` says what was
    left out and how to see it. `max_chars` must be at least 500.
    """
    text = to_json_text(reply)
    if len(text) <= max_chars:
        return text
    bounded = _with_few_notes(reply)
    for attempt in (_fewer_rows, _less_inside):
        bounded = attempt(bounded, max_chars)
        text = to_json_text(bounded)
        if len(text) <= max_chars:
            return text
    return to_json_text(_outline(reply, max_chars))


def without_constant_zeros(samples: Sequence[JsonValue]) -> tuple[list[JsonValue], list[str]]:
    """The samples' values without the numbers that are 0 in every one of them, and their paths.

    Only leaves of objects go, and never all of one object: a structure that is 0 throughout says
    something and stays whole. Fewer than two values are left as they are.
    """
    if len(samples) < 2:
        return list(samples), []
    shared: dict[tuple[str, ...], None] | None = None
    for sample in samples:
        zeros = dict.fromkeys(_zeros(sample, ()))
        shared = zeros if shared is None else {path: None for path in shared if path in zeros}
    gone = set(shared or ())
    for sample in samples:
        for path, names in _objects(sample, ()):
            leaves = {(*path, name) for name in names}
            if leaves <= gone:
                gone -= leaves
    named = [".".join(path) for path in shared or () if path in gone]
    return [_without(sample, (), gone) for sample in samples] if gone else list(samples), named


def _sound(value: JsonValue) -> JsonValue:
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-8", "replace").decode("utf-8")
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None
    if isinstance(value, list):
        return [_sound(item) for item in value]
    if isinstance(value, dict):
        return {_key(key): _sound(item) for key, item in value.items()}
    return value


def _key(key: str) -> str:
    return key if key.isascii() else key.encode("utf-8", "replace").decode("utf-8")


def _zeros(value: JsonValue, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _zeros(item, (*path, key))
    elif path and isinstance(value, int | float) and not isinstance(value, bool) and value == 0:
        yield path


def _objects(
    value: JsonValue, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    if isinstance(value, dict):
        yield path, list(value)
        for key, item in value.items():
            yield from _objects(item, (*path, key))


def _without(value: JsonValue, path: tuple[str, ...], gone: set[tuple[str, ...]]) -> JsonValue:
    if not isinstance(value, dict):
        return value
    return {
        key: _without(item, (*path, key), gone)
        for key, item in value.items()
        if (*path, key) not in gone
    }


def _noted(reply: JsonObject, sentence: str) -> JsonObject:
    """The reply with one more note; `notes` stays its last key."""
    rest = {key: item for key, item in reply.items() if key != "notes"}
    return {**rest, "notes": [*_notes(reply), sentence]}


def _notes(reply: JsonObject) -> list[JsonValue]:
    notes = reply.get("notes")
    return notes if isinstance(notes, list) else []


def _with_few_notes(reply: JsonObject) -> JsonObject:
    notes = _notes(reply)
    if not notes:
        return reply
    kept = [_cut(note, _LONGEST_NOTE) for note in notes[:_MOST_NOTES]]
    if len(notes) > _MOST_NOTES:
        kept.append(f"and {len(notes) - _MOST_NOTES} more notes")
    return {**reply, "notes": kept}


def _outline(reply: JsonObject, max_chars: int) -> JsonObject:
    """The few words and numbers of the reply's first level, for what defies being shortened."""
    sentence = (
        f"the answer does not fit into {max_chars} characters; name parts of it in fields, or ask "
        "more narrowly"
    )
    kept: JsonObject = {}
    for key, item in reply.items():
        is_short = (
            key != "notes" and not isinstance(item, list | dict) and len(to_json_text(item)) < 80
        )
        if is_short and len(to_json_text({**kept, key: item})) < max_chars // 2:
            kept[key] = item
    return {**kept, "notes": [sentence]}


def _fewer_rows(reply: JsonObject, max_chars: int) -> JsonObject:
    """Thins the longest lists of the reply's first level until it fits or few rows are left."""
    lists = {key: item for key, item in reply.items() if isinstance(item, list) and key != "notes"}
    for key in sorted(lists, key=lambda key: len(to_json_text(lists[key])), reverse=True):
        rows = lists[key]
        if len(to_json_text(reply)) <= max_chars or len(rows) <= _FEWEST_ROWS:
            continue
        sizes = [len(to_json_text(row)) + 1 for row in rows]
        empty = _noted({**reply, key: []}, _rows_note(key, len(rows), len(rows), max_chars))
        spare = max_chars - len(to_json_text(empty))
        kept = _rows_that_fit(key, sizes, spare)
        reply = _noted(
            {**reply, key: [rows[index] for index in kept]},
            _rows_note(key, len(kept), len(rows), max_chars),
        )
    return reply


def _rows_that_fit(key: str, sizes: Sequence[int], spare: int) -> list[int]:
    def places(count: int) -> list[int]:
        return evenly(len(sizes), count) if key in EVENLY_THINNED else list(range(count))

    def fits(count: int) -> bool:
        return sum(sizes[index] for index in places(count)) <= spare

    return places(_largest(_FEWEST_ROWS, len(sizes), fits) or _FEWEST_ROWS)


def _rows_note(key: str, kept: int, total: int, max_chars: int) -> str:
    if key in EVENLY_THINNED:
        how, more = "evenly spaced", "ask for a shorter window or for fewer fields to see more"
    else:
        how, more = "from the beginning", "ask more narrowly to see others"
    return (
        f"{key}: {kept} of {total} kept, {how}, to keep the reply under {max_chars} "
        f"characters; {more}"
    )


def _less_inside(reply: JsonObject, max_chars: int) -> JsonObject:
    """Thins what stands inside the rows: arrays, then texts, then keys of wide objects."""
    note_room = max_chars - _LONGEST_NOTE if max_chars > 3 * _LONGEST_NOTE else max_chars * 2 // 3

    def fits(keys: int, arrays: int, text: int) -> bool:
        return len(to_json_text(_Shorter(keys, arrays, text).reply(reply))) <= note_room

    whole = len(to_json_text(reply))
    longest = _largest(_ARRAY_STEPS[0], max_chars, lambda size: fits(whole, size, whole))
    if longest is not None:
        return _shortened(reply, _Shorter(whole, longest, whole), max_chars)
    for arrays in _ARRAY_STEPS:
        text = _largest(_SHORTEST_TEXT, max_chars, partial(fits, whole, arrays))
        if text is not None:
            return _shortened(reply, _Shorter(whole, arrays, text), max_chars)
    fewest, shortest = _ARRAY_STEPS[-1], _SHORTEST_TEXT // 4
    keys = next((step for step in _KEY_STEPS if fits(step, fewest, shortest)), _KEY_STEPS[-1])
    return _shortened(reply, _Shorter(keys, fewest, shortest), max_chars)


def _shortened(reply: JsonObject, shorter: _Shorter, max_chars: int) -> JsonObject:
    short = shorter.reply(reply)
    touched = list(shorter.touched.items())
    named = [f"{_in_fields(path)} ({how}{kept})" for (path, how), kept in touched[:_MOST_NAMES]]
    if len(touched) > _MOST_NAMES:
        named.append(f"and {len(touched) - _MOST_NAMES} more")
    sentence = (
        f"shortened to keep the reply under {max_chars} characters: {', '.join(named)}; "
        "name one of them in fields to see more of it"
    )
    return _noted(short, _cut_text(sentence, _LONGEST_NOTE - 50))


def _in_fields(path: str) -> str:
    """The dot-path as the `fields` argument takes it: counted from the value of a sample."""
    return path.removeprefix("samples.").removeprefix("value.")


class _Shorter:
    """One set of limits, and what they touched: (dot-path without indices, how), and how much.

    How much is that of the longest list or widest object at the path; empty for texts.
    """

    def __init__(self, keys: int, arrays: int, text: int) -> None:
        self._keys = keys
        self._arrays = arrays
        self._text = text
        self.touched: dict[tuple[str, str], str] = {}
        self._most: dict[tuple[str, str], int] = {}

    def reply(self, reply: JsonObject) -> JsonObject:
        """The reply with everything below its first level within the limits."""
        self.touched.clear()
        self._most.clear()
        return {
            key: item if key == "notes" else self._top(key, item) for key, item in reply.items()
        }

    def _touch(self, path: str, how: str, kept: int, total: int) -> None:
        if total > self._most.get((path, how), 0):
            self._most[path, how] = total
            self.touched[path, how] = f": {kept} of {total} kept"

    def _top(self, key: str, item: JsonValue) -> JsonValue:
        if isinstance(item, list):
            return [self._value(row, key) for row in item]
        return self._value(item, key)

    def _value(self, value: JsonValue, path: str) -> JsonValue:
        if isinstance(value, str):
            if len(value) <= self._text:
                return value
            self.touched[path, "texts cut"] = ""
            return _cut_text(value, self._text)
        if isinstance(value, list):
            return self._array(value, path)
        if isinstance(value, dict):
            return self._object(value, path)
        return value

    def _array(self, value: list[JsonValue], path: str) -> JsonValue:
        kept = evenly(len(value), self._arrays)
        if len(kept) < len(value):
            self._touch(path, "evenly thinned", len(kept), len(value))
        return [self._value(value[index], path) for index in kept]

    def _object(self, value: JsonObject, path: str) -> JsonValue:
        kept = list(value.items())[: self._keys]
        if len(kept) < len(value):
            self._touch(path, "keys left out", len(kept), len(value))
        return {
            _cut_text(key, self._text): self._value(item, f"{path}.{key}") for key, item in kept
        }


def _cut(value: JsonValue, length: int) -> JsonValue:
    return _cut_text(value, length) if isinstance(value, str) else value


def _cut_text(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + _CUT


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int | None:
    """The largest number from `low` to `high` that fits, by halving; None where `low` does not."""
    if not fits(low):
        return None
    while low < high:
        middle = (low + high + 1) // 2
        if fits(middle):
            low = middle
        else:
            high = middle - 1
    return low
