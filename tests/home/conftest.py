"""What tests of the home robot's world share. Files that use it are of the group "home"."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from tests.home.days import Scale
from tests.home.recording import write_world

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The world of the usual scale, which takes seconds to make: bags, places and labels."""
    folder = tmp_path_factory.mktemp("home")
    write_world(Scale(), folder)
    return folder


@pytest.fixture
def in_utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Has this process's days begin and end as those of the robot do."""
    with monkeypatch.context() as patched:
        patched.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()
