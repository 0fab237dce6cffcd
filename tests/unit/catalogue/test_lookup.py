"""Complete digests of a segment are not looked up again; incomplete ones are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.catalogue.store import FILE, FOLDER
from ros2_memory.columns.store import BagKey
from ros2_memory.index.segment import Segment
from tests.support.bags import odom, write_mcap
from tests.support.memories import memory_of, recalling

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.history.context import Memory

T0 = 1_700_000_000 * 10**9


def recorded(bag_dir: Path, bags: int = 2) -> tuple[Memory, Segment]:
    for n in range(bags):
        write_mcap(bag_dir / "rec" / f"rec_{n}.mcap", [odom(T0 + n, 0.0, 0.0)])
    memory = memory_of(bag_dir)
    [run] = memory.index.snapshot().timeline.segments
    return memory, run


def test_a_segment_whose_bags_all_have_an_entry_is_complete_after_the_first_look(
    tmp_path: Path,
) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path).recall
    assert recall is not None
    notes = recall.digests_for(run, recall.catalogue.newest())
    assert len(notes.numbers) == 2
    assert recall.complete_digests(run) is notes


def test_bags_that_the_catalogue_restored_are_not_looked_up_by_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path).recall
    assert recall is not None
    catalogue = recall.catalogue
    found = recall.digests_for(run, catalogue.newest()).numbers
    restored = Segment([*catalogue.known_files(tmp_path).values()])
    with monkeypatch.context() as patched:
        patched.setattr(catalogue, "find", None)
        assert recall.digests_for(restored, catalogue.newest()).numbers == found
    # Another program digests a bag again.
    catalogue.forget([BagKey.of(run.bags[0], tmp_path).path])
    recalling(memory, tmp_path)
    again = recall.looked_up_again(restored, catalogue.newest())
    assert again.whole
    assert again.numbers[run.bags[0].file] == catalogue.newest()


def test_a_segment_with_a_bag_without_an_entry_is_not_complete(tmp_path: Path) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path, part=0.5).recall
    assert recall is not None
    assert len(recall.digests_for(run, recall.catalogue.newest()).numbers) == 1
    assert recall.complete_digests(run) is None


def test_digests_of_a_catalogue_that_was_lost_are_not_complete(tmp_path: Path) -> None:
    memory, run = recorded(tmp_path)
    recall = recalling(memory, tmp_path).recall
    assert recall is not None
    recall.digests_for(run, recall.catalogue.newest())
    (tmp_path / FOLDER / FILE).unlink()
    recall.catalogue.look_after()
    recall.catalogue.newest()
    assert recall.complete_digests(run) is None
    assert not recall.digests_for(run, recall.catalogue.newest()).numbers
