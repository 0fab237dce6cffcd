"""What detectors saw, ten minutes after the other: however it is cut, and stored once."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.columns import scan
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.sights import joined
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import View
from ros2_memory.things import placing
from ros2_memory.things.find import find_things
from ros2_memory.things.seen import SIGHTS_NS, Watching
from tests.support.bags import McapLayout, text, write_mcap, write_splits
from tests.support.column_worlds import EVERYTHING, World
from tests.unit.things.test_find import BEGIN, HERE, looked

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.results import Thing

APART_S = SIGHTS_NS // 10**9


def things_in(memory: Memory) -> tuple[Thing, ...]:
    return find_things(memory, Call()).things


def test_a_latched_text_that_each_recording_received_hinders_no_storing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "STRETCH_NS", 14_400 * 10**9)
    layout = McapLayout(latched=frozenset({"/tf_static", "/robot_description"}))
    for nth in range(3):
        messages = looked(nth * APART_S, nth * APART_S + 60, HERE, ("mug", 3.0, 0.5))
        said = text(messages[0].log_time, "<robot/>", "/robot_description")
        said = replace(said, publish_time=BEGIN * 10**9)
        write_mcap(tmp_path / f"rec_{nth}" / f"rec_{nth}_0.mcap", [said, *messages], layout)
    plain = things_in(World.of(tmp_path).memory)
    world = World.of(tmp_path)
    world.fill()
    assert world.memory.scanner is not None
    assert [*Watching(View(world.memory, Call())).made(EVERYTHING)]
    world.memory.scanner.write_fragments()
    assert [thing.label for thing in plain] == ["mug"]
    monkeypatch.delattr(placing, "sights_of")
    another = replace(world.memory, scanner=Scanner(world.store, tmp_path))
    assert things_in(another) == plain


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
