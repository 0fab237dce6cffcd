"""What is asked of the C library's allocator."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import TYPE_CHECKING

from ros2_memory.core.malloc import return_free_memory, return_large_at_once, share_one_arena

if TYPE_CHECKING:
    import pytest


def test_threads_share_a_heap_and_large_blocks_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[int, ...]] = []

    def note(*numbers: int) -> int:
        told.append(numbers)
        return 1

    library = SimpleNamespace(mallopt=note, malloc_trim=note)
    monkeypatch.setattr(ctypes, "CDLL", lambda _: library)
    share_one_arena()
    return_large_at_once()
    return_free_memory()
    m_arena_max, m_mmap_threshold, m_trim_threshold = -8, -3, -1  # malloc.h
    assert told == [(m_arena_max, 1), (m_mmap_threshold, 65536), (m_trim_threshold, 65536), (0,)]
