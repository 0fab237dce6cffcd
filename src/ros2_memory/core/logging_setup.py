"""Log events: structlog to stderr, one JSON object a line. stdout belongs to the stdio transport.

Our events and those that libraries log through `logging` (uvicorn, mcp) pass one handler in one
format. Values bound with `structlog.contextvars.bound_contextvars` (the correlation id of a call)
join every event. No setting or payload is logged as a whole, so none can leak a secret.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

    from structlog.typing import EventDict, FilteringBoundLogger, Processor


@contextmanager
def _not_installed(package: str) -> Iterator[None]:
    """Makes imports of a package fail in the block, unless it was imported before."""
    if package in sys.modules:
        yield
        return
    sys.modules[package] = None  # type: ignore[assignment]  # so Python documents it
    try:
        yield
    finally:
        del sys.modules[package]


# Where Rich is installed, structlog imports it for a layout of tracebacks that is not used here:
# 8 MB, and a twentieth of a server's start.
with _not_installed("rich"):
    import structlog
    from structlog.stdlib import ProcessorFormatter

_SESSION_LOGGER: Final = "mcp.server.streamable_http"
"""A logger that reports the end of a session at each request, though there are no sessions."""

MAX_CHARS: Final = 8000
"""Characters of any text of a log event, such as a traceback or what a library repeats."""

EVERY_S: Final = 10.0
"""Events that clients can cause are logged this often at most: they must not fill the disk."""

_LIBRARY: Final = "mcp"
_LIBRARIES: Final = ("asyncio", "mcp", "starlette", "uvicorn")
_KIND_CHARS: Final = 32
_MAX_KINDS: Final = 256
_OTHER_KINDS: Final = object()
"""The kind of all events of other kinds while so many are known."""


def configure_logging(
    level: Literal["debug", "info", "warning", "error"],
    layout: Literal["json", "pretty"],
    *,
    arguments: bool = True,
) -> None:
    """Sends every event of at least `level` to stderr, with a UTC timestamp.

    Call it before a server is built: the MCP SDK configures logging itself if nobody has.

    Args:
        level: the least severe level that is logged.
        layout: `json` for machines; `pretty` for people, coloured on a terminal.
        arguments: whether the MCP library may log messages of clients, as it does at `debug`.
            Without, it logs warnings and errors only, and no content of messages.
    """
    common: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_logger_name,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
    ]
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
            processors=[ProcessorFormatter.remove_processors_meta, *_renderers(layout)],
        )
    )
    handler.addFilter(_LibraryFilter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    least = logging.WARNING if level == "info" else logging.NOTSET
    logging.getLogger(_SESSION_LOGGER).setLevel(least)
    logging.getLogger(_LIBRARY).setLevel(logging.NOTSET if arguments else logging.WARNING)
    if not arguments:
        handler.addFilter(_remove_arguments)
    logging.captureWarnings(capture=True)


def _renderers(layout: Literal["json", "pretty"]) -> list[Processor]:
    """Returns the last processors of an event, which make its line."""
    if layout == "json":
        return [structlog.processors.format_exc_info, _cut, structlog.processors.JSONRenderer()]
    console = structlog.dev.ConsoleRenderer(
        colors=sys.stderr.isatty(),
        # The default one prints local variables, which may be secret.
        exception_formatter=structlog.dev.plain_traceback,
    )
    return [_cut, console]


def get_logger(name: str) -> FilteringBoundLogger:
    """Returns a logger: `log.info("indexed", bags=3, duration_ms=1.2)`.

    It may be made at import: the configuration at the time of an event counts.
    """
    logger: FilteringBoundLogger = structlog.get_logger(name)
    return logger


def _cut(_logger: object, _method: str, event: EventDict) -> EventDict:
    """Cuts long texts; a traceback keeps its end, which names the exception."""
    for name, value in event.items():
        if isinstance(value, str) and len(value) > MAX_CHARS:
            is_traceback = name == "exception"
            event[name] = f"...{value[-MAX_CHARS:]}" if is_traceback else f"{value[:MAX_CHARS]}..."
    return event


def _remove_arguments(record: logging.LogRecord) -> bool:
    """Removes from a record of the MCP library what a client may have sent; keeps the record."""
    if record.name.partition(".")[0] == _LIBRARY:
        record.msg, record.args = str(record.msg)[:_KIND_CHARS], ()
        record.exc_info = record.exc_text = None
    return True


class LogThrottle:
    """Counts events by kind, so that each kind is logged once in `every_s` at most. Thread-safe.

    Args:
        monotonic: a clock that never steps, in seconds.
        every_s: the least time between two events of a kind (s).
    """

    def __init__(
        self, monotonic: Callable[[], float] = time.monotonic, every_s: float = EVERY_S
    ) -> None:
        self._monotonic = monotonic
        self._every_s = every_s
        self._counts: Counter[Hashable] = Counter()
        self._silent_until: dict[Hashable, float] = {}
        # Garbage that is collected meanwhile may log in the same thread.
        self._lock = threading.RLock()

    def count(self, kind: Hashable) -> int:
        """Counts an event; returns how many are to be logged as one, or 0 if none is now.

        While 256 kinds are known, all other kinds count as one.
        """
        with self._lock:
            now = self._monotonic()
            counted_as = self._known_kind(kind, now)
            self._counts[counted_as] += 1
            if now < self._silent_until.get(counted_as, now):
                return 0
            self._silent_until[counted_as] = now + self._every_s
            return self._counts.pop(counted_as, 0)

    def _known_kind(self, kind: Hashable, now: float) -> Hashable:
        """Returns the kind that an event counts as. Makes room if there is none."""
        if kind in self._silent_until or len(self._silent_until) < _MAX_KINDS:
            return kind
        self._forget_expired(now)
        return kind if len(self._silent_until) < _MAX_KINDS else _OTHER_KINDS

    def _forget_expired(self, now: float) -> None:
        """Forgets the kinds that may be logged again; what they counted joins the other kinds."""
        for kind, silent_until in [*self._silent_until.items()]:
            if silent_until <= now and kind is not _OTHER_KINDS:
                self._silent_until.pop(kind, None)
                self._counts[_OTHER_KINDS] += self._counts.pop(kind, 0)


class _LibraryFilter(logging.Filter):
    """Throttles warnings and errors of network libraries.

    Records of a logger that begin with the same words are of one kind. A record has as
    `suppressed` how many of its kind were left out before it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._throttle = LogThrottle(time.monotonic)

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether a record is logged."""
        if record.levelno < logging.WARNING or record.name.partition(".")[0] not in _LIBRARIES:
            return True
        count = self._throttle.count((record.name, str(record.msg)[:_KIND_CHARS]))
        if count > 1:
            record.suppressed = count - 1
        return count > 0
