"""Dispatches tool calls: a turn in a queue, a worker thread, a deadline, one log event for each.

Every exception becomes a reply. An unexpected one is logged with its traceback under the call's
correlation id, and the client receives only that id.
"""

from __future__ import annotations

import math
import threading
import time
import traceback
import uuid
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import anyio
import structlog

from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.malloc import return_free_memory
from ros2_memory.core.telemetry import SILENT, UNKNOWN_TOOL, Answered, Telemetry
from ros2_memory.core.text import abbreviate, shortened, similar
from ros2_memory.core.timebase import Deadline, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.serving.fair_queue import STOPPING, FairQueue
from ros2_memory.tools.extra_tools import DECLARATIONS
from ros2_memory.tools.replies import Replies, Reply
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.tools.declaration import Tool


LONGEST_ANSWER: Final = 2_000
LONGEST_QUESTION: Final = 500


class QuestionLog:
    """Keeps the latest `most` questions for the page; 0 keeps none. One thread adds them."""

    def __init__(self, most: int) -> None:
        self._questions: deque[JsonObject] = deque(maxlen=most)
        self.is_on = most > 0
        self.count = 0

    def add(self, name: str, arguments: Mapping[str, object], done: Answered, answer: str) -> None:
        """Adds a call that is over. Long texts are cut."""
        question: JsonObject = {
            "asked": round(time.time() - done.duration_s, 3),
            "tool": name if done.tool == name else abbreviate(name),
            "arguments": abbreviate(arguments, LONGEST_QUESTION),
            "outcome": done.outcome,
            "ms": round(done.duration_s * 1000, 1),
            "answer": shortened(answer, LONGEST_ANSWER),
        }
        self.count += 1
        self._questions.append(question)

    def newest(self, most: int) -> tuple[JsonObject, ...]:
        """Returns the latest questions, the newest first, as JSON for the page.

        `asked` is Unix seconds of the wall clock, `answer` the begin of the reply.
        """
        return tuple(reversed(self._questions.copy()))[:most]  # another thread may add one


QUICK_AT_ONCE: Final = 4
BLOCKING_AT_ONCE: Final = 2
"""Queries are mostly Python, which runs one at a time: more threads would only slow each other.

Blocking tools have threads of their own, so that a quick query never waits for them.
"""

_QUERY_MARGIN_S: Final = 0.5
"""How much before the call its query times out, so that the client receives the query's error."""

_REPORTED_WAIT_S: Final = 0.5
_LONG_S: Final = 0.02
"""After an answer that took longer, free memory goes back, which takes a millisecond."""
_LOGGED_CHARS: Final = 300
_WRITES: Final = (
    "it needs a recorder, which alone saves and deletes bags, and server.write_tools=true; with "
    "recorder=none nothing is deleted"
)
MAX_VALUES: Final = 10_000
"""Keys and values in the arguments of one call, which are some dozen short ones."""
MAX_DEPTH: Final = 64

log = get_logger(__name__)


class Dispatcher:
    """Answers tool calls from one memory, a bounded number at a time.

    Args:
        memory: answers the questions.
        tools: the tools that clients see.
        replies: renders answers and errors.
        call_timeout_s: how long a call may take, with its time in a queue.
        readable: tools that only the resources use.
        telemetry: observes each call.
        log_arguments: whether log events show what a caller wrote, cut short.
        most_questions: how many calls are kept for the page.

    Attributes:
        tools: those that clients see, by name.
        readable: the tools that a resource can use, by name.
        blocking: the queue of the tools that are declared as blocking.
        quick: the queue of all other tools.
    """

    def __init__(
        self,
        memory: Memory,
        tools: Sequence[Tool],
        replies: Replies,
        *,
        call_timeout_s: float,
        readable: Sequence[Tool] = (),
        telemetry: Telemetry = SILENT,
        log_arguments: bool = True,
        most_questions: int = 0,
    ) -> None:
        self.questions = QuestionLog(most_questions)
        self.memory = memory
        self.tools = {tool.name: tool for tool in tools}
        self.readable = self.tools | {tool.name: tool for tool in readable}
        self._replies = replies
        self._call_timeout_s = call_timeout_s
        self._telemetry = telemetry
        self._log_arguments = log_arguments
        self.quick = FairQueue("quick", QUICK_AT_ONCE)
        self.blocking = FairQueue("blocking", BLOCKING_AT_ONCE)
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Makes running queries time out, and begins no others, so that the program can end."""
        self._stopping.set()
        self.quick.stop()
        self.blocking.stop()

    async def answer(
        self,
        name: str,
        given: Mapping[str, object],
        client: Hashable = None,
        *,
        for_resource: bool = False,
        for_page: bool = False,
        robots: frozenset[str] | None = None,
        part: Callable[[], Memory] | None = None,
    ) -> Reply:
        """Returns the reply to a call, within `call_timeout_s`. Raises nothing but cancellation.

        Args:
            name: of the tool.
            given: its arguments, unchecked.
            client: if more calls wait than there are threads, clients take turns.
            for_resource: whether the tools that only the resources use can be named, too.
            for_page: whether the page asks, whose own questions are not kept.
            robots: the robots of a fleet that the client may ask about; None for all.
            part: returns the part of the memory that answers; tools that write are refused then.
        """
        tools = self.readable if for_resource else self.tools
        begun = time.perf_counter_ns()
        outcome, reply = "cancelled", Reply("")
        with self._running_call() as (call, correlation_id):
            call.robots = robots
            try:
                outcome, reply = await self._answer(tools, name, given, call, client, part=part)
            except Exception as error:  # noqa: BLE001 - it is logged there
                outcome, reply = self._failed(error)
            finally:
                done = Answered(
                    name if name in tools else UNKNOWN_TOOL,
                    outcome,
                    unix_from_ns(time.perf_counter_ns() - begun),
                    len(reply.text),
                    correlation_id,
                    call.stages.as_ms(),
                )
                self._report(done, name, given)
                if self.questions.is_on and not for_page:
                    self.questions.add(name, given, done, reply.text)
        return reply

    async def look(self, work: Callable[[Call], JsonObject], client: Hashable = None) -> Reply:
        """Returns the result of `work` as JSON, or its error, within the time of a call.

        The page asks so: in the queue of the blocking tools, without a log event and metrics of a
        tool call. Raises nothing but cancellation.
        """
        try:
            with self._running_call() as (call, _):
                _, reply = await self._run_in_turn(
                    "the page",
                    self.blocking,
                    ("page", client),
                    call,
                    lambda: Reply(to_json_text(work(call))),
                )
        except EpisodicError as error:
            return self.refusal(error)
        return reply

    def refusal(self, error: EpisodicError) -> Reply:
        """Returns the reply to what is refused before it is asked."""
        return self._replies.error(error)

    @contextmanager
    def _running_call(self) -> Iterator[tuple[Call, str]]:
        """Yields a call and its correlation id. After the block its query times out at once."""
        over = threading.Event()
        timeout_s = max(self._call_timeout_s - _QUERY_MARGIN_S, self._call_timeout_s * 0.9)

        def monotonic() -> float:
            # Past every deadline when nobody waits for the call any more.
            return math.inf if self._stopping.is_set() or over.is_set() else time.monotonic()

        correlation_id = uuid.uuid4().hex[:12]
        with structlog.contextvars.bound_contextvars(correlation_id=correlation_id):
            try:
                yield Call(Deadline.after(timeout_s, monotonic)), correlation_id
            finally:
                over.set()

    def _report(self, done: Answered, name: str, given: Mapping[str, object]) -> None:
        """Logs a call that is over, and passes it to the observers."""
        tool, _log = done.tool, log
        if self._log_arguments:
            tool = name if tool != UNKNOWN_TOOL else abbreviate(name)
            _log = log.bind(arguments=abbreviate(given, _LOGGED_CHARS))
        _log.info(
            "tool_call",
            tool=tool,
            outcome=done.outcome,
            duration_ms=round(done.duration_s * 1000, 3),
            stages_ms=done.stages_ms,
            chars=done.chars,
        )
        try:
            self._telemetry.answered(done)
        except Exception:
            # A fault of an observer must not cost the reply.
            log.exception("telemetry_failed")

    async def _answer(
        self,
        tools: Mapping[str, Tool],
        name: str,
        given: Mapping[str, object],
        call: Call,
        client: Hashable,
        *,
        part: Callable[[], Memory] | None,
    ) -> tuple[str, Reply]:
        """Returns the outcome and the reply of a call.

        Raises:
            InvalidArgumentsError: the tool is not offered, or the arguments are refused.
            BusyError, QueryTimeoutError: as `_run_in_turn`.
        """
        tool = _find_tool(name, tools)
        if part is not None and tool.writes:
            raise InvalidArgumentsError(f"{name} writes, and is not asked of one recording")
        if excess := excess_in_arguments(given):
            raise InvalidArgumentsError(excess)
        question = tool.question(given)

        def answer() -> Reply:
            return self._replies.answer(
                question(self.memory if part is None else part(), call),
                from_active=call.used_active,
                from_memory=call.used_thinned,
                now=call.now,
            )

        queue = self.blocking if tool.blocking else self.quick
        return await self._run_in_turn(name, queue, client, call, answer)

    async def _run_in_turn(
        self, name: str, queue: FairQueue, client: Hashable, call: Call, answer: Callable[[], Reply]
    ) -> tuple[str, Reply]:
        """Waits for the client's turn, and returns the outcome and the reply.

        Raises:
            BusyError: its turn does not come in time, or too many wait.
            QueryTimeoutError: the time of a call is up.
        """
        asked_s = time.monotonic()
        waited_s: float | None = None

        def run() -> tuple[str, Reply]:
            nonlocal waited_s
            waited_s = time.monotonic() - asked_s
            return self._run(answer, call, waited_s)

        with anyio.move_on_after(self._call_timeout_s):
            return await queue.run(client, run)
        if self._stopping.is_set():
            raise BusyError(STOPPING)
        if waited_s is None:
            raise BusyError(
                f"{name} waited {self._call_timeout_s:g} s behind other calls and was not "
                "started; ask again, with fewer at once"
            )
        raise QueryTimeoutError(
            f"{name} needs more than {self._call_timeout_s:g} s{_note_on_wait(waited_s)}; "
            "ask about a shorter window or a single topic"
        )

    def _run(self, answer: Callable[[], Reply], call: Call, waited_s: float) -> tuple[str, Reply]:
        """Returns the outcome and the reply, in a worker thread; errors as replies."""
        begun = time.monotonic()
        # Around all of it: an error keeps what was read alive until it has become a reply.
        with call.reading(self.memory.large):
            try:
                try:
                    done = "ok", answer()
                except GoneError:  # the store has changed since, and is looked at anew
                    done = "ok", answer()
            except Exception as error:  # noqa: BLE001 - it is logged there
                # Caught here too, because nobody may be waiting for this thread any more.
                done = self._failed(error, waited_s)
                _free_frames(error)
        if time.monotonic() - begun > _LONG_S:
            return_free_memory()
        return done

    def _failed(self, error: Exception, waited_s: float = 0.0) -> tuple[str, Reply]:
        """Returns the outcome and the reply of a call that an error ended, after it waited (s).

        An error that is not of the domain is a fault of this program, and is logged.
        """
        if isinstance(error, QueryTimeoutError):
            detail = f"{error}{_note_on_wait(waited_s)}"
            timeout = QueryTimeoutError(detail, error.searched_back_to)
            error = BusyError(STOPPING) if self._stopping.is_set() else timeout
        try:
            if not isinstance(error, EpisodicError):
                raise error  # noqa: TRY301 - logged as a fault while an error is rendered is
            reason = f": {error.reason}" if isinstance(error, NoDataError) else ""
            return f"{error.code}{reason}", self._replies.error(error)
        except Exception:
            log.exception("tool_failed")
            context = structlog.contextvars.get_contextvars()
            return "internal", self._replies.internal(str(context.get("correlation_id")))


def _free_frames(error: BaseException | None) -> None:
    """Frees what the functions read that an error ended: a frame may refer to its own error."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__context__


def _note_on_wait(waited_s: float) -> str:
    """Returns how long a call waited for its turn, for the error of a timeout; "" if not long."""
    if waited_s < _REPORTED_WAIT_S:
        return ""
    return f" (it waited {waited_s:.1f} s of its time behind other calls)"


def _find_tool(name: str, tools: Mapping[str, Tool]) -> Tool:
    """Returns the tool of a name.

    Raises:
        InvalidArgumentsError: it is not offered; the sentence says why, or which names are near.
    """
    if name in tools:
        return tools[name]
    for declaration in DECLARATIONS:
        if name in {variant.name for variant in declaration.names}:
            why = _WRITES if declaration.writes else "server.tools is spec"
            raise InvalidArgumentsError(f"{name} is not offered here: {why}")
    near = similar(name, tools)
    hint = f"do you mean {' or '.join(near)}?" if near else f"the tools are: {', '.join(tools)}"
    raise InvalidArgumentsError(f"unknown tool {abbreviate(name)}; {hint}")


def excess_in_arguments(given: Mapping[str, object]) -> str | None:
    """Returns why the arguments of a call are too large or too deep, naming one; else None.

    Stops at the limit, so that huge arguments take no longer than allowed ones.
    """
    left = MAX_VALUES - len(given)
    if left < 0:
        return f"more than {MAX_VALUES} arguments were given; a call has a few"
    for name, argument in given.items():
        pending: list[tuple[object, int]] = [(argument, 1)]
        while pending:
            value, depth = pending.pop()
            if not isinstance(value, dict | list | tuple):
                continue
            left -= len(value)
            if left < 0:
                return f"{name[:80]} has more than {MAX_VALUES} values; a call needs a few"
            if depth >= MAX_DEPTH:
                return f"{name[:80]} is nested deeper than {MAX_DEPTH} levels"
            inner = value.values() if isinstance(value, dict) else value
            pending.extend((item, depth + 1) for item in inner)
    return None
