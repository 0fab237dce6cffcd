"""What `ros2 bag record` says on stderr, line by line, as events.

The texts are those of rosbag2 0.15 (Humble) to 0.33 (Rolling); a line that none of them fits is
kept by its level. Pure: `parse_line` knows one line and no history.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Said(StrEnum):
    """What a line says."""

    READY = "ready"
    SUBSCRIBED = "subscribed"
    FLUSHING = "flushing"  # a split is being closed, or the whole recording
    STOPPED = "stopped"
    FOLDER_EXISTS = "folder_exists"
    QOS_REFUSED = "qos_refused"
    UNKNOWN_TYPE = "unknown_type"
    SEVERAL_TYPES = "several_types"
    MESSAGES_LOST = "messages_lost"
    WARNING = "warning"
    ERROR = "error"
    REMARK = "remark"


@dataclass(frozen=True, slots=True)
class Line:
    """One line: what it says, of which topic (where it names one), and its words."""

    said: Said
    text: str
    topic: str | None = None


_ANSI: Final = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
# Searched, not matched: the first line of a recorder without a terminal has a sentence before it.
_LOGGED: Final = re.compile(
    r"\[(?P<level>DEBUG|INFO|WARN|ERROR|FATAL)\] (?:\[[\d.]+\] )?\[[^\]]*\]: (?P<text>.*)"
)
_MEANINGS: Final = (
    (Said.READY, re.compile(r"(?:Recording\.\.\.|Listening for topics\.\.\.)$")),
    (Said.SUBSCRIBED, re.compile(r"Subscribed to topic '(?P<topic>[^']+)'")),
    (Said.FLUSHING, re.compile(r"Writing remaining messages from cache")),
    (Said.STOPPED, re.compile(r"Recording stopped")),
    (Said.FOLDER_EXISTS, re.compile(r"Output folder '.*' already exists")),
    (
        Said.QOS_REFUSED,
        re.compile(r"A new publisher for subscribed topic (?P<topic>\S+) was found offering"),
    ),
    (
        Said.QOS_REFUSED,
        re.compile(r"New publisher discovered on topic '(?P<topic>[^']+)', offering incompatible"),
    ),
    (Said.UNKNOWN_TYPE, re.compile(r"Topic '(?P<topic>[^']+)' has unknown type")),
    (Said.SEVERAL_TYPES, re.compile(r"Topic '(?P<topic>[^']+)' has more than one type")),
    (Said.MESSAGES_LOST, re.compile(r"Cache buffers lost messages")),
)
# The total stands on a line of its own, below one line for each topic.
_LOST: Final = re.compile(r"Total lost: (?!0\b)\d+")


def parse_line(raw: str) -> Line:
    """What one line of the recorder's output says. Never fails."""
    line = _ANSI.sub("", raw).strip()
    logged = _LOGGED.search(line)
    text = logged["text"].strip() if logged else line
    for said, pattern in _MEANINGS:
        found = pattern.match(text)
        if found is not None:
            return Line(said, text, found.groupdict().get("topic"))
    if _LOST.match(text):
        return Line(Said.MESSAGES_LOST, text)
    return Line(_by_level(logged["level"] if logged else ""), text)


def _by_level(level: str) -> Said:
    if level == "WARN":
        return Said.WARNING
    return Said.ERROR if level in {"ERROR", "FATAL"} else Said.REMARK
