"""What is settled of a run is not asked for again; what is not, is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.catalogue import FILE, FOLDER
from tests.bags import odom, write_mcap
from tests.memories import memory_of
from tests.recalled import recalling

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.memory import Memory
    from ros2_memory.recorder.timeline import Run

T0 = 1_700_000_000 * 10**9


def recorded(bag_dir: Path, bags: int = 2) -> tuple[Memory, Run]:
    for n in range(bags):
        write_mcap(bag_dir / "rec" / f"rec_{n}.mcap", [odom(T0 + n, 0.0, 0.0)])
    memory = memory_of(bag_dir)
    [run] = memory.index.snapshot().runs
    return memory, run


def test_a_run_of_which_every_bag_has_an_entry_is_settled_once_it_was_looked_at(
    tmp_path: Path,
) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path).recall
    assert recall is not None
    notes = recall.notes(run, recall.as_of())
    assert len(notes.numbers) == 2
    assert recall.settled(run) is notes


def test_a_run_with_a_bag_without_an_entry_is_not_settled(tmp_path: Path) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path, part=0.5).recall
    assert recall is not None
    assert len(recall.notes(run, recall.as_of()).numbers) == 1
    assert recall.settled(run) is None


def test_what_a_catalogue_said_that_is_no_more_does_not_settle_anything(tmp_path: Path) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path).recall
    assert recall is not None
    recall.notes(run, recall.as_of())
    (tmp_path / FOLDER / FILE).unlink()
    recall.catalogue.look_after()
    recall.as_of()
    assert recall.settled(run) is None
    assert not recall.notes(run, recall.as_of()).numbers
