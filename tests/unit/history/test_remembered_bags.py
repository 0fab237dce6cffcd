"""Bags that are not stored are decoded once, as long as they stay as they are."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from tests.support.bags import boolean, write_mcap
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from pathlib import Path


S = 10**9
T0 = 1_784_000_000 * S


def test_a_bag_that_changes_after_it_was_looked_up_is_not_taken_from_memory(
    tmp_path: Path,
) -> None:
    messages = [boolean(T0 + n * S, n == 5) for n in range(60)]
    path = write_mcap(tmp_path / "a" / "a_0.mcap", messages)
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
