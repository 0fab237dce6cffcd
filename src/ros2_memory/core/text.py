"""Text for people: counts and names in sentences, values in few characters, globs over names.

And texts that messages say, which a planner must not obey. What people say to a robot, what nodes
log and what a network names reaches a language model with the reply. Such a text is `Quoted`, and
so is a sentence that repeats one; `quoted_keys` finds where they stand in a reply, which lists
these places first. Frames, labels of detections, nodes, joints and the like are names: they are
quoted as soon as they are more than two words, since a bag, or a network that names what it sees in
its own words, can hold a sentence there.
"""

from __future__ import annotations

import json
import re
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import translate
from itertools import islice
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.core.model import JsonValue

MAX_LABEL_CHARS: Final = 256
"""A longer label of a detection is cut, and ends with an ellipsis."""
MAX_NAMED: Final = 3
"""How many names a sentence lists before it counts the rest."""
_MAX_NAME_CHARS: Final = 160
_LONGEST_COMPARED: Final = 256
_SHORTEST_PART: Final = 3
_MAX_DEPTH: Final = 3
_MAX_ITEMS: Final = 8
_MAX_TEXT_CHARS: Final = 80
_MAX_INTEGER_BITS: Final = 128
_ELLIPSIS: Final = "…"
LABELS: Final = ("label", "class_id", "class_name", "class", "object")
"""Fields with the label of a detection, the first that is there."""
LISTS_OF_LABELS: Final = frozenset({"labels", "class_ids", "objects", "classes"})
NAMED_IN_TYPES: Final = {
    frozenset({"family", "id"}): "id",  # apriltag_msgs, isaac_ros_apriltag_interfaces
    frozenset({"marker_id", "pose"}): "marker_id",  # aruco_opencv_msgs
    frozenset({"Class", "probability"}): "Class",  # darknet_ros_msgs of ROS 1
}
"""The name of an object that has these fields, for types in which no label says what was seen."""
_FRAMES: Final = ("frame_id", "child_frame_id", "parent", "child")
_OTHER_NAMES: Final = (
    *("name", "names", "hardware_id", "type", "encoding", "format", "skill", "family"),
)
NAMES_IN_MESSAGES: Final = LISTS_OF_LABELS.union(
    LABELS, NAMED_IN_TYPES.values(), _FRAMES, _OTHER_NAMES
)
"""Fields of messages that hold names."""
_NAME: Final = re.compile(r"[A-Za-z0-9_./:+-]{1,80}( [A-Za-z0-9_./:+-]{1,20})?")
"""One word, or two: `map`, `traffic light`."""
_JSON: Final = frozenset("[{")
_STRINGS: Final = re.compile(r'"(?:[^"\\]|\\.)*+"|\\.', re.DOTALL)
"""Strings of JSON. An escape is passed over where the string around it does not end: else the
search begins again at each quote that is escaped."""
_MOST_KEYS: Final = 12
_MOST_KEYS_CHARS: Final = 300
"""Of more places, or longer ones, a reply lists its own keys above them."""


def looks_like_json(text: str) -> bool:
    """Returns whether a text begins as a JSON array or object does."""
    return text.lstrip()[:1] in _JSON


def caseless(text: str) -> str:
    """Returns a text as it is compared: without regard to case, and to how letters are written.

    That is to accents, and in JSON to escapes, as of all letters that are not ASCII.
    """
    if "\\" in text and looks_like_json(text):
        text = _STRINGS.sub(_unescaped, text)
    folded = text.casefold()
    return folded if folded.isascii() else unicodedata.normalize("NFC", folded)


def _unescaped(match: re.Match[str]) -> str:
    """Returns a string of JSON as it is meant, in quotes; anything else as it is."""
    if match[0][0] == '"' and "\\" in match[0]:
        with suppress(ValueError):
            return f'"{json.loads(match[0], strict=False)}"'
    return match[0]


def similar(name: str, names: Iterable[str], at_most: int = 3) -> list[str]:
    """Returns names that contain one or are part of it, the nearest first, then those like it.

    Without regard to case.
    """
    asked = caseless(name[:_LONGEST_COMPARED])
    by_folded = {caseless(other): other for other in names}
    parts = [other for other in by_folded if asked in other or other in asked]
    parts = [other for other in parts if min(len(asked), len(other)) >= _SHORTEST_PART]
    parts.sort(key=lambda other: abs(len(other) - len(asked)))
    near = dict.fromkeys([*parts, *get_close_matches(asked, by_folded, at_most)])
    return [by_folded[other] for other in near][:at_most]


def dotted(path: str, name: str) -> str:
    """Returns the dot-path of a field; `path` is that of the message around it, if any."""
    return f"{path}.{name}" if path else name


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """Returns a number and its noun: `1 jump`, `2 jumps`."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def listed(names: Sequence[str], count: int | None = None, at_most: int = MAX_NAMED) -> str:
    """Returns the first few names, and how many more there are of `count` (or of the names)."""
    more = (len(names) if count is None else count) - min(len(names), at_most)
    shown = ", ".join(shortened(name) for name in names[:at_most])
    return f"{shown} and {more} more" if more > 0 else shown


def shortened(text: str, max_chars: int = _MAX_NAME_CHARS) -> str:
    """Returns the text, cut to `max_chars` with an ellipsis; a quoted one stays so."""
    return text if len(text) <= max_chars else type(text)(text[: max_chars - 1] + _ELLIPSIS)


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
        named = [
            f"{name} ({detail})" if detail else name for name, detail in sorted(things.items())
        ]
        subject = f"{self.of}{counted(len(things), self.noun, self.plural)}"
        return f"{subject} {self.many or self.what}: {listed(named)}"


def match_topics(names: Iterable[str], glob: str) -> list[str]:
    """Returns the names that a glob matches, in their order.

    `*`, `?` and `[...]` work as in a shell, except that a slash is a character like any other.
    Upper and lower case differ. A glob that is a name matches itself, too. `fnmatch.filter`
    matches likewise, but caches 32,768 globs: clients could fill memory with them.
    """
    matches = re.compile(translate(glob)).match
    return [name for name in names if name == glob or matches(name)]


def abbreviate(value: object, max_chars: int = 80) -> str:
    """Returns the value in the manner of JSON, in at most `max_chars` characters.

    Takes no longer for a value of any depth, length or number of digits than for a short one. An
    ellipsis marks what is left out. NaN and infinities are shown as such; a lone surrogate is
    escaped.
    """
    text = json.dumps(_pruned(value, _MAX_DEPTH), ensure_ascii=False, default=_type_name)
    return shortened(encodable(text), max_chars)


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


class Quoted(str):
    """A text that a message says, or one that repeats it."""

    __slots__ = ()


def named(name: str) -> str:
    """Returns the name of a frame or a label; quoted if it is more than two words."""
    return name if not name or _NAME.fullmatch(name) else Quoted(name)


def repeating(sentence: str, names: Iterable[str]) -> str:
    """Returns a sentence with names of frames or labels in it; quoted if one of them is."""
    return Quoted(sentence) if any(isinstance(named(name), Quoted) for name in names) else sentence


def still_quoted(text: str, *parts: str) -> str:
    """Returns a text that was made with parts of it; quoted if one of these is."""
    return Quoted(text) if any(isinstance(part, Quoted) for part in parts) else text


def quote(value: JsonValue, field: str = "") -> JsonValue:
    """Returns a value of a message with its texts quoted; `field` is the path that it is of."""
    if isinstance(value, str):
        is_name = not value or field.rpartition(".")[2] in NAMES_IN_MESSAGES
        return named(value) if is_name else Quoted(value)
    if isinstance(value, dict):
        return {named(name): quote(part, name) for name, part in value.items()}
    if isinstance(value, list) and any(isinstance(part, str | dict | list) for part in value):
        return [quote(part, field) for part in value]
    return value


def quoted_keys(reply: JsonValue) -> list[str]:
    """Returns the dot-paths of the keys of a reply at which quoted texts stand, without indices.

    A cell of a table (`fields`, `rows`) is at `rows` and the name of its column.
    """
    paths: dict[str, None] = {}
    columns = reply.get("fields") if isinstance(reply, dict) else None
    rows = reply.get("rows") if isinstance(reply, dict) else None
    if isinstance(reply, dict) and isinstance(columns, list) and isinstance(rows, list):
        for row in rows:
            for name, cell in zip(columns, row if isinstance(row, list) else (), strict=True):
                _add_quoted_paths(
                    cell, f"rows.{name}" if not isinstance(name, Quoted) else "rows", paths
                )
        reply = {key: value for key, value in reply.items() if key != "rows"}
    _add_quoted_paths(reply, "", paths)
    if len(paths) > _MOST_KEYS or sum(map(len, paths)) > _MOST_KEYS_CHARS:
        paths = dict.fromkeys(path.partition(".")[0] for path in paths)
    return [*paths]


def _add_quoted_paths(value: JsonValue, path: str, paths: dict[str, None]) -> None:
    if isinstance(value, Quoted):
        paths[path] = None
    elif isinstance(value, list):
        for part in value:
            _add_quoted_paths(part, path, paths)
    elif isinstance(value, dict):
        for name, part in value.items():
            if isinstance(name, Quoted):
                paths[path] = None
                _add_quoted_paths(part, path, paths)
            else:
                _add_quoted_paths(part, dotted(path, name), paths)
