"""What a lake's files are read as, of which some lack columns, or are gone."""

from datetime import date
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.warehouse import LakeFile
from tests.support.lakes import lake_in

DAY = date(2026, 11, 20)


def test_a_column_that_a_file_lacks_is_null_and_a_file_that_is_gone_is_reported(
    tmp_path: Path,
) -> None:
    row = {"robot": "hall", "bag_id": "a", "day": DAY, "topic": "/seen", "first_ns": 0}
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
