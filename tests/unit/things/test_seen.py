"""What detectors saw, ten minutes after the other: however it is cut, and stored once."""

from pathlib import Path

import pytest

from ros2_memory.columns.sights import joined
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from ros2_memory.things.seen import Watching
from tests.support.bags import write_splits
from tests.support.column_worlds import World
from tests.unit.things.test_find import HERE, looked


@pytest.mark.parametrize("apart_s", [0, 3 * 10**8])
def test_a_bag_of_odd_times_has_the_sights_of_its_messages_alone(
    tmp_path: Path, apart_s: int
) -> None:
    odd = [
        *looked(0, 10, HERE, ("mug", 3.0, 0.5)),
        *looked(apart_s + 20, apart_s + 30, HERE, ("cup", 2.0, 0.0)),
    ]
    write_splits(tmp_path, odd, split_s=10.0**10)
    stretches = [
        one
        for some in Watching(View(World.of(tmp_path).memory, Call())).newest_first()
        for one in some
    ]
    parts = [part.packed for stretch in stretches for part in stretch.sights]
    sections = [0 for stretch in stretches for _ in stretch.sights for _ in stretch.sessions]
    assert joined(parts, sections, sections).labels == ("cup", "mug")
