"""Asks a memory over a world's bags all questions by the script, and counts what that took."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bootstrap import build_backfill, build_memory, build_server
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.config import Settings, load_settings
from ros2_memory.core.logging_setup import configure_logging
from tests.home import replies
from tests.home.judging import wrong_fields

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.serving.mcp_server import EpisodicServer
    from tests.home.questions import Question

RIGHT: Final = "right"
WRONG: Final = "wrong"
NOT_YET: Final = "not answered yet"
_REFUSED: Final = "invalid_arguments"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a question; `why` says what was wrong or is missing."""

    question: Question
    result: str
    why: str
    calls: int
    characters: int
    """Of arguments and replies together."""
    longest_reply: int


def settings_for(world: Path, split_s: float) -> Settings:
    """Returns the shipped configuration over the bags of a world, with its places and labels."""
    configure_logging("error", "json")
    shipped = [
        f"recording.bag_dir='{world / 'bags'}'",
        f"recording.split_duration_s={split_s:g}",
        "data.now=latest",
        "logging.level=error",
    ]
    own = [f"data.{kind}_file='{world / kind}.yaml'" for kind in ("places", "labels")]
    return load_settings([*shipped, *own], env={})


def server_over(settings: Settings) -> EpisodicServer:
    """Returns a server that has every bag stored."""
    memory = build_memory(settings)
    memory.index.refresh()
    fill_store(build_backfill(settings, memory))
    return build_server(settings, memory)


def ask_all(server: EpisodicServer, questions: Sequence[Question]) -> list[Outcome]:
    """Returns the outcome of each question."""
    return [_ask(server, question) for question in questions]


def _ask(server: EpisodicServer, question: Question) -> Outcome:
    found: list[replies.Row] = []
    characters, longest = 0, 0
    for call in question.calls:
        reply = asyncio.run(server.dispatcher.answer(call.tool, call.arguments)).text
        characters += len(json.dumps(dict(call.arguments))) + len(reply)
        longest = max(longest, len(reply))
        parsed = json.loads(reply)
        found.append(parsed if isinstance(parsed, dict) else {"items": parsed})
    result, why = _judged(question, found)
    return Outcome(question, result, why, len(found), characters, longest)


def _judged(question: Question, found: Sequence[replies.Row]) -> tuple[str, str]:
    for reply in found:
        if reply.get("error") == _REFUSED:
            return NOT_YET, str(reply.get("detail", ""))
    try:
        answer = question.read(found)
    except replies.UnreadableError as error:
        return NOT_YET, str(error)
    except (LookupError, ValueError) as error:
        return WRONG, str(error)
    wrong = wrong_fields(question.truth, answer)
    if wrong:
        expected = {name: question.truth[name].as_json() for name in wrong}
        given = {name: answer.get(name) for name in wrong}
        return WRONG, f"{json.dumps(given)}, but {json.dumps(expected)}"
    return RIGHT, ""
