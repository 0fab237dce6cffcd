"""What is wrong with the configuration, as plain sentences.

Faults that Pydantic finds get a line each, with the key and who set it. What Hydra, OmegaConf, YAML
and the file system raise is translated in one place.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Final, TypeVar, get_args, get_origin, get_type_hints

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError
from yaml import YAMLError

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.text import listed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails

_T = TypeVar("_T")

_LONGEST_VALUE: Final = 80
_FOREIGN: Final = (
    HydraException,
    OmegaConfBaseException,
    YAMLError,
    OSError,
    ValueError,
    RecursionError,  # brackets in brackets, a thousand deep
)
_RULES: Final = {
    "tuple_type": "must be a list",
    "path_type": "must be a path",
    "string_too_short": "must not be empty",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
}


_WITHOUT_KEYS: Final = {
    "recorder": "recorder=none records nothing, so it is not allowed; leave it out, or choose what "
    "records: unset MEMORY_DEPLOYMENT if it is replay or query_only",
    "storage": "storage=mcap has no such setting; leave it out, or choose storage=rosbag2",
}
"""Why a key is refused if the chosen adapter has no keys, by section."""


class OpenSecretError(ValueError):
    """A value that seems to hold a secret, so that no error shows it."""


def validated(
    model: type[_T],
    data: object,
    *,
    config_dirs: Sequence[Path],
    source: Callable[[str], str],
    adapters: Mapping[str, type] | None = None,
) -> _T:
    """Returns `data` as an instance of `model`.

    Args:
        model: a class of the configuration.
        data: the composed configuration, interpolations resolved.
        config_dirs: the folders in which a path that begins with `config/` is looked for.
        source: returns who set the key of a dot-path, as a phrase that follows "set".
        adapters: the classes of sections that are chosen by their `_target_`.

    Raises:
        ConfigError: one line for each fault.
    """
    nodes = adapters or {}
    lines: list[str] = []
    try:
        return TypeAdapter(model).validate_python(data, context=config_dirs)
    except ValidationError as error:
        for fault in error.errors(include_url=False):
            key = _dot_path(fault, nodes)
            lines.append(f"{_sentence(model, key, fault, nodes)} (set {source(key)})")
    raise ConfigError("\n".join(lines))


@contextmanager
def foreign_errors_as_config_error(where: str, source: Callable[[str], str]) -> Iterator[None]:
    """Translates errors of Hydra, OmegaConf, YAML and the file system into `ConfigError`.

    Args:
        where: names what is read, for an error that names no key.
        source: as for `validated`.
    """
    try:
        yield
    except _FOREIGN as error:
        key = getattr(error, "full_key", None) or getattr(error.__cause__, "full_key", None)
        reason = _reason_of(error)
        sentence = f"{key}: {reason} (set {source(key)})" if key else f"{where}: {reason}"
        raise ConfigError(sentence) from error


def _reason_of(error: Exception) -> str:
    """Returns an error's reason without search paths, links to manuals and dumps."""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    if text in {"", "None"} and error.__cause__ is not None:
        text = str(error.__cause__)
    first, *_ = re.split(r"\n *(?:full_key:|Config search path:|See https:)", text)
    return " ".join(first.split())


def _dot_path(fault: ErrorDetails, nodes: Mapping[str, type]) -> str:
    """Returns a fault's dot-path, without Pydantic's marks for union members and mapping keys."""
    key = ".".join(str(part) for part in fault["loc"] if part not in {*nodes, "[key]"})
    return f"{key}._target_" if fault["type"].startswith("union_tag") else key


def _sentence(model: type, key: str, fault: ErrorDetails, nodes: Mapping[str, type]) -> str:
    """Returns what is wrong with a key, and what is allowed instead."""
    kind, context = fault["type"], fault.get("ctx", {})
    if kind == "unexpected_keyword_argument":
        keys = _known_keys(model, fault, nodes)
        section = key.partition(".")[0]
        is_without_keys = keys == ["_target_"]
        known = f"unknown key; use one of: {', '.join(keys)}"
        others = [*_keys_named(str(fault["loc"][-1]), model)]
        if others:
            known += f"; {listed(others)} {'is a key' if len(others) == 1 else 'are keys'}"
        return f"{key}: {_WITHOUT_KEYS[section] if is_without_keys else known}"
    if kind in {"missing", "union_tag_not_found"}:
        return f"{key}: missing; give it a value"
    if kind in {"dataclass_type", "model_attributes_type", "dict_type"}:
        return f"{key or 'the file'}: {_cut_repr(fault['input'])} is not allowed; must hold keys"
    choices = context.get("expected") or context.get("expected_tags")
    if choices:
        refused = context.get("tag", fault["input"])
        allowed = ", ".join(re.findall(r"'([^']*)'", choices))
        return f"{key}: {_cut_repr(refused)} is not allowed; use one of: {allowed}"
    if kind == "float_type" and key.endswith("_gb"):
        rule = "must be a number in GB, such as 2"
    else:
        rule = _RULES.get(kind) or re.sub(r"^\w+ should ", "must ", fault["msg"])
        rule = rule.removeprefix("Value error, ")
    if isinstance(context.get("error"), OpenSecretError):
        return f"{key}: its value is not allowed, and not shown; {rule}"
    return f"{key}: {_cut_repr(fault['input'])} is not allowed; {rule}"


def _keys_named(name: str, model: type, section: str = "") -> Iterator[str]:
    """Yields the dot-paths of keys with a name in a section and all below it."""
    for key, kind in get_type_hints(model).items():
        path = f"{section}{key}"
        if key == name:
            yield path
        if isinstance(kind, type) and is_dataclass(kind):
            yield from _keys_named(name, kind, f"{path}.")


def _known_keys(model: type, fault: ErrorDetails, nodes: Mapping[str, type]) -> list[str]:
    """Returns the keys that the section of an unknown key knows."""
    *sections, _unknown = fault["loc"]
    for section in sections:
        if get_origin(model) in {dict, tuple}:  # the section is any key, or a number
            model = next(kind for kind in get_args(model) if kind is not str)
        else:
            model = nodes.get(str(section)) or get_type_hints(model)[str(section)]
            if type(None) in get_args(model):
                model = get_args(model)[0]
    names = [field.name for field in fields(model)] if is_dataclass(model) else []
    return ["_target_" if name == "target" else name for name in names]


def _cut_repr(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
