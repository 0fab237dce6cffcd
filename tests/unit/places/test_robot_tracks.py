"""Making tracks for the store leaves alone what is not stored yet."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.places.robot_tracks import TrackReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.memories import memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.storage.base import Batch


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


def test_making_tracks_reads_no_bag_that_waits_to_be_stored(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 7, seconds=1500, split_s=60.0)
    plain = memory_of(tmp_path)
    store = with_store(plain, tmp_path, part=0.8).scanner.store
    most = replace(plain, scanner=Scanner(store, tmp_path), reader=Unread())
    window = TimeWindow(BEGIN, BEGIN + 1500 * S)
    assert [*TrackReader(View(most, Call(stored=True)), "odom").made(window)]
    with pytest.raises(AssertionError, match="are read"):
        TrackReader(View(most, Call()), "odom").over(window)
