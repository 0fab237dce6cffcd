"""Checks composed data against `settings.py`, and says what is wrong with it in plain sentences."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Final, TypeVar, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from ros2_memory.core.errors import ConfigError
from ros2_memory.settings import McapNode, NullRecorderNode, Ros2BagNode, Rosbag2Node

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pydantic_core import ErrorDetails

_T = TypeVar("_T")

_NODES: Final = {
    get_args(get_type_hints(node)["target"])[0]: node
    for node in (McapNode, Rosbag2Node, Ros2BagNode, NullRecorderNode)
}
_RULES: Final = {
    "tuple_type": "must be a list",
    "path_type": "must be a path",
    "string_too_short": "must not be empty",
}


def validated(
    model: type[_T],
    data: object,
    *,
    config_dir: Path,
    source: Callable[[str], str],
    raw: object = None,
) -> _T:
    """`data` as a `model`.

    Args:
        model: `Settings` or `MessageSchemas`.
        data: the composed configuration, interpolations resolved.
        config_dir: what a path that begins with `config/` counts from.
        source: for a key's dot-path, who set it: what completes the phrase "set ...".
        raw: the same as `data` with its interpolations left as they stand. A key that only repeats
            another key's refused value is not reported beside it.

    Raises:
        ConfigError: one line for each fault.
    """
    try:
        return TypeAdapter(model).validate_python(data, context=config_dir)
    except ValidationError as error:
        faults = [(_dotted(fault), fault) for fault in error.errors(include_url=False)]
    refused = {key for key, _fault in faults}
    lines = [
        f"{_sentence(model, key, fault)} (set {source(key)})"
        for key, fault in faults
        if _repeats(raw, key) not in refused
    ]
    raise ConfigError("\n".join(lines))


def _dotted(fault: ErrorDetails) -> str:
    """A fault's dot-path, without what Pydantic adds for a union's member and a mapping's key."""
    key = ".".join(str(part) for part in fault["loc"] if part not in {*_NODES, "[key]"})
    return f"{key}._target_" if fault["type"].startswith("union_tag") else key


def _repeats(raw: object, key: str) -> str | None:
    """The key that this one takes its value from (`${reader.chunk_cache_mb}`), if it does."""
    parts = key.split(".")
    for depth, part in enumerate(parts, start=1):
        raw = raw.get(part) if isinstance(raw, dict) else None
        link = re.fullmatch(r"\$\{([\w.]+)\}", raw) if isinstance(raw, str) else None
        if link:
            return ".".join([link[1], *parts[depth:]])
    return None


def _sentence(model: type, key: str, fault: ErrorDetails) -> str:
    """What is wrong, and what is allowed instead."""
    kind, context = fault["type"], fault.get("ctx", {})
    if kind == "unexpected_keyword_argument":
        return f"{key}: there is no such key; use one of: {', '.join(_keys_beside(model, fault))}"
    if kind in {"missing", "union_tag_not_found"}:
        return f"{key}: missing; give it a value"
    if kind in {"dataclass_type", "model_attributes_type", "dict_type"}:
        return f"{key or 'the file'}: {_shown(fault['input'])} is not allowed; must hold keys"
    choices = context.get("expected") or context.get("expected_tags")
    if choices:
        refused = context.get("tag", fault["input"])
        allowed = ", ".join(re.findall(r"'([^']*)'", choices))
        return f"{key}: {_shown(refused)} is not allowed; use one of: {allowed}"
    rule = _RULES.get(kind) or re.sub(r"^(Input|String|Value) should ", "must ", fault["msg"])
    rule = rule.removeprefix("Value error, ")
    return f"{key}: {_shown(fault['input'])} is not allowed; {rule}"


def _keys_beside(model: type, fault: ErrorDetails) -> list[str]:
    """The keys that exist where the fault's unknown key stands."""
    *sections, _unknown = fault["loc"]
    for section in sections:
        model = _NODES.get(str(section)) or get_type_hints(model)[str(section)]
    names = (field.name for field in fields(model) if is_dataclass(model))
    return ["_target_" if name == "target" else name for name in names]


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
