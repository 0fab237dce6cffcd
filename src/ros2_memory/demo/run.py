"""Runs `ros2-memory demo`: a recorder, the query server and a client together."""

from __future__ import annotations

import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, TypeAlias

import anyio
from mcp import Client, MCPError
from mcp.client.sse import sse_client
from mcp.types import TextContent

from ros2_memory.core.errors import ConfigError, EpisodicError
from ros2_memory.core.timebase import NS_PER_S, WallClock, ns_from_unix
from ros2_memory.demo.answer_checks import CallContext
from ros2_memory.demo.output import connection_hints, exchange_as_json, format_exchange
from ros2_memory.demo.published_topics import MessageSchedule
from ros2_memory.demo.questions import QUESTIONS, Exchange, Question, judge_reply
from ros2_memory.demo.recording import DemoRecorder
from ros2_memory.demo.robot import LAP_S
from ros2_memory.demo.server_process import HOST, free_port, running_server

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    _Show: TypeAlias = Callable[[int, Exchange], object]

SPLIT_DURATION_S: Final = 5.0
SHORTEST_S: Final = LAP_S + 2 * SPLIT_DURATION_S
LONGEST_S: Final = 86_400.0
_UNDERWAY_S: Final = 22
"""How long the robot has been driving when its recording begins (it leaves the front door)."""

_KNOWN_WITHIN_NS: Final = 3 * NS_PER_S
"""The server knows a closed split within this time: the index refresh, with some room."""


_CONNECTED_WITHIN_S: Final = 60.0


def run_demo(
    say: Callable[[str], object],
    questions: Sequence[Question] = QUESTIONS,
    *,
    once: bool = False,
    port: int = 9203,
    bag_dir: Path | None = None,
    duration_s: float = 120.0,
    verbose: bool = False,
    as_json: bool = False,
) -> int:
    """Records, serves, asks, and (unless `once`) continues until it is interrupted.

    Args:
        say: prints.
        questions: what is asked.
        once: leave after the answers.
        port: where the server listens; 0 for any that is free.
        bag_dir: an empty or new folder for the bags, kept; None for a temporary one.
        duration_s: length of the history that exists when the questions are asked.
        verbose: the server's log goes to stderr.
        as_json: a line of JSON for each question, and nothing else.

    Returns:
        0 where every answer was right, otherwise 1.

    Raises:
        ConfigError: the options cannot be followed.
        EpisodicError: the server or the recording did not last.
        KeyboardInterrupt: it was interrupted before all answers were there.
    """
    if not SHORTEST_S <= duration_s <= LONGEST_S:
        raise ConfigError(
            f"--duration {duration_s:g} is not between {SHORTEST_S:g} and {LONGEST_S:g} s; "
            "the shortest is a lap of the robot and two bag files"
        )
    if bag_dir is not None and bag_dir.exists() and not _is_empty(bag_dir):
        raise ConfigError(f"--bag-dir {bag_dir} is not an empty folder; give a new or an empty one")
    port = free_port(port)
    tell: Callable[[str], object] = str if as_json else say
    with ExitStack() as stack:
        folder = _made(bag_dir, stack)
        recorder = stack.enter_context(_recorder(folder, duration_s))
        server = stack.enter_context(
            running_server(folder, port, tell, split_duration_s=SPLIT_DURATION_S, verbose=verbose)
        )
        url = f"http://{HOST}:{port}"
        tell(
            "A simulated robot drives through a flat and records what it does. A client asks the "
            "real\nquery server about it, and each answer is held against the robot's closed form."
            f"\n\n  bags     {recorder.directory}\n"
            f"           {duration_s:g} s of history in {recorder.splits} files of "
            f"{SPLIT_DURATION_S:g} s, the last one being written\n"
            f"  server   {url}/sse (SSE), {url}/mcp (streamable HTTP)\n"
        )
        show = exchange_as_json if as_json else format_exchange
        wrong = _count_wrong(f"{url}/sse", recorder, lambda *each: say(show(*each)), questions)
        total = len(questions)
        tell(f"{total - wrong} of {total} answers are right.")
        if not once:
            tell(f"\n{connection_hints(url)}")
            _wait(server, recorder)
    return 1 if wrong else 0


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


def _made(bag_dir: Path | None, stack: ExitStack) -> Path:
    """Returns the folder of the bags; without a name one that is removed at the end."""
    if bag_dir is None:
        temporary = TemporaryDirectory(prefix="ros2-memory-demo-", ignore_cleanup_errors=True)
        return Path(stack.enter_context(temporary))
    try:
        bag_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--bag-dir {bag_dir} cannot be made: {error}") from error
    return bag_dir.resolve()


def _recorder(bag_dir: Path, duration_s: float) -> DemoRecorder:
    """Returns a recorder that has written its history and continues."""
    now = WallClock().now()
    start = now - ns_from_unix(duration_s)
    timeline = MessageSchedule(t0=start - _UNDERWAY_S * NS_PER_S, start=start)
    name = time.strftime("flat_%Y_%m_%d-%H_%M_%S")
    recorder = DemoRecorder(bag_dir / name, timeline, split_duration_s=SPLIT_DURATION_S)
    recorder.write_until(now)
    recorder.start()
    return recorder


def _count_wrong(
    url: str, recorder: DemoRecorder, show: _Show, questions: Sequence[Question]
) -> int:
    try:
        return anyio.run(_ask_all, url, recorder, show, questions)
    except ExceptionGroup as group:
        # What the client raises, and what is raised while it is open, comes nested in groups.
        cause: BaseException = group
        while isinstance(cause, BaseExceptionGroup):
            cause = cause.exceptions[0]
        why = str(cause) or type(cause).__name__
        raise EpisodicError(f"the questions broke off: {why}") from group


async def _ask_all(
    url: str, recorder: DemoRecorder, show: _Show, questions: Sequence[Question]
) -> int:
    """Asks every question over one connection; returns how many answers were wrong."""
    wrong = 0
    async with Client(sse_client(url, timeout=_CONNECTED_WITHIN_S)) as client:
        for number, question in enumerate(questions, start=1):
            exchange = await _ask(client, question, recorder)
            show(number, exchange)
            wrong += not exchange.right
    return wrong


async def _ask(client: Client, question: Question, recorder: DemoRecorder) -> Exchange:
    clock = WallClock()
    before = clock.now()
    try:
        result = await client.call_tool(question.tool, dict(question.arguments))
    except MCPError as error:
        return Exchange(question, "", f"the call failed: {error}", right=False)
    after = clock.now()
    reply = "".join(part.text for part in result.content if isinstance(part, TextContent))
    call = CallContext(
        recorder.timeline, before, after, recorder.closed_ends(before - _KNOWN_WITHIN_NS, after)
    )
    return judge_reply(question, reply, call, is_error=result.is_error)


def _wait(server: subprocess.Popen[bytes], recorder: DemoRecorder) -> None:
    """Waits until it is interrupted.

    Raises:
        EpisodicError: the server or the recording ended by itself.
    """
    try:
        while recorder.failure is None:
            try:
                code = server.wait(timeout=1.0)
            except subprocess.TimeoutExpired:
                continue
            raise EpisodicError(f"the server ended by itself, with exit code {code}")
    except KeyboardInterrupt:
        return
    raise EpisodicError(f"the recording ended: {recorder.failure}")
