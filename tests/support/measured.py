"""In which tests coverage is measured, which takes up to five times as long as the test itself.

Measured is the first example of each plain test; what the others run, tests of the same room or of
the tools above it run as well: 87 % of all lines and branches together, the gate is 85 %.
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
    "cli/test_export.py::test_other_programs",
    "cli/test_forget.py",
    "cli/test_plot.py",
    "columns/test_fill.py",
    "columns/test_fragments.py",
    "columns/test_scan.py",
    "columns/test_store.py",
    "counts/test_column_numbers.py",
    "episodes/*.py",
    "faults/*.py",
    "fleet/test_tools.py",
    "fleet/test_who_may_ask.py",
    "fuzz/*.py",
    "history/test_frames.py",
    "history/test_latching.py",
    "home/*.py",
    "insights/test_in_each.py::test_each_window_has",
    "integration/*.py",
    "lake/test_forgetting.py",
    "lake/test_index.py",
    "lake/test_lake_fleet.py::test_a_bag_",
    "lake/test_lake_fleet.py::test_a_lake_that",
    "lake/test_lake_fleet.py::test_a_server_starts",
    "lake/test_lake_fleet.py::test_robots_",
    "lake/test_lake_fleet.py::test_what_retention_deleted",
    "lake/test_reader.py",
    "lake/test_select.py::test_rows_",
    "lake/test_shipper.py",
    "lake/test_tables.py",
    "mcap/test_writer.py",
    "oracle/*.py",
    "recorder/test_days.py",
    "recorder/test_supervisor*.py",
    "retention/test_deleted_bags.py",
    "serving/test_backfill.py::test_what_followed",
    "soak/*.py",
    "test_any_cut.py",
    "test_cancelled.py",
    "test_clock_steps.py",
    "test_config.py",
    "test_confinement.py::test_no_text_of_a_caller",
    "test_confinement.py::test_no_tool_reads",
    "test_deep_directories.py",
    "test_documents.py",
    "test_forget_messages.py::test_nothing_of_it_is_left",
    "test_forget_messages.py::test_what_is_not_forgotten",
    "test_forget_messages.py::test_whatever_was_done",
    "test_honesty.py::test_a_frame_that_is_reported",
    "test_honesty.py::test_many_topics",
    "test_honesty.py::test_no_reply_about_a_memory_from_time_zero",
    "test_hostile_*.py",
    "test_latched_carry.py",
    "test_mcap_reader.py::test_of_uncompressed_files",
    "test_metadata_yaml.py::test_what_ros_recorded_is_opened",
    "test_path_length.py",
    "test_queries.py::test_a_recorded_circle",
    "test_quoted.py",
    "test_real_bags.py",
    "test_reply_size.py",
    "test_repository.py",
    "test_robots.py::test_what_a_file_has_twice",
    "test_screening.py::test_a_kill_at_any_point",
    "test_search_replies.py",
    "test_sightings.py::test_spells_whose_ends",
    "test_standstills.py",
    "test_storage_limits.py",
    "test_thinning.py::test_of_integers",
    "test_times.py",
    "test_typestore.py::test_every_standard_type",
    "test_unlike_robots.py",
    "test_visits.py",
    "things/test_compare.py",
    "things/test_find.py::test_a_detector_that_repeats",
    "things/test_find.py::test_a_thing_with_a_routine",
    "things/test_find.py::test_find_things_answers",
    "things/test_find.py::test_of_a_window_before",
    "things/test_find.py::test_things_of_a_robot_that",
    "things/test_find.py::test_what_is_said_of_a_past",
    "things/test_find.py::test_where_a_machine_was_slow",
)
"""Files, or tests of a file by how their names begin, that are not measured.

They ask much of everything at once, of hours of poses, or of programs over and over, and what they
run others run too: the lines and branches that they alone reach are 6 % of all.
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
