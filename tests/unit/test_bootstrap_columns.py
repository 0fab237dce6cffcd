"""Where the store of columns lies, and what the configuration says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bootstrap import (
    build_backfill,
    build_memory,
)
from ros2_memory.config import load_settings
from tests.support.bags import odom, write_mcap

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

T0 = 1_700_000_000 * 10**9


def test_a_memory_stores_columns_unless_it_is_told_not_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    bag_dir = tmp_path / "bags"
    write_mcap(bag_dir / "rec" / "rec_0.mcap", [odom(T0, 1.0, 2.0)])
    given = {"MEMORY_BAG_DIR": str(bag_dir), "MEMORY_DEPLOYMENT": "query_only"}
    without = load_settings(["store.enabled=false"], given)
    memory = build_memory(without)
    assert memory.scanner.store is None
    assert build_backfill(without, memory).filling is None
    store = build_memory(load_settings([], given)).scanner.store
    assert store is not None
    assert store.path is not None
    assert store.path.is_relative_to(tmp_path / "cache")
