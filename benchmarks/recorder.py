"""The memory of the recorder's daemon with a week of bags.

The daemon itself, over bags of its own that fill its budget, so that each split that closes has it
delete the oldest. The memory of its child, `ros2 bag record`, is not counted.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final

from tests.support import stub_ros2

from benchmarks.bags import Recording, Row, Topic
from benchmarks.timing import resident_mb
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import identity_of

if TYPE_CHECKING:
    from pathlib import Path

_TOPICS: Final = 12
_MESSAGES: Final = 3
"""Of each topic in a bag: the daemon's memory depends on how many topics there are, not on this."""
_SPLIT_NS: Final = 10 * 10**9
_SPLITS: Final = 60
"""Of a recording."""
_PASSES: Final = 3
"""Deletions that are waited for."""
_PATIENCE_S: Final = 600.0


def measured(folder: Path, bags: int, setup: Path | None) -> tuple[float, float]:
    """Returns the daemon's peak and resident memory (MB) over so many bags, made in `folder`.

    Args:
        folder: is made anew, and deleted afterwards.
        bags: splits of 10 s.
        setup: the setup file of a `ros2 bag record`; without it the tests' stand-in is run.

    Raises:
        RuntimeError: the daemon ended, or deletes nothing.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        return _peak_mb(folder, _make_week(folder / "bags", bags), setup)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _make_week(bag_dir: Path, bags: int) -> int:
    """Makes bags that end now, listed as the recorder's own; returns their bytes."""
    start = time.time_ns() - bags * _SPLIT_NS
    numbers = range(0, bags, _SPLITS)
    with ProcessPoolExecutor() as pool:
        sizes = [*pool.map(partial(_record, bag_dir, start, bags), numbers, chunksize=8)]
    identities = {each.name: identity_of(each) for each in bag_dir.iterdir()}
    OwnRecordings(bag_dir).adopt({name: each for name, each in identities.items() if each})
    return sum(sizes)


def _record(bag_dir: Path, start: int, bags: int, first: int) -> int:
    """Writes one recording from its first bag on; returns its bytes."""
    began = start + first * _SPLIT_NS
    stamp = time.strftime("%Y%m%d_%H%M%S", time.gmtime(began / 1e9))
    topics = [Topic(f"/robot/topic_{nth}", "std_msgs/msg/String") for nth in range(_TOPICS - 1)]
    topics.append(Topic("/tf_static", "std_msgs/msg/String", "transient_local"))
    recording = Recording(bag_dir / f"rec_{stamp}", topics)
    for nth in range(min(_SPLITS, bags - first)):
        recording.write(_rows(began + nth * _SPLIT_NS, with_latched=not nth))
    recording.close()
    os.utime(recording.folder, ns=(began, began))
    return sum(split.path.stat().st_size for split in recording.splits)


def _rows(start: int, *, with_latched: bool) -> list[Row]:
    rows = []
    for topic in range(_TOPICS if with_latched else _TOPICS - 1):
        for nth in range(1 if topic == _TOPICS - 1 else _MESSAGES):
            at = start + topic * 1_000_003 + nth * _SPLIT_NS // _MESSAGES
            rows.append(Row(at, at, topic, b"\0\1\0\0\2\0\0\0x\0"))
    return sorted(rows)


def _peak_mb(folder: Path, size: int, setup: Path | None) -> tuple[float, float]:
    topics = folder / "topics.yaml"
    topics.write_text("topics: [/odom, /tf]\n", encoding="utf-8")
    programs = folder / "bin"
    programs.mkdir()
    stub_ros2.install(programs / "ros2")
    overrides = [
        f"recording.bag_dir={folder / 'bags'}",
        f"recording.topics_file={topics}",
        "recording.split_duration_s=2",
        "retention.min_free_gb=0",
        "retention.max_age_h=400",
        f"retention.max_total_gb={size / 1e9}",
        *([] if setup is None else [f"recorder.setup_files=[{setup}]"]),
    ]
    environment = {**os.environ, "STUB_PERIOD_MS": "100"}
    if setup is None:
        environment["PATH"] = f"{programs}:{environment['PATH']}"
    log = folder / "log"
    argv = [sys.executable, "-m", "ros2_memory.recorder", *overrides]
    with log.open("wb") as stream:
        process = subprocess.Popen(argv, env=environment, stderr=stream, stdin=subprocess.DEVNULL)
        try:
            _await_deletions(process, log)
            own = str(process.pid)
            return resident_mb("VmHWM", own), resident_mb("VmRSS", own)
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=60)


def _await_deletions(process: subprocess.Popen[bytes], log: Path) -> None:
    """Waits until the daemon has deleted bags several times.

    Raises:
        RuntimeError: it ended, or does not delete any.
    """
    given_up = time.monotonic() + _PATIENCE_S
    while time.monotonic() < given_up and process.poll() is None:
        lines = log.read_text(encoding="utf-8").splitlines()
        events = [json.loads(line) for line in lines if line.startswith("{")]
        names = [each["event"] for each in events if each.get("bags", 1)]
        if "recorder_started" in names:
            begun = names.index("recorder_started")
            if names[begun:].count("retention_applied") >= _PASSES:
                return
        time.sleep(0.5)
    raise RuntimeError(f"the recorder did not delete {_PASSES} times:\n{log.read_text()[-2000:]}")
