"""The engine of a lake, which tests that ask one share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ros2_memory.lake.engine import DuckdbEngine


@pytest.fixture(scope="session")
def engine() -> Iterator[DuckdbEngine]:
    engine = DuckdbEngine(memory_mb=256, threads=1)
    yield engine
    engine.close()
