"""What clients read as MCP resources: each is a question whose reply is the resource's text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import unquote

from ros2_memory.core.errors import InvalidArgumentsError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue

SCHEME: Final = "episodic://"
_OF_TYPE: Final = f"{SCHEME}schema/"
_LONGEST: Final = 200


class Readable(NamedTuple):
    """A resource, or a template of resources: its URI, what is said of it, and who is asked."""

    uri: str
    name: str
    description: str
    tool: str


TOPICS: Final = Readable(
    f"{SCHEME}topics",
    "topics",
    "Every recorded topic with its type, times and count.",
    "list_recorded_topics",
)
STATUS: Final = Readable(
    f"{SCHEME}status", "status", "How far the memory can be trusted just now.", "memory_status"
)
SCHEMA: Final = Readable(
    f"{_OF_TYPE}{{type}}",
    "schema",
    "The fields that replies show of a message type, as dot-paths, e.g. nav_msgs/msg/Odometry.",
    "describe_type",
)


def asked_of(uri: str, offered: Sequence[Readable]) -> tuple[str, dict[str, JsonValue]]:
    """The question behind a URI: a tool and its arguments.

    Raises:
        InvalidArgumentsError: it is none of the resources that are offered.
    """
    for each in offered:
        if each is SCHEMA:
            if uri.startswith(_OF_TYPE) and len(uri) > len(_OF_TYPE):
                return SCHEMA.tool, {"type": unquote(uri.removeprefix(_OF_TYPE))}
        elif uri == each.uri:
            return each.tool, {}
    shown = uri if len(uri) <= _LONGEST else f"{uri[:_LONGEST]}..."
    there = ", ".join(each.uri for each in offered)
    raise InvalidArgumentsError(f"there is no resource {shown}; what can be read: {there}")
