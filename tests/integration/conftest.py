"""A machine with the real recorder, the bags of a short run, a browser: for tests that ask."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integration.browser import Browser, browsing
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


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scratch")


@pytest.fixture(scope="module")
def chromium(scratch: Path) -> Iterator[Browser]:
    with browsing(scratch) as browser:
        yield browser
