"""Temporary files that a reader needs: unpacked bags, and bags with their journal played back."""

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

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


@dataclass(slots=True)
class _Entry:
    folder: Path
    lock: threading.Lock = field(default_factory=threading.Lock)
    size: int = 0
    users: int = 0
    filled: tuple[Path, str] | None = None


class Scratch:
    """A folder of its own for temporary files, bounded in bytes. Safe to use from several threads.

    The least recently used are deleted first, never one in use. All go when the reader goes, or
    the program ends.

    Args:
        max_bytes: what all files together may take.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()
        self._bytes = 0
        self._made = 0
        self._root: Path | None = None
        self._lock = threading.Lock()

    @contextmanager
    def holding(
        self, key: Hashable, fill: Callable[[Path, Callable[[int], None]], tuple[Path, str]]
    ) -> Iterator[tuple[Path, str]]:
        """The file made of the content `key`; it is not deleted inside the block.

        Args:
            key: the content that it is made of.
            fill: makes it, where it is not there: gets an empty folder, and a function to call
                with a number of bytes before writing as many; gives the file and a note on it.

        Raises:
            UnreadableError: it does not fit into `max_bytes`.
            UnreachableError: the disk of the temporary files is full.
        """
        entry = self._enter(key)
        try:
            with entry.lock:
                if entry.filled is None or not entry.filled[0].exists():
                    entry.filled = self._fill(entry, fill)
                filled = entry.filled
            yield filled
        finally:
            self._leave(key, entry)

    def _enter(self, key: Hashable) -> _Entry:
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                self._made += 1
                entry = self._entries[key] = _Entry(self._folder() / str(self._made))
            entry.users += 1
            self._entries.move_to_end(key)
            return entry

    def _folder(self) -> Path:
        if self._root is None or not self._root.is_dir():
            try:
                self._root = Path(tempfile.mkdtemp(prefix="ros2-memory-"))
            except OSError as error:
                raise _no_room(error) from error
            weakref.finalize(self, shutil.rmtree, self._root, ignore_errors=True)
        return self._root

    def _leave(self, key: Hashable, entry: _Entry) -> None:
        with self._lock:
            entry.users -= 1
            if entry.filled is None and not entry.users:
                self._entries.pop(key, None)

    def _fill(
        self, entry: _Entry, fill: Callable[[Path, Callable[[int], None]], tuple[Path, str]]
    ) -> tuple[Path, str]:
        def reserve(size: int) -> None:
            self._reserve(entry, size)

        self._forget(entry)
        try:
            entry.folder.mkdir(parents=True)
            return fill(entry.folder, reserve)
        except OSError as error:
            self._forget(entry)
            if error.errno in _NO_ROOM:
                raise _no_room(error) from error
            raise
        except BaseException:
            self._forget(entry)
            raise

    def _forget(self, entry: _Entry) -> None:
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
                if not other.users:
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


def _no_room(error: OSError) -> UnreachableError:
    return UnreachableError(
        "it must be unpacked, and nothing can be written into the folder for temporary files"
        f" ({error.strerror or error}); free disk space there, or name another folder in TMPDIR"
    )
