"""The contract of the port `Recorder`, held by both adapters."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_recorder
from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.base import Recorder
from ros2_memory.recorder.null import NullRecorder
from ros2_memory.storage.mcap_reader import McapReader
from tests.support import stub_ros2
from tests.support.processes import until
from tests.support.simulated_recorders import PlayedHousekeeper


def ros2bag(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    stub_ros2.install(programs / "ros2")
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    (folder / "topics.yaml").write_text("topics: [/odom]\n")
    given = (f"bag_dir={folder}/bags", f"topics_file={folder}/topics.yaml")
    return build_recorder(
        load_settings((*(f"recording.{each}" for each in given), "retention.min_free_gb=0"), {}),
        reader=McapReader(),
        housekeeper=PlayedHousekeeper(),
        own=OwnRecordings(folder / "bags"),
        keep_open=(),
        excluding={},
        background=Background(),
    )


@pytest.fixture(params=["none", "ros2bag"])
def recorder(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Recorder]:
    made: Recorder = NullRecorder()
    if request.param == "ros2bag":
        made = ros2bag(tmp_path, monkeypatch)
    yield made
    made.stop()


def drive(recorder: Recorder) -> bool:
    """Lets it work until it records; False for one that never does."""
    if isinstance(recorder, NullRecorder):
        return False

    def ticked() -> bool:
        recorder.tick()
        return recorder.is_running()

    return until(ticked)


def children() -> set[str]:
    return set(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())


def test_it_runs_from_its_start_to_its_stop_each_time_into_a_new_recording(
    recorder: Recorder, tmp_path: Path
) -> None:
    before = children()
    assert not recorder.is_running()
    recorder.stop()
    for nth in (1, 2):
        recorder.start()
        started = children()
        recorder.start()
        assert children() == started
        records = drive(recorder)
        recorder.stop()
        recorder.stop()
        assert not recorder.is_running()
        assert children() == before
        assert len(list(tmp_path.glob("bags/rec_*"))) == nth * records


def test_one_that_cannot_begin_leaves_nothing_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = ros2bag(tmp_path, monkeypatch)
    before = children()
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(RecorderError):
        recorder.start()
    (tmp_path / "topics.yaml").write_text("topics: []\n")
    with pytest.raises(ConfigError):
        recorder.start()
    assert children() == before
    assert not recorder.is_running()
