"""Where the values of the configuration come from: variables, overrides, and files.

Variables and overrides become assignments in Hydra's grammar. `Sources` tells which assignment, or
which files of the configuration directory, set a key.
"""

from __future__ import annotations

import re
import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType, Quote, QuotedString
from hydra.errors import HydraException
from yaml import YAMLError

from ros2_memory.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

GROUPS: Final = ("deployment", "storage", "recorder", "lake")
"""The config groups: folders with options, of which one is chosen."""
INTERFACES_VARIABLE: Final = "ROS_VISION_INTERFACES_PATH"

_LAST_ROS_DOMAIN: Final = 232  # the highest whose DDS ports are below 65536


@dataclass(frozen=True, slots=True)
class Override:
    """An assignment for Hydra.

    Attributes:
        key: the key or group that it sets.
        text: the assignment in Hydra's grammar.
        source: who gave it, as a phrase that follows "set".
    """

    key: str
    text: str
    source: str


@dataclass(frozen=True)
class Sources:
    """Tells who set a key, such as `server.port`, as a phrase that follows "set".

    Attributes:
        folder: the configuration directory.
        overrides: the assignments of variables and overrides; later wins.
    """

    folder: Path
    overrides: Sequence[Override]

    def __call__(self, key: str) -> str:
        """Returns who set a key: an assignment, or the files that have the key."""
        for override in reversed(self.overrides):
            path, override_path = f"{key}.", f"{override.key}."
            is_related = path.startswith(override_path) or override_path.startswith(path)
            if override.key not in GROUPS and is_related:
                return override.source
        files = [str(path) for path in sorted(self.folder.rglob("*.yaml")) if self._sets(path, key)]
        return f"in {' or '.join(files) or self.folder}"

    def _sets(self, path: Path, key: str) -> bool:
        try:
            content: object = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, YAMLError, RecursionError):
            return False
        group = path.parent.name
        if path.parent != self.folder and group != "deployment":
            content = {group: content}
        for name in key.split("."):
            if not isinstance(content, dict) or name not in content:
                return False
            content = content[name]
        return True


def quoted(value: str) -> str:
    """Returns a text as a value in Hydra's grammar, with any characters."""
    # A backslash keeps OmegaConf from expanding ${...}; those before it are then doubled.
    literal = re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
    return str(QuotedString(text=literal, quote=Quote.single).with_quotes())


def _whole_number(value: str) -> str:
    """Returns a whole number in Hydra's grammar; quotes other text, which validation refuses."""
    try:
        return str(int(value))
    except ValueError:
        return quoted(value)


_VARIABLES: Final[dict[str, tuple[str, Callable[[str], str]]]] = {
    "MEMORY_BAG_DIR": ("recording.bag_dir", quoted),
    "MCP_TRANSPORT": ("server.transport", quoted),
    "MCP_HOST": ("server.host", quoted),
    "MCP_PORT": ("server.port", _whole_number),
}


def given_variables(env: Mapping[str, str]) -> dict[str, str]:
    """Returns the variables that are not empty.

    Raises:
        ConfigError: one of them is refused whatever the configuration holds.
    """
    given = {name: text for name, text in env.items() if text}
    for name in ("MEMORY_CONFIG_DIR", INTERFACES_VARIABLE, *_VARIABLES):
        # Environment files, unlike shells, do not expand it, and Hydra would take it for its own.
        if "${" in given.get(name, ""):
            raise ConfigError(
                f"{name}: {given[name]!r} is not allowed; write the value itself, "
                "since ${...} is not expanded here"
            )
    domain = given.get("ROS_DOMAIN_ID", "0")
    if not domain.isdecimal() or int(domain) > _LAST_ROS_DOMAIN:
        raise ConfigError(
            f"ROS_DOMAIN_ID: {domain!r} is not allowed; "
            f"must be a whole number from 0 to {_LAST_ROS_DOMAIN}"
        )
    return given


def expand_home(text: str) -> Path:
    """Returns a path with `~` expanded; unchanged if no such home is known."""
    with suppress(RuntimeError):
        return Path(text).expanduser()
    return Path(text)


def parse_overrides(
    command_line: Sequence[str], given: Mapping[str, str], folder: Path
) -> list[Override]:
    """Returns the assignments of variables and of the command line; later wins.

    Raises:
        ConfigError: one of them is not an assignment, holds a token, or names no option of a group.
    """
    options = {
        group: sorted(option.stem for option in (folder / group).glob("*.yaml")) for group in GROUPS
    }
    texts: list[tuple[str, str]] = []  # each with who gave it
    if preset := given.get("MEMORY_DEPLOYMENT"):
        texts.append((f"deployment={quoted(preset)}", "by MEMORY_DEPLOYMENT"))
    for name, (key, as_value) in _VARIABLES.items():
        if name in given:
            texts.append((f"{key}={as_value(given[name])}", f"by {name}"))
    texts += [(text, "by MEMORY_CONFIG_OVERRIDES") for text in _split_overrides(given)]
    texts += [(text, "on the command line") for text in command_line]
    return [_parse_override(text, source, options) for text, source in texts]


def _split_overrides(given: Mapping[str, str]) -> list[str]:
    """Returns the assignments in MEMORY_CONFIG_OVERRIDES."""
    text = given.get("MEMORY_CONFIG_OVERRIDES", "")
    try:
        return shlex.split(text)
    except ValueError as error:
        is_secret = _may_hold_secret(text)
        shown = "what it holds" if is_secret else repr(text)
        raise ConfigError(
            f"MEMORY_CONFIG_OVERRIDES: {shown} is not allowed ({error}); "
            "write assignments as for a shell, separated by spaces"
        ) from (None if is_secret else error)


def _names_token(text: str) -> bool:
    """Returns whether a text sets a token as if it were a setting: it must not be shown."""
    # `fleet.tokens` has the names of files.
    return re.search(r"(?<!\bfleet\.)token\w*\s*=", text, re.IGNORECASE) is not None


def _may_hold_secret(text: str) -> bool:
    """Returns whether a text that is not a setting may hold a secret: it must not be shown."""
    named = r"(token|secret|password|access.?key)[\w.-]*\W*[=:]"
    return re.search(named, text, re.IGNORECASE) is not None


def _parse_override(text: str, source: str, options: Mapping[str, Sequence[str]]) -> Override:
    """Parses an assignment; `source` says who gave it, `options` has the options of each group.

    Raises:
        ConfigError: as `parse_overrides`.
    """
    if _names_token(text):
        raise ConfigError(
            f"a token has no place among the settings (set {source}), where others can read it; "
            "give the one that clients must show as MEMORY_API_TOKEN"
        )
    is_secret = _may_hold_secret(text)
    shown = "what may hold a secret" if is_secret else repr(text)
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        advice = (
            "write key=value, such as server.port=9300, and \"key='value'\" where spaces or "
            "special characters are in it"
        )
        if "/" in text and "=" not in text and not is_secret:
            advice = f"a folder of bags is given as recording.bag_dir={text}"
        raise ConfigError(f"{shown} is not a setting (given {source}); {advice}") from (
            None if is_secret else error
        )
    key = override.key_or_group
    if not key or override.is_sweep_override():
        raise ConfigError(
            f"{shown} is not one value for one key (set {source}); a list is written key=[a,b]"
        )
    is_change = override.type is OverrideType.CHANGE
    if key not in options:
        # Added by force, an unknown key reaches the validation, which names the known ones.
        return Override(key, f"++{text}" if is_change else text, source)
    if is_change and override.value() not in options[key]:
        raise ConfigError(
            f"{key}: {override.value()!r} is not allowed; use one of: {', '.join(options[key])} "
            f"(set {source})"
        )
    return Override(key, text, source)
