"""Runs `ros2-memory demo`: a recorder, the query server and a client together."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import textwrap
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, TypeAlias

import anyio
import yaml
from mcp import Client, MCPError
from mcp.client.sse import sse_client
from mcp.types import TextContent

from ros2_memory.config_sources import quoted
from ros2_memory.core.errors import ConfigError, EpisodicError
from ros2_memory.core.timebase import NS_PER_S, Ns, WallClock, ns_from_unix
from ros2_memory.demo.messages import MessageSchedule
from ros2_memory.demo.questions import QUESTIONS, CallContext, Exchange, Question, judge_reply
from ros2_memory.demo.recording import DemoRecorder
from ros2_memory.demo.robot import ROOMS
from ros2_memory.recorder.process.child import Child, end_all

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    _Show: TypeAlias = Callable[[int, Exchange], object]


WIDTH: Final = 96
_INDENT: Final = "    "
_JSON_LINES: Final = 4


def format_exchange(number: int, exchange: Exchange) -> str:
    """Returns the question, the tool call, the answer in words, the reply, and an empty line."""
    question, mark = exchange.question, "" if exchange.right else "WRONG: "
    arguments = ", ".join(
        f"{name}={json.dumps(value)}" for name, value in question.arguments.items()
    )
    call = _filled(f"{question.tool}({arguments})", _INDENT, _INDENT * 2)
    answer = _filled(f"{mark}{exchange.sentence}", f"{_INDENT}=> ", f"{_INDENT}   ")
    reply = textwrap.wrap(exchange.reply, WIDTH - len(_INDENT), break_on_hyphens=False)
    lines = [f"{_INDENT}{line}" for line in reply[:_JSON_LINES]]
    if len(reply) > _JSON_LINES:
        lines.append(f"{_INDENT}... ({len(exchange.reply):,} characters in all)")
    return "\n".join([f"{number:>2}. {question.words}", call, answer, *lines, ""])


def _filled(text: str, first_indent: str, indent: str) -> str:
    return textwrap.fill(
        text,
        width=WIDTH,
        break_on_hyphens=False,
        initial_indent=first_indent,
        subsequent_indent=indent,
    )


def exchange_as_json(number: int, exchange: Exchange) -> str:
    """Returns the question, the call, the answer and the reply as a line of JSON."""
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
    """Returns how to open the page and how to connect a client, while the robot drives on."""
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


HOST: Final = "127.0.0.1"
PLACES_NAME: Final = "places.yaml"
_OURS: Final = ("MEMORY_", "MCP_", "ROS_VISION_INTERFACES_PATH", "CREDENTIALS_DIRECTORY")
_UP_WITHIN_S: Final = 300.0
"""A busy machine may take so long; a server that fails ends at once."""
_POLL_S: Final = 0.05
_LOOKED_AT_S: Final = 0.5
"""How often the server and the recording are checked."""
_LOG_LINES_SHOWN: Final = 8


def server_environment(
    environment: Mapping[str, str], bag_dir: Path, port: int, cache: str
) -> dict[str, str]:
    """Returns the environment of a server of `bag_dir`, without the settings in `environment`."""
    others = {name: value for name, value in environment.items() if not name.startswith(_OURS)}
    return others | {
        "MCP_TRANSPORT": "sse",
        "MCP_HOST": HOST,
        "MCP_PORT": str(port),
        "MEMORY_BAG_DIR": str(bag_dir),
        "XDG_CACHE_HOME": cache,
        "MEMORY_CONFIG_OVERRIDES": (
            f"recorder=none storage=mcap reader.index_refresh_s=1 "
            f"recording.split_duration_s={SPLIT_DURATION_S:g} "
            f"{shlex.quote(f'data.places_file={quoted(str(bag_dir / PLACES_NAME))}')}"
        ),
    }


@contextmanager
def running_server(bag_dir: Path, port: int) -> Iterator[tuple[Child, str]]:
    """Starts a server, yields it with its address when it answers, and ends it after the block.

    Writes the rooms of the flat to `places.yaml` in the bag directory. The server's columns go into
    a temporary folder. The server also ends if this program is killed.

    Raises:
        EpisodicError: it did not come up; the sentence ends with the last lines of its log.
    """
    places = {
        name: {"x": [from_x, to_x], "y": [from_y, to_y]}
        for name, (from_x, to_x, from_y, to_y) in ROOMS.items()
    }
    (bag_dir / PLACES_NAME).write_text(yaml.safe_dump({"places": places}, sort_keys=False))
    with TemporaryDirectory(prefix="ros2-memory-demo-cache-", ignore_cleanup_errors=True) as cache:
        server = Child.start(
            [sys.executable, "-P", "-m", "ros2_memory.server", "--page", "print"],
            server_environment(os.environ, bag_dir, port, cache),
            stderr=subprocess.STDOUT,
        )
        try:
            yield server, _wait_for_address(server)
        finally:
            end_all([server])


def _wait_for_address(server: Child) -> str:
    """Waits until a server has printed its address, and returns the address.

    Raises:
        EpisodicError: the server ended, or did not answer in time.
    """
    begun, lines = time.monotonic(), list[str]()
    while not (address := re.search(rf"http://{HOST}:\d+", "\n".join(lines))):
        status, waited_s, failed = server.exit_status(), time.monotonic() - begun, ""
        lines += server.take_lines()
        if status is not None:
            failed = f"the server ended with exit code {status}"
        elif waited_s > _UP_WITHIN_S:
            failed = f"the server did not answer within {_UP_WITHIN_S:g} s"
        if failed:
            words = [": its last words are", *lines[-_LOG_LINES_SHOWN:]] if lines else []
            raise EpisodicError("\n  ".join([failed, *words]))
        time.sleep(_POLL_S)
    return address[0]


SPLIT_DURATION_S: Final = 5.0
HISTORY_S: Final = 120.0
"""The length of the history when the questions are asked: more than a lap of the robot."""
_UNDERWAY_S: Final = 22
"""Seconds that the robot has been driving when its recording begins: it leaves the front door."""

_CONNECTED_WITHIN_S: Final = 60.0


def run_demo(
    say: Callable[[str], object],
    questions: Sequence[Question] = QUESTIONS,
    *,
    once: bool = False,
    port: int = 9203,
    bag_dir: Path | None = None,
    as_json: bool = False,
) -> int:
    """Records, serves, asks, and then continues until it is interrupted.

    Args:
        say: prints a line.
        questions: what is asked.
        once: whether to leave after the answers.
        port: the server's; 0 for any free one.
        bag_dir: an empty or new folder for the bags; None for a temporary one.
        as_json: whether to print only a line of JSON for each question.

    Returns:
        0 if every answer was right, otherwise 1.

    Raises:
        ConfigError: the options cannot be followed.
        EpisodicError: the server or the recording did not last.
        KeyboardInterrupt: it was interrupted before all answers were there.
        OSError: the folder cannot be made or written.
    """
    if bag_dir and bag_dir.exists() and (not bag_dir.is_dir() or any(bag_dir.iterdir())):
        raise ConfigError(f"--bag-dir {bag_dir} is not an empty folder; give a new or an empty one")

    def show(number: int, exchange: Exchange) -> None:
        say((exchange_as_json if as_json else format_exchange)(number, exchange))

    def tell(text: str) -> None:
        if not as_json:
            say(text)

    with ExitStack() as stack:
        if bag_dir is None:
            temporary = TemporaryDirectory(prefix="ros2-memory-demo-", ignore_cleanup_errors=True)
            bag_dir = Path(stack.enter_context(temporary))
        bag_dir.mkdir(parents=True, exist_ok=True)
        folder = bag_dir.resolve()
        begun = WallClock().now() - ns_from_unix(HISTORY_S)
        schedule = MessageSchedule(t0=begun - _UNDERWAY_S * NS_PER_S, start=begun)
        name = time.strftime("flat_%Y_%m_%d-%H_%M_%S")
        recorder = DemoRecorder(folder / name, schedule, split_duration_s=SPLIT_DURATION_S)
        if recorder.failure is not None:
            raise recorder.failure
        stack.callback(recorder.stop)
        server, url = stack.enter_context(running_server(folder, port))
        tell(
            "A simulated robot drives through a flat and records what it does. A client asks the "
            "real\nquery server about it, and each answer is held against the robot's closed form."
            f"\n\n  bags     {recorder.directory}\n"
            f"           {HISTORY_S:g} s of history in {recorder.splits} files of "
            f"{SPLIT_DURATION_S:g} s, the last one being written\n"
            f"  server   {url}/sse (SSE), {url}/mcp (streamable HTTP)\n"
        )
        right = _ask_all(f"{url}/sse", schedule.t0, show, questions)
        tell(f"{right} of {len(questions)} answers are right.")
        if not once:
            tell(f"\n{connection_hints(url)}")
            _wait(server, recorder)
    return int(right < len(questions))


def _ask_all(url: str, t0: Ns, show: _Show, questions: Sequence[Question]) -> int:
    """Asks every question; returns how many answers were right.

    Raises:
        EpisodicError: the connection breaks.
    """
    try:
        return anyio.run(_ask_over_one_connection, url, t0, show, questions)
    except ExceptionGroup as group:
        # The client raises errors, also those of its block, in nested groups.
        cause: BaseException = group
        while isinstance(cause, BaseExceptionGroup):
            cause = cause.exceptions[0]
        why = str(cause) or type(cause).__name__
        raise EpisodicError(f"the questions broke off: {why}") from group


async def _ask_over_one_connection(
    url: str, t0: Ns, show: _Show, questions: Sequence[Question]
) -> int:
    right, clock = 0, WallClock()
    async with Client(sse_client(url, timeout=_CONNECTED_WITHIN_S)) as client:
        for number, question in enumerate(questions, start=1):
            before = clock.now()
            try:
                result = await client.call_tool(question.tool, dict(question.arguments))
            except MCPError as error:
                exchange = Exchange(question, "", f"the call failed: {error}", right=False)
            else:
                texts = [part.text for part in result.content if isinstance(part, TextContent)]
                call = CallContext(t0, before, clock.now())
                exchange = judge_reply(question, "".join(texts), call, is_error=result.is_error)
            show(number, exchange)
            right += exchange.right
    return right


def _wait(server: Child, recorder: DemoRecorder) -> None:
    """Waits until it is interrupted.

    Raises:
        EpisodicError: the server or the recording ended by itself.
    """
    try:
        while recorder.failure is None:
            if (status := server.exit_status()) is not None:
                raise EpisodicError(f"the server ended by itself, with exit code {status}")
            time.sleep(_LOOKED_AT_S)
    except KeyboardInterrupt:
        return
    raise EpisodicError(f"the recording ended: {recorder.failure}")
