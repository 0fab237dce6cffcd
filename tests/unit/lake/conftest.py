"""The engines of a lake: each test that asks one is run with all of them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine


def duckdb_engine() -> Iterator[LakeEngine]:
    engine = DuckdbEngine(memory_mb=256, threads=1)
    yield engine
    engine.close()


@pytest.fixture(scope="session", params=[pytest.param(duckdb_engine, id="duckdb")])
def engine(request: pytest.FixtureRequest) -> Iterator[LakeEngine]:
    yield from request.param()
