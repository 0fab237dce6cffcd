"""Forgets a time of a robot in a lake: rows, old versions and files.

Each bag that reaches into the time goes as a whole, or, where topics are forgotten, that holds some
of them: where its file is still there without the messages, it is shipped again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.logging_setup import get_logger
from ros2_memory.lake.conditions import (
    any_of,
    except_bags,
    of_bags,
    of_ids,
    of_topics,
    overlapping,
)
from ros2_memory.lake.tables import TABLES
from ros2_memory.lake.tombstones import append_tombstone
from ros2_memory.lake.upkeep import expire
from ros2_memory.lake.warehouse import quiet_deletes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import date

    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.tombstones import Tombstone
    from ros2_memory.lake.warehouse import LakeLocation

log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Forgotten:
    """What is gone: how many bags, and files; `kept_by` names tags and branches that keep some."""

    bags: int
    files: int
    kept_by: tuple[str, ...] = ()


def forget_in_lake(
    location: LakeLocation, tables: Mapping[str, IcebergTable], tombstone: Tombstone, now: Ns
) -> Forgotten:
    """Deletes what a tombstone names, which is written already; killed anywhere, it is done again.

    Raises:
        LakeError: the lake cannot be read or written.
    """
    with location.translated("forgetting in the lake"):
        named = of_ids(tombstone.robot, tombstone.bags) if tombstone.bags else None
        found = _bags(tables["bags"], named or _reaching(tombstone, "bags"))
        spared: set[str] = set()
        if tombstone.topics:
            # What is in the lake of a bag shows in its channels.
            holding = of_topics(_reaching(tombstone, "channels"), tombstone.topics)
            holders = {bag_id for _, bag_id in _bags(tables["channels"], holding)}
            spared = {bag_id for _, bag_id in found} - holders
        bags = [(tombstone.robot, *each) for each in found if each[1] not in spared]
        # `bags` last: until then it lists the rows to delete.
        for name in TABLES:
            # By their own times, too: a killed process left rows without one in `bags`.
            conditions = [named or except_bags(_reaching(tombstone, name), spared)]
            if bags:
                conditions.append(of_bags(bags))
            table = tables[name]
            with quiet_deletes():
                table.refresh().delete(any_of(conditions))
            # The list of what a version deleted has the bounds of its columns, which are texts of
            # rows; the next version does not refer to it.
            table.append(table.schema().as_arrow().empty_table())
    # The versions before hold what was deleted, so they go whatever their age.
    files = expire(location, tables, now, 0)
    kept_by = tuple(
        f"{name}: {ref}"
        for name, table in tables.items()
        for ref, each in table.metadata.refs.items()
        if each.snapshot_id != table.metadata.current_snapshot_id
    )
    append_tombstone(location.state_dir, tombstone, done=True)
    log.info("forgotten_in_lake", robot=tombstone.robot, bags=len(bags), files=files)
    return Forgotten(len(bags), files, kept_by)


def _bags(table: IcebergTable, condition: BooleanExpression) -> list[tuple[date, str]]:
    """Returns the day and the bag of each of some rows."""
    scan = table.refresh().scan(row_filter=condition, selected_fields=("bag_id", "day"))
    found = scan.to_arrow()
    return [*zip(found["day"].to_pylist(), found["bag_id"].to_pylist(), strict=True)]


def _reaching(tombstone: Tombstone, name: str) -> BooleanExpression:
    """Returns the condition on rows of a table that reach into the window."""
    return overlapping(tombstone.robot, TABLES[name].span, tombstone.start, tombstone.stop)
