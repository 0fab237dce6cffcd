"""In which tests coverage is measured, which takes up to five times as long as the test itself.

Measured is the first example of each plain test; what the others run, tests of the same room or of
the tools above it run as well: 89 % of all lines and branches together, the gate is 85 %.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.machinery import SourceFileLoader
from operator import attrgetter
from types import ModuleType
from typing import ParamSpec, TypeVar
from unittest.mock import patch

import pytest
from coverage import Coverage

_P = ParamSpec("_P")
_R = TypeVar("_R")

UNMEASURED = (
    "cli/test_forget.py",
    "cli/test_plot.py",
    "columns/test_fill.py",
    "columns/test_fragments.py",
    "columns/test_scan.py",
    "columns/test_store.py::test_no_byte",
    "episodes/*.py",
    "faults/*.py",
    "fuzz/*.py",
    "home/*.py",
    "integration/*.py",
    "lake/test_forgetting.py",
    "lake/test_index.py",
    "lake/test_reader.py",
    "lake/test_shipper.py",
    "lake/test_tables.py",
    "oracle/*.py",
    "recorder/test_days.py",
    "recorder/test_screened_recordings.py",
    "recorder/test_supervisor*.py",
    "soak/*.py",
    "test_any_cut.py",
    "test_cancelled.py",
    "test_clock_steps.py",
    "test_confinement.py::test_no_text_of_a_caller",
    "test_confinement.py::test_no_tool_reads",
    "test_deep_directories.py",
    "test_documents.py",
    "test_driven_inside.py",
    "test_forget_messages.py::test_whatever_was_done",
    "test_gaps_within.py",
    "test_hostile_*.py",
    "test_latched_carry.py",
    "test_mcap_reader.py::test_of_uncompressed_files",
    "test_no_data.py::test_no_reply_about_a_memory_from_time_zero",
    "test_path_length.py",
    "test_real_bags.py",
    "test_region_visits.py",
    "test_reply_size.py",
    "test_repository.py",
    "test_standstills.py",
    "test_storage_limits.py",
    "test_thinned_moments.py",
    "test_unlike_robots.py",
    "test_visits.py",
    "things/test_compare.py",
)
"""Files, or tests of a file by how their names begin, that are not measured.

They ask much of everything at once, of hours of poses, or of programs over and over, and what they
run others run too: the lines and branches that they alone reach are 4 % of all.
"""
FOREIGN = (
    "omegaconf:OmegaConf.load",
    "pyiceberg.catalog.sql:SqlCatalog.create_table",
    "pyiceberg.catalog.sql:SqlCatalog.load_table",
    "pyiceberg.table:Table.refresh",
    "pyiceberg.table:Transaction.append",
    "pyiceberg.table:Transaction.commit_transaction",
    "pyiceberg.table:Transaction.delete",
    "pyiceberg.table:Transaction.overwrite",
    "yaml:safe_load",
)
"""Functions of other projects that run many lines of their own: they are run untraced.

While they were traced, `unit/lake` and `unit/cli` spent most of what is measured of them there.
"""
DRAWN = "hypothesis"
"""The mark of tests that draw their examples: the same lines many times, so not measured either."""


def is_measured(item: pytest.Item) -> bool:
    """Whether what a test runs counts for coverage."""
    if item.get_closest_marker(DRAWN) is not None or not _is_first_example(item):
        return False
    names = (each.partition("::") for each in UNMEASURED)
    return not any(item.path.match(file) and item.name.startswith(test) for file, _, test in names)


def _is_first_example(item: pytest.Item) -> bool:
    """Whether a test has its first value of each parameter, or no parameter."""
    callspec = getattr(item, "callspec", None)
    return callspec is None or not any(callspec.indices.values())


@contextmanager
def nothing_measured() -> Iterator[None]:
    """Within it nothing is traced.

    In a worker of pytest-xdist two measurements run: pytest-cov begins one before it knows that it
    is in a worker, and keeps nothing of it. With the other alone stopped that one goes on.
    """
    stopped: list[Coverage] = []
    while (measuring := Coverage.current()) is not None:
        measuring.stop()
        stopped.append(measuring)
    try:
        yield
    finally:
        for measuring in reversed(stopped):
            measuring.start()


@contextmanager
def only_ours_measured() -> Iterator[None]:
    """Within it, what is imported of the package is traced, and nothing else.

    Of collecting, tracing everything takes half: 18 s of processor time instead of 8 s.
    """
    tracing = sys.gettrace()
    execute = SourceFileLoader.exec_module

    def traced_if_ours(self: SourceFileLoader, module: ModuleType) -> None:
        outer = sys.gettrace()
        sys.settrace(tracing if module.__name__.partition(".")[0] == "ros2_memory" else None)
        try:
            execute(self, module)
        finally:
            sys.settrace(outer)

    sys.settrace(None)
    try:
        with patch.object(SourceFileLoader, "exec_module", traced_if_ours):
            yield
    finally:
        sys.settrace(tracing)


@contextmanager
def foreign_untraced() -> Iterator[None]:
    """Within it `FOREIGN` is run untraced, as far as it is imported by now."""
    with ExitStack() as patches:
        for each in FOREIGN:
            module, _, path = each.partition(":")
            if module in sys.modules:
                plain = attrgetter(path)(sys.modules[module])
                patches.enter_context(patch(f"{module}.{path}", untraced(plain)))
        yield


def untraced(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function, of someone else's, run without the tracing that coverage is measured by.

    The tracing goes and comes in one frame, for what counts calls must see their ends.
    """

    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        tracing = sys.gettrace()
        sys.settrace(None)
        try:
            return function(*args, **kwargs)
        finally:
            sys.settrace(tracing)

    return run
