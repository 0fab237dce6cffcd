"""Warnings that a program for people counts instead of showing them among its output."""

from __future__ import annotations

import logging
from collections import Counter


def withhold_warnings() -> None:
    """Counts warnings from here on instead of showing them; errors are shown as ever.

    For programs whose output people read. The next `configure_logging` ends it.
    """
    for handler in logging.getLogger().handlers:
        handler.addFilter(_Withheld())


def withheld_warnings() -> Counter[str]:
    """How often each event was withheld since this was last asked."""
    counted = Counter[str]()
    for handler in logging.getLogger().handlers:
        for each in handler.filters:
            if isinstance(each, _Withheld):
                counted += each.counted
                each.counted.clear()
    return counted


class _Withheld(logging.Filter):
    """Lets no warning pass, and counts them by event; a library's by the name of its logger."""

    def __init__(self) -> None:
        super().__init__()
        self.counted = Counter[str]()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        event: object = record.msg
        self.counted[str(event.get("event")) if isinstance(event, dict) else record.name] += 1
        return False
