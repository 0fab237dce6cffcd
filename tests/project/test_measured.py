"""Which tests are measured for coverage, and what is run aside from it."""

from __future__ import annotations

import sys
from pathlib import PurePath

import pytest

from tests.support.measured import UNMEASURED, is_measured, untraced
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
    assert is_measured(request.node) == ((one, other) == (1, "a"))


def test_what_is_run_untraced_leaves_the_tracing_as_it_was() -> None:
    before = sys.gettrace()
    assert untraced(sys.gettrace)() is None
    assert sys.gettrace() is before
