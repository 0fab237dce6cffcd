"""Figures of a memory, without a look at its bags."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import QuerySettings
from ros2_memory.observability.gauges import Measuring
from ros2_memory.retention.policy import RetentionLimits
from tests.support.bags import text, write_mcap
from tests.support.memories import SettableClock, memory_of

if TYPE_CHECKING:
    from pathlib import Path

T0 = 1_700_000_000 * NS_PER_S


def heartbeat(pid: int, updated: int) -> Heartbeat:
    return Heartbeat(
        pid=pid,
        updated=updated,
        state=RecorderState.PAUSED,
        recordings=(),
        since=T0,
        bytes_written=700,
        subscribed=("/a", "/b"),
        silent=("/b",),
        last_error=None,
        interval_s=2.0,
    )


def test_nothing_is_scanned_for_them(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [text(T0, "x")])
    memory = memory_of(tmp_path)
    measuring = Measuring(memory)
    assert measuring().index is None
    memory.index.refresh()
    first = measuring().index
    assert first is not None
    write_mcap(tmp_path / "b" / "b_0.mcap", [text(T0, "x")])
    (tmp_path / "broken.mcap").write_bytes(b"x" * 1000)
    again = measuring().index
    assert again is not None
    assert (first.bags, again.bags, again.damaged) == (1, 1, 0)
    memory.index.refresh()
    last = measuring().index
    assert last is not None
    assert (last.bags, last.kept_bytes > first.kept_bytes) == (2, True)


def test_they_tell_how_much_is_kept_and_how_old_the_newest_is(tmp_path: Path) -> None:
    path = tmp_path / "a" / "a_0.mcap"
    write_mcap(path, [text(T0, "x"), text(T0 + NS_PER_S, "y")])
    clock = SettableClock(time.time_ns() + 3600 * NS_PER_S)
    kept = RetentionLimits(max_total_bytes=5000, max_age_ns=NS_PER_S, min_free_bytes=0)
    memory = memory_of(tmp_path, clock=clock, limits=QuerySettings(kept=kept))
    memory.index.refresh()
    scanned, clock.at = clock.at, clock.at + 4 * NS_PER_S
    found = Measuring(memory)()
    assert found.budget_bytes == 5000
    assert found.recorder is None
    assert found.index is not None
    assert found.index.kept_bytes == path.stat().st_size
    assert found.index.age_s == 4.0
    assert found.index.newest_age_s == (scanned - T0) / NS_PER_S + 3


def test_an_empty_memory_has_no_age_and_without_a_recorder_there_is_no_budget(
    tmp_path: Path,
) -> None:
    memory = memory_of(tmp_path)
    memory.index.refresh()
    found = Measuring(memory)()
    assert found.index is not None
    assert (found.index.bags, found.index.newest_age_s, found.budget_bytes) == (0, None, None)


def test_they_tell_what_the_recorder_says_and_whether_it_is_another_one(tmp_path: Path) -> None:
    clock = SettableClock(T0 + 9 * NS_PER_S)
    measuring = Measuring(memory_of(tmp_path, clock=clock))
    write_heartbeat(tmp_path, heartbeat(7, T0 + 5 * NS_PER_S))
    told = measuring().recorder
    assert told is not None
    assert (told.state, told.live, told.heartbeat_age_s) == (RecorderState.PAUSED, True, 4.0)
    assert (told.written_bytes, told.silent_topics, told.restarts) == (700, 1, 0)
    assert told.since == T0 / NS_PER_S
    for pid, restarts in ((7, 0), (8, 1), (8, 1), (9, 2)):
        write_heartbeat(tmp_path, replace(heartbeat(pid, T0), interval_s=2.0))
        again = measuring().recorder
        assert again is not None
        assert again.restarts == restarts
    clock.at += 3600 * NS_PER_S
    late = measuring().recorder
    assert late is not None
    assert not late.live
