"""Which tests are measured for coverage, and what is run aside from it."""

from __future__ import annotations

import sys
from importlib import import_module
from operator import attrgetter
from pathlib import PurePath

import pytest
from coverage import Coverage

from tests.support.measured import (
    FOREIGN,
    UNMEASURED,
    foreign_untraced,
    is_measured,
    nothing_measured,
    untraced,
)
from tests.support.workers import TESTS


def test_whatever_is_not_measured_is_there() -> None:
    texts = {PurePath(path): path.read_text() for path in TESTS.rglob("test_*.py")}
    names = {each: each.partition("::") for each in UNMEASURED}
    stale = {
        each
        for each, (file, _, test) in names.items()
        if not any(path.match(file) and f"def {test}" in text for path, text in texts.items())
    }
    assert stale == set()


@pytest.mark.parametrize("one", [1, 2])
@pytest.mark.parametrize("other", ["a", "b"])
def test_of_several_examples_the_first_is_measured(
    request: pytest.FixtureRequest, one: int, other: str
) -> None:
    measured = (one, other) == (1, "a")
    assert is_measured(request.node) == measured
    if not measured:
        assert Coverage.current() is None
        assert "coverage" not in type(sys.gettrace()).__module__


def test_every_measurement_that_runs_is_stopped_and_goes_on() -> None:
    before = Coverage.current()
    outer, inner = (Coverage(data_file=None) for _ in range(2))
    outer.start()
    inner.start()
    try:
        tracing = sys.gettrace()
        with nothing_measured():
            assert Coverage.current() is None
            assert sys.gettrace() is None
        assert Coverage.current() is inner
        assert type(sys.gettrace()) is type(tracing)
    finally:
        inner.stop()
        outer.stop()
    assert Coverage.current() is before


def test_what_is_run_untraced_leaves_the_tracing_as_it_was() -> None:
    before = sys.gettrace()
    assert untraced(sys.gettrace)() is None
    assert sys.gettrace() is before


@pytest.mark.parametrize("name", FOREIGN)
def test_what_is_run_untraced_of_other_projects_is_there(name: str) -> None:
    module, _, path = name.partition(":")
    before = attrgetter(path)(import_module(module))
    with foreign_untraced():
        assert attrgetter(path)(import_module(module)) is not before
    assert attrgetter(path)(import_module(module)) is before
