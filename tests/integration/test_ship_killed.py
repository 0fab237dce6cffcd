"""`ros2-memory ship` as a process that is killed with SIGKILL, again and again, at random moments.

Robots record on meanwhile. Messages have numbers, so that afterwards they can be counted.
"""

import json
import os
import random
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from pyiceberg.expressions import AlwaysTrue

from ros2_memory.bag_dir.state_files import read_receipts
from ros2_memory.lake.tables import NAMESPACE, TABLES
from tests.support.fleets import START_S
from tests.support.lakes import location, write_bag
from tests.support.processes import until

KILLS = 100
ROBOTS = ("hall", "kitchen")
DAYS_AGO_S = 30 * 86_400
"""So long ago that the days of bags are closed, and are put together."""
A_DAY_S = 86_400 - 86_400 // 5


def ship(folder: Path) -> subprocess.Popen[str]:
    settings = (
        f"fleet.robots={folder}/fleet/*",
        f"lake.warehouse={folder}/lake",
        "lake.messages=[/chatter]",
        "lake.commit_interval_s=0",
        "lake.grace_h=0",
    )
    return subprocess.Popen(
        [sys.executable, "-m", "ros2_memory.cli", "ship", "--once", "--json", *settings],
        env={
            **os.environ,
            "MEMORY_DEPLOYMENT": "lake",
            "XDG_CACHE_HOME": str(folder / "cache"),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def record(folder: Path, number: int) -> None:
    """A bag of each robot, written long enough ago to be shipped at once; a few are of one day."""
    at_s = START_S - DAYS_AGO_S + number * A_DAY_S // 4
    for name in ROBOTS:
        os.utime(write_bag(folder / "fleet" / name, number, at_s=at_s), (at_s, at_s))


def holds(state_dir: Path, process: subprocess.Popen[str]) -> bool:
    """Whether the process writes the lake now, or has ended."""
    if process.poll() is not None:
        return True
    lock = state_dir / "writer.lock"
    return lock.exists() and f'"pid": {process.pid},' in lock.read_text("utf-8")


@pytest.mark.skipif(
    os.environ.get("EPISODIC_LONG") != "1", reason="starts 100 processes: EPISODIC_LONG=1"
)
def test_killed_a_hundred_times_it_loses_and_doubles_nothing(tmp_path: Path) -> None:
    chance = random.Random(16)
    where = location(tmp_path / "lake")
    bags = killed = 0
    longest_s = 0.0
    while killed < KILLS:
        record(tmp_path, bags)
        bags += 1
        process = ship(tmp_path)
        until(partial(holds, where.state_dir, process))
        begun_s = time.monotonic()
        if longest_s:
            time.sleep(chance.uniform(0, 1.3 * longest_s))  # the moment of the kill is random
        else:
            process.wait()
        if process.poll() is None:
            process.kill()
            killed += 1
        output, errors = process.communicate()
        if process.returncode == 0:
            longest_s = max(longest_s, time.monotonic() - begun_s)
            assert json.loads(output)["problems"] == []
        assert process.returncode in {0, -9}, errors
    last = ship(tmp_path)
    output, errors = last.communicate()
    assert last.returncode == 0, errors
    assert json.loads(output)["waiting"] == 0
    check(tmp_path, bags)


def check(folder: Path, bags: int) -> None:
    """Every message is in the lake once, in whole bags, and no other file is there."""
    with location(folder / "lake").writable() as lake:
        rows = {name: lake.rows(name, AlwaysTrue()).to_pylist() for name in TABLES}
        used = {
            task.file.file_path.removeprefix("file://")
            for name in TABLES
            for task in lake.tables[name].refresh().scan().plan_files()
        }
    for name in ROBOTS:
        here = {
            table: [row for row in found if row["robot"] == name] for table, found in rows.items()
        }
        expected = Counter(f"n{bag * 100 + nth}" for bag in range(bags) for nth in range(3))
        assert Counter(dict(row["texts"])["value"] for row in here["messages"]) == expected
        ids = {row["bag_id"] for row in here["bags"]}
        assert len(here["bags"]) == len(ids) == bags
        assert Counter(row["bag_id"] for row in here["sightings"]) == dict.fromkeys(ids, 1)
        packed = Counter((row["bag_id"], row["channel"]) for row in here["channels"])
        assert set(packed.values()) == {1}
        assert {bag_id for bag_id, *_ in packed} == ids
        receipts = read_receipts(folder / "fleet" / name)
        assert {each.bag_id for each in receipts.values()} == ids
    data = folder / "lake" / NAMESPACE
    assert {str(path) for path in data.rglob("*.parquet")} == used
