"""What holds for every test."""

import gc
import os
import shutil
import signal
import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import mkdtemp
from unittest.mock import patch

import pytest
import structlog
from hypothesis import HealthCheck, settings
from xdist.remote import Producer

from ros2_memory.typestore import MessageType
from tests.support.composed import shipped_once
from tests.support.examples import examples
from tests.support.forked_commands import ADDRESS, forking
from tests.support.measured import (
    foreign_untraced,
    is_measured,
    nothing_measured,
    only_ours_measured,
)
from tests.support.real_recorder import real_recorder  # noqa: F401 (a fixture)
from tests.support.workers import Groups, give_way, place, workers_for

# A loaded machine is slow, not wrong.
settings.register_profile(
    "steady",
    deadline=None,
    max_examples=examples(100),
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("steady")

# Also for the programs that tests start: nothing is to be left in the user's own.
_CACHE = mkdtemp(prefix="ros2-memory-tests-")
os.environ["XDG_CACHE_HOME"] = _CACHE

if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    # Hundreds of programs are started here; each would compile all that it imports. Nothing is
    # written beside the sources, which is what such an environment wants.
    _COMPILED = str(Path(__file__).resolve().parents[1] / "build" / "bytecode")
    os.environ.setdefault("PYTHONPYCACHEPREFIX", _COMPILED)
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"]
    sys.dont_write_bytecode = False


NEEDS_SHARED = "needs_shared_bags"
"""A property of reports, which reach the summary from every worker."""

# A shell starts what runs in its background with these ignored, and children inherit that.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


# Where nothing configures the log: a traceback with the variables of each frame takes seconds.
structlog.dev.ConsoleRenderer.get_active().exception_formatter = structlog.dev.plain_traceback

# What is imported and collected stays: the collector would go through all of it time and again,
# for a third of the processor time of collecting, and for 0.4 s each later time.
gc.disable()
# Later it runs less often than by itself: each time it goes through what all tests so far left.
gc.set_threshold(5_000, 20, 100)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Measures what tests import of the package, and not the collecting.

    From its end on there is garbage, among new objects only.
    """
    try:
        with only_ours_measured():
            return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """Workers fork programs from what the first process of all began."""
    if ADDRESS not in os.environ:
        stack = ExitStack()
        stack.enter_context(forking())
        config.add_cleanup(stack.close)


def pytest_unconfigure() -> None:
    """Removes what tests left in that cache."""
    shutil.rmtree(_CACHE, ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first, so that the others are done meanwhile.

    Tests that are marked `shared(PATH)` are skipped where that is not beside this checkout.
    """
    items.sort(key=lambda item: place(item.nodeid))
    for item in items:
        needed: list[Path] = [mark.args[0] for mark in item.iter_markers("shared")]
        absent = [path for path in needed if not path.exists()]
        if needed:
            item.user_properties.append((NEEDS_SHARED, True))
        if absent:
            reason = f"{absent[0].name} of the shared bags is not beside this checkout"
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter,
) -> Generator[None, object, object]:
    """Counts the tests that need the shared bags, so that nobody takes skipped ones for passed.

    Below the reasons of what was skipped.
    """
    result = yield
    reports = [
        report
        for reports in terminalreporter.stats.values()
        for report in reports
        if isinstance(report, pytest.TestReport) and (NEEDS_SHARED, True) in report.user_properties
    ]
    if needing := {report.nodeid for report in reports}:
        skipped = {report.nodeid for report in reports if report.skipped}
        terminalreporter.write_line(
            f"{len(needing)} tests need the shared bags: {len(skipped)} skipped"
        )
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measures no coverage in some tests and their fixtures."""
    if is_measured(item):
        return (yield)
    with nothing_measured():
        return (yield)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Programs that wait for real time come before what burns processor time."""
    give_way(item.nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Workers for many tests, see `tests/support/workers.py`; a few files are run without."""
    return workers_for(config.args)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Groups:
    """Tests that share a worker, see `tests/support/workers.py`."""
    return Groups(config, log)


@pytest.fixture(autouse=True)
def _logging_left_as_it_was() -> Iterator[None]:
    """A program that a test ran in process configures logging; the next test has its own."""
    yield
    structlog.reset_defaults()


_COMPILED_TYPES: dict[tuple[str, str, bytes], "MessageType | str"] = {}


@pytest.fixture(autouse=True)
def types_compiled_once() -> Iterator[None]:
    """A message type is compiled once for all readers of all tests, which make thousands of them.

    Tests of the compiling itself have a fixture of this name that does nothing.
    """
    # Not imported before coverage is measured.
    from ros2_memory.typestore import Typestores  # noqa: PLC0415

    build = Typestores._build

    def once(self: Typestores, name: str, encoding: str, text: bytes) -> "MessageType | str":
        if self._folders:
            return build(self, name, encoding, text)
        key = (name, encoding, text)
        if key not in _COMPILED_TYPES:
            _COMPILED_TYPES[key] = build(self, name, encoding, text)
        return _COMPILED_TYPES[key]

    with patch.object(Typestores, "_build", once):
        yield


@pytest.fixture(scope="session", autouse=True)
def _configuration_composed_once() -> Iterator[None]:
    """Hydra takes long to compose what most tests have in common, and its lines are not ours."""
    with shipped_once():
        yield


@pytest.fixture(scope="session", autouse=True)
def _foreign_code_untraced() -> Iterator[None]:
    """What is slow of other projects, and only slower while it is traced."""
    with foreign_untraced():
        yield


@pytest.fixture
def no_flushing(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that are not about power cuts: flushing takes most of their time."""
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)
