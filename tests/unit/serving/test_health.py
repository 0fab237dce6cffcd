import json
import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import anyio
import anyio.from_thread
import anyio.lowlevel
import pytest
from structlog.testing import capture_logs

from ros2_memory import package_version
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.serving.health import NAMED, Health, keep_fresh
from tests.support.bags import McapLayout, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat
from tests.support.memories import memory_of

T0 = 1_784_023_200 * NS_PER_S


def memory_at(bag_dir: Path, *, seconds: int = 0) -> Memory:
    return memory_of(bag_dir, clock=SettableClock(T0 + seconds * NS_PER_S))


async def test_an_empty_memory_is_healthy_and_a_live_recorder_is_shown(tmp_path: Path) -> None:
    health = Health(memory_at(tmp_path, seconds=3))
    assert await health() == {
        "status": "ok",
        "version": package_version(),
        "pid": os.getpid(),
        "bags": 0,
        "earliest": None,
        "latest": None,
        "active": 0,
        "damaged": 0,
        "incomplete": 0,
        "unread": 0,
        "clock_faults": 0,
        "gaps_last_hour": {"count": 0, "seconds": 0.0},
        "index_age_s": 0.0,
    }
    beat(tmp_path, T0, RecorderState.RECORDING, restarts=2, silent=("/b",), missing=("/c",))
    reply = await health()
    assert reply["status"] == "ok"
    assert reply["recorder"] == {
        "state": "recording",
        "live": True,
        "heartbeat_age_s": 3.0,
        "restarts": 2,
        "silent_topics": ["/b"],
        "missing_topics": ["/c"],
        "last_error": None,
        "last_error_at": None,
        "recovered": False,
        "waiting_for": None,
        "age_held": None,
        "unshipped": None,
        "failing_rules": [],
        "required_missing": [],
        "degraded": [],
    }


async def test_everything_that_does_not_answer_is_counted_and_the_last_of_it_named(
    tmp_path: Path,
) -> None:
    write_mcap(tmp_path / "r" / "r_0.mcap", [text(T0, "a")])
    write_mcap(tmp_path / "cut" / "cut_0.mcap", [text(T0, "a")], McapLayout(None, finish=False))
    (tmp_path / "r" / "r_1.db3").write_bytes(b"of another storage")
    for number in range(5):
        write_mcap(tmp_path / "boot" / f"boot_{number}.mcap", [text(number, "a")])
    reply = await Health(memory_of(tmp_path))()
    assert reply["status"] == "ok"
    counts = {what: reply[what] for what in ("damaged", "incomplete", "unread", "clock_faults")}
    assert counts == {"damaged": 0, "incomplete": 1, "unread": 1, "clock_faults": 5}
    assert reply["earliest"] == T0 / NS_PER_S
    lists = [reply[name] for name in ("incomplete_files", "unread_files", "clock_fault_files")]
    assert [len(each) for each in lists if isinstance(each, list)] == [1, 1, NAMED]


async def test_a_clock_that_stands_before_all_bags_is_a_problem(tmp_path: Path) -> None:
    write_mcap(tmp_path / "r" / "r_0.mcap", [text(T0, "a")])
    reply = await Health(memory_at(tmp_path, seconds=-3600))()
    assert reply["problems"] == [
        "every bag is dated after now: the clock of this machine is behind, or theirs ahead"
    ]


async def test_a_machine_that_booted_without_its_time_says_so_until_it_has_it(
    tmp_path: Path,
) -> None:
    write_mcap(tmp_path / "r" / "r_0.mcap", [text(T0, "a")])
    write_mcap(tmp_path / "boot" / "boot_0.mcap", [text(95 * NS_PER_S, "a")])
    booted = await Health(memory_at(tmp_path, seconds=100 - T0 // NS_PER_S))()
    assert booted["problems"] == [
        "the clock of this machine is not set: bags are dated years after now"
    ]
    assert booted["latest"] == T0 / NS_PER_S
    assert (await Health(memory_at(tmp_path, seconds=3))())["status"] == "ok"


@pytest.mark.parametrize(
    ("state", "seconds", "problems"),
    [
        (RecorderState.RECORDING, 600, ["the recorder died"]),
        (RecorderState.PAUSED, 1, ["the recorder is paused: disk full"]),
        (RecorderState.STARTING, 1, ["the recorder does not record yet: disk full"]),
        (RecorderState.STOPPED, 600, None),
    ],
)
async def test_a_recorder_that_does_not_record_degrades_it_unless_it_was_stopped(
    tmp_path: Path, state: RecorderState, seconds: int, problems: list[str] | None
) -> None:
    beat(tmp_path, T0, state, last_error="disk full")
    reply = await Health(memory_at(tmp_path, seconds=seconds))()
    assert reply["status"] == ("degraded" if problems else "ok")
    assert reply.get("problems") == problems


@patch("ros2_memory.serving.health.TIMEOUT_S", 0.001)
async def test_a_disk_that_hangs_costs_one_thread_however_often_it_is_asked(tmp_path: Path) -> None:
    released = threading.Event()
    looks: list[int] = []

    class Hanging(IndexManager):
        def snapshot(self, reach: int | None = None) -> Snapshot:
            looks.append(threading.get_ident())
            released.wait(10)
            return super().snapshot(reach)

    memory = memory_at(tmp_path)
    index = Hanging(tmp_path, memory.reader, memory.clock, refresh_s=5.0, split_duration_s=10.0)
    health = Health(replace(memory, index=index))
    before = threading.active_count()
    reply = [await health() for _ in range(10)]
    during = threading.active_count()
    released.set()
    health.stop()
    assert {str(each["status"]) for each in reply} == {"degraded"}
    assert during <= before + 1
    assert len(looks) <= 1


async def test_a_scan_that_fails_is_logged_and_tried_again(tmp_path: Path) -> None:
    calls: list[int] = []
    again = anyio.Event()

    class Failing(IndexManager):
        def refresh(self) -> Snapshot:
            calls.append(1)
            if len(calls) == 2:
                anyio.from_thread.run_sync(again.set)
            raise RuntimeError("no such disk")

    memory = memory_at(tmp_path)
    failing = Failing(tmp_path, memory.reader, memory.clock, refresh_s=5.0, split_duration_s=10.0)
    with capture_logs() as logs:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_fresh, replace(memory, index=failing), 0.001)
            await again.wait()
            tasks.cancel_scope.cancel()
    # A thread of another test may log beside it.
    assert "index_refresh_failed" in {line["event"] for line in logs}


async def test_what_it_says_is_bounded_however_much_is_amiss(tmp_path: Path) -> None:
    for number in range(50):
        (tmp_path / f"{'x' * 200}{number}.mcap").write_bytes(b"no bag at all, but not empty")
    names = tuple(f"/topic_{n}/{'y' * 300}" for n in range(1000))
    beat(
        tmp_path,
        T0 + 3600 * NS_PER_S,
        RecorderState.PAUSED,
        last_error="z" * 100_000,
        silent=names,
        subscribed=names,
        missing=names,
        unheard=names[:5],
        required_missing=names[:7],
    )
    said: Any = await Health(memory_at(tmp_path, seconds=3600))()
    assert len(json.dumps(said)) < 14_000
    assert (said["status"], said["damaged"]) == ("degraded", 50)
    assert said["problems"][0] == "50 damaged bag files; data_time_range lists them"
    damaged = said["damaged_files"][0]
    assert damaged["file"].startswith(f"{tmp_path.name}/xx")
    assert damaged["reason"] == "not an MCAP file: it does not begin as one"
    assert said["recorder"]["more_silent_topics"] == 980
    assert said["recorder"]["more_missing_topics"] == 994


async def test_topics_that_are_offered_and_not_recorded_degrade_it(tmp_path: Path) -> None:
    beat(
        tmp_path,
        T0,
        RecorderState.RECORDING,
        unknown_types=("/arm",),
        unheard=("/scan",),
        fell_silent=("/odom",),
        required_missing=("/odom: it came regularly, and is silent",),
        advice="look at the users",
    )
    report: Any = await Health(memory_at(tmp_path))()
    assert report["status"] == "degraded"
    assert report["problems"] == [
        "required, and not recorded: /odom: it came regularly, and is silent",
        "not recorded, since ros2 bag record does not know the type, or knows several: /arm",
        "offered for 30 s, and no message has come: /scan; look at the users",
        "regular until now, and silent: /odom",
    ]
    assert len(report["recorder"]["degraded"]) == 3
