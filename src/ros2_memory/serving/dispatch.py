"""One tool call from arguments to reply: its turn, a worker thread, a deadline, one log event.

Nothing escapes: what a query raises becomes a reply, and what it should not have raised is logged
with its traceback under the call's correlation id, which is all that the client learns of it.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Final

import anyio
import structlog

from ros2_memory.core.errors import (
    BusyError,
    EpisodicError,
    InvalidArgumentsError,
    NoDataError,
    QueryTimeoutError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.telemetry import SILENT, UNKNOWN_TOOL, Answered
from ros2_memory.core.text import abbreviate
from ros2_memory.core.timebase import Deadline, unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.serving.call_size import too_much_of
from ros2_memory.serving.fair_queue import FairQueue

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence

    from ros2_memory.core.telemetry import Telemetry
    from ros2_memory.history.context import Memory
    from ros2_memory.tools.declaration import Question, Tool
    from ros2_memory.tools.replies import Replies, Reply

QUICK_AT_ONCE: Final = 4
BLOCKING_AT_ONCE: Final = 2
"""Queries are mostly Python, which runs one at a time: more threads would only slow each other.

Those that may take long have places of their own, so that a quick one never waits for them.
"""

_SOONER_S: Final = 0.5
"""How much before the call a query gives up, so that its own sentence is what the client reads."""

_WORTH_TELLING_S: Final = 0.5
_LOGGED_CHARS: Final = 300
_LONGEST_NAME: Final = 64

log = get_logger(__name__)


class Dispatcher:
    """Answers tool calls from one memory, a bounded number at a time.

    `readable`: what no tool call reaches, but a resource that is read. `log_arguments`: whether log
    events show what a caller wrote, cut short.

    Attributes:
        tools: what a call can name, in the order of their declaration.
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
    ) -> None:
        self.tools = (*tools,)
        self._memory = memory
        self._tools = {tool.name: tool for tool in tools}
        self._readable = self._tools | {each.name: each for each in readable}
        self._replies = replies
        self._call_timeout_s = call_timeout_s
        self._telemetry = telemetry
        self._log_arguments = log_arguments
        self.quick = FairQueue("quick", QUICK_AT_ONCE)
        self.blocking = FairQueue("blocking", BLOCKING_AT_ONCE)
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Has every query that still runs give up, and begins no other: the program can end."""
        self._stopping.set()
        self.quick.stop()
        self.blocking.stop()

    async def answer(
        self, name: str, given: Mapping[str, object], client: Hashable = None
    ) -> Reply:
        """The reply to one call, within `call_timeout_s`. Raises nothing but cancellation.

        Where there are more calls than places, they are begun in turn for each `client`.
        """
        return await self._answer(self._tools, name, given, client)

    async def read(self, name: str, given: Mapping[str, object], client: Hashable = None) -> Reply:
        """The reply to the question behind a resource; the rest as for a call."""
        return await self._answer(self._readable, name, given, client)

    async def _answer(
        self,
        asked: Mapping[str, Tool],
        name: str,
        given: Mapping[str, object],
        client: Hashable,
    ) -> Reply:
        begun = time.perf_counter_ns()
        patience_s = max(self._call_timeout_s - _SOONER_S, self._call_timeout_s * 0.9)
        over = threading.Event()
        call = Call(Deadline.after(patience_s, partial(self._monotonic, over)))
        outcome, chars = "cancelled", 0
        correlation_id = uuid.uuid4().hex[:12]
        with structlog.contextvars.bound_contextvars(correlation_id=correlation_id):
            try:
                try:
                    outcome, reply = await self._outcome(asked, name, given, call, client)
                except Exception:
                    log.exception("tool_failed")
                    outcome, reply = self._fault()
                chars = len(reply.text)
            finally:
                over.set()
                known = name in asked
                done = Answered(
                    name if known else UNKNOWN_TOOL,
                    outcome,
                    unix_from_ns(time.perf_counter_ns() - begun),
                    chars,
                    correlation_id,
                    call.stages.as_ms(),
                )
                self._tell(done, name, given)
        return reply

    def _tell(self, done: Answered, name: str, given: Mapping[str, object]) -> None:
        """Of a call that is over: the log, and whoever observes."""
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
            # No answer is worth losing for it.
            log.exception("telemetry_failed")

    def _monotonic(self, over: threading.Event) -> float:
        """The clock of one call's deadline: its time is up when nobody waits for it any more."""
        return math.inf if self._stopping.is_set() or over.is_set() else time.monotonic()

    async def _outcome(
        self,
        asked: Mapping[str, Tool],
        name: str,
        given: Mapping[str, object],
        call: Call,
        client: Hashable,
    ) -> tuple[str, Reply]:
        try:
            tool = _named(name, asked)
            question = _asked(tool, given)
        except InvalidArgumentsError as error:
            return error.code, self._replies.error(error)
        waits = _Waits()
        lane = self.blocking if tool.blocking else self.quick
        late: EpisodicError
        try:
            with anyio.move_on_after(self._call_timeout_s):
                return await lane.run(client, partial(self._ask, question, call, waits))
        except BusyError as busy:
            late = busy
        else:
            late = self._late(name, waits)
        return late.code, self._replies.error(late)

    def _late(self, name: str, waits: _Waits) -> EpisodicError:
        """Why there is no answer when the time of a call is up."""
        if waits.ended_s is None:
            return BusyError(
                f"{name} waited {self._call_timeout_s:g} s behind other questions and was not "
                "begun; ask again, and fewer at once"
            )
        return QueryTimeoutError(
            f"{name} needs more than {self._call_timeout_s:g} s{waits.told()}; "
            "ask about a shorter window or a single topic"
        )

    def _ask(self, question: Question, call: Call, waits: _Waits) -> tuple[str, Reply]:
        """Runs in a worker thread: the query, and the rendering of what it gives."""
        waits.end()
        try:
            return self._told(question, call, waits)
        except Exception:
            # Here too, for a thread that nobody waits for any more.
            log.exception("tool_failed")
            return self._fault()

    def _told(self, question: Question, call: Call, waits: _Waits) -> tuple[str, Reply]:
        try:
            answer = question(self._memory, call)
            return "ok", self._replies.answer(answer, from_active=call.used_active)
        except NoDataError as error:
            return f"{error.code}: {error.reason}", self._replies.error(error)
        except QueryTimeoutError as error:
            told = QueryTimeoutError(f"{error}{waits.told()}", error.searched_back_to)
            return told.code, self._replies.error(told)
        except EpisodicError as error:
            return error.code, self._replies.error(error)

    def _fault(self) -> tuple[str, Reply]:
        """The reply to a call that failed through a fault of this program."""
        context = structlog.contextvars.get_contextvars()
        return "internal", self._replies.internal(str(context.get("correlation_id")))


def _named(name: str, tools: Mapping[str, Tool]) -> Tool:
    if name in tools:
        return tools[name]
    near = get_close_matches(name[:_LONGEST_NAME], tools, n=3)
    hint = f"do you mean {' or '.join(near)}?" if near else f"there are: {', '.join(tools)}"
    raise InvalidArgumentsError(f"there is no tool {abbreviate(name)}; {hint}")


def _asked(tool: Tool, given: Mapping[str, object]) -> Question:
    if too_much := too_much_of(given):
        raise InvalidArgumentsError(too_much)
    return tool.question(given)


class _Waits:
    """How long a call waited for its turn."""

    def __init__(self) -> None:
        self._begun_s = time.monotonic()
        self.ended_s: float | None = None

    def end(self) -> None:
        """Its turn has come."""
        self.ended_s = time.monotonic()

    def told(self) -> str:
        """What a sentence on lack of time says of it; nothing where it was short."""
        waited = 0.0 if self.ended_s is None else self.ended_s - self._begun_s
        if waited < _WORTH_TELLING_S:
            return ""
        return f" (it waited {waited:.1f} s of its time behind other questions)"
