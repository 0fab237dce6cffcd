"""Fixtures of the tests of columns."""

import pytest

from ros2_memory.columns import decode
from ros2_memory.columns.plan import Plan
from ros2_memory.columns.walk import LevelColumns, NotWalkedError, walked
from ros2_memory.storage.base import Batch


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
