"""A bounded soak: what the server holds in the end is what it held at the start."""

import asyncio
from pathlib import Path

from tests.soak.rounds import SHORT, SLOW, soaked
from tests.support.examples import LONG
from tests.support.robot_run import write_run
from tests.support.served import PROGRAM, serving
from tests.timing import in_time

SECONDS = 600.0 if LONG else 2.0
"""Of rounds, besides the one that warms the server up and the slow requests that it waits for."""

GROWTH_MB = 24.0
"""Far less than one reply kept for each of the calls, or one buffer for each of the connections."""

MOST_THREADS = 24


def test_bad_clients_leave_no_files_threads_or_memory_behind(tmp_path: Path) -> None:
    """A client that is refused has a second to read why."""
    write_run(tmp_path / "bags")
    in_time(lambda: soak_once(tmp_path))


def soak_once(tmp_path: Path) -> None:
    with serving(tmp_path / "bags", tmp_path / "log", program=PROGRAM) as served:
        soak = asyncio.run(soaked(served, SECONDS))
        events = served.events()
    assert soak.end is not None
    assert soak.end.files <= soak.start.files
    assert soak.end.threads <= soak.start.threads <= MOST_THREADS
    assert soak.growth_mb < GROWTH_MB
    assert soak.end.rss_mb - soak.start.rss_mb < GROWTH_MB
    assert {habit.__name__ for habit in (*SHORT, *SLOW)} <= soak.seen.keys()
    assert [each for each in events if each.get("outcome") == "cancelled"]
    assert not [each for each in events if each["level"] in {"error", "critical"}]
