"""The tables of a lake, in a catalogue of SQLite and files."""

from datetime import date, timedelta
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.partitioning import PartitionSpec
from pyiceberg.schema import Schema
from pyiceberg.types import DateType, NestedField, StringType

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.tables import NAMESPACE, TABLES, of_bags, open_tables
from ros2_memory.lake.warehouse import LakeFile
from tests.support.lakes import lake_in

DAY = date(2026, 11, 20)
KEYS = {"robot": "hall", "bag_id": "a", "day": DAY}


@pytest.fixture
def catalog(tmp_path: Path) -> SqlCatalog:
    return SqlCatalog("lake", uri=f"sqlite:///{tmp_path}/x.sqlite", warehouse=tmp_path.as_uri())


def test_rows_are_sorted_and_lie_by_robot_and_day_in_zstd(catalog: SqlCatalog) -> None:
    table = open_tables(catalog, ["events"])["events"]
    row = {**KEYS, "topic": "/wheel/odom", "kind": "stop", "first_ns": 5_000_000_123, "x": 1.5}
    events = TABLES["events"]
    table.append(events.sorted(events.filled([row, {**row, "first_ns": 1_000_000_000}])))
    before, found = table.scan().to_arrow().to_pylist()
    assert before["time"].timestamp() == 1.0
    assert {name: found[name] for name in row} == row
    assert (found["topic_key"], found["last_ns"]) == ("wheel.odom", None)
    assert found["time"].timestamp() == 5.0
    [task] = table.scan().plan_files()
    assert "/robot=hall/day=2026-11-20/" in task.file.file_path
    written = pa.parquet.read_metadata(Path(task.file.file_path.removeprefix("file://")))
    assert written.row_group(0).column(0).compression == "ZSTD"
    names = [table.schema().find_field(part.source_id).name for part in table.sort_order().fields]
    assert names == ["topic_key", "kind", "first_ns"]


def test_an_older_lake_gets_the_columns_that_are_new(catalog: SqlCatalog) -> None:
    catalog.create_namespace_if_not_exists(NAMESPACE)
    kinds = (StringType(), StringType(), DateType())
    fields = [
        NestedField(number, name, kind, required=True)
        for number, (name, kind) in enumerate(zip(KEYS, kinds, strict=True), 1)
    ]
    catalog.create_table(f"{NAMESPACE}.things", Schema(*fields), partition_spec=PartitionSpec())
    table = open_tables(catalog, ["things"])["things"]
    assert table.schema().column_names == [*TABLES["things"].columns]


def test_bags_of_years_are_deleted_at_once(catalog: SqlCatalog) -> None:
    """Python's limit of nested calls was reached with 500 days."""
    table = open_tables(catalog, ["events"])["events"]
    days = [DAY + timedelta(days=nth) for nth in (0, 1, 599, 600)]
    rows = [{**KEYS, "day": day, "topic": "/odom", "first_ns": 0} for day in days]
    table.append(TABLES["events"].filled(rows))
    table.delete(of_bags(("hall", days[0] + timedelta(days=nth), "a") for nth in range(600)))
    assert table.scan().to_arrow()["day"].to_pylist() == [days[-1]]


def test_lone_surrogates_of_a_hostile_bag_are_escaped() -> None:
    texts = {"value": "bad \udc80", "texts": [("\udc80", "\udc81")]}
    table = TABLES["messages"].filled([{**KEYS, "topic": "/\udc80", "time_ns": 1, **texts}])
    assert table["value"].to_pylist() == ["bad \\udc80"]
    assert table["topic_key"].to_pylist() == ["\\udc80"]
    assert table["texts"].to_pylist() == [[("\\udc80", "\\udc81")]]


def test_a_column_that_a_file_lacks_is_null_and_a_file_that_is_gone_is_reported(
    tmp_path: Path,
) -> None:
    row = {**KEYS, "topic": "/seen", "first_ns": 0}
    whole = TABLES["things"].filled([{**row, "label": "cup", "spread_m": 0.1}])
    path = tmp_path / "old.parquet"
    pq.write_table(whole.drop_columns(["spread_m"]), path)
    lake, files = Lake(lake_in(tmp_path)), [LakeFile(path.as_uri())]
    columns = ("label", "spread_m")
    assert lake.rows("things", files, columns).to_pylist() == [{"label": "cup", "spread_m": None}]
    assert lake.rows("things", files, columns, pc.field("label") == "a").num_rows == 0
    assert lake.rows("things", (), columns).num_rows == 0
    path.unlink()
    with pytest.raises(RefusedError, match="the lake cannot be read") as raised:
        lake.rows("things", files, columns)
    assert str(tmp_path) not in str(raised.value)
