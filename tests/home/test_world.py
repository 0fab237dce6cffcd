"""The home robot's world is the same each time, and plain rosbags read its bags."""

from __future__ import annotations

from collections import Counter
from hashlib import sha256
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from tests.home.days import Scale
from tests.home.recording import write_world
from tests.home.world import World, world_of

pytestmark = pytest.mark.xdist_group("home")

SCALE = Scale()


def _world() -> World:
    return world_of(SCALE)


def _splits(folder: Path) -> list[Path]:
    """Returns the bags that were closed."""
    cut = max(each for each in _world().recordings if each.cut).name
    every = sorted((folder / "bags").rglob("*.mcap"))
    last = max(
        (each for each in every if each.parent.name == cut),
        key=lambda path: path.stat().st_mtime_ns,
    )
    return [each for each in every if each != last]


def _digest(folder: Path) -> str:
    whole = sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            whole.update(path.name.encode() + path.read_bytes())
    return whole.hexdigest()


def test_a_world_is_the_same_each_time_and_another_for_another_seed(tmp_path: Path) -> None:
    day = Scale(days=1)
    digests = []
    for nth, scale in enumerate((day, day, Scale(days=1, seed=8))):
        world_of.cache_clear()
        write_world(scale, tmp_path / str(nth))
        digests.append(_digest(tmp_path / str(nth)))
    assert digests[0] == digests[1] != digests[2]


def test_plain_rosbags_reads_every_closed_split_and_every_closed_recording(home: Path) -> None:
    counts: Counter[str] = Counter()
    closed = {each.name for each in _world().recordings if not each.cut}
    for path in _splits(home):
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counts[path.parent.name] += summary.statistics.message_count
        with Reader(path) as reader:
            assert "/tf_static" in {each.topic for each in reader.connections if each.msgcount}
            if path.parent.name not in closed:
                count = sum(1 for _ in reader.messages())
                assert count == summary.statistics.message_count
    for name in closed:
        with Reader(home / "bags" / name) as reader:
            count = sum(1 for _ in reader.messages())
            assert count == reader.message_count == counts[name] > 0
