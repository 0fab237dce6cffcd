"""Who set a key: a variable, an override, or one of the files of the configuration directory."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import yaml

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

GROUPS: Final = ("deployment", "storage", "recorder")
"""The groups of files of which one each is chosen."""
_NODES: Final = ("storage", "recorder")
"""Those whose files hold the section of that name; a preset's holds any."""
_OVERRIDE: Final = "override /"


@dataclass(frozen=True, slots=True)
class Asked:
    """A parsed override that Hydra is to apply.

    `source` completes the phrase "set ..."; `option` is what is chosen of a group.
    """

    key: str
    text: str
    source: str
    is_group: bool
    option: str | None = None


@dataclass(frozen=True, slots=True)
class Sources:
    """Tells of a key, such as `server.port`, who set it: what completes the phrase "set ...".

    Args:
        folder: holds `config.yaml` and the groups.
        asked: what variables and overrides set; later wins.
        joined: by key, the variable that adds to what is set otherwise.
    """

    folder: Path
    asked: Sequence[Asked]
    joined: Mapping[str, str]

    def __call__(self, key: str) -> str:
        """Who set a key; of files the exact one, with the key whose value it takes over."""
        for one in reversed(self.asked):
            mine, its = f"{key}.", f"{one.key}."
            if not one.is_group and (mine.startswith(its) or its.startswith(mine)):
                return one.source
        variable = self.joined.get(key)
        return f"{self._file(key)}{f', and by {variable}' if variable else ''}"

    def choice(self, group: str) -> tuple[str | None, str]:
        """The option of a group, and who chose it."""
        for one in reversed(self.asked):
            if one.is_group and one.key == group:
                return one.option, one.source
        if group != "deployment":
            for path in self._presets():
                for default in _defaults(path):
                    if group in default:
                        return default[group], f"in {path}"
        config = self.folder / "config.yaml"
        chosen = next((each[group] for each in _defaults(config) if group in each), None)
        return chosen, f"in {config}"

    def _file(self, key: str) -> str:
        for path in self._files(key.partition(".")[0]):
            found, value = _held(_content(path), key)
            if found:
                link = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
                return f"in {path}{f', as {link[1]}' if link else ''}"
        return f"in {self.folder}"

    def _files(self, section: str) -> Iterator[Path]:
        """The files that may hold a section's keys, the strongest first."""
        yield from self._presets()
        yield self.folder / "config.yaml"
        option = self.choice(section)[0] if section in GROUPS else None
        if option is not None:
            yield self.folder / section / f"{option}.yaml"

    def _presets(self) -> Iterator[Path]:
        """The preset that was chosen, and those that it builds on, the strongest first."""
        names, seen = [self.choice("deployment")[0]], set[str]()
        while names:
            name = names.pop()
            if name is None or name in seen:
                continue
            seen.add(name)
            path = self.folder / "deployment" / f"{name}.yaml"
            yield path
            names += [each for default in _defaults(path) for each in default.get("", "").split()]


def _defaults(path: Path) -> Iterator[dict[str, str]]:
    """The choices in a file's defaults list; under "" the presets that it builds on."""
    content = _content(path)
    listed = content.get("defaults") if isinstance(content, dict) else None
    for each in listed if isinstance(listed, list) else []:
        if isinstance(each, dict):
            yield {
                str(group).removeprefix(_OVERRIDE): option
                for group, option in each.items()
                if isinstance(option, str)
            }
        elif isinstance(each, str) and each != "_self_":
            yield {"": each}


def _held(content: object, key: str) -> tuple[bool, object]:
    """Whether a file sets a key, and to what."""
    for part in key.split("."):
        if not isinstance(content, dict) or part not in content:
            return False, None
        content = content[part]
    return True, content


def _content(path: Path) -> object:
    """What a file holds, from the root of the configuration on; None where it cannot be read."""
    try:
        content: object = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return None
    group = path.parent.name
    return {group: content} if path.name != "config.yaml" and group in _NODES else content
