"""`ros2-memory ship`: one pass, who writes, what is missing, and no secret anywhere."""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from ros2_memory import bootstrap_fleet, cli
from ros2_memory.cli.maintenance import ship as ship_module
from ros2_memory.config import load_settings
from ros2_memory.core.errors import LakeError
from ros2_memory.lake.shipper import Shipper
from ros2_memory.lake.upkeep import TOMBSTONES_FILE
from ros2_memory.lake.warehouse import LakeLocation, writing_alone
from tests.support.fleets import START_S, seeded, write_robot
from tests.support.lakes import lake_column, selecting_here, write_bag
from tests.support.program import Printed, Program

__all__ = ["selecting_here"]

Ship = Callable[..., Printed]
Capture = pytest.CaptureFixture[str]
ROBOTS = ("hall", "kitchen")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for name in ROBOTS:
        write_robot(seeded(name), folder / name)
    return folder


@pytest.fixture
def settings(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Of a lake of its own for these robots."""
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "lake")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return [f"fleet.robots={fleet}/*", f"lake.warehouse={tmp_path}/lake"]


@pytest.fixture
def ship(settings: list[str], exits: Program) -> Ship:
    """Runs one pass into the lake, which must end with a code."""

    def run(code: int, *more: object) -> Printed:
        return exits(code, "ship --once --json lake.commit_interval_s=0", *settings, *more)

    return run


def test_what_a_batch_took_goes_back_to_the_c_library(tmp_path: Path) -> None:
    """Arrow's own heap kept it: after 1,300 bags `ship` had 1.4 GB, and more after each batch."""
    bag = write_bag(tmp_path / "robots" / "hall", 0)
    os.utime(bag, (START_S, START_S))  # else it may still grow
    words = ["ship", "--once", "deployment=lake", f"fleet.robots={tmp_path}/robots/*"]
    lake = f"lake.warehouse={tmp_path}/lake"
    code = (
        f"from ros2_memory import cli; cli.main({[*words, lake]});"
        "import pyarrow; print(pyarrow.default_memory_pool().backend_name);"
        f"cli.main({['sql', 'SELECT 1 AS one', lake]})"
    )
    own = {name: text for name, text in os.environ.items() if not name.startswith("ARROW_")}
    environment = {**own, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    found = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert found.stdout.split("\n", 2)[:2] == ["shipped 1 bag (5 rows)", "system"]
    assert found.stdout.split()[-2:] == ["one", "1"]
    assert not found.stderr


def test_a_second_writer_ends_and_names_the_first(ship: Ship, tmp_path: Path) -> None:
    with writing_alone(tmp_path / "lake" / ".ros2-memory"):
        refused = ship(2).err
    assert "one writer" in refused
    assert "process" in refused


def test_a_time_of_a_robot_that_is_known_is_forgotten_and_stays_so(
    ship: Ship, tmp_path: Path
) -> None:
    ship(0)
    hall = seeded("hall")
    times = ("--start", str(hall.start_s), "--end", str(hall.start_s + 5))
    # A mistyped name would look like success, and leave a tombstone for ever.
    assert "hall" in ship(2, "--forget", "hal", *times).err
    assert not (tmp_path / "lake" / ".ros2-memory" / TOMBSTONES_FILE).exists()
    assert ship(0, "--forget", "hall", *times).json["bags"] == 1
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == 3
    [problem] = ship(1).json["problems"]
    assert "rec_0.mcap has messages that were forgotten" in problem
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == 3
    assert "--start" in ship(2, "--forget", "hall").err


def test_a_service_tries_again_where_the_store_cannot_be_reached_when_it_starts(
    settings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claimed = LakeLocation.claim
    waited: list[float] = []

    def claim(location: LakeLocation) -> None:
        if not waited:
            raise LakeError("the store cannot be reached")
        claimed(location)

    def wait(seconds: float) -> None:
        if seconds > 0:  # not before a commit
            waited.append(seconds)
        if len(waited) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(LakeLocation, "claim", claim)
    monkeypatch.setattr(ship_module, "_wait", wait)
    assert cli.main(["ship", *settings]) == 130
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == 4


def test_one_pass_does_not_wait_before_its_last_batch(
    ship: Ship, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No more bags come while it waits."""
    commit, are_full = Shipper._commit, iter([True])

    def commit_batch(shipper: Shipper, batch: Any, *, is_full: bool) -> None:
        assert is_full
        commit(shipper, batch, is_full=next(are_full, False))

    monkeypatch.setattr("ros2_memory.lake.shipper.MOST_BYTES", 1)
    monkeypatch.setattr(Shipper, "_commit", commit_batch)
    waited: list[float] = []
    monkeypatch.setattr(ship_module, "_wait", waited.append)
    ship(0, "lake.commit_interval_s=3600")
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == 4
    assert waited == []


def test_doctor_tells_of_a_lake_what_keeps_it_from_working(
    ship: Ship, fleet: Path, tmp_path: Path, capsys: Capture
) -> None:
    robots, lake = f"fleet.robots={{hall: {fleet}/hall}}", tmp_path / "lake"

    def found(*more: str) -> dict[str, list[str]]:
        cli.main(["doctor", "--json", robots, f"lake.warehouse={lake}", *more])
        seen: dict[str, list[str]] = {}
        for each in json.loads(capsys.readouterr().out)["findings"]:
            if each["about"] == "lake":
                seen.setdefault(f"{each['about']} {each['level']}", []).append(each["seen"])
        return seen

    assert "has no bag yet" in found()["lake warning"][0]
    assert not lake.exists()
    ship(0, robots)
    told = found()
    assert [*told] == ["lake ok"]
    assert "its bags last changed" in told["lake ok"][0]
    shutil.rmtree(lake / "ros2_memory")
    assert "looking into the lake failed" in found()["lake error"][0]


def test_no_secret_is_in_an_error_or_in_the_configuration(
    ship: Ship, tmp_path: Path, exits: Program
) -> None:
    secrets = tmp_path / "secrets.yaml"
    secrets.write_text('s3.secret-access-key: "hunter2hunter2"\n')
    given = f"lake.secrets_file={secrets}"
    location = bootstrap_fleet.lake_location(load_settings(["lake.warehouse=/nowhere", given], {}))
    assert location.secrets == {"s3.secret-access-key": "hunter2hunter2"}
    assert "hunter2" not in repr(location)
    with pytest.raises(LakeError) as failed, location.translated("writing"):
        raise RuntimeError("the store refused hunter2hunter2")
    assert "hunter2" not in str(failed.value)
    assert "hunter2" not in exits(0, "config show", "fleet.robots={r1: /r1}", given).out
    for text in ("[hunter2hunter2]", f"hunter2hunter2: {'[' * 3000}"):
        secrets.write_text(text)
        refused = ship(2, given).err
        assert "must have lines like" in refused
        assert "hunter2" not in refused


@pytest.mark.usefixtures("selecting_here")
def test_a_select_is_answered_over_the_tables_as_they_are_now(
    fleet: Path, ship: Ship, tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    ship(0)
    counted, of_lake = (
        "sql 'SELECT robot, count(*) AS bags, max(day) AS day FROM bags",
        [f"lake.warehouse={tmp_path}/lake"],
    )
    rows = json.loads(exits(0, f"{counted} GROUP BY robot ORDER BY robot' --json", *of_lake).out)
    assert [row["robot"] for row in rows] == [*ROBOTS]
    [first, *_] = rows
    lines = exits(0, f"{counted} GROUP BY robot ORDER BY robot' --csv", *of_lake).out.splitlines()
    assert lines[:2] == ["robot,bags,day", f"{first['robot']},{first['bags']},{first['day']}"]
    assert "kitchen" in exits(0, f"{counted} GROUP BY ALL'", *of_lake).out
    odd = "0.5 a, 1e999::DOUBLE b, MAP{'x': 1} c, '\\x01'::BLOB d, DATE '2026-11-20' e"
    [row] = json.loads(exits(0, "sql --json", f"SELECT {odd}", *of_lake).out)
    assert row == {"a": 0.5, "b": None, "c": {"x": 1}, "d": "01", "e": "2026-11-20"}
    printed = exits(0, "sql", "SELECT 1500000000.25::DOUBLE AS mean_ns, NULL AS b", *of_lake).out
    assert printed.split() == ["mean_ns", "b", "1500000000.25", "-"]  # it is no time
    asking = ["select=SELECT 1500000000.25::DOUBLE AS mean_ns", f"fleet.robots={fleet}/*"]
    answered = exits(0, "ask query_lake lake=duckdb", *asking, *of_lake).out
    assert answered.split()[-2:] == ["mean_ns", "1500000000.25"]
    assert "two columns have one name" in exits(2, "sql 'SELECT 1 AS a, 2 AS a'", *of_lake).err
    assert exits(0, "sql --csv 'SELECT 1 AS a, 2 AS a'", *of_lake).out == "a,a\n1,2\n"
    nested = "SELECT true AS a, [1, NULL] AS b, MAP{'x': 1} AS c, NULL AS d"
    [_, line] = csv.reader(StringIO(exits(0, "sql --csv", nested, *of_lake).out))
    assert line == ["true", "[1,null]", '{"x":1}', ""]  # as in JSON
    with monkeypatch.context() as patch:
        patch.setattr(sys.stdout, "isatty", lambda: True)
        assert exits(0, "sql --csv 'SELECT chr(27) AS a'", *of_lake).out == "a\n\\x1b\n"
    refused = exits(2, "sql 'SELECT * FROM chanels'", *of_lake).err
    assert 'there is no table "chanels"' in refused
    assert "the tables are channels, poses" in refused
    nothing = exits(2, "sql 'SELECT 1'", f"lake.warehouse={tmp_path}/elsewhere").err
    assert f"{tmp_path}/elsewhere: there is no lake, or no bag in it" in nothing
