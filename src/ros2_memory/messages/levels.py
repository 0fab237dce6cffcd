"""The names of levels in logs and diagnostics: WARN is 30 in `/rosout`, and 1 in diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import listed

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

FIELD: Final = "level"
_LOG: Final = {"DEBUG": 10, "INFO": 20, "WARN": 30, "ERROR": 40, "FATAL": 50}
_STATUS: Final = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}
_FOXGLOVE: Final = {"DEBUG": 1, "INFO": 2, "WARN": 3, "ERROR": 4, "FATAL": 5}
FOXGLOVE_LOGS: Final = frozenset({"foxglove.Log", "foxglove_msgs/msg/Log"})
_BY_TYPE: Final[Mapping[str, Mapping[str, int]]] = {
    "rcl_interfaces/msg/Log": _LOG,
    **dict.fromkeys(FOXGLOVE_LOGS, _FOXGLOVE),
    "diagnostic_msgs/msg/DiagnosticArray": _STATUS,
    "diagnostic_msgs/msg/DiagnosticStatus": _STATUS,
}
_BESIDE: Final = (
    (frozenset({"msg"}), _LOG),
    (frozenset({"message", "hardware_id"}), _STATUS),
    (frozenset({"message", "timestamp"}), _FOXGLOVE),
)
"""Levels of messages of unknown type, by the fields beside `level`."""


def level_number(value: JsonValue, field: str | None, type_name: str) -> JsonValue:
    """Returns the value of a condition, with the number of a level in place of its name.

    Args:
        value: of the condition.
        field: the dot-path that the condition is on; only `level` has names.
        type_name: the type of the messages; a value for a type without levels is returned itself.

    Raises:
        InvalidArgumentsError: messages of the type have no level of that name.
    """
    levels = _BY_TYPE.get(type_name)
    if levels is None or not _is_name_of_level(value, field):
        return value
    word = str(value).strip().upper()
    number = levels.get("WARN" if word == "WARNING" else word)
    if number is None:
        known = ", ".join(f"{name} ({level})" for name, level in levels.items())
        raise InvalidArgumentsError(f"{value!r} is no level of {type_name}: these are {known}")
    return number


def level_path(value: JsonValue, type_name: str) -> str | None:
    """Returns the dot-path of the level in messages of a type; None if the value names no level."""
    levels = _BY_TYPE.get(type_name, {})
    word = value.strip().upper() if isinstance(value, str) else ""
    if not levels or word not in {"WARNING", *levels}:
        return None
    return f"status.{FIELD}" if type_name.endswith("/DiagnosticArray") else FIELD


def unknown_name_hint(value: JsonValue, field: str | None, types: Collection[str]) -> str:
    """Returns what is added to the error of a condition that needs a number and got a level's name.

    Empty if the value is no such name. `types` are the types of the messages asked about.
    """
    if not _is_name_of_level(value, field):
        return ""
    if len(types) > 1:
        return "; levels have names where the topics asked about are of one type: name one topic"
    return f"; names of levels are not known of {listed(sorted(types))}: give the number"


def _is_name_of_level(value: JsonValue, field: str | None) -> bool:
    is_name = isinstance(value, str) and value.strip().isalpha()
    return is_name and (field or "").strip().rpartition(".")[2] == FIELD


def with_level_names(value: JsonValue, type_name: str | None = None) -> JsonValue:
    """Returns a value with names beside the numbers of levels, for people: `WARN (30)`.

    `type_name` is the message type; without it the fields beside a level tell its names.
    """
    if isinstance(value, list):
        return [with_level_names(element, type_name) for element in value]
    if not isinstance(value, dict):
        return value
    shown = {key: with_level_names(part, type_name) for key, part in value.items()}
    number = value.get(FIELD)
    if isinstance(number, int) and not isinstance(number, bool):
        levels = _levels_beside(value) if type_name is None else _BY_TYPE.get(type_name, {})
        for name, level in levels.items():
            if level == number:
                shown[FIELD] = f"{name} ({number})"
    return shown


def _levels_beside(value: JsonObject) -> Mapping[str, int]:
    """Returns the levels of an extracted value by the fields beside `level`; else none."""
    for fields, levels in _BESIDE:
        if fields <= value.keys():
            return levels
    return {}
