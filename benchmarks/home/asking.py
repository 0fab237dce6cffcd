"""Asks a memory over a world's bags all questions by the script, and counts what that took."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from benchmarks.home import replies
from benchmarks.home.judging import wrong_fields
from benchmarks.home.questions import KINDS
from benchmarks.timing import made_known
from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.logging_setup import configure_logging

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.home.questions import Question
    from ros2_memory.config import Settings
    from ros2_memory.serving.mcp_server import EpisodicServer

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
    slowest_s: float


def settings_for(world: Path, split_s: float) -> Settings:
    """Returns the shipped configuration over the bags of a world, with its places and labels.

    They are left out where the configuration has no keys for them.
    """
    configure_logging("error", "json")
    shipped = [
        f"recording.bag_dir='{world / 'bags'}'",
        f"recording.split_duration_s={split_s:g}",
        "data.now=latest",
        "logging.level=error",
    ]
    own = [f"data.{kind}_file='{world / kind}.yaml'" for kind in ("places", "labels")]
    for key in own:
        try:
            load_settings([*shipped, key], env={})
        except ConfigError:
            continue
        shipped.append(key)
    return load_settings(shipped, env={})


def server_over(settings: Settings) -> EpisodicServer:
    """Returns a server that has every bag stored."""
    memory = build_memory(settings)
    memory.index.refresh()
    made_known(memory, settings)
    return build_server(settings, memory)


def ask_all(server: EpisodicServer, questions: Sequence[Question]) -> list[Outcome]:
    """Returns the outcome of each question."""
    return [_ask(server, question) for question in questions]


def _ask(server: EpisodicServer, question: Question) -> Outcome:
    found: list[replies.Row] = []
    characters, longest, slowest = 0, 0, 0.0
    for call in question.calls:
        begun = time.perf_counter()
        reply = asyncio.run(server.dispatcher.answer(call.tool, call.arguments)).text
        slowest = max(slowest, time.perf_counter() - begun)
        characters += len(json.dumps(dict(call.arguments))) + len(reply)
        longest = max(longest, len(reply))
        parsed = json.loads(reply)
        found.append(parsed if isinstance(parsed, dict) else {"items": parsed})
    result, why = _judged(question, found)
    return Outcome(question, result, why, len(found), characters, longest, slowest)


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


def as_table(outcomes: Sequence[Outcome]) -> str:
    """Returns right, calls and characters of each kind, and all that is not right."""
    lines = [
        "| kind | questions | right | wrong | not answered yet | calls | characters |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, "all"):
        mine = [each for each in outcomes if kind in {each.question.kind, "all"}]
        counts = [sum(each.result == one for each in mine) for one in (RIGHT, WRONG, NOT_YET)]
        calls = sum(each.calls for each in mine)
        characters = sum(each.characters for each in mine)
        cells = [kind, len(mine), *counts, calls, characters]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    longest = max(outcomes, key=lambda each: each.longest_reply)
    slowest = max(outcomes, key=lambda each: each.slowest_s)
    lines += [
        "",
        f"longest reply: {longest.longest_reply} characters ({longest.question.id})",
        f"slowest call: {slowest.slowest_s:.2f} s ({slowest.question.id})",
    ]
    lines += [
        f"{each.result}: {each.question.id} ({each.question.text}): {each.why}"
        for result in (WRONG, NOT_YET)
        for each in outcomes
        if each.result == result
    ]
    return "\n".join(lines)
