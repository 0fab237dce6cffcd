"""The telemetry port: observers of answered calls, and metrics. Empty unless configured.

`ros2_memory.observability` has the adapters; nothing here depends on them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

UNKNOWN_TOOL: Final = "unknown"
"""Counts all calls of tools that do not exist: their names are chosen by clients."""


@dataclass(frozen=True, slots=True)
class Answered:
    """One finished call.

    Attributes:
        tool: a tool of this server, or `UNKNOWN_TOOL`.
        outcome: `ok`, `cancelled`, `internal` or the code of an error; `no_data` is followed by its
            reason, as in `no_data: gap`.
        duration_s: from arguments to reply, including the wait in the queue.
        stages_ms: milliseconds spent in `index`, `read` and `extract`; no stage that was skipped.
        chars: length of the reply.
        correlation_id: of the log events of the call.
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
    """Observes each finished call, on the thread of the event loop.

    It must be quick and raise nothing. The context of the call is current meanwhile, so that a span
    that a library began for it can be found.
    """

    @abstractmethod
    def answered(self, call: Answered) -> None:
        """Observes a finished call."""

    def stop(self) -> None:  # noqa: B027 - most have nothing to release
        """Flushes and releases resources, without waiting for long."""


class Exposition(NamedTuple):
    """The reply to a scrape of `/metrics`."""

    content_type: str
    body: bytes


@dataclass(frozen=True, slots=True)
class Telemetry:
    """The observers of calls, and what `/metrics` returns; none by default."""

    observers: tuple[Observer, ...] = ()
    metrics: Callable[[], Awaitable[Exposition]] | None = None

    def answered(self, call: Answered) -> None:
        """Notifies every observer of a finished call."""
        for observer in self.observers:
            observer.answered(call)

    def stop(self) -> None:
        """Stops every observer."""
        for observer in self.observers:
            observer.stop()


SILENT: Final = Telemetry()
"""Without observers and metrics."""
