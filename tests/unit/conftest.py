"""What holds for every test of a room."""

from collections.abc import Iterator

import pytest

from ros2_memory.columns import scan
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.serving import backfill


@pytest.fixture(autouse=True, scope="session")
def short_stretches() -> Iterator[None]:
    """What follows from parts is joined by five minutes, so that short histories have stretches."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (scan, backfill):
            patch.setattr(module, "STRETCH_NS", 300 * NS_PER_S)
        yield
