"""What the tests of the commands share."""

import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.columns.pack import decompress
from tests.support.program import Printed, Program, exits

__all__ = ["exits"]

Forget = Callable[..., Printed]
Using = Callable[..., None]


@pytest.fixture
def using(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Using:
    """Has commands use a bag directory, and keep what they cache beside it."""

    def use(bag_dir: Path, deployment: str = "") -> None:
        monkeypatch.setenv("MEMORY_BAG_DIR", str(bag_dir))
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        if deployment:
            monkeypatch.setenv("MEMORY_DEPLOYMENT", deployment)

    return use


@pytest.fixture
def forget(exits: Program) -> Forget:
    """`ros2-memory forget`, from and to so many seconds after 1,700,000,000."""

    def run(code: int, first: float, last: float, words: str = "--yes") -> Printed:
        window = f"--start {1_700_000_000 + first} --end {1_700_000_000 + last}"
        return exits(code, f"forget {window} {words}")

    return run


def left(path: Path) -> Path:
    """Nobody has written to the file for an hour."""
    hour_ago = time.time() - 3600
    os.utime(path, (hour_ago, hour_ago))
    return path


@pytest.fixture
def no_deployment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is configured."""
    for name in ("MEMORY_DEPLOYMENT", "MEMORY_BAG_DIR", "MEMORY_CONFIG_OVERRIDES"):
        monkeypatch.delenv(name, raising=False)


def columns_in(store: Path) -> Iterator[bytes]:
    """All that a store of columns packs, unpacked."""
    with closing(sqlite3.connect(store)) as base:
        columns = base.execute("SELECT data FROM part_column WHERE data IS NOT NULL").fetchall()
    yield from (decompress(blob) for (blob,) in columns)


@contextmanager
def locked(bag_dir: Path) -> Iterator[None]:
    """A recorder holds the bag directory."""
    lock = BagDirLock.acquire(bag_dir, patience_s=0.0)
    try:
        yield
    finally:
        lock.release()
