"""A machine with the real recorder, for each test that asks for one."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.live_recorder import Machine, machine
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import ros_environment


@pytest.fixture
def site(real_recorder: RealRecorder, tmp_path: Path) -> Iterator[Machine]:
    with ros_environment(tmp_path, real=real_recorder) as env, machine(tmp_path, env) as found:
        yield found
