"""Bags that are not stored are decoded once, as long as they stay as they are."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from tests.support.bags import McapLayout, boolean, write_mcap
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path


S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S


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
