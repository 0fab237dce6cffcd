"""What is told of each answered call, and to whom: nobody, unless the configuration asks for it.

The port behind which `ros2_memory.observability` has its adapters; nothing here depends on them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

UNKNOWN_TOOL: Final = "unknown"
"""The name under which calls of tools that do not exist are counted, whatever they were called."""


@dataclass(frozen=True, slots=True)
class Answered:
    """One call that is over.

    Attributes:
        tool: a tool of this server, or `UNKNOWN_TOOL`.
        outcome: `ok`, `cancelled`, `internal` or the code of an error; with `no_data` its reason
            behind a colon, as in `no_data: gap`.
        duration_s: from arguments to reply, the wait for its turn included.
        stages_ms: milliseconds spent in `index`, `read` and `extract`; not all of them need occur.
        chars: length of the reply.
        correlation_id: what the log events of the call carry.
    """

    tool: str
    outcome: str
    duration_s: float
    chars: int
    correlation_id: str
    stages_ms: Mapping[str, float] = field(default_factory=dict)

    @property
    def code(self) -> str:
        """The outcome without its reason."""
        return self.outcome.partition(":")[0]

    @property
    def reason(self) -> str:
        """The reason of `no_data`; empty for all other outcomes."""
        return self.outcome.partition(": ")[2]


class Observer(ABC):
    """Somebody who is told of each call when it is over, on the event loop's thread.

    It must be quick and raise nothing. The call's own context is current meanwhile, so that a span
    that a library began for it can be found.
    """

    @abstractmethod
    def answered(self, call: Answered) -> None:
        """A call is over."""

    def stop(self) -> None:  # noqa: B027 - most have nothing to let go
        """Lets go of what it holds; waits a moment at most."""


class Exposition(NamedTuple):
    """What is answered to whoever scrapes."""

    content_type: str
    body: bytes


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Who is told of each call, and what is shown at `/metrics`; nobody and nothing by default."""

    observers: tuple[Observer, ...] = ()
    metrics: Callable[[], Awaitable[Exposition]] | None = None

    def answered(self, call: Answered) -> None:
        """Tells every observer of a call that is over."""
        for each in self.observers:
            each.answered(call)

    def stop(self) -> None:
        """Has every observer let go of what it holds."""
        for each in self.observers:
            each.stop()


SILENT: Final = Telemetry()
"""What tells nobody anything."""
