"""Fixtures of the tests of columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.columns import decode, writing
from ros2_memory.columns.walk import LevelColumns, NotWalkedError, walked
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.columns.plan import Plan
    from ros2_memory.storage.base import Batch


@pytest.fixture(scope="module")
def short_parts() -> Iterator[None]:
    """Has parts of ten minutes stay as they are, so that a few bags make several of them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(writing, "PART_NS", 600 * NS_PER_S)
        yield


@pytest.fixture
def fallbacks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The topics of batches that were decoded message by message."""
    topics: list[str] = []

    def noting(plan: Plan, batch: Batch) -> LevelColumns:
        try:
            return walked(plan, batch)
        except NotWalkedError:
            topics.append(batch.channel.topic)
            raise

    monkeypatch.setattr(decode, "walked", noting)
    return topics
