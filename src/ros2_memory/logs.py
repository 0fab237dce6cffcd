"""Log events: structlog to stderr, one JSON object a line. stdout is the stdio transport's wire.

Our events and what libraries log through `logging` (uvicorn, mcp) leave by one handler in one
shape. Values bound with `structlog.contextvars.bound_contextvars` (the correlation id of a call)
join every event. No setting or payload is logged whole, so that none can carry a secret out.
"""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Final, Literal

import structlog
from structlog.stdlib import ProcessorFormatter

if TYPE_CHECKING:
    from structlog.typing import FilteringBoundLogger, Processor

_TALKATIVE: Final = "mcp.server.streamable_http"
"""Says at the end of each request that a session ends, where there are no sessions."""


def configure_logging(
    level: Literal["debug", "info", "warning", "error"], layout: Literal["json", "pretty"]
) -> None:
    """Sends every event of at least `level` to stderr, with a UTC timestamp.

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
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if layout == "json"
        else [
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(),
                # The default one prints local variables, which may hold what logs must not.
                exception_formatter=structlog.dev.plain_traceback,
            )
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
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    least = logging.WARNING if level == "info" else logging.NOTSET
    logging.getLogger(_TALKATIVE).setLevel(least)
    logging.captureWarnings(capture=True)


def get_logger(name: str) -> FilteringBoundLogger:
    """A logger under `name`: `log.info("indexed", bags=3, duration_ms=1.2)`.

    May be made at import: the configuration that counts is the one at the time of the event.
    """
    logger: FilteringBoundLogger = structlog.get_logger(name)
    return logger
