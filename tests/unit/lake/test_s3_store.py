"""A lake in an S3 store, here moto's server: shipped, asked, and forgotten.

moto is in no lock, since its server brings forty packages for this one test:
`EPISODIC_LONG=1 uv run --with "moto[s3,server]" pytest -n0 tests/unit/lake/test_s3_store.py`.
"""

from __future__ import annotations

import os
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.shipper import Shipper
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.warehouse import LakeLocation
from tests.support.clocks import FixedClock
from tests.support.lakes import LATER, robot_bags, write_bag

moto = pytest.importorskip("moto.server", reason="needs moto, which no lock has")
pytestmark = pytest.mark.skipif(
    os.environ.get("EPISODIC_LONG") != "1", reason="starts an S3 server: EPISODIC_LONG=1"
)
SECRET = "very-secret-key"  # noqa: S105 - of no account


def test_bags_are_shipped_once_into_a_bucket_and_asked(tmp_path: Path) -> None:
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        where = LakeLocation(
            "s3://robots/lake",
            tmp_path / "state",
            properties={"s3.endpoint": f"http://{host}:{port}", "s3.region": "us-east-1"},
            secrets={"s3.access-key-id": "ship", "s3.secret-access-key": SECRET},
        )
        where.state_dir.mkdir()
        endpoint = where.properties["s3.endpoint"]
        urlopen(Request(f"{endpoint}/robots", method="PUT")).close()  # noqa: S310 - of this host
        for number in (0, 1):
            write_bag(tmp_path / "hall", number)
            for shipped in (1, 0):  # the second process finds nothing new
                with where.opened() as catalog:
                    robots = [robot_bags("hall", tmp_path / "hall")]
                    tables = where.tables(catalog, TABLES)
                    shipper = Shipper(where, tables, robots, FixedClock(LATER), messages=())
                    assert shipper.run().bags == shipped
        with where.opened() as catalog:
            engine = DuckdbEngine()
            lake = Lake(catalog, engine, where.namespace, where.translated)
            assert lake.robots() == ["hall"]
            sql = "SELECT bag_id, label FROM sightings ORDER BY bag_id"
            found = lake.select(sql, ["sightings"], robots=["hall"]).to_pylist()
            engine.close()
        assert [row["label"] for row in found] == ["cup", "cup"]
        assert len({row["bag_id"] for row in found}) == 2
        kept = [each for each in (tmp_path / "state").rglob("*") if each.is_file()]
        assert not any(SECRET.encode() in each.read_bytes() for each in kept)
    finally:
        server.stop()
