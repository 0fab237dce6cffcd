"""A tool asked as a client asks it, and its reply as the client reads it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from ros2_memory.core.errors import EpisodicError
from ros2_memory.history.context import Call
from ros2_memory.tools.replies import Replies, Reply
from ros2_memory.tools.spec_tools import build_tools

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from ros2_memory.history.context import Memory


def asked(memory: Memory, bag_dir: Path, name: str, **given: object) -> Any:
    """The JSON of the reply, be it an error."""
    return json.loads(replied(memory, bag_dir, name, given).text)


def replied(
    memory: Memory,
    bag_dir: Path,
    name: str,
    given: Mapping[str, object],
    *,
    max_chars: int = 24_000,
) -> Reply:
    """The reply itself."""
    [tool] = [each for each in build_tools(memory.limits, 25.0) if each.name == name]
    replies, call = Replies(bag_dir, max_chars), Call()
    try:
        answer = tool.question(given)(memory, call)
    except EpisodicError as error:
        return replies.error(error)
    return replies.answer(answer, from_active=call.used_active)
