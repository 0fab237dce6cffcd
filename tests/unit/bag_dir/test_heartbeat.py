"""What the recorder says of itself, and how little of it is believed."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.heartbeat import (
    HEARTBEAT_FILE,
    Heartbeat,
    RecorderState,
    process_of,
    read_heartbeat,
    write_heartbeat,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from tests.faults.small_disk import filled, needs_mounts, small_disk

S = 10**9
NOW = 1_800_000_000 * S
BEAT = Heartbeat(
    pid=4711,
    updated=NOW,
    state=RecorderState.RECORDING,
    recordings=("rec_1", "day/rec_2"),
    since=NOW - 60 * S,
    bytes_written=123_456,
    subscribed=("/odom", "/tf"),
    silent=("/tf",),
    last_error=None,
    interval_s=2.0,
)

MOMENTS = st.integers(MIN_NS, MAX_NS)
COUNTS = st.integers(0, MAX_NS)
NAMES = st.lists(st.text()).map(tuple)
BEATS = st.builds(
    Heartbeat,
    pid=st.integers(1, 2**22),
    updated=MOMENTS,
    recordings=NAMES,
    since=MOMENTS,
    bytes_written=COUNTS,
    subscribed=NAMES,
    silent=NAMES,
    interval_s=st.floats(0.001, 3600),
    restarts=COUNTS,
    missing=NAMES,
    age_held=st.none() | st.text(),
)


def test_that_of_an_older_recorder_is_read(tmp_path: Path) -> None:
    write_heartbeat(tmp_path, replace(BEAT, restarts=3, missing=("/gone",), age_held="2 bags"))
    content = json.loads((tmp_path / HEARTBEAT_FILE).read_text()) | {"mood": "fine"}
    assert (content.pop("restarts"), content.pop("missing")) == (3, ["/gone"])
    assert content.pop("age_held") == "2 bags"
    (tmp_path / HEARTBEAT_FILE).write_text(json.dumps(content))
    assert read_heartbeat(tmp_path) == (BEAT, None)


@given(beat=BEATS)
def test_what_was_written_is_read(
    beat: Heartbeat, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("bags")
    write_heartbeat(folder, beat)
    assert read_heartbeat(folder) == (beat, None)


def test_a_recorder_that_was_killed_is_not_live_any_more() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        beat = replace(BEAT, pid=process.pid, process=process_of(process.pid))
        assert beat.process is not None
        assert beat.is_live(NOW + 10 * S)
        assert not beat.is_live(NOW + 20 * S)
        # Another process may have the number by now, or the system was started again.
        assert not replace(beat, process=f"{beat.process}1").is_live(NOW)
        assert replace(beat, process=f"0{beat.process}1").is_live(NOW)
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not beat.is_live(NOW)
    assert not beat.is_live(NOW)
    assert process_of(process.pid) is None


@given(
    content=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(BEAT.__slots__), inner),
    )
)
def test_any_json_is_read_without_a_crash(
    content: object, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("bags")
    (folder / HEARTBEAT_FILE).write_text(json.dumps(content), encoding="utf-8")
    heartbeat, reason = read_heartbeat(folder)
    assert (heartbeat is None) == (reason is not None)


@pytest.mark.parametrize(
    ("interval_s", "away_s", "live"),
    [(2.0, 15, True), (2.0, -15.001, False), (10.0, 30, True), (10.0, 30.001, False)],
)
def test_it_is_live_for_three_intervals_and_at_least_15_s_on_either_side(
    interval_s: float, away_s: float, live: bool
) -> None:
    beat = replace(BEAT, interval_s=interval_s)
    assert beat.is_live(NOW + round(away_s * S)) is live


@needs_mounts
def test_on_a_full_disk_the_one_that_lies_there_is_overwritten(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "128k") as disk:
        write_heartbeat(disk, replace(BEAT, last_error="x" * 700))
        with filled(disk):
            for error in ("the disk is full", None):
                with pytest.raises(RecorderError, match="No space left"):
                    write_heartbeat(disk, replace(BEAT, last_error=error))
                assert read_heartbeat(disk).heartbeat == replace(BEAT, last_error=error)
            with pytest.raises(RecorderError, match="No space left"):
                write_heartbeat(disk, replace(BEAT, last_error="y" * 10_000))
            assert read_heartbeat(disk).heartbeat == replace(BEAT, last_error=None)
        write_heartbeat(disk, BEAT)
        assert read_heartbeat(disk).heartbeat == BEAT
