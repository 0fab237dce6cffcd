"""Log events: structlog to stderr, one JSON object a line. stdout is the stdio transport's wire.

Our events and what libraries log through `logging` (uvicorn, mcp) leave by one handler in one
shape. Values bound with `structlog.contextvars.bound_contextvars` (the correlation id of a call)
join every event. No setting or payload is logged whole, so that none can carry a secret out.
"""

from __future__ import annotations

import logging
import sys
import time
from typing import TYPE_CHECKING, Final, Literal

import structlog
from structlog.stdlib import ProcessorFormatter

if TYPE_CHECKING:
    from collections.abc import Callable

    from structlog.typing import EventDict, FilteringBoundLogger, Processor

_TALKATIVE: Final = "mcp.server.streamable_http"
"""Says at the end of each request that a session ends, where there are no sessions."""

LONGEST: Final = 8000
"""Characters of any text of a log event, be it a traceback or what a library repeats."""

EVERY_S: Final = 10.0
"""How often at most one kind of refusal is logged, and one sentence of a library that clients can
have it say: nobody who may not ask can fill the disk by being refused."""

_LIBRARY: Final = "mcp"
_LIBRARIES: Final = ("asyncio", "mcp", "starlette", "uvicorn")
_ALIKE_CHARS: Final = 32
_MOST_KINDS: Final = 256


def configure_logging(
    level: Literal["debug", "info", "warning", "error"],
    layout: Literal["json", "pretty"],
    *,
    arguments: bool = True,
) -> None:
    """Sends every event of at least `level` to stderr, with a UTC timestamp.

    Without `arguments` the MCP library, which shows whole messages at `debug`, logs warnings alone,
    and without what clients sent. Nothing that is logged is longer than `LONGEST` characters.

    `json` is for machines; `pretty` is for people, and coloured on a terminal. Call it before a
    server is built: the MCP SDK configures logging itself where nobody has.
    """
    common: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_logger_name,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
    ]
    render: list[Processor] = (
        [structlog.processors.format_exc_info, _cut, structlog.processors.JSONRenderer()]
        if layout == "json"
        else [
            _cut,
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(),
                # The default one prints local variables, which may hold what logs must not.
                exception_formatter=structlog.dev.plain_traceback,
            ),
        ]
    )
    structlog.configure(
        processors=[*common, ProcessorFormatter.wrap_for_formatter],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.stdlib.LoggerFactory(),
        # A cached logger would keep the first configuration through a second call.
        cache_logger_on_first_use=False,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        ProcessorFormatter(
            foreign_pre_chain=[*common, structlog.stdlib.ExtraAdder()],
            processors=[ProcessorFormatter.remove_processors_meta, *render],
        )
    )
    handler.addFilter(_NowAndThen())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    least = logging.WARNING if level == "info" else logging.NOTSET
    logging.getLogger(_TALKATIVE).setLevel(least)
    logging.getLogger(_LIBRARY).setLevel(logging.NOTSET if arguments else logging.WARNING)
    if not arguments:
        handler.addFilter(_without_arguments)
    logging.captureWarnings(capture=True)


def get_logger(name: str) -> FilteringBoundLogger:
    """A logger under `name`: `log.info("indexed", bags=3, duration_ms=1.2)`.

    May be made at import: the configuration that counts is the one at the time of the event.
    """
    logger: FilteringBoundLogger = structlog.get_logger(name)
    return logger


def _cut(_logger: object, _method: str, event: EventDict) -> EventDict:
    """Cuts texts that are too long; a traceback keeps its end, which says what was raised."""
    for name, value in event.items():
        if isinstance(value, str) and len(value) > LONGEST:
            is_traceback = name == "exception"
            event[name] = f"...{value[-LONGEST:]}" if is_traceback else f"{value[:LONGEST]}..."
    return event


def _without_arguments(record: logging.LogRecord) -> bool:
    """Takes out of a library's record what a client may have sent: its parameters and traceback."""
    if record.name.partition(".")[0] == _LIBRARY:
        record.msg, record.args = str(record.msg)[:_ALIKE_CHARS], ()
        record.exc_info = record.exc_text = None
    return True


class Refusals:
    """Counts what was refused, so that each kind is logged now and then; kinds are few and fixed.

    Args:
        monotonic: a clock that never steps, in seconds.
        every_s: how often at most one kind is logged.
    """

    def __init__(
        self, monotonic: Callable[[], float] = time.monotonic, every_s: float = EVERY_S
    ) -> None:
        self._monotonic = monotonic
        self._every_s = every_s
        self._counts: dict[str, int] = {}
        self._silent_until: dict[str, float] = {}

    def count(self, reason: str) -> int:
        """Counts one; returns how many since this kind was logged, or 0 until it is due again."""
        self._counts[reason] = self._counts.get(reason, 0) + 1
        now = self._monotonic()
        if now < self._silent_until.get(reason, now):
            return 0
        self._silent_until[reason] = now + self._every_s
        return self._counts.pop(reason)


class _NowAndThen(logging.Filter):
    """Lets warnings and errors of network libraries pass now and then, each kind for itself.

    What is alike begins with the same words. The next that passes says how many were `suppressed`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._suppressed: dict[tuple[str, str], int] = {}
        self._silent_until: dict[tuple[str, str], float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record passes."""
        if record.levelno < logging.WARNING or record.name.partition(".")[0] not in _LIBRARIES:
            return True
        kind = (record.name, str(record.msg)[:_ALIKE_CHARS])
        now = time.monotonic()
        if now < self._silent_until.get(kind, now):
            self._suppressed[kind] = self._suppressed.get(kind, 0) + 1
            return False
        if len(self._silent_until) >= _MOST_KINDS:
            self._silent_until.clear()
            self._suppressed.clear()
        self._silent_until[kind] = now + EVERY_S
        if suppressed := self._suppressed.pop(kind, 0):
            record.suppressed = suppressed
        return True
