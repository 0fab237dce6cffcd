"""Text for people: counts and names in sentences, values in few characters, globs over names.

And texts of messages, which a planner must not obey. The words of people, of logs and of networks
reach a language model with the reply. Such a text is `Quoted`, and so is a sentence that repeats
one. A reply lists first where its `Quoted` texts stand (`quoted_keys`). Frames, labels of
detections, nodes, joints and the like are names. A name is `Quoted` if it has more than two words:
a bag, or a network that describes what it sees, can hold a sentence there.
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
    from collections.abc import Iterable, Iterator, Mapping, Sequence

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
_DIGITS_PER_BIT: Final = 0.30103  # log10(2)
_ELLIPSIS: Final = "…"
LABELS: Final = ("label", "class_id", "class_name", "class", "object")
"""Fields that may have the label of a detection; the first one that a message has counts."""
LISTS_OF_LABELS: Final = frozenset({"labels", "class_ids", "objects", "classes"})
LOOKED_FOR: Final = "classes"
"""Without a list or an object beside it, this list says what a detector is to look for."""
NAMED_IN_TYPES: Final = {
    frozenset({"family", "id"}): "id",  # apriltag_msgs, isaac_ros_apriltag_interfaces
    frozenset({"marker_id", "pose"}): "marker_id",  # aruco_opencv_msgs
    frozenset({"Class", "probability"}): "Class",  # darknet_ros_msgs of ROS 1
}
"""The field that names an object with these fields, in types without a label."""
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
"""A string of JSON; or one escape, in a text whose string does not end: else the search would begin
again at each escaped quote."""
_ACCENTS: Final = re.compile("[\u0300-\u036f]")
"""Accents of Latin, Greek and Cyrillic letters; marks of other scripts are vowels or consonants."""
_MOST_KEYS: Final = 12
_MOST_KEYS_CHARS: Final = 300
"""Of more or longer paths, a reply lists the first keys only."""


def looks_like_json(text: str) -> bool:
    """Returns whether a text begins as a JSON array or object does."""
    return text.lstrip()[:1] in _JSON


def caseless(text: str) -> str:
    """Returns a text as texts are compared: without case and accents, else as NFC.

    Escapes of letters in a JSON text are resolved.
    """
    if "\\" in text and looks_like_json(text):
        text = _STRINGS.sub(_unescaped, text)
    folded = text.casefold()
    if folded.isascii():
        return folded
    bare = _ACCENTS.sub("", unicodedata.normalize("NFD", folded))
    return unicodedata.normalize("NFC", bare)


def _unescaped(match: re.Match[str]) -> str:
    """Returns a matched JSON string without its escapes, in quotes; any other match as it is."""
    if match[0][0] == '"' and "\\" in match[0]:
        with suppress(ValueError):
            return f'"{json.loads(match[0], strict=False)}"'
    return match[0]


def similar(name: str, names: Iterable[str], at_most: int = 3) -> list[str]:
    """Returns the names that contain `name` or are part of it, then others like it; ignores case.

    Of the first kind those of the nearest length come first.
    """
    asked = caseless(name[:_LONGEST_COMPARED])
    by_folded = {caseless(other): other for other in names}
    parts = []
    for other in by_folded:
        is_part = asked in other or other in asked
        if is_part and min(len(asked), len(other)) >= _SHORTEST_PART:
            parts.append(other)
    parts.sort(key=lambda other: abs(len(other) - len(asked)))
    near = dict.fromkeys([*parts, *get_close_matches(asked, by_folded, at_most)])
    return [by_folded[other] for other in near][:at_most]


def dotted(path: str, name: str) -> str:
    """Returns the dot-path of a field; `path` is that of the message around it, or empty."""
    return f"{path}.{name}" if path else name


def leaves(value: JsonValue, path: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Yields the innermost values of nested objects by dot-path; a list, or {}, is one value."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from leaves(inner, dotted(path, name))
    else:
        yield path, value


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """Returns a number and its noun: `1 jump`, `2 jumps`."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def listed(names: Sequence[str], count: int | None = None, at_most: int = MAX_NAMED) -> str:
    """Returns the first names, and how many more there are: `a, b, c and 4 more`.

    `count` is the number of all names, if `names` has not all of them.
    """
    more = (len(names) if count is None else count) - min(len(names), at_most)
    shown = ", ".join(shortened(name) for name in names[:at_most])
    return f"{shown} and {more} more" if more > 0 else shown


def shortened(text: str, max_chars: int = _MAX_NAME_CHARS) -> str:
    """Returns the text, cut to `max_chars` with an ellipsis; a `Quoted` one stays `Quoted`."""
    return text if len(text) <= max_chars else type(text)(text[: max_chars - 1] + _ELLIPSIS)


def encodable(text: str) -> str:
    """Returns the text with lone surrogates, which UTF-8 cannot hold, escaped as in JSON."""
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


@dataclass(frozen=True, slots=True)
class Reason:
    """A fault that several things can share, reported in one sentence.

    Attributes:
        what: the sentence after its subject.
        noun: what the things are.
        plural: of the noun, if it is not the noun with an s.
        of: precedes the noun or the name, such as "messages of ".
        many: `what` for several things, if it differs.
    """

    what: str
    noun: str
    plural: str | None = None
    of: str = ""
    many: str | None = None

    def sentence(self, things: Mapping[str, str]) -> str:
        """Returns the sentence on things; `things` has a detail, or an empty text, by name."""
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

    `*`, `?` and `[...]` work as in a shell, but also match slashes; case counts. A name matches
    itself, whatever characters it has. `fnmatch.filter` does the same, but caches 32,768 globs:
    clients could fill memory with them.
    """
    matches = re.compile(translate(glob)).match
    return [name for name in names if name == glob or matches(name)]


def abbreviate(value: object, max_chars: int = 80) -> str:
    """Returns the value in the manner of JSON, in at most `max_chars` characters.

    Takes no longer for a value of any depth, length or number of digits than for a short one. An
    ellipsis marks what is left out. NaN and infinities are shown as such; a lone surrogate is
    escaped.
    """
    text = json.dumps(
        _pruned(value, _MAX_DEPTH),
        ensure_ascii=False,
        default=lambda other: f"a {type(other).__name__}",
    )
    return shortened(encodable(text), max_chars)


def _pruned(value: object, levels: int) -> object:
    """Returns a value without items below `levels` levels, and with long parts cut."""
    if isinstance(value, str):
        return value if len(value) <= _MAX_TEXT_CHARS else value[:_MAX_TEXT_CHARS] + _ELLIPSIS
    if isinstance(value, int) and value.bit_length() > _MAX_INTEGER_BITS:
        # Python refuses to convert integers of thousands of digits to decimal.
        return f"a number of {value.bit_length() * _DIGITS_PER_BIT:.0f} digits"
    if not isinstance(value, dict | list | tuple):
        return value
    if value and not levels:
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


class Quoted(str):
    """A text of a message, or a sentence that repeats one."""

    __slots__ = ()


def named(name: str) -> str:
    """Returns the name of a frame or a label, `Quoted` if it is more than two words."""
    return name if not name or _NAME.fullmatch(name) else Quoted(name)


def repeating(sentence: str, names: Iterable[str]) -> str:
    """Returns a sentence, `Quoted` if one of the names of frames or labels in it is."""
    return Quoted(sentence) if any(isinstance(named(name), Quoted) for name in names) else sentence


def still_quoted(text: str, *parts: str) -> str:
    """Returns a text, `Quoted` if one of its parts is."""
    return Quoted(text) if any(isinstance(part, Quoted) for part in parts) else text


def quote(value: JsonValue, field: str = "") -> JsonValue:
    """Returns a value of a message with its texts `Quoted`; `field` is its dot-path.

    Texts in a field for names are treated as names.
    """
    if isinstance(value, str):
        is_name = not value or field.rpartition(".")[2] in NAMES_IN_MESSAGES
        return named(value) if is_name else Quoted(value)
    if isinstance(value, dict):
        return {named(name): quote(part, name) for name, part in value.items()}
    if isinstance(value, list) and any(isinstance(part, str | dict | list) for part in value):
        return [quote(part, field) for part in value]
    return value


def quoted_keys(reply: JsonValue) -> list[str]:
    """Returns the dot-paths of a reply at which `Quoted` texts stand, without indices of lists.

    A cell of a table (`fields`, `rows`) is at `rows` and the name of its column. If there are many
    paths, only the first key of each is returned.
    """
    paths: dict[str, None] = {}
    columns = reply.get("fields") if isinstance(reply, dict) else None
    rows = reply.get("rows") if isinstance(reply, dict) else None
    if isinstance(reply, dict) and isinstance(columns, list) and isinstance(rows, list):
        for row in rows:
            for name, cell in zip(columns, row if isinstance(row, list) else (), strict=True):
                path = "rows" if isinstance(name, Quoted) else f"rows.{name}"
                paths |= dict.fromkeys(_quoted_paths(cell, path))
        reply = {key: value for key, value in reply.items() if key != "rows"}
    paths |= dict.fromkeys(_quoted_paths(reply, ""))
    if len(paths) > _MOST_KEYS or sum(map(len, paths)) > _MOST_KEYS_CHARS:
        paths = dict.fromkeys(path.partition(".")[0] for path in paths)
    return [*paths]


def _quoted_paths(value: JsonValue, path: str) -> Iterator[str]:
    """Yields the dot-path of each `Quoted` text and key in a value at `path`."""
    if isinstance(value, Quoted):
        yield path
    elif isinstance(value, list):
        for part in value:
            yield from _quoted_paths(part, path)
    elif isinstance(value, dict):
        for name, part in value.items():
            if isinstance(name, Quoted):
                yield path
                yield from _quoted_paths(part, path)
            else:
                yield from _quoted_paths(part, dotted(path, name))
