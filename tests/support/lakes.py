"""A lake in a folder, and robots of a few messages whose bags are shipped into it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Final

from pyiceberg.expressions import AlwaysTrue

from ros2_memory.bag_dir.layout import LIST_FILE
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.lake.engines.duckdb_engine import DuckdbEngine
from ros2_memory.lake.files import Lake
from ros2_memory.lake.shipper import RobotBags, Shipped, Shipper
from ros2_memory.lake.warehouse import LakeLocation, location_of
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, detections, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.memories import memory_of, with_store

START_S: Final = 1_795_161_600
LATER: Final = (START_S + 86_400) * NS_PER_S


def write_bag(
    bag_dir: Path, number: int, *, at_s: int | None = None, most: int = 3, recording: str = "rec"
) -> Path:
    """A bag with numbered texts, one for each second, and a cup that is seen."""
    first = START_S + 10 * number if at_s is None else at_s
    messages: list[Msg] = [detections(first * NS_PER_S, ["cup"])]
    messages += [text((first + nth) * NS_PER_S, f"n{number * 100 + nth}") for nth in range(most)]
    own = bag_dir / LIST_FILE
    own.parent.mkdir(parents=True, exist_ok=True)
    own.touch()  # a recorder has recorded here
    return write_mcap(bag_dir / recording / f"{recording}_{number}.mcap", messages)


def robot_bags(name: str, bag_dir: Path, clock: Clock | None = None) -> RobotBags:
    """A robot whose bags are shipped."""
    bag_dir.mkdir(parents=True, exist_ok=True)
    memory = with_store(memory_of(bag_dir, clock=clock), bag_dir)
    return RobotBags(name, memory, McapReader(), "test")


def location(folder: Path) -> LakeLocation:
    """A lake below a folder."""
    warehouse, state_dir = location_of(str(folder), None)
    return LakeLocation(warehouse, state_dir)


@contextmanager
def shipping(
    folder: Path,
    robots: Sequence[RobotBags],
    *,
    messages: Sequence[str] = ("/chatter",),
    most_bags: int = 2,
) -> Iterator[Shipper]:
    """What ships these robots' bags, two in each batch."""
    with location(folder).writable() as lake:
        yield Shipper(
            lake,
            robots,
            FixedClock(LATER),
            messages=messages,
            most_bags=most_bags,
        )


def ship(folder: Path, robots: Sequence[RobotBags], *, most_bags: int = 2) -> Shipped:
    """One pass, as of a process that has just started."""
    with shipping(folder, robots, most_bags=most_bags) as shipper:
        return shipper.run()


def ship_from(folder: Path, *names: str) -> Shipped:
    """One pass over robots in a folder, into its lake."""
    return ship(folder / "lake", [robot_bags(name, folder / name) for name in names or ("hall",)])


def lake_column(folder: Path, table: str, column: str) -> list[object]:
    """The values of a column of the lake, sorted by their text."""
    with location(folder).writable() as lake:
        found = lake.rows(table, AlwaysTrue(), (column,))
    return sorted(found[column].to_pylist(), key=str)


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
        engine = DuckdbEngine()
        lake = Lake(catalog, engine, where.translated)
        assert lake.robots() == ["hall"]
        sql = "SELECT bag_id, label FROM sightings ORDER BY bag_id"
        files = chain.from_iterable(lake.days("sightings", "hall").values())
        found = lake.select(sql, "sightings", files).to_pylist()
        engine.close()
    assert [row["label"] for row in found] == ["cup", "cup"]
    assert len({row["bag_id"] for row in found}) == 2
