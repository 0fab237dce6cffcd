"""A week of bags that only the catalogue knows: questions about all of it read no bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest

from ros2_memory import queries
from ros2_memory.catalogue.digest import Digest, Digester
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.lookup import DigestCache
from ros2_memory.catalogue.store import Catalogue
from ros2_memory.columns.store import BagKey
from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.index.timeline import Timeline
from tests.support.bags import detections, odom, tf, transform
from tests.support.clocks import FixedClock
from tests.support.fakes import FakeReader
from tests.support.memories import extractor

if TYPE_CHECKING:
    from ros2_memory.recorder.index_manager import IndexManager

T0_S = 1_700_000_000
T0 = T0_S * NS_PER_S
SPLIT_S = 100
"""Splits of ten seconds would be ten times as many bags, and the same answers."""
SPLIT = SPLIT_S * NS_PER_S
BAGS = 7 * 24 * 3600 // SPLIT_S
PERIOD_S = 10
"""Of the odometry, at 0.1 m/s."""
SCENE = "/vision/scene/scene_objects"
BAG_DIR = Path("/no/such/folder")


class Still:
    """An index that stands still."""

    def __init__(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        self.bag_dir = BAG_DIR

    def snapshot(self, reach: int | None = None) -> Snapshot:
        return self._snapshot


def first_bag() -> Digest:
    reader = FakeReader()
    times = range(0, SPLIT_S, PERIOD_S)
    messages = [odom(T0 + at * NS_PER_S, at / 10, 0.0, vx=0.1) for at in times]
    messages.append(detections(T0, ["cup", "person"], at=(1.0, 0.0, 0.0)))
    messages.append(tf(T0, transform(T0, "odom", "base_link", (0.0, 0.0, 0.0))))
    path = reader.add(Path("bag.mcap"), messages)
    return Digester(reader, extractor()).digest(path)


def later(digest: Digest, by: int) -> Digest:
    """What a bag would have held some time later, at the same speed."""
    shifted = [
        replace(each, first=each.first + by, last=each.last + by) for each in digest.summary.topics
    ]
    return Digest(BagSummary(tuple(shifted)), digest.topics)


@pytest.fixture(scope="module")
def week() -> tuple[Memory, FakeReader]:
    catalogue, first = Catalogue([], DigestConfig("week")), first_bag()
    bags: list[BagFile] = []
    entries: list[tuple[BagKey, Digest]] = []
    for number in range(BAGS):
        digest = later(first, number * SPLIT)
        path = BAG_DIR / f"rec_{number // 36}" / f"rec_{number}.mcap"
        summary = digest.summary
        bags.append(BagFile(str(path), 1, T0, BagState.CLOSED, summary, summary.start, summary.end))
        entries.append((BagKey.of(bags[-1], BAG_DIR), digest))
    assert catalogue.put_all(entries)
    index = cast("IndexManager", Still(Snapshot(Timeline.of(bags))))
    reader = FakeReader()
    clock = FixedClock(T0 + BAGS * SPLIT)
    recall = DigestCache(catalogue, BAG_DIR)
    return Memory(index, reader, extractor(), clock, QuerySettings(), recall), reader


def test_frames_of_a_week_are_listed_without_reading_a_bag(
    week: tuple[Memory, FakeReader],
) -> None:
    memory, reader = week
    [edge] = queries.frames(memory, Call()).edges
    assert (edge.parent, edge.child, edge.static) == ("odom", "base_link", False)
    assert reader.opened == []
