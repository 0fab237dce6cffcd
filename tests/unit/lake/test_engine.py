"""What the engine of a lake promises: SQL over files of which some lack columns, or are gone."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date, timedelta
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engine import Lake, Parameters
from ros2_memory.lake.tables import TABLES, Row
from ros2_memory.lake.warehouse import LakeFile
from tests.support.lakes import lake_in

DAY = date(2026, 11, 20)
ROBOTS = ("attic", "hall", "it's")
ODD = ("it's", 'a "cup"', "back\\slash", "$label", "%_", "x'; SELECT 1 --", "ß 茶")


Select = Callable[..., pa.Table]


@pytest.fixture(scope="module")
def select(tmp_path_factory: pytest.TempPathFactory) -> Select:
    """Runs a select over all files of `sightings`: of three robots, each with two days."""
    folder, table = tmp_path_factory.mktemp("lake"), TABLES["sightings"]
    files: list[LakeFile] = []
    for robot in ROBOTS:
        for day in (0, 1):
            keys = {"robot": robot, "bag_id": f"{robot}{day}", "day": DAY + timedelta(days=day)}
            seen = [(label, 0.5) for label in ODD]
            rows: list[Row] = [
                {
                    **keys,
                    "topic": "/seen",
                    "time_ns": 100 * day + nth,
                    "label": label,
                    "score": score,
                }
                for nth, (label, score) in enumerate([*seen, ("unscored", None)])
            ]
            path = folder / f"{len(files)}.parquet"
            pq.write_table(table.filled(rows), path)
            files.append(LakeFile(path.as_uri()))
    lake = Lake(lake_in(folder))

    def run(sql: str, parameters: Parameters) -> pa.Table:
        return lake.select(sql, "sightings", files, parameters)

    return run


def test_it_filters_groups_and_orders(select: Select) -> None:
    found = select(
        "SELECT robot, max(time_ns) AS newest, count(*) AS n, CAST(sum(time_ns) AS BIGINT) AS s"
        " FROM sightings WHERE label = $label AND (score IS NULL OR score >= $least)"
        " GROUP BY robot ORDER BY robot DESC",
        {"label": "%_", "least": 0.25},
    )
    at = 100 + ODD.index("%_")
    assert found.to_pylist() == [
        {"robot": robot, "newest": at, "n": 2, "s": 2 * at - 100} for robot in reversed(ROBOTS)
    ]


def test_a_text_is_never_sql(select: Select) -> None:
    sql = "SELECT label FROM sightings WHERE label IN $labels GROUP BY label ORDER BY label"
    assert select(sql, {"labels": ODD})["label"].to_pylist() == sorted(ODD)
    assert select(sql, {"labels": ()}).num_rows == 0
    one_by_one = "SELECT count(*) AS n FROM sightings WHERE label = $label AND robot = $robot"
    for label in ODD:
        counted = select(one_by_one, {"label": label, "robot": "it's"})
        assert counted["n"].to_pylist() == [2]


def test_a_column_that_a_file_lacks_is_null_and_a_file_that_is_gone_is_reported(
    tmp_path: Path,
) -> None:
    row = {"robot": "hall", "bag_id": "a", "day": DAY, "topic": "/seen", "first_ns": 0}
    whole = TABLES["things"].filled([{**row, "label": "cup", "spread_m": 0.1}])
    path = tmp_path / "old.parquet"
    pq.write_table(whole.drop_columns(["spread_m"]), path)
    lake, files = Lake(lake_in(tmp_path)), [LakeFile(path.as_uri())]
    sql = "SELECT label, spread_m FROM things"
    assert lake.select(sql, "things", files).to_pylist() == [{"label": "cup", "spread_m": None}]
    assert lake.select(sql, "things", ()).num_rows == 0
    path.unlink()
    with pytest.raises(RefusedError, match="the lake cannot be read") as raised:
        lake.select(sql, "things", files)
    assert str(tmp_path) not in str(raised.value)
