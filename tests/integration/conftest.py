"""A machine with the real recorder, and the bags of a short run, for each test that asks."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.live_recorder import Machine, machine
from tests.support.real_recorder import RealRecorder
from tests.support.robot_run import write_run


@pytest.fixture
def site(real_recorder: RealRecorder, tmp_path: Path) -> Iterator[Machine]:
    with machine(tmp_path, real_recorder) as found:
        yield found


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    write_run(tmp_path / "bags")
    return tmp_path / "bags"
