"""The queries that docs/reference/files.md shows answer what it says that they do."""

import os
import random
import re
import sqlite3
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.columns.database import TABLES
from ros2_memory.columns.fill import StoreLimits
from tests.support.bags import battery, odom, write_mcap
from tests.support.column_worlds import World, store_file
from tests.support.memories import ROOT

S = 10**9
T0 = 1_700_000_400 * S  # 2023-11-14, 22:20 UTC


@cache
def section() -> str:
    text = (ROOT / "docs/reference/files.md").read_text(encoding="utf-8")
    return text.partition("## The store of columns")[2]


def query(question: str) -> str:
    match = re.search(re.escape(question) + r"\n\n```sql\n(.+?);\n```", section(), re.DOTALL)
    assert match is not None
    return match[1]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag_dir = tmp_path_factory.mktemp("bags")
    draw = random.Random(3)
    for number in range(3):
        start = T0 + number * 3000 * S
        messages = [battery(start + n * S, 0.9 - number / 10 - n / 1000) for n in range(5)]
        messages += [
            odom(start + n * S // 100, draw.uniform(-9, 9), draw.uniform(-9, 9)) for n in range(300)
        ]
        path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
        os.utime(path, ns=(T0, T0))
    World.of(bag_dir, limits=StoreLimits(max_share=0.0)).fill()
    return store_file(bag_dir)


def answer(file: Path, question: str) -> list[Any]:
    with closing(sqlite3.connect(file)) as base:
        return base.execute(query(question)).fetchall()


def test_columns_that_are_dropped_and_bytes_of_each_topic(file: Path) -> None:
    dropped = answer(file, "Of which topics are columns dropped, and since when?")
    assert dropped == [("/odom", "2023-11-14 22:20:00", 3)]
    sizes = dict(answer(file, "How many bytes does each topic take?"))
    assert sizes.keys() == {"/battery_state", "/odom"}


def test_all_tables_are_described() -> None:
    assert [table for table in TABLES if f"`{table}`" not in section()] == []
