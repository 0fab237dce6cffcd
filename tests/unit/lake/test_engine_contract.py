"""What `lake/engines/base.py` promises of a `LakeEngine`, checked with every adapter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import date, timedelta
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyiceberg.catalog.sql import SqlCatalog

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engines.base import DataFiles, LakeEngine, Parameters
from ros2_memory.lake.files import Lake
from ros2_memory.lake.tables import NAMESPACE, TABLES, Row, open_tables

DAY = date(2026, 11, 20)
ROBOTS = ("attic", "hall", "it's")
ODD = ("it's", 'a "cup"', "back\\slash", "$label", "%_", "x'; SELECT 1 --", "ß 茶")


def seen(robot: str, day: int, label: str, second: int, score: float | None = 0.5) -> Row:
    keys = {"robot": robot, "bag_id": f"{robot}{day}", "day": DAY + timedelta(days=day)}
    at = (100 * day + second) * 10**9
    return {**keys, "topic": "/seen", "time_ns": at, "label": label, "score": score}


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> SqlCatalog:
    """Three robots, each with two days."""
    folder = tmp_path_factory.mktemp("lake")
    catalog = SqlCatalog("lake", uri=f"sqlite:///{folder}/lake.sqlite", warehouse=folder.as_uri())
    table = open_tables(catalog, ["sightings", "bags"])["sightings"]
    for robot in ROBOTS:
        for day in (0, 1):
            rows = [seen(robot, day, label, nth) for nth, label in enumerate(ODD)]
            rows.append(seen(robot, day, "unscored", 0, None))
            table.append(TABLES["sightings"].filled(rows))
    return catalog


Select = Callable[..., pa.Table]


@pytest.fixture
def select(catalog: SqlCatalog, engine: LakeEngine) -> Select:
    """Runs a select over all files of `sightings`."""
    plan = catalog.load_table(f"{NAMESPACE}.sightings").scan().plan_files()
    locations = tuple(task.file.file_path for task in plan)
    files = DataFiles(TABLES["sightings"].arrow_schema, locations, {})

    def run(sql: str, parameters: Parameters) -> pa.Table:
        return engine.select(sql, "sightings", files, parameters)

    return run


def test_it_filters_groups_and_orders(select: Select) -> None:
    found = select(
        "SELECT robot, max(time_ns) AS newest, count(*) AS n, CAST(sum(time_ns) AS BIGINT) AS s"
        " FROM sightings WHERE label = $label AND (score IS NULL OR score >= $least)"
        " GROUP BY robot ORDER BY robot DESC",
        {"label": "%_", "least": 0.25},
    )
    at = 10**9 * (ODD.index("%_") + 100)
    assert found.to_pylist() == [
        {"robot": robot, "newest": at, "n": 2, "s": 2 * at - 100 * 10**9}
        for robot in reversed(ROBOTS)
    ]


def test_a_text_is_never_sql(select: Select) -> None:
    sql = "SELECT label FROM sightings WHERE label IN $labels GROUP BY label ORDER BY label"
    found = select(sql, {"labels": ODD})
    assert found["label"].to_pylist() == sorted(ODD)
    one_by_one = "SELECT count(*) AS n FROM sightings WHERE label = $label AND robot = $robot"
    for label in ODD:
        counted = select(one_by_one, {"label": label, "robot": "it's"})
        assert counted["n"].to_pylist() == [2]


def test_nothing_is_in_no_values(select: Select) -> None:
    sql = "SELECT label FROM sightings WHERE label IN $labels"
    assert select(sql, {"labels": ()}).num_rows == 0


def test_only_files_of_one_robot_and_day_are_read(catalog: SqlCatalog, engine: LakeEngine) -> None:
    lake = Lake(catalog, engine)
    sql = "SELECT robot, day FROM sightings GROUP BY robot, day ORDER BY robot, day"
    for robot in ROBOTS:
        files = lake.days("sightings", robot)[DAY]
        one = lake.select(sql, "sightings", files)
        assert one.to_pylist() == [{"robot": robot, "day": DAY}]
    assert lake.select(sql, "sightings", []).num_rows == 0


def test_a_column_that_a_file_lacks_is_null(tmp_path: Path, engine: LakeEngine) -> None:
    schema = TABLES["things"].arrow_schema
    row = {"robot": "hall", "bag_id": "a", "day": DAY, "topic": "/seen", "first_ns": 0}
    whole = TABLES["things"].filled([{**row, "label": "cup", "spread_m": 0.1}])
    old = whole.drop_columns(["spread_m"])
    pq.write_table(old, tmp_path / "old.parquet")
    files = DataFiles(schema, ((tmp_path / "old.parquet").as_uri(),), {})
    found = engine.select("SELECT label, spread_m FROM things", "things", files, {})
    assert found.to_pylist() == [{"label": "cup", "spread_m": None}]


def test_a_file_that_is_gone_is_reported_without_its_path(
    tmp_path: Path, engine: LakeEngine
) -> None:
    schema = TABLES["things"].arrow_schema
    files = DataFiles(schema, ((tmp_path / "gone.parquet").as_uri(),), {})
    with pytest.raises(RefusedError, match="the lake cannot be read") as raised:
        engine.select("SELECT label FROM things", "things", files, {})
    assert str(tmp_path) not in str(raised.value)


def test_threads_ask_at_once(select: Select) -> None:
    sql = "SELECT count(*) AS n FROM sightings WHERE label = $label"

    def count(label: str) -> object:
        return select(sql, {"label": label})["n"].to_pylist()

    with ThreadPoolExecutor(4) as pool:
        assert [*pool.map(count, ODD * 2)] == [[6]] * len(ODD) * 2
