"""Loads the configuration: Hydra composes it, Pydantic validates it, once, at start.

Later wins: `config.yaml`, a deployment preset (`MEMORY_DEPLOYMENT`), the named environment
variables, `MEMORY_CONFIG_OVERRIDES`, the command line's overrides. An empty variable counts as
unset. `.env` is never read here: the shell, Docker and systemd do that. Whatever is wrong becomes
one `ConfigError` with a line for each fault: the key, the value, what is allowed, who set it.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ros2_memory.config_errors import validated
from ros2_memory.config_sources import GROUPS, Asked, Sources
from ros2_memory.core.errors import ConfigError
from ros2_memory.settings import MessageSchemas, Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from omegaconf import DictConfig

EXIT_CODE: Final = 2
_INTERFACES: Final = "ROS_VISION_INTERFACES_PATH"
_LAST_ROS_DOMAIN: Final = 232  # the highest whose DDS ports stay below 65536
_FOREIGN: Final = (HydraException, OmegaConfBaseException, YAMLError, OSError, ValueError)


def quoted(value: str) -> str:
    """The text as a value in Hydra's grammar, whatever is in it."""
    return str(QuotedString(text=value, quote=Quote.single).with_quotes())


def _whole(value: str) -> str:
    """An int as Hydra reads it; what is none stays text, and the key's own check refuses it."""
    try:
        return str(int(value))
    except ValueError:
        return quoted(value)


_VARIABLES: Final[dict[str, tuple[str, Callable[[str], str]]]] = {
    "MEMORY_BAG_DIR": ("recording.bag_dir", quoted),
    "MCP_TRANSPORT": ("server.transport", quoted),
    "MCP_HOST": ("server.host", quoted),
    "MCP_PORT": ("server.port", _whole),
}


@dataclass(frozen=True, slots=True)
class _Assignment:
    """One override in Hydra's grammar; `source` completes the phrase "set ..."."""

    text: str
    source: str


def load_settings(overrides: Sequence[str] = (), env: Mapping[str, str] | None = None) -> Settings:
    """The validated configuration.

    Args:
        overrides: assignments in Hydra's grammar (`server.port=9300`, `recorder=none`).
        env: the environment; the process's own where None.

    Raises:
        ConfigError: the files, the environment or the overrides hold something that is refused.
    """
    return load_explained(overrides, env)[0]


def load_explained(
    overrides: Sequence[str] = (), env: Mapping[str, str] | None = None
) -> tuple[Settings, Sources]:
    """As `load_settings`, and what tells of a key, such as `server.port`, who set it.

    Raises:
        ConfigError: as `load_settings`.
    """
    given = _given(os.environ if env is None else env)
    folder = config_dir(given)
    assignments = [
        *_named_variables(given),
        *(_Assignment(text, "by MEMORY_CONFIG_OVERRIDES") for text in _split_overrides(given)),
        *(_Assignment(text, "on the command line") for text in overrides),
    ]
    groups = {
        group: sorted(option.stem for option in (folder / group).glob("*.yaml")) for group in GROUPS
    }
    asked = [_parsed(assignment, groups) for assignment in assignments]

    joined = {"reader.custom_msg_paths": _INTERFACES} if _INTERFACES in given else {}
    source = Sources(folder, asked, joined)
    with _foreign_errors_as_config_error(str(folder), source):
        with initialize_config_dir(version_base="1.3", config_dir=str(folder)):
            composed = compose("config", overrides=[one.text for one in asked])
        _add_interface_folder(composed, given)
        data = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        raw = OmegaConf.to_container(composed, resolve=False)
    return validated(Settings, data, config_dir=folder, source=source, raw=raw), source


def config_dir(env: Mapping[str, str]) -> Path:
    """The folder that holds `config.yaml` and its groups, absolute.

    `MEMORY_CONFIG_DIR`, else the copy inside an installed package, else the checkout's `config/`.

    Raises:
        ConfigError: there is no `config.yaml` in it.
    """
    package = Path(__file__).resolve().parent
    chosen = env.get("MEMORY_CONFIG_DIR")
    if chosen:
        folder = _expanded(chosen).absolute()
    elif (package / "_config").is_dir():
        folder = package / "_config"
    else:
        folder = package.parents[1] / "config"
    if not (folder / "config.yaml").is_file():
        raise ConfigError(
            f"MEMORY_CONFIG_DIR: {str(folder)!r} is not allowed; must be a folder with a "
            "config.yaml, laid out as the repository's config/"
        )
    return folder


def load_message_schemas(settings: Settings) -> Mapping[str, Mapping[str, str]]:
    """The schema map of `reader.schemas_file`: message type to {field name: dot-path}.

    Raises:
        ConfigError: the file is missing, is not YAML, or holds something that is refused.
    """
    path = settings.reader.schemas_file

    def source(_key: str) -> str:
        return f"in {path}, which reader.schemas_file names"

    with _foreign_errors_as_config_error(f"reader.schemas_file: {path}", source):
        data = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    return validated(MessageSchemas, data, config_dir=path.parent, source=source).schemas


@contextmanager
def exit_on_config_error(program: str) -> Iterator[None]:
    """Around a program's start: a refused configuration is explained on stderr, exit code 2."""
    try:
        yield
    except ConfigError as error:
        sys.stderr.write(f"{program} cannot start, its configuration is refused:\n{error}\n")
        raise SystemExit(EXIT_CODE) from None


def _given(env: Mapping[str, str]) -> dict[str, str]:
    """The variables that are set, checked as far as they say what is wrong by themselves."""
    given = {name: text for name, text in env.items() if text}
    for name in ("MEMORY_CONFIG_DIR", _INTERFACES, *_VARIABLES):
        # Environment files, unlike shells, leave this as it stands; Hydra would read it as its own.
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


def _expanded(text: str) -> Path:
    """The path with `~` expanded, where that names a home."""
    with suppress(RuntimeError):
        return Path(text).expanduser()
    return Path(text)


def _named_variables(given: Mapping[str, str]) -> list[_Assignment]:
    preset = given.get("MEMORY_DEPLOYMENT")
    presets = (
        [_Assignment(f"deployment={quoted(preset)}", "by MEMORY_DEPLOYMENT")] if preset else []
    )
    return presets + [
        _Assignment(f"{key}={written(given[name])}", f"by {name}")
        for name, (key, written) in _VARIABLES.items()
        if name in given
    ]


def _split_overrides(given: Mapping[str, str]) -> list[str]:
    text = given.get("MEMORY_CONFIG_OVERRIDES", "")
    try:
        return shlex.split(text)
    except ValueError as error:
        shown = "what it holds" if _names_a_token(text) else repr(text)
        raise ConfigError(
            f"MEMORY_CONFIG_OVERRIDES: {shown} is not allowed ({error}); "
            "write assignments as for a shell, separated by spaces"
        ) from (None if _names_a_token(text) else error)


def _names_a_token(text: str) -> bool:
    """Whether somebody took a secret for a setting: what is wrong with it must not be shown."""
    return re.search(r"token\w*\s*=", text, re.IGNORECASE) is not None


def _parsed(assignment: _Assignment, groups: Mapping[str, Sequence[str]]) -> Asked:
    text, source = assignment.text, assignment.source
    if _names_a_token(text):
        raise ConfigError(
            f"a token has no place among the settings (set {source}), where others can read it; "
            "give the one that clients must show as MEMORY_API_TOKEN"
        )
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(
            f"{text!r} is no override ({_reason(error)}; set {source}); write key=value, such as "
            "server.port=9300, and key='value' where special characters are in it"
        ) from error
    key = override.key_or_group
    is_group = key in groups
    if not key or override.is_sweep_override():
        raise ConfigError(
            f"{text!r} is not one value for one key (set {source}); a list is written key=[a,b]"
        )
    changes = override.type is OverrideType.CHANGE
    if is_group and changes and override.value() not in groups[key]:
        raise ConfigError(
            f"{key}: {override.value()!r} is not allowed; use one of: {', '.join(groups[key])} "
            f"(set {source})"
        )
    # Added by force, an unknown key reaches the validation, which names the known ones.
    option = str(override.value()) if is_group and changes else None
    return Asked(key, f"++{text}" if changes and not is_group else text, source, is_group, option)


def _add_interface_folder(composed: DictConfig, given: Mapping[str, str]) -> None:
    """Appends `ROS_VISION_INTERFACES_PATH`, unless what it would join is no list and is refused."""
    folder = given.get(_INTERFACES)
    if not folder:
        return
    if not _expanded(folder).is_dir():
        raise ConfigError(
            f"ROS_VISION_INTERFACES_PATH: {folder!r} is not allowed; must be an existing folder "
            "of message packages (or one package, with msg/*.msg)"
        )
    paths = OmegaConf.select(composed, "reader.custom_msg_paths")
    if isinstance(paths, ListConfig):
        paths.append(folder)


@contextmanager
def _foreign_errors_as_config_error(where: str, source: Callable[[str], str]) -> Iterator[None]:
    """Translates what Hydra, OmegaConf, YAML and the file system raise."""
    try:
        yield
    except _FOREIGN as error:
        key = getattr(error, "full_key", None) or getattr(error.__cause__, "full_key", None)
        reason = _reason(error)
        sentence = f"{key}: {reason} (set {source(key)})" if key else f"{where}: {reason}"
        raise ConfigError(sentence) from error


def _reason(error: Exception) -> str:
    """The reason alone: without search paths, links to manuals and dumps of objects."""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    if text in {"", "None"} and error.__cause__ is not None:
        text = str(error.__cause__)
    reason = re.split(r"\n *(?:full_key:|Config search path:|See https:)", text)[0]
    return " ".join(reason.split())
