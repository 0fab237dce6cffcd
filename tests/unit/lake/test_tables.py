"""The tables of a lake, in a catalogue of SQLite and files."""

from datetime import date
from pathlib import Path

import pyarrow as pa
import pytest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.partitioning import PartitionSpec
from pyiceberg.schema import Schema
from pyiceberg.types import DateType, NestedField, StringType

from ros2_memory.lake.tables import NAMESPACE, TABLES, open_tables

DAY = date(2026, 11, 20)


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> SqlCatalog:
    folder = tmp_path_factory.mktemp("lake")
    return SqlCatalog("lake", uri=f"sqlite:///{folder}/lake.sqlite", warehouse=folder.as_uri())


def test_a_row_comes_back_as_it_was(catalog: SqlCatalog) -> None:
    table = open_tables(catalog, ["events"])["events"]
    keys = {"robot": "kitchen", "bag_id": "a", "day": DAY}
    row = {"topic": "/wheel/odom", "kind": "stop", "first_ns": 5_000_000_123, "x": 1.5}
    table.append(TABLES["events"].filled([{**keys, **row}]))
    [found] = open_tables(catalog, ["events"])["events"].scan().to_arrow().to_pylist()
    assert (found["robot"], found["bag_id"], found["day"]) == ("kitchen", "a", DAY)
    assert (found["first_ns"], found["last_ns"], found["x"]) == (5_000_000_123, None, 1.5)
    assert found["time"].timestamp() == 5.0
    assert found["topic_key"] == "wheel.odom"


def test_files_lie_by_robot_and_day_and_are_zstd(catalog: SqlCatalog) -> None:
    table = open_tables(catalog, ["poses"])["poses"]
    row = {"robot": "hall", "bag_id": "a", "day": DAY, "topic": "/odom", "time_ns": 1}
    table.append(TABLES["poses"].filled([row]))
    [task] = table.scan().plan_files()
    assert "/robot=hall/day=2026-11-20/" in task.file.file_path
    written = pa.parquet.read_metadata(Path(task.file.file_path.removeprefix("file://")))
    assert written.row_group(0).column(0).compression == "ZSTD"
    names = [table.schema().find_field(each.source_id).name for each in table.sort_order().fields]
    assert names == ["topic_key", "frame_id", "time_ns"]


def test_an_older_lake_gets_the_columns_that_are_new(catalog: SqlCatalog) -> None:
    catalog.create_namespace_if_not_exists(NAMESPACE)
    names = ("robot", "bag_id", "day")
    kinds = (StringType(), StringType(), DateType())
    fields = [
        NestedField(number, name, kind, required=True)
        for number, (name, kind) in enumerate(zip(names, kinds, strict=True), 1)
    ]
    catalog.create_table(f"{NAMESPACE}.things", Schema(*fields), partition_spec=PartitionSpec())
    table = open_tables(catalog, ["things"])["things"]
    assert table.schema().column_names == [*TABLES["things"].columns]
