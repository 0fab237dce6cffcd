"""`recorder=none`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.recorder.null import NullRecorder

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_it_never_runs_however_it_is_driven_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recorder = NullRecorder()
    drives = (recorder.check, recorder.start, recorder.tick, recorder.stop, recorder.stop)
    for drive in drives:
        drive()
        assert not recorder.is_running()
    assert list(tmp_path.iterdir()) == []
