"""What clients read as MCP resources: each is a question whose reply is the resource's text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import unquote

from ros2_memory.errors import InvalidArgumentsError

if TYPE_CHECKING:
    from ros2_memory.model import JsonValue

SCHEME: Final = "episodic://"
_OF_TYPE: Final = f"{SCHEME}schema/"


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


def asked_of(uri: str) -> tuple[str, dict[str, JsonValue]]:
    """The question behind a URI: a tool and its arguments.

    Raises:
        InvalidArgumentsError: there is no such resource.
    """
    for fixed in (TOPICS, STATUS):
        if uri == fixed.uri:
            return fixed.tool, {}
    if uri.startswith(_OF_TYPE) and len(uri) > len(_OF_TYPE):
        return SCHEMA.tool, {"type": unquote(uri.removeprefix(_OF_TYPE))}
    raise InvalidArgumentsError(
        f"there is no such resource; there are {TOPICS.uri}, {STATUS.uri} and {SCHEMA.uri}"
    )
