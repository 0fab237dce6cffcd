"""The names of levels in logs and diagnostics: WARN is 30 in `/rosout`, and 1 in diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import listed

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from ros2_memory.core.model import JsonValue

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
