"""A recorder on a small budget, with `memory.keep`: deleted splits are answered from memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.live_recorder import NS_PER_S, answer, answering, closed_files, machine
from tests.support.ros_processes import (
    RECORDERS,
    installation,
    publishing_robot,
    ros_environment,
)

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.real_recorder import RealRecorder


@pytest.fixture(params=RECORDERS)
def installed(request: pytest.FixtureRequest) -> RealRecorder | None:
    return installation(request)


def test_positions_of_deleted_splits_are_answered_from_memory(
    installed: RealRecorder | None, tmp_path: Path
) -> None:
    with (
        ros_environment(tmp_path, real=installed) as env,
        machine(tmp_path, env) as site,
        publishing_robot(env, tmp_path / "truth.json", "--topics", "/odom", "--hz", "50"),
    ):
        recorder = site.record(
            "year",
            "memory.keep=true",
            "recording.split_duration_s=2",
            "recording.session_duration_s=6",
            "retention.max_total_gb=0.0003",
            topics=["/odom"],
        )
        recorder.wait_for("memory_kept", 2)
        recorder.stop()
    assert sum(each["messages"] for each in recorder.events("memory_kept")) > 0
    reader = McapReader()
    paths = [path for path in closed_files(recorder.bag_dir) if not is_thinned(path)]
    left = [summary for summary in map(reader.summarize, paths) if not summary.empty]
    with answering(recorder.bag_dir, site.folder / "server.log") as served:
        earliest = answer(served, "data_time_range")["earliest"]
        assert (earliest + 1) * NS_PER_S < min(summary.start for summary in left)
        reply = answer(served, "get_position_at", timestamp=earliest + 1)
    assert (reply["from"], reply["resolution_s"]) == ("memory", 1)
    assert earliest <= reply["timestamp"] <= earliest + 1
