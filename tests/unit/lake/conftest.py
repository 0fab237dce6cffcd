"""The engines of a lake: each test that asks one is run with all of them."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator

import pytest

from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine

LONG = os.environ.get("EPISODIC_LONG") == "1"
HAS_RAY = all(importlib.util.find_spec(each) for each in ("daft", "ray"))


def duckdb_engine() -> Iterator[LakeEngine]:
    engine = DuckdbEngine(memory_mb=256, threads=1)
    yield engine
    engine.close()


def ray_engine() -> Iterator[LakeEngine]:
    """On two nodes, each with one processor."""
    import ray  # noqa: PLC0415 - not installed everywhere
    from ray.cluster_utils import Cluster  # noqa: PLC0415 - not installed everywhere

    from ros2_memory.lake.engines.ray_engine import RayEngine  # noqa: PLC0415

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    yield RayEngine(cluster.address)
    ray.shutdown()
    cluster.shutdown()


RAY = pytest.mark.skipif(
    not (LONG and HAS_RAY), reason="starts a cluster: EPISODIC_LONG=1, with the extra ray"
)


@pytest.fixture(
    scope="session",  # a process joins one cluster, once
    params=[
        pytest.param(duckdb_engine, id="duckdb"),
        pytest.param(ray_engine, id="ray", marks=RAY),
    ],
)
def engine(request: pytest.FixtureRequest) -> Iterator[LakeEngine]:
    yield from request.param()
