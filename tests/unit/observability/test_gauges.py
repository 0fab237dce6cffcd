"""Gauges of a memory, measured without a look at its bags."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import QuerySettings
from ros2_memory.retention.policy import RetentionLimits
from tests.support.bags import text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("prometheus_client", reason="needs the extra observability")

from ros2_memory.observability.prometheus import MemoryGauges

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


def measured(gauges: MemoryGauges) -> dict[str, float]:
    """The values of this moment, by name and label."""
    return {
        " ".join((sample.name.removeprefix("ros2_memory_"), *sample.labels.values())): sample.value
        for family in gauges()
        for sample in family.samples
    }


def test_the_bag_directory_is_not_scanned_for_them(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [text(T0, "x")])
    memory = memory_of(tmp_path)
    gauges = MemoryGauges(memory)
    assert measured(gauges) == {}
    memory.index.refresh()
    first = measured(gauges)
    write_mcap(tmp_path / "b" / "b_0.mcap", [text(T0, "x")])
    (tmp_path / "broken.mcap").write_bytes(b"x" * 1000)
    again = measured(gauges)
    assert (first["bags"], again["bags"], again["files_set_aside damaged"]) == (1, 1, 0)
    memory.index.refresh()
    last = measured(gauges)
    assert (last["bags"], last["kept_bytes"] > first["kept_bytes"]) == (2, True)
    aside = [last[f"files_set_aside {state}"] for state in ("active", "damaged", "unread")]
    assert aside == [0, 1, 0]


def test_they_show_how_much_is_kept_and_how_old_the_newest_is(tmp_path: Path) -> None:
    path = tmp_path / "a" / "a_0.mcap"
    write_mcap(path, [text(T0, "x"), text(T0 + NS_PER_S, "y")])
    clock = SettableClock(time.time_ns() + 3600 * NS_PER_S)
    kept = RetentionLimits(max_total_bytes=5000, max_age_ns=NS_PER_S, min_free_bytes=0)
    memory = memory_of(tmp_path, clock=clock, limits=QuerySettings(kept=kept))
    memory.index.refresh()
    scanned, clock.at = clock.at, clock.at + 4 * NS_PER_S
    found = measured(MemoryGauges(memory))
    assert found["budget_bytes"] == 5000
    assert not any(name.startswith("recorder") for name in found)
    assert found["kept_bytes"] == path.stat().st_size
    assert found["index_age_seconds"] == 4.0
    assert found["newest_data_age_seconds"] == (scanned - T0) / NS_PER_S + 3


def test_they_show_what_the_recorder_reports_and_whether_it_is_another_one(tmp_path: Path) -> None:
    clock = SettableClock(T0 + 9 * NS_PER_S)
    gauges = MemoryGauges(memory_of(tmp_path, clock=clock))
    write_heartbeat(tmp_path, heartbeat(7, T0 + 5 * NS_PER_S))
    found = measured(gauges)
    states = {each: found[f"recorder_state {each}"] for each in RecorderState}
    assert [each for each, is_it in states.items() if is_it] == [RecorderState.PAUSED]
    assert (found["recorder_live"], found["recorder_heartbeat_age_seconds"]) == (1, 4.0)
    assert found["recorder_written_bytes_total"] == 700
    assert found["recorder_silent_topics"] == 1
    assert found["recorder_restarts_total"] == 0
    assert found["recorder_state_since_timestamp_seconds"] == T0 / NS_PER_S
    write_heartbeat(tmp_path, replace(heartbeat(7, T0 + 5 * NS_PER_S), lost={"/odom": 3}))
    assert measured(gauges)["recorder_lost_messages /odom"] == 3
    for pid, restarts in ((7, 0), (8, 1), (8, 1), (9, 2)):
        write_heartbeat(tmp_path, replace(heartbeat(pid, T0), interval_s=2.0))
        assert measured(gauges)["recorder_restarts_total"] == restarts
    clock.at += 3600 * NS_PER_S
    assert measured(gauges)["recorder_live"] == 0
