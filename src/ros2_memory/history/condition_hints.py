"""What a condition may be about: constants of message definitions, and frames of positions."""

from __future__ import annotations

import re
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.conditions import Condition, NearPosition
from ros2_memory.core.errors import BagError, InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.messages.conversions import constants_of_field
from ros2_memory.messages.detections import detections_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Schema

_ELSEWHERE: Final = "for another frame, such as the map, ask visits, or give where"
_INTEGER: Final = r"(?:u?int[0-9]+|byte|char|octet|(?:unsigned[ \t]+)?(?:short|long))"
_CONSTANT: Final = re.compile(
    rf"^[ \t]*(?:const[ \t]+)?{_INTEGER}[ \t]+([A-Z][A-Z0-9_]*)[ \t]*=[ \t]*(-?[0-9]+)"
    r"\s*(?:[#;]|$)",
    re.MULTILINE,
)
"""A constant that is a whole number, in the text of a message definition, or in IDL."""
_CONSTANT_NAME: Final = re.compile(r"[A-Z][A-Z0-9_]*")
_NUMBER_FIELD: Final = re.compile(
    rf"^[ \t]*(?:{_INTEGER}|float[0-9]*|double)[ \t]+([a-z]\w*)", re.MULTILINE
)
_SEPARATOR: Final = re.compile(r"^={40,}[ \t]*$", re.MULTILINE)
"""A line between the definitions of a type and of its parts."""
_MOST_CONSTANTS: Final = 16
"""How many constants a refusal lists."""
_MOST_FRAMES: Final = 3
"""The frames of this many topics are named: each reads one message."""


def constant_number(view: View, value: JsonValue, field: str, type_name: str) -> JsonValue:
    """Returns the number of a constant if the value is its name and the field a number.

    Constants of the part that has the field come first. Else returns the value.
    """
    word = value.strip().upper() if isinstance(value, str) else ""
    if not _CONSTANT_NAME.fullmatch(word):
        return value
    shown, _, below = field.partition(".")
    path = below or ".".join(view.extractor.fields_of(type_name).get(shown, (shown,)))
    schemas = schemas_of(view, type_name)
    for read in (_constants_beside, _constants_of):
        constants = chain.from_iterable(read(schema, path) for schema in schemas)
        numbers = {number for constant, number in constants if constant == word}
        if numbers:
            return int(numbers.pop()) if len(numbers) == 1 else value
    return value


def _constants_beside(schema: Schema, path: str) -> list[tuple[str, str]]:
    """Returns the constants of the number at a dot-path; of every number for an empty path."""
    _, _, name = path.rpartition(".")
    constants: list[tuple[str, str]] = []
    for part in _SEPARATOR.split(_text_of(schema)):
        fields = _NUMBER_FIELD.findall(part)
        for field in fields:
            if name in {"", field}:
                constants += constants_of_field(field, fields, _CONSTANT.findall(part))
    return constants


def _constants_of(schema: Schema, path: str) -> list[tuple[str, str]]:
    """Returns all constants of a definition, if a dot-path leads to a number in it."""
    _, _, name = path.rpartition(".")
    text = _text_of(schema)
    return _CONSTANT.findall(text) if name in _NUMBER_FIELD.findall(text) else []


def names_of_numbers(
    view: View, topic: str, field: str | None, numbers: Collection[str]
) -> Iterator[str]:
    """Yields for each type of a topic a sentence with the constants of some numbers in a field."""
    for type_name in view.timeline.types_of(topic):
        schemas = schemas_of(view, type_name)
        constants = chain.from_iterable(
            _constants_beside(schema, field or "") for schema in schemas
        )
        named = _listed(constant for constant in constants if constant[1] in numbers)
        if named:
            yield f"numbers of {type_name}: {named}"


def _listed(constants: Iterable[tuple[str, str]]) -> str:
    named = [f"{name} = {number}" for name, number in dict.fromkeys(constants)]
    return listed(named, at_most=_MOST_CONSTANTS)


def schemas_of(view: View, type_name: str) -> list[Schema]:
    """Returns the definitions of a recorded type in the first and the last file that have it.

    They differ after an update of the robot. None are returned of a damaged file.
    """
    timeline = view.timeline
    topic = next(name for name in timeline.topics() if type_name in timeline.types_of(name))
    schemas: list[Schema] = []
    bags = [timeline.bag_with(topic, type_name, last=last) for last in (False, True)]
    for path in dict.fromkeys(bag.path for bag in bags):
        with suppress(BagError):
            channels = view.memory.reader.channels(path)
            schemas += [channel.schema for channel in channels if channel.type == type_name]
    return schemas


def _text_of(schema: Schema) -> str:
    return schema.text.decode("utf-8", "replace")


def constants_named(schema: Schema, field: str, word: str) -> list[str]:
    """Returns the constants of a definition that a word names, with their values.

    A constant whose whole name is the word, or the field and the word, comes alone. Else all are
    returned that have the word between underscores.
    """
    wanted = "_".join(word.upper().split())
    constants = dict.fromkeys(_CONSTANT.findall(_text_of(schema))) if wanted else {}
    whole_names = {wanted, f"{field.upper()}_{wanted}"}
    named = [(name, value) for name, value in constants if name in whole_names]
    if not named:
        named = [(name, value) for name, value in constants if f"_{wanted}_" in f"_{name}_"]
    return [f"{name} = {value}" for name, value in named]


def hint_on_constants(schema: Schema, field: str, word: str) -> str:
    """Returns a clause on the constants that a word may mean, else on all of the field, if any."""
    _, _, name = field.rpartition(".")
    named = constants_named(schema, name, word)
    if named:
        # Without a field, the number would also match in the bytes of an id.
        advice = "" if field else ": ask equals on the field of that number"
        return f", such as {listed(named)}{advice}"
    of_field = _listed(_constants_beside(schema, field))
    return f", or one of {of_field}" if of_field else ""


def compared_frames(
    view: View, topics: Sequence[str], condition: Condition, window: TimeWindow
) -> tuple[str, ...]:
    """Returns a note on the frames in which `near_position` compared; none for another test."""
    if not isinstance(condition.test, NearPosition):
        return ()
    frames_of = position_frames(view, topics, window)
    named = [f"{', '.join(frames)} ({topic})" for topic, frames in frames_of]
    if not named:
        return ()
    axes = "x and y" if condition.test.z is None else "x, y and z"
    note = (
        f"near_position compared {axes} within {condition.test.tolerance_m:g} m in "
        f"{listed(named)}; {_ELSEWHERE}"
    )
    return (note,)


def require_frame(
    view: View, topics: Sequence[str], condition: Condition, window: TimeWindow | None = None
) -> None:
    """Checks that a topic has positions in the frame that `near_position` names, if it does.

    Raises:
        InvalidArgumentsError: a topic has positions in other frames.
    """
    asked = condition.test.frame_id if isinstance(condition.test, NearPosition) else None
    if not asked:
        return
    for topic, frames in position_frames(view, topics, window):
        if asked.lstrip("/") not in {frame.lstrip("/") for frame in frames}:
            raise InvalidArgumentsError(
                f"value: frame_id is {abbreviate(asked)}, and near_position compares x and y in "
                f"the frame of each message, which is {', '.join(frames)} on {topic}; {_ELSEWHERE}"
            )


def position_frames(
    view: View, topics: Sequence[str], window: TimeWindow | None = None
) -> list[tuple[str, list[str]]]:
    """Returns the topics that have positions, with the frames of these; reads the first few.

    They are those of the first and the last message (in a window): an update may rename a frame.
    """
    asked = window or TimeWindow.everything()
    found: list[tuple[str, list[str]]] = []
    for topic in topics[:_MOST_FRAMES]:
        frames: set[str] = set()
        with suppress(QueryTimeoutError):
            for newest_first in (True, False):
                stored = view.stream.first([topic], asked, newest_first=newest_first)
                frames.update(_frames_in(view, stored))
        if frames:
            found.append((topic, sorted(frames)))
    return found


def _frames_in(view: View, stored: StoredMessage | None) -> Iterator[str]:
    """Yields the frames of the positions in a message, if it can be decoded."""
    message = view.bags.decode(stored)
    if stored is None or message is None:
        return
    extractor, type_name = view.extractor, stored.type
    own_frame = extractor.frame(message)
    seen = detections_of(extractor.exact(message, type_name), own_frame)
    frames = {detection.frame_id for detection in seen if detection.place is not None}
    pose = extractor.pose(message, type_name)
    yield from filter(None, frames or {own_frame if pose is None else pose.frame_id})
