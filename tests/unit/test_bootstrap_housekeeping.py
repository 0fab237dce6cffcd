from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_housekeeper, build_reader
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S, WallClock
from ros2_memory.recorder.background import Background
from tests.support.bags import odom, write_mcap
from tests.support.housekeepers import files_in

if TYPE_CHECKING:
    from pathlib import Path


def kept(bag_dir: Path, *overrides: str) -> list[str]:
    """What is left of five bags, one of every hour, after the recorder's housekeeper was there."""
    now = WallClock().now()
    for ago in range(5):
        at = now - ago * 3600 * NS_PER_S - NS_PER_S
        write_mcap(bag_dir / "rec" / f"h{ago}.mcap", [odom(at - n, 1.0, 2.0) for n in range(9)])
    settings = load_settings(overrides, {"MEMORY_BAG_DIR": str(bag_dir)})
    keeper = build_housekeeper(
        settings, bag_dir, build_reader(settings), OwnRecordings(bag_dir), Background()
    )
    keeper.apply()
    keeper.wait()
    return files_in(bag_dir)


def test_the_budget_of_the_configuration_is_kept(tmp_path: Path) -> None:
    size = (
        2.5
        * write_mcap(tmp_path / "probe.mcap", [odom(n, 1.0, 2.0) for n in range(9)]).stat().st_size
    )
    left = kept(
        tmp_path / "bags", f"retention.max_total_gb={size / 1e9}", "retention.foreign=delete"
    )
    assert left == ["rec", "rec/h0.mcap", "rec/h1.mcap"]
