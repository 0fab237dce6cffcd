"""A lake whose tables a REST catalogue lists: shipped once, and asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.shipper import Shipper
from ros2_memory.lake.tables import TABLES
from tests.support.clocks import FixedClock
from tests.support.lakes import LATER, location, robot_bags, write_bag
from tests.support.rest_catalogue import rest_catalogue


def test_bags_are_shipped_once_and_asked_through_a_rest_catalogue(tmp_path: Path) -> None:
    with rest_catalogue(tmp_path / "lake") as uri:
        where = replace(location(tmp_path / "lake"), catalog="rest", uri=uri)
        where.state_dir.mkdir(parents=True)
        for number in (0, 1):
            write_bag(tmp_path / "hall", number)
            for shipped in (1, 0):  # the second process finds nothing new
                with where.opened() as catalog:
                    tables = where.tables(catalog, TABLES)
                    robots = [robot_bags("hall", tmp_path / "hall")]
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
        assert where.last_commit() is not None
