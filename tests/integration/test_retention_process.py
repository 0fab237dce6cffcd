"""Retention while a recorder records and questions are asked.

20 splits; EPISODIC_LONG=1 makes it 200.
"""

import json
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType
from mcp import Client

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.bag_dir.state_files import LEAVING, Leaving
from ros2_memory.core.timebase import NS_PER_S, WallClock
from ros2_memory.history.context import Memory, QuerySettings
from tests.integration.test_recorder_daemon import sited
from tests.support.bags import (
    McapLayout,
    along_x,
    mcap_content,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.examples import LONG
from tests.support.heartbeats import beat
from tests.support.housekeepers import keeper_of, own_all, size_of, state
from tests.support.live_recorder import answer, answering
from tests.support.memories import asked, memory_of
from tests.support.processes import until
from tests.support.robot_run import ask_everything, write_run
from tests.support.served import serving

SPLIT = 10 * NS_PER_S
DOCK = "/docked"
LAYOUT = McapLayout(
    chunk_size=4096,
    compression=CompressionType.ZSTD,
    latched=frozenset({"/tf_static", DOCK}),
)
SPLITS = 200 if LONG else 20
SPLITS_IN_RECORDING = 5
KEPT_SPLITS = 6
SLACK = 8192
"""Bytes of the heartbeat, of metadata and of carried messages that are about to be counted."""
QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("list_recorded_topics", {}),
    ("data_time_range", {}),
    ("get_position_seconds_ago", {"seconds_ago": 40}),
    ("get_topic_in_last", {"topic": "/odom", "seconds": 60}),
    ("recent_trajectory_summary", {"seconds": 100}),
    ("find_last_match", {"topic": "/chatter", "condition_type": "contains", "value": "no such"}),
    ("list_frames", {}),
]


def content_of(begin: int, nth: int) -> bytes:
    """Ten seconds of odometry, one metre a second, and a word a second.

    What is latched is published once, and received again by each recording.
    """
    start = begin + nth * SPLIT
    times = [start + 10 + n * NS_PER_S // 5 for n in range(50)]
    messages = [odom(at, (at - begin) / NS_PER_S, 0.0, vx=1.0) for at in times]
    messages += [text(start + 20 + n * NS_PER_S, f"word {n}") for n in range(10)]
    if nth % SPLITS_IN_RECORDING == 0:
        fixed = transform(begin, "base_link", "laser", (1, 0, 2))
        messages.append(replace(text(begin, "home", DOCK), log_time=start + 1, publish_time=begin))
        messages.append(tf(begin, fixed, topic="/tf_static", log_time=start + 2))
    return mcap_content(messages, LAYOUT)


def splits_of(bag_dir: Path, begin: int) -> Iterator[Path]:
    """Writes splits that are dated from `begin` on; yields the newest, which is open."""
    path: Path | None = None
    rest = b""
    for nth in range(SPLITS):
        content = content_of(begin, nth)
        # It reaches the disk in two parts, as a recorder's does.
        cut = len(content) * 6 // 10
        name = f"rec_{nth // SPLITS_IN_RECORDING:04d}"
        beat(bag_dir, WallClock().now(), recordings=(name,), interval_s=3600.0)
        before, path = path, bag_dir / name / f"{name}_{nth}.mcap"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content[:cut])
        if before:
            with before.open("ab") as stream:
                stream.write(rest)
            if before.parent != path.parent:
                metadata = before.with_name("metadata.yaml")
                metadata.write_text("rosbag2_bagfile_information: {}\n")
        rest = content[cut:]
        yield path


def ask_on(memory: Memory, begin: int, rounds: list[int], over: threading.Event) -> None:
    """Asks everything again and again; what is latched is known whatever was deleted."""
    while not over.is_set():
        for tool, given in QUESTIONS:
            reply = asked(memory, tool, **given)
            if isinstance(reply, dict):
                assert reply.get("error", "no_data") == "no_data", reply
        docked = asked(memory, "get_topic_seconds_ago", topic=DOCK, seconds_ago=0)
        assert docked["value"] == {"value": "home"}
        assert docked["timestamp"] == pytest.approx(begin / NS_PER_S, abs=1e-5, rel=0)
        frames = {"parent": "base_link", "child": "laser"}
        placed = asked(memory, "get_transform_seconds_ago", **frames, seconds_ago=0)
        assert [placed["translation"][axis] for axis in "xyz"] == [1, 0, 2]
        rounds.append(len(rounds))


def test_the_budget_is_held_while_it_is_recorded_and_asked(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    bag_dir.mkdir()
    begin = WallClock().now() - (SPLITS + 10) * SPLIT
    limits = QuerySettings(now="latest", split_duration_s=10.0)
    memory = memory_of(bag_dir, clock=WallClock(), limits=limits)
    opened, writer = list[Path](), splits_of(bag_dir, begin)
    opened += [next(writer), next(writer)]
    split = max(len(content_of(begin, nth)) for nth in range(2))
    budget, rounds, over = KEPT_SPLITS * split, list[int](), threading.Event()
    keeper = keeper_of(
        bag_dir,
        max_bytes=budget,
        clock=WallClock(),
        grace_s=2.0,
        monotonic=lambda: float(len(rounds)),
    )
    with ThreadPoolExecutor() as pool:
        asking = pool.submit(ask_on, memory, begin, rounds, over)
        try:
            for path in writer:
                opened.append(path)
                assert size_of(bag_dir) <= budget + split + SLACK
                keeper.apply()
                assert size_of(bag_dir) <= budget + SLACK
                # Every question is asked once more, by what is there at this moment.
                enough = len(rounds) + 2
                until(lambda: asking.done() or len(rounds) >= enough)  # noqa: B023 - at once
        finally:
            over.set()
        asking.result()
    left = sorted(path for path in bag_dir.rglob("*.mcap") if not is_carried(path))
    assert KEPT_SPLITS - 2 <= len(left) < SPLITS // 2
    assert left[-1] == opened[-1]
    assert {path.parent for path in left} == {*bag_dir.glob("rec_*")}


def age_held(bag_dir: Path) -> str | None:
    heartbeat = read_heartbeat(bag_dir).heartbeat
    assert heartbeat is not None
    return heartbeat.age_held


def test_a_clock_that_stepped_forward_deletes_nothing_before_it_is_synchronised(
    tmp_path: Path,
) -> None:
    """As the recorder finds it after a step of 150 h: its bags of a week look older than that."""
    with sited(tmp_path) as site:
        site.synchronised.write_text("no\n")
        now = WallClock().now()
        kept = [
            write_mcap(
                site.bag_dir / f"rec_20260101T{n:06}Z" / "0.mcap",
                [
                    odom(now - (149 + 2 * n) * 3600 * NS_PER_S + each, 1.0, 2.0)
                    for each in range(20)
                ],
            )
            for n in range(1, 20)
        ]
        daemon = site.run("retention.max_age_h=168", "retention.foreign=delete")
        (held,) = daemon.wait_for("age_held")
        assert held["bags"] == 10
        until(lambda: age_held(site.bag_dir) == held["reason"])
        with serving(site.bag_dir, site.folder / "server") as served:
            assert answer(served, "memory_status")["notes"] == [held["reason"]]
            assert json.loads(served.get("/health")[1])["recorder"]["age_held"] == held["reason"]
        assert all(path.exists() for path in kept)
        recorded = {path.name for path in daemon.recordings()} - {path.parent.name for path in kept}
        assert max(recorded) in (site.bag_dir / ".episodic/recorded.jsonl").read_text()

        site.synchronised.write_text("yes\n")
        daemon.wait_for("age_no_longer_held")
        assert [path.exists() for path in kept] == [True] * 9 + [False] * 10
        until(lambda: age_held(site.bag_dir) is None)
        daemon.stop()


@contextmanager
def read_only(folder: Path, at: Path) -> Iterator[None]:
    """The folder mounted so that nobody can write, which rights alone do not do for root."""
    at.mkdir()
    mount = f"mount --bind {folder} {at} && mount -o remount,ro,bind {at}"
    try:
        if subprocess.run(["sh", "-c", mount], capture_output=True, check=False).returncode:
            pytest.skip("no read-only mount can be made here")
        yield
    finally:
        subprocess.run(["umount", at], capture_output=True, check=False)


async def test_bags_on_a_read_only_mount_are_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_run(tmp_path / "bags")
    before = state(tmp_path / "bags")
    mount = tmp_path / "mount"
    with read_only(tmp_path / "bags", mount):
        with pytest.raises(OSError, match="Read-only"):
            (mount / "probe").write_text("x")
        with serving(mount, tmp_path / "log", "recorder=none") as served:
            async with Client(served.url("/mcp")) as client:
                await ask_everything(client)
    assert state(tmp_path / "bags") == before


def test_days_are_kept_by_the_recorder_and_go_with_the_setting(tmp_path: Path) -> None:
    two_days_ago = WallClock().now() - 48 * 3600 * NS_PER_S
    with sited(tmp_path) as site:
        for number in range(3):
            start = two_days_ago + number * 10 * NS_PER_S
            poses = along_x(start, 10, mps=0.25, hz=100)
            write_mcap(site.bag_dir / "rec_old" / f"rec_old_{number}.mcap", poses)
        own_all(site.bag_dir)
        keeping = site.run("memory.keep=true", "retention.max_total_gb=0.0005")
        keeping.wait_for("memory_kept")
        until(lambda: not [*site.bag_dir.glob("rec_old/*.mcap")])
        keeping.stop()
        days = [*site.bag_dir.glob("memory/*.thinned.mcap")]
        assert days
        with answering(site.bag_dir, tmp_path / "served") as served:
            asked = two_days_ago / NS_PER_S + 5
            reply = answer(served, "get_position_at", timestamp=asked)
        assert reply["from"] == "memory"
        # One pose a second stayed: the newest until then, in whole microseconds.
        assert asked - 1.01 <= reply["timestamp"] <= asked + 1e-6
        moved_s = reply["timestamp"] - two_days_ago / NS_PER_S
        assert reply["x"] == pytest.approx(moved_s / 4, abs=0.005)
        leaving = site.run()
        [said] = leaving.wait_for("memory_leaves")
        leaving.stop()
        assert (said["days"], said["left_s"]) == (len(days), 86_400)
        assert [*site.bag_dir.glob("memory/*.thinned.mcap")] == days
        LEAVING.write(site.bag_dir, Leaving(0.0))  # the recorder has run for a day
        again = site.run()
        [deleted] = again.wait_for("memory_deleted")
        assert deleted["days"] == len(days)
        assert not [*site.bag_dir.glob("memory/*")]
