"""A disk that fails on command, where the program touches files: the calls of `os` themselves."""

import errno
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Final

import pytest

OPEN: Final = frozenset({"open", "fstat", "pread"})
"""What is called to read a bag file."""
LOOK: Final = frozenset({"stat", "lstat", "scandir"})
"""What is called to see which bag files there are."""

_ROOMS: Final = ("ros2_memory.storage.file_io", "ros2_memory.index.scan")


class Disk:
    """Stands for the module `os` in the rooms that touch bags; counts calls, and fails some.

    Attributes:
        calls: calls so far of the functions that may fail.
        failed: how many of them failed.
        short: whether a read gives a few bytes at a time.
    """

    def __init__(self, functions: Collection[str]) -> None:
        self._functions = frozenset(functions)
        self._number = 0
        self._from: int | None = None
        self._until = 0
        self.calls = 0
        self.failed = 0
        self.short = False

    def fail(self, number: int, *, after: int = 0, times: int = 1 << 60) -> None:
        """The calls fail with this `errno`, from the one after so many on, so many times."""
        self._number, self._from, self._until = number, self.calls + after, times
        self.failed = 0

    def heal(self) -> None:
        self._from = None

    def __getattr__(self, name: str) -> object:
        real = getattr(os, name)
        if name not in self._functions:
            return real

        def call(*args: object, **named: object) -> object:
            self.calls += 1
            if self._from is not None and self.calls > self._from and self.failed < self._until:
                self.failed += 1
                raise OSError(self._number, os.strerror(self._number), str(args[0]))
            if name == "pread" and self.short:
                descriptor, length, offset = args
                return real(descriptor, min(int(str(length)), 7), offset)
            return real(*args, **named)

        return call


@contextmanager
def failing(patch: pytest.MonkeyPatch, functions: Collection[str]) -> Iterator[Disk]:
    """Puts the disk under everything that is done inside the block."""
    disk = Disk(functions)
    with patch.context() as patched:
        for room in _ROOMS:
            patched.setattr(f"{room}.os", disk)
        yield disk


PASSING: Final = (
    errno.EIO,
    errno.ESTALE,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.ETIMEDOUT,
    errno.EACCES,
    errno.ENODEV,
)
"""What disks, mounts and a machine that lacks something answer with, until it is over."""
