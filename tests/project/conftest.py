"""What tests of the home robot's world share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="session")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which `benchmarks.home` keeps its world, which takes seconds to make.

    Files that use it are of the group "home".
    """
    return tmp_path_factory.mktemp("worlds")
