"""What holds for every test of a room."""

from collections.abc import Iterator

import pytest

from ros2_memory.columns import scan, writing
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.serving import backfill


@pytest.fixture(autouse=True, scope="session")
def short_stretches() -> Iterator[None]:
    """Short histories have several parts that stay, and what follows from them is joined."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "PART_NS", 600 * NS_PER_S)
        for module in (scan, backfill):
            patch.setattr(module, "STRETCH_NS", 300 * NS_PER_S)
        yield
