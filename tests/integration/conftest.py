"""A machine with the real recorder, for each test that asks for one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.live_recorder import Machine, machine
from tests.support.ros_processes import ros_environment

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.real_recorder import RealRecorder


@pytest.fixture
def site(real_recorder: RealRecorder, tmp_path: Path) -> Iterator[Machine]:
    with ros_environment(tmp_path, real=real_recorder) as env, machine(tmp_path, env) as found:
        yield found
