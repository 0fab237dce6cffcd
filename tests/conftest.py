"""What holds for every test."""

import atexit
import os
import shutil
from collections.abc import Iterator
from tempfile import mkdtemp

import pytest
import structlog
from hypothesis import settings

# A loaded machine is slow, not wrong.
settings.register_profile("steady", deadline=None)
settings.load_profile("steady")

# Also for the programs that tests start: nothing is to be left in the user's own.
_CACHE = mkdtemp(prefix="ros2-memory-tests-")
atexit.register(shutil.rmtree, _CACHE, ignore_errors=True)
os.environ["XDG_CACHE_HOME"] = _CACHE


@pytest.fixture(autouse=True)
def _logging_left_as_it_was() -> Iterator[None]:
    """A program that a test ran in process configures logging; the next test has its own."""
    yield
    structlog.reset_defaults()
