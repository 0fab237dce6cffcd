"""Temporary files that a reader needs: decompressed bags, and bags with their journal applied."""

from __future__ import annotations

import errno
import shutil
import tempfile
import threading
import weakref
from collections import OrderedDict
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.storage.errors import UnreachableError, UnreadableError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


@dataclass(slots=True, weakref_slot=True, eq=False)
class _Entry:
    lock: threading.Lock = field(default_factory=threading.Lock)
    folder: Path | None = None
    size: int = 0
    users: int = 0
    filled: tuple[Path, str] | None = None


class Scratch:
    """Folders for temporary files, bounded in bytes. Safe to use from several threads.

    The least recently used are deleted first, never one in use. All are deleted with the reader, or
    when the program ends.

    Args:
        max_bytes: what all files together may take.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @contextmanager
    def use(
        self, key: Hashable, fill: Callable[[Path, Callable[[int], None]], tuple[Path, str]]
    ) -> Iterator[tuple[Path, str]]:
        """Yields the file that is made of the content `key`; it is not deleted inside the block.

        Args:
            key: the content that it is made of.
            fill: makes the file if it is not there: takes an empty folder, and a function to call
                with a number of bytes before it writes as many; returns the file and a note on it.

        Raises:
            UnreadableError: the file does not fit into `max_bytes`.
            UnreachableError: the disk of the temporary files is full.
        """
        with self._lock:
            entry = self._entries.setdefault(key, _Entry())
            entry.users += 1
            self._entries.move_to_end(key)
        try:
            with entry.lock:
                if entry.filled is None or not entry.filled[0].exists():
                    entry.filled = self._fill(entry, fill)
                filled = entry.filled
            yield filled
        finally:
            with self._lock:
                entry.users -= 1
                if entry.filled is None and not entry.users:
                    self._entries.pop(key, None)

    def _fill(
        self, entry: _Entry, fill: Callable[[Path, Callable[[int], None]], tuple[Path, str]]
    ) -> tuple[Path, str]:
        self._empty(entry)
        try:
            return fill(_new_folder(entry), lambda size: self._reserve(entry, size))
        except BaseException as error:
            self._empty(entry)
            if isinstance(error, OSError) and error.errno in _DISK_FULL:
                raise _disk_full(error) from error
            raise

    def _empty(self, entry: _Entry) -> None:
        if entry.folder is not None:
            shutil.rmtree(entry.folder, ignore_errors=True)
        with self._lock:
            self._bytes -= entry.size
            entry.size = 0
            entry.filled = None

    def _reserve(self, entry: _Entry, size: int) -> None:
        with self._lock:
            for key, other in list(self._entries.items()):
                if self._bytes + size <= self._max_bytes:
                    break
                if not other.users and other.folder is not None:
                    del self._entries[key]
                    self._bytes -= other.size
                    shutil.rmtree(other.folder, ignore_errors=True)
            if self._bytes + size > self._max_bytes:
                raise UnreadableError(
                    f"unpacked it takes more than the {self._max_bytes >> 20} MiB allowed for"
                    " temporary files; raise unpack_max_mb"
                )
            self._bytes += size
            entry.size += size


def _new_folder(entry: _Entry) -> Path:
    """Makes a folder that is deleted with the entry, or when the program ends."""
    try:
        entry.folder = Path(tempfile.mkdtemp(prefix="ros2-memory-"))
    except OSError as error:
        raise _disk_full(error) from error
    weakref.finalize(entry, shutil.rmtree, entry.folder, ignore_errors=True)
    return entry.folder


def _disk_full(error: OSError) -> UnreachableError:
    return UnreachableError(
        "it must be unpacked, and nothing can be written into the folder for temporary files"
        f" ({error.strerror or error}); free disk space there, or name another folder in TMPDIR"
    )
