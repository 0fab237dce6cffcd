"""Bags that are not stored are decoded once, as long as they stay as they are."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, boolean, write_mcap
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.storage.base import Batch

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S


class CountingReader(McapReader):
    """Counts how often messages of a bag are read at once."""

    def __init__(self) -> None:
        super().__init__()
        self.decoded = 0

    def batches(
        self,
        path: Path,
        topics: Collection[str],
        window: TimeWindow,
        *,
        bare: Collection[str] = (),
    ) -> Iterator[Batch]:
        self.decoded += 1
        return super().batches(path, topics, window, bare=bare)


def write(path: Path, pressed: Collection[int], *, chunk_size: int = 768 * 1024) -> Path:
    messages = [boolean(T0 + n * S, n in pressed) for n in range(60)]
    return write_mcap(path, messages, McapLayout(chunk_size=chunk_size))


def pressed_in(memory: Memory, bag_dir: Path, start_s: int = T0_S) -> Any:
    return asked(
        memory,
        bag_dir,
        "find_matches",
        topic="/bumper",
        condition_type="equals",
        value=True,
        start=start_s,
        end=T0_S + 60,
    )


def test_a_bag_that_is_not_stored_is_decoded_once(tmp_path: Path) -> None:
    write(tmp_path / "a" / "a_0.mcap", {5})
    reader = CountingReader()
    memory = memory_of(tmp_path, reader=reader)
    first = pressed_in(memory, tmp_path)
    decoded = reader.decoded
    assert decoded > 0
    assert pressed_in(memory, tmp_path) == first
    assert reader.decoded == decoded


def test_a_bag_that_changed_is_read_again(tmp_path: Path) -> None:
    path = write(tmp_path / "a" / "a_0.mcap", {5})
    memory = memory_of(tmp_path)
    [match] = pressed_in(memory, tmp_path)["sightings"]
    assert match["first_seen"] == T0_S + 5
    size = path.stat().st_size
    write(path, {7})
    assert path.stat().st_size == size
    [match] = pressed_in(memory, tmp_path)["sightings"]
    assert match["first_seen"] == T0_S + 7


def test_a_bag_that_changes_after_it_was_looked_up_is_not_taken_from_memory(
    tmp_path: Path,
) -> None:
    path = write(tmp_path / "a" / "a_0.mcap", {5})
    memory = memory_of(tmp_path)

    def times(view: View) -> list[int]:
        return [
            int(at) for rows in scan(view, "/bumper", TimeWindow.everything()) for at in rows.times
        ]

    assert len(times(View(memory, Call()))) == 60
    shorter, deleted = View(memory, Call()), View(memory, Call())
    changed = path.stat().st_mtime_ns + S
    write_mcap(path, [boolean(T0, True)])
    os.utime(path, ns=(changed, changed))
    assert times(shorter) == [T0]
    path.unlink()
    assert times(deleted) == []
    assert "a/a_0.mcap was deleted before it could be read" in deleted.notes.sentences()[0]


def test_what_is_lost_of_a_bag_is_noted_in_each_answer(tmp_path: Path) -> None:
    spoil_chunk(write(tmp_path / "a" / "a_0.mcap", {5, 50}, chunk_size=500), 1)
    memory = memory_of(tmp_path)
    # Behind what is lost, which says nothing of it, and then from the begin, twice.
    assert "could not be read whole" not in str(pressed_in(memory, tmp_path, T0_S + 45))
    first = pressed_in(memory, tmp_path)
    assert "a/a_0.mcap could not be read whole" in str(first["notes"])
    assert pressed_in(memory, tmp_path) == first
