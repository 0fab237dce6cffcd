"""Parses what `ros2 bag record` prints on stderr, line by line.

It knows the texts of rosbag2 0.15 (Humble) to 0.33 (Rolling), and classifies other lines by their
log level.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class LineKind(StrEnum):
    """The meaning of a line; most values are names of log events."""

    READY = "recording"
    SUBSCRIBED = "subscribed"
    STOPPED = "recorder_stopped"
    QOS_REFUSED = "qos_refused"
    UNKNOWN_TYPE = "unknown_type"
    SEVERAL_TYPES = "several_types"
    MESSAGES_LOST = "messages_lost"
    TOPIC_LOST = "topic_lost"  # one topic of MESSAGES_LOST
    WARNING = "warning"
    ERROR = "error"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class Line:
    """One line: its meaning and text, and the topic and the count if it names them."""

    kind: LineKind
    text: str
    topic: str | None = None
    count: int | None = None


_ANSI: Final = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
# Searched, not matched: without a terminal, another sentence precedes the first line.
_LOGGED: Final = re.compile(
    r"\[(?P<level>DEBUG|INFO|WARN|ERROR|FATAL)\] (?:\[[\d.]+\] )?\[[^\]]*\]: (?P<text>.*)"
)
_MEANINGS: Final = (
    (LineKind.READY, re.compile(r"(?:Recording\.\.\.|Listening for topics\.\.\.)$")),
    (LineKind.SUBSCRIBED, re.compile(r"Subscribed to topic '(?P<topic>[^']+)'")),
    (LineKind.STOPPED, re.compile(r"Recording stopped")),
    (
        LineKind.QOS_REFUSED,
        re.compile(r"A new publisher for subscribed topic (?P<topic>\S+) was found offering"),
    ),
    (
        LineKind.QOS_REFUSED,
        re.compile(r"New publisher discovered on topic '(?P<topic>[^']+)', offering incompatible"),
    ),
    (LineKind.UNKNOWN_TYPE, re.compile(r"Topic '(?P<topic>[^']+)' has unknown type")),
    (LineKind.SEVERAL_TYPES, re.compile(r"Topic '(?P<topic>[^']+)' has more than one type")),
    (LineKind.MESSAGES_LOST, re.compile(r"Cache buffers lost messages")),
    (LineKind.TOPIC_LOST, re.compile(r"(?P<topic>/[A-Za-z0-9_/]+): (?P<count>[1-9]\d{0,9})$")),
    # The total is on a line of its own, below one line for each topic.
    (LineKind.MESSAGES_LOST, re.compile(r"Total lost: (?!0\b)\d+")),
)
_BY_LEVEL: Final = {"WARN": LineKind.WARNING, "ERROR": LineKind.ERROR, "FATAL": LineKind.ERROR}


def parse_line(raw: str) -> Line:
    """Returns the meaning of one line of the output. Raises nothing."""
    line = _ANSI.sub("", raw).strip()
    logged = _LOGGED.search(line)
    text = logged["text"].strip() if logged else line
    for kind, pattern in _MEANINGS:
        meaning = pattern.match(text)
        if meaning is not None:
            groups = meaning.groupdict()
            count = groups.get("count")
            return Line(kind, text, groups.get("topic"), None if count is None else int(count))
    return Line(_BY_LEVEL.get(logged["level"] if logged else "", LineKind.OTHER), text)
