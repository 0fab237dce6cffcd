"""A lake filled with the rows of robots' bags, and the fleet that it answers for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from pyiceberg.catalog import Catalog
from pyiceberg.catalog.sql import SqlCatalog

from ros2_memory.columns.fill import Filling, StoreLimits
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.model import BagFile
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.lake.engines.base import LakeEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.memory import MOST_BAGS, LakeIndex, lake_memory
from ros2_memory.lake.rows import bag_id_of, rows_of
from ros2_memory.lake.tables import TABLES, Row, ShippedBag, day_of, open_tables
from ros2_memory.serving.backfill import make_fragments
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW
from tests.support.memories import extractor


def lake_in(folder: Path) -> SqlCatalog:
    """An Iceberg catalogue in a folder."""
    uri = f"sqlite:///{folder}/lake.sqlite"
    return SqlCatalog("lake", uri=uri, warehouse=folder.as_uri())


def fill(catalog: SqlCatalog, robots: Mapping[str, Memory], messages: Sequence[str] = ()) -> None:
    """Writes the rows of all bags of robots' memories."""
    tables = open_tables(catalog, TABLES)
    for name, memory in robots.items():
        found: dict[str, list[Row]] = {table: [] for table in TABLES}
        for bag in memory.index.snapshot().bags:
            for table, rows in rows_of(memory, bag, shipped(name, bag), messages).items():
                found[table] += rows
        for table, rows in found.items():
            if rows:
                tables[table].append(TABLES[table].filled(rows))


def shipped(robot: str, bag: BagFile) -> ShippedBag:
    """What names a bag of a robot in a lake, without a look at its file."""
    bag_id, day, name = bag_id_of(robot, bag, bag.start), day_of(bag.start), bag.path
    file = f"{name.parent.name}/{name.name}"
    return ShippedBag(
        robot, bag_id, day, file, bag.size, "0" * 64, bag.mtime_ns, "made", bag.start, bag.end
    )


def lake_robots(
    catalog: Catalog,
    engine: LakeEngine,
    names: Sequence[str],
    limits: QuerySettings | None = None,
    stores: Path | None = None,
    *,
    days: int = 31,
    most_bags: int = MOST_BAGS,
    now: int = NOW,
) -> dict[str, Memory]:
    """The robots of a lake; with a folder for `stores` each has one."""
    lake, clock, decoder = Lake(catalog, engine), FixedClock(now), McapReader()
    return {
        name: lake_memory(
            LakeIndex(lake, name, clock, refresh_s=0, days=days, most_bags=most_bags),
            clock,
            limits or QuerySettings(),
            extractor=extractor(),
            decoder=decoder,
            store=None
            if stores is None
            else ColumnStore([stores / name / FILE], decoder.definition),
            large=LargeReads(),
        )
        for name in names
    }


def store_columns(memory: Memory) -> Filling:
    """Fills the store of a lake's robot, as a server does; returns what filled it."""
    filling = Filling(
        memory.columns,
        memory.reader,
        memory.index.bag_dir,
        memory.clock,
        StoreLimits(max_share=1.0),
        are_files=False,
    )
    timeline = memory.index.snapshot().timeline
    for batch in filling.batches(timeline):
        assert filling.fill(batch, timeline) == len(batch.bags)
    make_fragments(memory, filling.whole_since())
    filling.thin()
    assert filling.progress(timeline).stored == len(timeline.bags)
    return filling


def fleet_of(memories: Mapping[str, Memory], *, shared_map: bool = False, now: int = NOW) -> Fleet:
    """The fleet of some memories."""
    robots = [
        Robot(name, Path("/") / name, partial(_same, memory)) for name, memory in memories.items()
    ]
    return Fleet(robots, FixedClock(now), shared_map=shared_map)


def _same(memory: Memory) -> Memory:
    return memory
