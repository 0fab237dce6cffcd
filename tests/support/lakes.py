"""A lake in a folder, and robots of a few messages: shipped into it, and asked over it."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.expressions import AlwaysTrue

from ros2_memory.bag_dir.layout import LIST_FILE
from ros2_memory.columns.fill import Filling, StoreLimits
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.memory import MOST_BAGS, LakeIndex, LakeReader
from ros2_memory.lake.select import Select
from ros2_memory.lake.shipper import RobotBags, Shipped, Shipper
from ros2_memory.lake.upkeep import Tombstone
from ros2_memory.lake.warehouse import CATALOGUE_FILE, LakeLocation, location_of
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, detections, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.column_worlds import World
from tests.support.fleets import NOW, START_S
from tests.support.memories import extractor

LATER = (START_S + 86_400) * NS_PER_S


def write_bag(bag_dir: Path, number: int, *, at_s: int | None = None, most: int = 3) -> Path:
    """A bag with numbered texts, one for each second, and a cup that is seen."""
    first = START_S + 10 * number if at_s is None else at_s
    messages: list[Msg] = [detections(first * NS_PER_S, ["cup"])]
    messages += [text((first + nth) * NS_PER_S, f"n{number * 100 + nth}") for nth in range(most)]
    own = bag_dir / LIST_FILE
    own.parent.mkdir(parents=True, exist_ok=True)
    own.touch()  # a recorder has recorded here
    return write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)


def robot_bags(
    name: str,
    bag_dir: Path,
    clock: Clock | None = None,
    messages: Sequence[str] = ("/chatter",),
    *,
    cache: Sequence[Path] | None = None,
    limits: StoreLimits | None = None,
) -> RobotBags:
    """A robot whose bags are shipped, with a store: its own, or at a path of `cache`."""
    bag_dir.mkdir(parents=True, exist_ok=True)
    world = World.of(bag_dir, limits=limits, files=cache, clock=clock)
    return RobotBags(name, world.memory, McapReader(), "test", messages, world.filling)


def location(folder: Path) -> LakeLocation:
    """A lake below a folder."""
    warehouse, state_dir = location_of(str(folder), None)
    return LakeLocation(warehouse, state_dir)


@contextmanager
def shipping(
    folder: Path,
    robots: Sequence[RobotBags],
    *,
    most_bags: int = 2,
    tombstones: set[Tombstone] | None = None,
) -> Iterator[Shipper]:
    """What ships these robots' bags, two in each batch."""
    with location(folder).writable() as lake:
        yield Shipper(
            lake,
            robots,
            FixedClock(LATER),
            most_bags=most_bags,
            tombstones=tombstones or set(),
        )


def ship(folder: Path, robots: Sequence[RobotBags], **how: Any) -> Shipped:
    """One pass, as of a process that has just started; see `shipping`."""
    with shipping(folder, robots, **how) as shipper:
        return shipper.run()


def ship_from(
    folder: Path, *names: str, messages: Sequence[str] = ("/chatter",), most_bags: int = 2
) -> Shipped:
    """One pass over robots in a folder, `hall` unless others are named, into its lake."""
    robots = [robot_bags(each, folder / each, messages=messages) for each in names or ("hall",)]
    return ship(folder / "lake", robots, most_bags=most_bags)


@pytest.fixture
def selecting_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Statements are answered in this process: one of its own takes half a second for each."""
    monkeypatch.setattr(Select, "run", lambda self, tables, _: self.rows(tables))


def lake_rows(folder: Path, table: str) -> list[dict[str, Any]]:
    """The rows of a table of the lake, in no order."""
    with location(folder).writable() as lake:
        found: list[dict[str, Any]] = lake.rows(table, AlwaysTrue()).to_pylist()
    return found


def lake_column(folder: Path, table: str, column: str) -> list[object]:
    """The values of a column of the lake, sorted by their text."""
    return sorted((row[column] for row in lake_rows(folder, table)), key=str)


def lake_in(folder: Path) -> SqlCatalog:
    """The catalogue of the lake in a folder."""
    where = location(folder)
    where.state_dir.mkdir(parents=True, exist_ok=True)
    uri = f"sqlite:///{where.state_dir}/{CATALOGUE_FILE}"
    return SqlCatalog("lake", uri=uri, warehouse=where.warehouse)


def lake_robots(
    lake: Lake,
    names: Sequence[str],
    stores: Path | None = None,
    *,
    days: int = 31,
    most_bags: int = MOST_BAGS,
    now: int = NOW,
    bag_dirs: Path = Path("/"),
) -> dict[str, Memory]:
    """The robots of a lake; with a folder for `stores` each has one."""
    clock, decoder, large = FixedClock(now), McapReader(), LargeReads()

    def memory(name: str) -> Memory:
        own = bag_dirs / name
        index = LakeIndex(lake, name, own, clock, refresh_s=0, days=days, most_bags=most_bags)
        path = [] if stores is None else [stores / name / FILE]
        store = ColumnStore(path, decoder.definition) if path else None
        scanner = Scanner(store, index.bag_dir, "", large)
        reader = LakeReader(index, decoder, large)
        return Memory(index, reader, extractor(), clock, QuerySettings(), scanner, large=large)

    return {name: memory(name) for name in names}


def lake_robot(folder: Path, **how: Any) -> Memory:
    """The robot `hall` of the lake in a folder; see `lake_robots`."""
    lake = Lake(lake_in(folder), memory_mb=256)
    return lake_robots(lake, ["hall"], **how)["hall"]


def store_columns(memory: Memory) -> Filling:
    """Fills the store of a lake's robot, as a server does; returns what filled it."""
    bag_dir, limits = memory.index.bag_dir, StoreLimits(max_share=1.0)
    filling = Filling(memory.scanner, memory.reader, bag_dir, memory.clock, limits)
    timeline = memory.index.snapshot().timeline
    assert World(bag_dir, memory, filling).fill() == len(timeline.bags)
    assert filling.progress(timeline).stored == len(timeline.bags)
    return filling


def fleet_of(memories: Mapping[str, Memory], *, shared_map: bool = False, now: int = NOW) -> Fleet:
    """The fleet of some memories."""
    robots = [Robot(name, memory) for name, memory in memories.items()]
    return Fleet(robots, FixedClock(now), shared_map=shared_map)
