"""How much freed memory the GNU C library keeps; any other C library is left as it is."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Final

_ARENA_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD = -8, -3, -1
"""Options of mallopt(3)."""
_LARGE: Final = 1 << 16
_KEPT: Final = 64 << 20


def share_one_arena() -> None:
    """Makes threads that start later share one heap: a heap of its own keeps what it has freed."""
    _set(_ARENA_MAX, 1)


def return_large_at_once() -> None:
    """Returns blocks of 64 KiB and more to the system when they are freed, which takes time."""
    _set(_MMAP_THRESHOLD, _LARGE)
    _set(_TRIM_THRESHOLD, _LARGE)


def keep_freed() -> None:
    """Keeps up to 64 MiB of freed memory, which is then allocated again sooner."""
    _set(_MMAP_THRESHOLD, _KEPT // 2)
    _set(_TRIM_THRESHOLD, _KEPT)


def return_free_memory() -> None:
    """Returns whole free pages to the system."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _set(option: int, value: int) -> None:
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(option, value)
