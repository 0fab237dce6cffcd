"""The sixty questions when the first day's bags are gone, and its thinned day is there."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import utc_day
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_memory, build_reader
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.memory.days import MemoryDays, MemoryLimits
from ros2_memory.storage.mcap.writer import McapWriter
from tests.home import asking
from tests.home.days import Scale
from tests.home.questions import questions
from tests.support.memories import shipped_extractor

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.xdist_group("home"), pytest.mark.usefixtures("in_utc")]

SCALE = Scale()
OF_BAGS = {"crash"}
"""Asks how many recordings a crash left open: that is of the bags, which are gone."""


@pytest.mark.parametrize("age_d", [1, 40])
def test_questions_are_answered_alike_when_the_first_day_is_thinned(
    home: Path, tmp_path: Path, age_d: int
) -> None:
    world = tmp_path / "world"
    shutil.copytree(home, world)
    settings = asking.settings_for(world, SCALE.split_s)
    snapshot = build_memory(settings).index.refresh()
    first = utc_day(snapshot.bags[0].start)
    going = {bag.file: bag.path for bag in snapshot.bags if utc_day(bag.start) == first}
    bag_dir = world / "bags"
    (bag_dir / ".episodic").mkdir()
    days = MemoryDays(
        bag_dir,
        BagDirReader(build_reader(settings)),
        McapWriter(),
        OwnRecordings(bag_dir),
        shipped_extractor(),
        limits=MemoryLimits(texts=("*",), labels=("person",)),
        static_topics=("/tf_static",),
    )
    days.keep(snapshot, going)
    size = sum(path.stat().st_size for path in going.values())
    for path in going.values():
        path.unlink()
    assert (bag_dir / "memory" / f"{first}.thinned.mcap").stat().st_size < size / 20
    # After a month numbers stay once a minute; then nothing changes for a year.
    days.limit(snapshot.bags[0].start + age_d * 86_400 * NS_PER_S)
    outcomes = asking.ask_all(asking.server_over(settings), questions(SCALE))
    missed = {each.question.id: each.why for each in outcomes if each.result != asking.RIGHT}
    assert missed.keys() <= OF_BAGS, missed
    assert len(outcomes) == 60
