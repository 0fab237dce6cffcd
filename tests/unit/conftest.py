"""What holds for every test of a room."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.columns import scan, writing
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.serving import backfill
from tests.support.bags import Msg
from tests.support.memories import Remember, memory_of, remembered


@pytest.fixture(autouse=True, scope="session")
def short_stretches() -> Iterator[None]:
    """Short histories have several parts that stay, and what follows from them is joined."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "PART_NS", 600 * NS_PER_S)
        for module in (scan, backfill):
            patch.setattr(module, "STRETCH_NS", 300 * NS_PER_S)
        yield


@pytest.fixture(params=[False, True], ids=["plain", "catalogue"])
def remember(tmp_path: Path, request: pytest.FixtureRequest) -> Remember:
    """A memory that asks the bags alone, and one of columns that are stored."""

    def memory(messages: Iterable[Msg] | None = None, **how: Any) -> Memory:
        if messages is None:
            return memory_of(tmp_path, recalls=request.param, **how)
        return remembered(tmp_path, messages, recalls=request.param, **how)

    return memory
