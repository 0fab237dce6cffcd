"""The track of the robot is the same from what is stored, whatever window cuts it."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from shutil import copytree
from typing import TYPE_CHECKING

import pytest

from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.bags import write_mcap
from tests.support.memories import memory_of, with_store
from tests.support.moving_map import BEGIN, S, moving_map

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.storage.base import Batch

MINUTES = 25
UNPLACED = 300
"""For so many seconds odometry is in no map."""


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracks")
    _, messages = moving_map(Random(7), MINUTES * 60)
    for number in range(MINUTES):
        begin = BEGIN + number * 60 * S
        minute = [
            each
            for each in messages
            if begin <= each.log_time < begin + 60 * S
            and (each.topic != "/tf" or each.log_time > BEGIN + UNPLACED * S)
        ]
        minute.sort(key=lambda each: each.log_time)
        write_mcap(folder / "rec" / f"rec_{number}.mcap", minute)
    return folder


class Unread(Rosbag2Reader):
    """A reader of which no message may be asked."""

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        raise AssertionError(f"messages of {path} are read")


def test_making_tracks_reads_no_bag_that_waits_to_be_stored(bag_dir: Path, tmp_path: Path) -> None:
    bag_dir = copytree(bag_dir / "rec", tmp_path / "rec").parent
    plain = memory_of(bag_dir)
    store = with_store(plain, bag_dir, part=0.8).scanner.store
    most = replace(plain, scanner=Scanner(store, bag_dir), reader=Unread())
    window = TimeWindow(BEGIN, BEGIN + MINUTES * 60 * S)
    assert [*TrackReader(View(most, Call(stored=True)), "odom").made(window)]
    with pytest.raises(AssertionError, match="are read"):
        TrackReader(View(most, Call()), "odom").over(window)
