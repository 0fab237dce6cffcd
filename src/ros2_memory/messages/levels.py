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
_BESIDE: Final = (
    (frozenset({"msg"}), _LOG),
    (frozenset({"message", "hardware_id"}), _STATUS),
    (frozenset({"message", "timestamp"}), _FOXGLOVE),
)
"""Fields beside `level` by which an extracted value is one of a log, or a status."""


def level_number(value: JsonValue, field: str | None, type_name: str) -> JsonValue:
    """Returns the number of a level, where a condition on `level` gives its name; else the value.

    Raises:
        InvalidArgumentsError: messages of the type have no level of that name.
    """
    names = _BY_TYPE.get(type_name)
    if names is None or not _is_name_of_level(value, field):
        return value
    word = str(value).strip().upper()
    number = names.get("WARN" if word == "WARNING" else word)
    if number is None:
        levels = ", ".join(f"{name} ({level})" for name, level in names.items())
        raise InvalidArgumentsError(f"{value!r} is no level of {type_name}: these are {levels}")
    return number


def level_path(value: JsonValue, type_name: str) -> str | None:
    """Returns the path of the level in messages of a type, where a value is the name of one."""
    names = _BY_TYPE.get(type_name, {})
    word = value.strip().upper() if isinstance(value, str) else ""
    if not names or word not in {"WARNING", *names}:
        return None
    return f"status.{FIELD}" if type_name.endswith("/DiagnosticArray") else FIELD


def unknown_name_hint(value: JsonValue, field: str | None, types: Collection[str]) -> str:
    """Returns the end of the sentence on a condition that needs a number and got a level's name.

    Empty where the value is no such name. `types` are those of the messages asked about.
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

    Without its type they are known by the fields beside them.
    """
    if isinstance(value, list):
        return [with_level_names(inner, type_name) for inner in value]
    if not isinstance(value, dict):
        return value
    shown = {key: with_level_names(inner, type_name) for key, inner in value.items()}
    number = value.get(FIELD)
    beside = next((names for keys, names in _BESIDE if keys <= value.keys()), None)
    names = beside if type_name is None else _BY_TYPE.get(type_name)
    if names is not None and isinstance(number, int) and not isinstance(number, bool):
        name = next((inner for inner, level in names.items() if level == number), None)
        if name is not None:
            shown[FIELD] = f"{name} ({number})"
    return shown
