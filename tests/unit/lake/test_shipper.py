"""Each bag comes into the lake once, whatever happens while it is shipped."""

import errno
import os
import re
import shutil
import threading
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch
from urllib.request import Request, urlopen

import pytest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.manifest import ManifestEntry
from pyiceberg.table.update.snapshot import _OverwriteFiles

from ros2_memory.bag_dir.layout import SHIPPED_FILE
from ros2_memory.bag_dir.state_files import append_receipts, read_receipts
from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.store import FILE
from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.lake import shipper as shipper_module
from ros2_memory.lake import warehouse
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.rows import RowMaker, sha256_of
from ros2_memory.lake.shipper import Shipper
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.upkeep import Tombstone, forget_in_lake
from ros2_memory.lake.warehouse import CATALOGUE_FILE, LakeLocation
from tests.support.bags import Msg, detections, make, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.examples import LONG
from tests.support.fakes import failing
from tests.support.fleets import START_S
from tests.support.lakes import (
    LATER,
    lake_column,
    lake_rows,
    location,
    robot_bags,
    ship,
    ship_from,
    shipping,
    write_bag,
)
from tests.support.processes import until

ROBOTS = ("hall", "kitchen")
BAGS = 3
DAY_S = 86_400


class _Killed(BaseException):
    """In place of SIGKILL: nothing catches it."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots with three bags each."""
    folder = tmp_path_factory.mktemp("fleet")
    for name in ROBOTS:
        for number in range(BAGS):
            write_bag(folder / name, number)
    return folder


def values(folder: Path) -> list[str]:
    """The text of each message, sorted."""
    return sorted(dict(row["texts"])["value"] for row in lake_rows(folder, "messages"))


def written(bags: int, robots: int = 1) -> list[str]:
    """The texts of so many bags of so many robots, sorted."""
    return sorted([f"n{bag * 100 + nth}" for bag in range(bags) for nth in range(3)] * robots)


def test_a_bag_directory_that_hangs_is_named_and_the_others_are_shipped(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, scandir = threading.Event(), os.scandir

    def hanging(folder: Any = ".") -> Any:
        if folder == fleet / "hall":
            released.wait()
        return scandir(folder)

    monkeypatch.setattr("ros2_memory.lake.shipper.os.scandir", hanging)
    robots = [robot_bags(name, fleet / name) for name in ROBOTS]
    with shipping(tmp_path, robots) as shipper:
        shipper.patience_s = 3.0
        for bags in (BAGS, 0):
            done = shipper.run()
            assert done.bags == bags
            [problem] = done.problems
            assert problem.startswith("hall: ")
            assert "does not answer" in problem
        with monkeypatch.context() as hung:
            hung.setattr(robots[0].memory.index, "snapshot", lambda: pytest.fail("it is looked at"))
            shipper.keep_up(0)
        released.set()
        assert until(lambda: shipper.run().bags or None) == BAGS


def test_what_it_stores_of_bags_is_in_a_file_and_cut_to_their_share(tmp_path: Path) -> None:
    for number in range(BAGS):
        write_bag(tmp_path / "hall", number)
    limits = StoreLimits(max_share=0.0, least_bytes_per_s=0)
    for name, cache in (("memory", []), ("file", [tmp_path / "cache" / FILE])):
        robot = robot_bags("hall", tmp_path / "hall", FixedClock(LATER), cache=cache, limits=limits)
        assert ship(tmp_path / name, [robot], most_bags=100).bags == BAGS
        assert values(tmp_path / name) == written(BAGS)
        assert robot.filling is not None
        assert len(robot.filling.store.paths()) == (BAGS if cache else 0)
        assert bool(robot.filling.store.dropped()) == bool(cache)


def test_columns_that_another_program_deletes_or_damages_keep_no_bag_from_being_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(BAGS):
        write_bag(tmp_path / "hall", number)
    robot = robot_bags("hall", tmp_path / "hall")
    made, calls = RowMaker.rows, 0

    def gone(maker: RowMaker, bags: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 1 or next(iter(bags.values())).file == spared:
            raise GoneError
        return made(maker, bags)

    monkeypatch.setattr(RowMaker, "rows", gone)
    spared = ""
    done = ship(tmp_path / "once", [robot], most_bags=100)
    assert (done.bags, done.problems) == (BAGS, [])
    spared = "rec/rec_0.mcap"
    done = ship(tmp_path / "always", [robot], most_bags=100)
    assert (done.bags, len(done.problems)) == (BAGS - 1, 1)


def test_rows_of_the_bags_of_an_hour_are_made_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is cut out of the track of its hour, which a group of other bags would make again."""
    made, groups = RowMaker.rows, list[list[str]]()

    def noted(maker: RowMaker, bags: Any) -> Any:
        groups.append([shipped.file for shipped in bags.values()])
        return made(maker, bags)

    monkeypatch.setattr(RowMaker, "rows", noted)
    begin = START_S // 3600 * 3600
    for number, at_s in enumerate((begin - 20, begin - 10, begin, begin + 10, begin + 3590)):
        write_bag(tmp_path / "hall", number, at_s=at_s)
    assert ship_from(tmp_path, most_bags=100).bags == 5
    named = [[f"rec/rec_{number}.mcap" for number in hour] for hour in ((0, 1), (2, 3, 4))]
    assert groups == named


def test_a_thing_has_the_name_by_which_people_ask_for_it(tmp_path: Path) -> None:
    seen = detections(START_S * 10**9, ["Scissors", "safety_goggles", "cups"])
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", [seen])
    ship_from(tmp_path)
    things = {row["thing"] for row in lake_rows(tmp_path / "lake", "sightings")}
    assert things == {"scissors", "safety goggles", "cup"}


def test_each_event_of_a_bag_has_a_row(tmp_path: Path) -> None:
    bag_dir, kind = tmp_path / "hall", "std_msgs/msg/Bool"
    write_bag(bag_dir, 0)
    states = [
        Msg("/door", kind, START_S * NS_PER_S + number * 10**8, make(kind, data=bool(number % 2)))
        for number in range(200)
    ]
    write_mcap(bag_dir / "rec" / "rec_1.mcap", states)
    ship_from(tmp_path)
    flips = [row for row in lake_rows(tmp_path / "lake", "events") if row["kind"] == "flip"]
    assert sorted(row["first_ns"] for row in flips) == [state.log_time for state in states[1:]]


def test_a_late_robot_and_a_copy_of_a_robot_change_nothing_else(
    fleet: Path, tmp_path: Path
) -> None:
    ship(tmp_path / "lake", [robot_bags("hall", fleet / "hall")])
    # Without their times: everything is looked at anew.
    shutil.copytree(fleet / "hall", tmp_path / "hall", copy_function=shutil.copyfile)
    for each in (tmp_path / "hall").rglob("*.mcap"):
        os.utime(each, (START_S, START_S))
    (tmp_path / "hall" / ".episodic" / "shipped.jsonl").unlink()
    robots = [robot_bags("hall", tmp_path / "hall"), robot_bags("kitchen", fleet / "kitchen")]
    assert ship(tmp_path / "lake", robots).bags == BAGS
    assert values(tmp_path / "lake") == written(BAGS, 2)
    # The copy gets receipts of its own.
    assert len(read_receipts(tmp_path / "hall")) == BAGS


def test_a_bag_of_which_messages_were_deleted_replaces_its_rows(tmp_path: Path) -> None:
    midnight = START_S // DAY_S * DAY_S
    write_bag(tmp_path / "hall", 0)
    write_bag(tmp_path / "hall", 1)
    write_bag(tmp_path / "hall", 2, at_s=midnight - 2, most=4)
    assert ship_from(tmp_path).bags == 3
    # Its first messages are gone, so that it has another id, of one also its first day.
    write_bag(tmp_path / "hall", 1, at_s=START_S + 11, most=2)
    write_bag(tmp_path / "hall", 0, most=1)
    write_bag(tmp_path / "hall", 2, at_s=midnight, most=2)
    assert [ship_from(tmp_path).bags for _ in range(2)] == [3, 0]
    assert values(tmp_path / "lake") == ["n0", "n100", "n101", "n200", "n201"]
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == 3
    # Nothing takes the place of all that was seen: these rows go, too.
    for number in (0, 1):
        said = text((START_S + 12 * number) * NS_PER_S, "hello")
        write_mcap(tmp_path / "hall" / "rec" / f"rec_{number}.mcap", [said])
    assert ship_from(tmp_path).bags == 2
    assert lake_column(tmp_path / "lake", "sightings", "label") == ["cup"]


@pytest.mark.parametrize("first", [0, 1])
def test_a_bag_that_retention_cut_keeps_its_rows(tmp_path: Path, first: int) -> None:
    write_bag(tmp_path / "hall", 0)
    ship_from(tmp_path)
    (receipt,) = read_receipts(tmp_path / "hall").values()
    # With its first message gone it has another id.
    bag = write_bag(tmp_path / "hall", 0, at_s=START_S + first, most=1 + first)
    append_receipts(tmp_path / "hall", [replace(receipt, size=bag.stat().st_size)])
    assert ship_from(tmp_path).bags == 0
    assert values(tmp_path / "lake") == written(1)


@pytest.mark.parametrize("is_readable", [True, False])
def test_bags_that_retention_cut_are_not_read_again_and_keep_no_others_from_being_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_readable: bool
) -> None:
    hall, kitchen = (tmp_path / name for name in ROBOTS)
    write_bag(kitchen, 0)
    for number in range(BAGS):
        write_bag(hall, number)
    with shipping(tmp_path / "lake", [robot_bags(name, tmp_path / name) for name in ROBOTS]) as two:
        assert two.run().bags == BAGS + 1
        receipts = read_receipts(hall)
        for number in range(BAGS):
            bag = write_bag(hall, number, most=1)
            receipt = receipts[f"rec/{bag.name}"]
            append_receipts(hall, [replace(receipt, size=bag.stat().st_size)])
        if not is_readable:
            (hall / SHIPPED_FILE).rename(tmp_path / "receipts")
            (hall / SHIPPED_FILE).symlink_to(tmp_path / "receipts")
        hashing, reading = Mock(wraps=sha256_of), Mock(wraps=read_receipts)
        monkeypatch.setattr(shipper_module, "sha256_of", hashing)
        monkeypatch.setattr(shipper_module, "read_receipts", reading)
        write_bag(kitchen, 1)
        done = two.run()
    assert (done.bags, len(done.problems)) == (1, 0 if is_readable else 1)
    assert hashing.call_count == 1
    assert not is_readable or reading.call_count <= len(ROBOTS)
    assert len(values(tmp_path / "lake")) == 3 * (BAGS + 2)


def test_a_saved_copy_of_a_bag_is_shipped_only_where_the_bag_is_not(tmp_path: Path) -> None:
    write_bag(tmp_path / "hall", 0)
    moment = tmp_path / "hall" / "moments" / "20261120T043012Z-cup"
    shutil.copytree(tmp_path / "hall" / "rec", moment / "rec")
    write_bag(moment, 1)
    ship_from(tmp_path)
    assert len(values(tmp_path / "lake")) == 6
    shutil.rmtree(tmp_path / "hall" / "rec")
    assert ship_from(tmp_path).bags == 0
    assert len(values(tmp_path / "lake")) == 6


def test_what_ships_for_years_forgets_bags_that_are_gone(tmp_path: Path) -> None:
    with shipping(tmp_path / "lake", [robot_bags("hall", tmp_path / "hall")]) as shipper:
        for day in range(3):
            bag = write_bag(tmp_path / "hall", day, at_s=START_S + day * DAY_S)
            assert shipper.run().bags == 1
            [robot] = shipper.robots
            assert max(len(robot.known), len(robot._states), len(robot._confirmed)) <= 2
            bag.unlink()


def test_read_only_bags_are_shipped_and_reported_and_nothing_is_written_beside_those_of_others(
    tmp_path: Path,
) -> None:
    write_bag(tmp_path / "hall", 0)
    own = tmp_path / "hall" / ".episodic"
    with patch.object(shipper_module, "append_receipts", failing(errno.EROFS)):
        done = ship_from(tmp_path)
    assert done.bags == 1
    [problem] = done.problems
    assert "Read-only file system" in problem
    assert "hall" in problem
    (own / "recordings.jsonl").unlink()
    # With other settings its rows are others.
    robot = robot_bags("hall", tmp_path / "hall", messages=())
    for config in ("test", "other"):
        robot.config = config
        done = ship(tmp_path / "lake", [robot])
        assert (done.bags, done.problems, values(tmp_path / "lake")) == (1, [], [])
    assert not (own / "shipped.jsonl").exists()


def test_what_pyiceberg_refuses_is_committed_from_a_fresh_look(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its threads share what evaluates manifests, and may miss the files that they are to delete.

    The rows of bags are there already, since a process was killed before their row in `bags`.
    """
    robots = [robot_bags(name, fleet / name) for name in ROBOTS]
    entries, commit = _OverwriteFiles._deleted_entries, SqlCatalog.commit_table
    refused: list[str] = []

    def missing(files: _OverwriteFiles) -> list[ManifestEntry]:
        found = entries(files)
        location = files._transaction._table.location()
        if found and location not in refused:
            refused.append(location)
            files._validate_required_deletes([])
        return found

    def kill(*given: Any) -> object:
        if given[1].name()[-1] == "bags":
            raise _Killed
        return commit(*given)

    with patch.object(SqlCatalog, "commit_table", kill), pytest.raises(_Killed):
        ship(tmp_path, robots, most_bags=200)
    monkeypatch.setattr(_OverwriteFiles, "_deleted_entries", missing)
    for robot in robots:
        robot.look_again()
    assert ship(tmp_path, robots, most_bags=200).bags == 2 * BAGS
    assert len(refused) > 1
    assert values(tmp_path) == written(BAGS, 2)


def test_killed_at_any_point_it_loses_and_doubles_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot records on while what ships its bags is killed again and again.

    At each point once; tests/integration kills a process at drawn ones.
    """
    robots = [robot_bags("hall", tmp_path / "hall")]
    left = killed = bags = 0

    def reached() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            raise _Killed

    commit, append = SqlCatalog.commit_table, append_receipts

    def commits(*given: Any) -> object:
        reached()
        return commit(*given)

    def appends(*given: Any) -> None:
        reached()
        append(*given)
        reached()

    monkeypatch.setattr(SqlCatalog, "commit_table", commits)
    monkeypatch.setattr(shipper_module, "append_receipts", appends)
    while left <= 0:
        write_bag(tmp_path / "hall", bags)
        bags += 1
        left = killed + 1
        try:
            # In one batch, so that each run goes on where the one before was killed.
            ship(tmp_path / "lake", robots, most_bags=200)
        except _Killed:
            killed += 1
    left = 0
    ship(tmp_path / "lake", robots)
    with_rows = [name for name in TABLES if lake_column(tmp_path / "lake", name, "bag_id")]
    assert killed == len(with_rows) + 2
    assert values(tmp_path / "lake") == written(bags)
    assert len(lake_column(tmp_path / "lake", "bags", "bag_id")) == bags
    assert lake_column(tmp_path / "lake", "sightings", "label") == ["cup"] * bags


def test_a_lake_lies_in_the_folder_that_is_named_whatever_its_name_has(tmp_path: Path) -> None:
    folder = tmp_path / "usb disk, ä %41 100%"
    ship_and_ask(location(folder), tmp_path / "hall")
    assert {*tmp_path.iterdir()} == {folder, tmp_path / "hall"}
    for refused in ("a?b", "a#b"):
        with pytest.raises(ValueError, match=f"{re.escape(refused)} has [?] or #"):
            location(tmp_path / refused)


def test_a_lake_goes_on_where_an_older_version_put_it(tmp_path: Path) -> None:
    folder = tmp_path / "usb disk"
    older = replace(location(folder), warehouse=folder.as_uri())
    for number, where in enumerate((older, location(folder))):
        write_bag(tmp_path / "hall", number)
        with where.writable() as tables:
            robots = [robot_bags("hall", tmp_path / "hall")]
            assert Shipper(tables, robots, FixedClock(LATER)).run().bags == 1
    assert lake_column(folder, "sightings", "label") == ["cup"] * 2
    assert not [*folder.rglob("*.parquet")]
    assert [*(tmp_path / "usb%20disk").rglob("*.parquet")]


def test_bags_are_shipped_once_and_asked_through_a_rest_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In place of the service is a database that lies elsewhere."""
    given: list[dict[str, str]] = []

    def service(name: str, **properties: str) -> SqlCatalog:
        given.append(properties)
        return SqlCatalog(name, **{**properties, "uri": f"sqlite:///{tmp_path}/service.sqlite"})

    monkeypatch.setattr(warehouse, "RestCatalog", service)
    where = replace(location(tmp_path / "lake"), catalog="rest", uri="https://catalogue/")
    ship_and_ask(where, tmp_path / "hall")
    assert where.last_change() is not None
    assert {properties["uri"] for properties in given} == {where.uri}
    assert not (where.state_dir / CATALOGUE_FILE).exists()


@pytest.mark.skipif(not LONG, reason="starts an S3 server: EPISODIC_LONG=1")
def test_bags_are_shipped_once_into_a_bucket_asked_and_forgotten(tmp_path: Path) -> None:
    """The store is moto's server, which is in no lock, since it brings forty packages.

    `EPISODIC_LONG=1 uv run --with "moto[s3,server]" pytest -n0 tests/unit/lake/test_shipper.py`.
    """
    moto = pytest.importorskip("moto.server", reason="needs moto, which no lock has")
    secret = "very-secret-key"  # noqa: S105 - of no account
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        where = LakeLocation(
            "s3://robots/lake",
            tmp_path / "state",
            properties={"s3.endpoint": f"http://{host}:{port}", "s3.region": "us-east-1"},
            secrets={"s3.access-key-id": "ship", "s3.secret-access-key": secret},
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
        assert not any(secret.encode() in each.read_bytes() for each in kept)
    finally:
        server.stop()


def ship_and_ask(where: LakeLocation, folder: Path) -> None:
    """Ships two bags of a robot, each by two processes in turn, and asks the lake for them.

    The second process finds nothing new.
    """
    for number in (0, 1):
        write_bag(folder, number)
        for shipped in (1, 0):
            with where.writable() as tables:
                robots = [robot_bags("hall", folder)]
                assert Shipper(tables, robots, FixedClock(LATER)).run().bags == shipped
    with where.opened() as catalog:
        lake = Lake(catalog, where.translated)
        assert [*lake.days("bags")] == ["hall"]
        files = chain.from_iterable(lake.days("sightings")["hall"].values())
        found = lake.rows("sightings", files, ("bag_id", "label")).to_pylist()
        assert lake.query("SELECT count(*) FROM sightings").rows == [[2]]
    assert [row["label"] for row in found] == ["cup", "cup"]
    assert len({row["bag_id"] for row in found}) == 2
