"""Formats what the demo prints, in at most 100 columns."""

from __future__ import annotations

import json
import re
import textwrap
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.demo.questions import Exchange

WIDTH: Final = 96
_INDENT: Final = "    "
_JSON_LINES: Final = 4


def format_exchange(number: int, exchange: Exchange) -> str:
    """Returns the question, the tool call, the answer in words, and the reply as received.

    An empty line follows.
    """
    question, mark = exchange.question, "" if exchange.right else "WRONG: "
    arguments = ", ".join(
        f"{name}={json.dumps(value)}" for name, value in question.arguments.items()
    )
    call = textwrap.wrap(
        f"{question.tool}({arguments})",
        WIDTH,
        initial_indent=_INDENT,
        subsequent_indent=_INDENT * 2,
        break_on_hyphens=False,
    )
    answer = textwrap.fill(
        f"{mark}{exchange.sentence}",
        WIDTH,
        initial_indent=f"{_INDENT}=> ",
        subsequent_indent=f"{_INDENT}   ",
        break_on_hyphens=False,
    )
    return "\n".join([f"{number:>2}. {question.words}", *call, answer, *_reply(exchange.reply), ""])


def exchange_as_json(number: int, exchange: Exchange) -> str:
    """Returns the same in one line, for programs."""
    question = exchange.question
    return json.dumps(
        {
            "number": number,
            "question": question.words,
            "tool": question.tool,
            "arguments": dict(question.arguments),
            "right": exchange.right,
            "answer": exchange.sentence,
            "reply": exchange.reply,
        }
    )


def connection_hints(url: str) -> str:
    """Returns where the page is and how a client connects, while the robot drives on."""
    return "\n".join(
        [
            "The robot drives on, and the server stays up until Ctrl-C. Look at it, or ask it:",
            "",
            f"  in a browser           {url}/",
            f"  from an MCP client     {url}/mcp (streamable HTTP)",
            "  from a brain           with this in its tools/mcp.yaml:",
            "",
            "    - name: episodic",
            "      transport: sse",
            f'      url: "{url}/sse"',
        ]
    )


def _reply(text: str) -> Iterator[str]:
    """Yields the JSON as received, broken after commas; of a long one the start and its length."""
    lines = [""]
    for piece in re.findall(r"[^,]*,|[^,]+$", text):
        if lines[-1] and len(_INDENT) + len(lines[-1]) + len(piece) > WIDTH:
            lines.append("")
        lines[-1] += piece
    for line in lines[:_JSON_LINES]:
        yield _INDENT + line
    if len(lines) > _JSON_LINES:
        yield f"{_INDENT}... ({len(text):,} characters in all)"
