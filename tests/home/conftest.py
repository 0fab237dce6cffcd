"""What tests of the home robot's world share. Files that use it are of the group "home"."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.home.days import Scale
from tests.home.recording import write_world
from tests.home.year import Year
from tests.support.clocks import in_zone


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The world of the usual scale, which takes seconds to make: bags, places and labels."""
    folder = tmp_path_factory.mktemp("home")
    write_world(Scale(), folder)
    return folder


@pytest.fixture(scope="session")
def thinned_home(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same world when retention has deleted its bags: of each day stays what `memory/` has."""
    folder = tmp_path_factory.mktemp("thinned") / "home"
    shutil.copytree(home, folder)
    Year(folder / "bags", Scale().split_s).age(Scale().days - 1)
    return folder


@pytest.fixture
def in_utc() -> Iterator[None]:
    """Has this process's days begin and end as those of the robot do."""
    with in_zone("UTC"):
        yield
