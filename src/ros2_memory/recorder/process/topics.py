"""Reads `topics.yaml`, and makes the regular expression that selects its topics in ROS 2.

    topics:
      - /odom
      - /vision/*/detections_meta
      - /drive/_action/status
      - /set_mode/_service_event
    exclude:
      - /vision/debug/detections_meta

An entry is a fully qualified topic name, or a glob: `*` matches one or more characters other than
`/`, inside one part of the name. Names follow the ROS 2 design article "Topic and Service name
mapping to DDS". Events of a service are recorded where the distribution can (Jazzy and later), and
the service publishes them (service introspection). What `exclude` lists, in the same form, is not
recorded; without it everything that `topics` selects is.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

MAX_NAME: Final = 247
"""Characters in a topic name: what rmw leaves of DDS's 255 for the name itself."""
MAX_REGEX: Final = 60_000
"""Characters in the regular expression: the C++ library fails on patterns not much larger."""

SERVICE_EVENT: Final = "/_service_event"
_NAME: Final = re.compile(r"(/(?!\d)(\w|\*(?!\*))+)+", re.ASCII)


@dataclass(frozen=True)
class TopicSelection:
    """The entries of `topics.yaml`, each once, in the order of the file.

    It is asked for its names several times a second.
    """

    entries: tuple[str, ...]
    excluded: tuple[str, ...] = ()

    @cached_property
    def exact(self) -> tuple[str, ...]:
        """The entries that are names, not globs, and are recorded."""
        return tuple(entry for entry in self.entries if "*" not in entry and self.matches(entry))

    @property
    def hidden(self) -> bool:
        """Whether a part of an entry begins with `_`: it needs `--include-hidden-topics`."""
        return any("/_" in entry for entry in self.entries)

    @property
    def listed(self) -> tuple[str, ...]:
        """The lines of the file: its entries, then its exclusions."""
        return (*self.entries, *(f"not {entry}" for entry in self.excluded))

    @property
    def services(self) -> tuple[str, ...]:
        """The entries that are events of services."""
        return tuple(entry for entry in self.entries if entry.endswith(SERVICE_EVENT))

    @cached_property
    def regex(self) -> str:
        """An anchored ECMAScript (and Python) regular expression that matches only these topics.

        Every distribution from Humble to Rolling accepts topics in this form, and with it the
        recorder never stops discovering.
        """
        selected = "|".join(_pattern(entry) for entry in self.entries)
        if not self.excluded:
            return f"^({selected})$"
        # Options for exclusions differ between distributions, and some have none.
        return f"^(?!({'|'.join(_pattern(entry) for entry in self.excluded)})$)({selected})$"

    def matches(self, topic: str) -> bool:
        """Whether the topic is recorded."""
        return re.search(self.regex, topic) is not None


class TopicsFile:
    """The list of topics in use, and its file, which may change while the recorder runs.

    Args:
        needed: topics that every list must have, each with the setting that needs it.

    Attributes:
        selection: the list in use.
        refused: a sentence on why the file's present content is not used; None if it is used.
    """

    def __init__(self, path: Path, needed: Mapping[str, str] | None = None) -> None:
        self._path = path
        self._needed = needed or {}
        self.selection = TopicSelection(())
        self.refused: str | None = None
        self._read: bytes | None = None
        self._seen: bytes | None = None

    def load(self) -> None:
        """Reads the file.

        Raises:
            ConfigError: see `load_topics`, or the list lacks a needed topic.
        """
        self._seen = self._content()
        self._use()

    def _use(self) -> None:
        self._read = self._seen
        selection = load_topics(self._path, self._seen)
        for topic, by in self._needed.items():
            if not selection.matches(topic):
                raise ConfigError(f"{self._path}: it does not list {topic}, which {by} needs")
        self.selection = selection

    def look(self) -> bool:
        """Reads the file again if it has changed; returns whether the list in use has changed.

        New content counts from the second look on, since it may be half written. Refused content
        leaves the list as it was. Raises nothing.
        """
        before, self._seen = self._seen, self._content()
        if self._seen == self._read or self._seen != before:
            return False
        old = self.selection
        try:
            self._use()
        except ConfigError as error:
            self.refused = f"{error}; the recorder keeps the list that it has"
            return False
        self.refused = None
        return self.selection != old

    def _content(self) -> bytes | None:
        try:
            return self._path.read_bytes()
        except OSError:
            return None


def load_topics(path: Path, data: bytes | None = None) -> TopicSelection:
    """Returns the topics that a file lists; `data` is its content if it was read before.

    Raises:
        ConfigError: the file is missing, is not such a list, lists nothing, or has an entry that is
            not a topic name; the message names the file and the entry.
    """
    try:
        text = (path.read_bytes() if data is None else data).decode()
        content: object = yaml.safe_load(text)
    except OSError as error:
        raise ConfigError(
            f"{path}: the list of topics cannot be read: {error.strerror or error}; "
            "correct recording.topics_file"
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: it is not YAML: {' '.join(str(error).split())}") from error
    lists = content if isinstance(content, dict) else {}
    topics, excluded = lists.get("topics"), lists.get("exclude") or []
    are_lists = isinstance(topics, list) and isinstance(excluded, list)
    if not (are_lists and topics and {*lists} <= {"topics", "exclude"}):
        raise ConfigError(
            f"{path}: it must hold the key topics, and below it a list of at least one topic, each "
            "on a line: - /odom; beside it, if anything, exclude with such a list"
        )
    for entry in (*topics, *excluded):
        if not isinstance(entry, str) or len(entry) > MAX_NAME or not _NAME.fullmatch(entry):
            raise ConfigError(
                f"{path}: {entry!r} cannot be recorded: it must be a fully qualified name such as "
                f"/odom, of at most {MAX_NAME} characters, whose parts have ASCII letters, digits "
                "and _, and begin with no digit; a * matches inside one part"
            )
    selection = TopicSelection(tuple(dict.fromkeys(topics)), tuple(dict.fromkeys(excluded)))
    if len(selection.regex) > MAX_REGEX:
        raise ConfigError(
            f"{path}: {len(selection.entries)} topics make a pattern of more than {MAX_REGEX} "
            "characters, which ROS 2 does not take; use globs such as /vision/*/detections_meta"
        )
    return selection


def _pattern(entry: str) -> str:
    service = entry.removesuffix(SERVICE_EVENT)
    pattern = "[^/]+".join(re.escape(literal) for literal in service.split("*"))
    # `ros2 bag record` compares the name of the service, not of the topic of its events.
    return pattern if service == entry else f"{pattern}({re.escape(SERVICE_EVENT)})?"
