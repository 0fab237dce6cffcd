"""What is asked of the C library's allocator, and that another library is left alone."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

from ros2_memory.core.malloc import return_free_memory, return_large_at_once, share_one_arena

if TYPE_CHECKING:
    import pytest


class GnuLibrary:
    """Notes what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[int, ...]] = []

    def mallopt(self, option: int, value: int) -> int:
        self.told.append((option, value))
        return 1

    def malloc_trim(self, pad: int) -> int:
        self.told.append((pad,))
        return 1


def tell_all() -> None:
    share_one_arena()
    return_large_at_once()
    return_free_memory()


def test_threads_share_a_heap_and_large_blocks_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    library = GnuLibrary()
    monkeypatch.setattr(ctypes, "CDLL", lambda _: library)
    tell_all()
    m_arena_max, m_mmap_threshold, m_trim_threshold = -8, -3, -1  # malloc.h
    assert library.told == [
        (m_arena_max, 1),
        (m_mmap_threshold, 65536),
        (m_trim_threshold, 65536),
        (0,),
    ]
