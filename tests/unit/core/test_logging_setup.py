"""Log events: where they go and what they look like."""

import json
import logging
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier, BrokenBarrierError
from types import SimpleNamespace
from typing import Any, Literal

import pytest
import structlog
from mcp.server import streamable_http as transport

from ros2_memory.core import logging_setup
from ros2_memory.core.logging_setup import (
    LogThrottle,
    configure_logging,
    get_logger,
)


@pytest.fixture(autouse=True)
def restored_logging() -> Iterator[None]:
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    # pytest's own handlers stand on the root logger, and the set-up closes what it replaces.
    root.handlers = []
    yield
    root.level, root.handlers = level, handlers
    logging.getLogger(transport.__name__).setLevel(logging.NOTSET)
    logging.captureWarnings(capture=False)
    structlog.reset_defaults()


def events(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    out, err = capsys.readouterr()
    assert out == ""
    return [json.loads(line) for line in err.splitlines()]


@pytest.mark.parametrize("layout", ["json", "pretty"])
def test_an_exception_does_not_show_local_variables(
    layout: Literal["json", "pretty"], capsys: pytest.CaptureFixture[str]
) -> None:
    configure_logging("info", layout)
    secret = f"hunter{1 + 1}"
    try:
        int("a bad bag")
    except ValueError:
        get_logger("ours").exception("scan failed")
    out, err = capsys.readouterr()
    assert out == ""
    assert "ValueError: invalid literal" in err
    assert secret not in err


def test_what_a_library_repeats_is_logged_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(logging_setup, "time", SimpleNamespace(monotonic=lambda: now[0]))
    configure_logging("info", "json")
    for second in range(25):
        now[0] = float(second)
        for logger in ("uvicorn.error", "asyncio", "mcp.server.sse"):
            logging.getLogger(logger).warning("Invalid HTTP request received.")
        logging.getLogger("asyncio").error("Fatal error: protocol.data_received() call %d", second)
        get_logger("ros2_memory.test").warning("ours")
    logged = events(capsys)
    counts = Counter(each["logger"] for each in logged)
    ours = {"ros2_memory.test": 25}
    assert counts == {"uvicorn.error": 3, "asyncio": 6, "mcp.server.sse": 3, **ours}
    seen = [each.get("suppressed") for each in logged if each["logger"] == "uvicorn.error"]
    assert seen == [None, 9, 9]


def test_nothing_that_is_logged_is_endless(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging("debug", "json")
    long = "x" * 1_000_000
    logging.getLogger("mcp.server.sse").debug(f"Received JSON: {long}")
    get_logger("ros2_memory.test").info("ours", reason=long)
    fault = ValueError(f"{long}the end")
    get_logger("ros2_memory.test").error("failed", exc_info=fault)
    logged = events(capsys)
    assert len(logged) == 3
    assert all(len(json.dumps(each)) < 2 * logging_setup.MAX_CHARS for each in logged)
    assert logged[2]["exception"].endswith("the end")


@pytest.mark.parametrize("level", ["debug", "info"])
def test_without_arguments_the_library_shows_nothing_of_a_message(
    level: Literal["debug", "info"], capsys: pytest.CaptureFixture[str]
) -> None:
    configure_logging(level, "json", arguments=False)
    theirs = logging.getLogger("mcp.server.sse")
    theirs.debug("Received JSON: %s", "s3cret")
    theirs.warning("Rejecting message for session %s: credential does not match", "s3cret")
    theirs.error("Failed to parse message", exc_info=ValueError("s3cret"))
    logged = events(capsys)
    assert [each["level"] for each in logged] == ["warning", "error"]
    assert "s3cret" not in str(logged)


def test_an_event_of_each_of_two_threads_is_counted_once() -> None:
    """Whether or not both are at the clock at once."""
    both = Barrier(2)

    def now() -> float:
        with suppress(BrokenBarrierError):
            both.wait(timeout=0.5)
        return 0.0

    throttle = LogThrottle(now, every_s=0.0)
    with ThreadPoolExecutor(2) as pool:
        assert sum(pool.map(throttle.count, ["refused", "refused"])) == 2


def test_of_more_kinds_than_are_told_apart_few_events_are_logged_and_all_are_counted() -> None:
    now = [0.0]
    throttle = LogThrottle(lambda: now[0], every_s=10.0)
    assert [throttle.count(nth) for nth in range(256)] == [1] * 256
    others = [throttle.count(nth) for nth in range(1000, 4000)]
    assert (others[0], sum(others)) == (1, 1)
    assert [throttle.count(7), throttle.count(8)] == [0, 0]
    now[0] = 10.0
    assert throttle.count(7) == 2
    logged = [count for nth in range(5000, 6000) if (count := throttle.count(nth))]
    assert len(logged) < 256
    # Of the other kinds, what was silent, that of the forgotten kind 8, and the present one.
    assert max(logged) == 2999 + 1 + 1


def test_what_is_silent_stays_silent_when_many_other_kinds_come() -> None:
    now = [0.0]
    throttle = LogThrottle(lambda: now[0], every_s=10.0)
    assert [throttle.count("refused") for _ in range(6)] == [1, 0, 0, 0, 0, 0]
    now[0] = 1.0
    for nth in range(400):
        throttle.count(nth)
    assert throttle.count("refused") == 0
    now[0] = 11.0
    assert throttle.count("refused") == 7
