"""Files that change while they are read: what happens at the n-th opening or reading of one."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.fuzz.mutant import Trap

_REAL_PREAD = os.pread


class _Set:
    """The trap that is set, if one is."""

    def __init__(self) -> None:
        self.path = ""
        self.file: Path | None = None
        self.trap: Trap | None = None
        self.seen = 0
        self.hooked = False

    def touched(self, name: object) -> None:
        if self.trap is None or self.file is None or self.path not in os.fsdecode(str(name)):
            return
        self.seen += 1
        if self.seen == self.trap.at:
            trap, self.trap = self.trap, None
            trap.spring(self.file)


_SET = _Set()


def _heard(event: str, arguments: tuple[object, ...]) -> None:
    if _SET.trap is not None and event in {"open", "sqlite3.connect"}:
        _SET.touched(arguments[0])


def _pread(descriptor: int, length: int, offset: int, /) -> bytes:
    if _SET.trap is not None:
        _SET.touched(Path(f"/proc/self/fd/{descriptor}").readlink())
    return _REAL_PREAD(descriptor, length, offset)


@contextmanager
def sprung(trap: Trap | None, file: Path) -> Iterator[None]:
    """Within the block the trap is set upon the file."""
    if trap is None:
        yield
        return
    if not _SET.hooked:
        sys.addaudithook(_heard)
        _SET.hooked = True
    _SET.path, _SET.file, _SET.seen, _SET.trap = str(file), file, 0, trap
    os.pread = _pread
    try:
        yield
    finally:
        os.pread = _REAL_PREAD
        _SET.trap = None
