"""`recorder=none`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.recorder.base import Recorder
from ros2_memory.recorder.null import NullRecorder

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_it_never_runs_however_it_is_driven() -> None:
    recorder: Recorder = NullRecorder()
    seen = [recorder.is_running()]
    for drive in (recorder.start, recorder.start, recorder.stop, recorder.stop, recorder.start):
        drive()
        seen.append(recorder.is_running())
    assert seen == [False] * 6


def test_it_writes_nothing_in_its_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recorder = NullRecorder()
    recorder.start()
    recorder.stop()
    assert list(tmp_path.iterdir()) == []
