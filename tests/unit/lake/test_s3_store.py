"""A lake in an S3 store, here moto's server: shipped, asked, and forgotten.

moto is in no lock, since its server brings forty packages for this one test:
`EPISODIC_LONG=1 uv run --with "moto[s3,server]" pytest -n0 tests/unit/lake/test_s3_store.py`.
"""

import os
from dataclasses import replace
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

from ros2_memory.core.errors import LakeError
from ros2_memory.lake.upkeep import Tombstone, forget_in_lake
from ros2_memory.lake.warehouse import LakeLocation
from tests.support.lakes import LATER, ship_and_ask

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
        for _ in range(2):
            where.claim()
        (tmp_path / "other").mkdir()
        with pytest.raises(LakeError, match="another writer"):
            replace(where, state_dir=tmp_path / "other").claim()
        ship_and_ask(where, tmp_path / "hall")
        with where.writable() as tables:
            assert forget_in_lake(tables, Tombstone("hall", 0, LATER)).bags == 2
        with urlopen(f"{endpoint}/robots?list-type=2") as listing:  # noqa: S310 - of this host
            objects = listing.read().decode()
        assert ".metadata.json" in objects
        assert ".parquet" not in objects
        kept = [each for each in (tmp_path / "state").rglob("*") if each.is_file()]
        assert not any(SECRET.encode() in each.read_bytes() for each in kept)
    finally:
        server.stop()
