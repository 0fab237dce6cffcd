"""Temporary files of a reader: copies of bags that are decompressed, or have a journal applied."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import threading
import weakref
from collections import OrderedDict
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from ros2_memory.core.temporary import delete_abandoned, lock_folder
from ros2_memory.storage.errors import UnreachableError, UnreadableError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

Fill: TypeAlias = "Callable[[Path, Callable[[int], None]], tuple[Path, str]]"
"""Makes a file in an empty folder; returns its path and a note on it.

Calls the function that it is given with a number of bytes before it writes as many.
"""
_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
_PREFIX = "ros2-memory-unpacked-"


@dataclass(slots=True, eq=False)
class _Copy:
    """A temporary file in a folder of its own.

    Attributes:
        folder: the folder.
        size: the bytes reserved for it.
        users: how many threads read it at the moment.
        file: the temporary file.
        note: a sentence on the file, as `fill` returned it.
    """

    folder: Path
    size: int = 0
    users: int = 0
    file: Path = Path()
    note: str = ""


class Scratch:
    """Folders for temporary files, bounded in bytes. Safe to use from several threads.

    The least recently used are deleted first, never one in use. All are deleted with the reader, or
    when the program ends. A program that is killed leaves its folders: the next program deletes the
    folders that nobody has locked.

    Args:
        max_bytes: what all files together may take.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._root: Path | None = None
        self._copies: OrderedDict[Hashable, _Copy] = OrderedDict()
        self._bytes = 0
        # A reader that is collected as garbage may end while this thread makes a file.
        self._lock = threading.RLock()

    @contextmanager
    def use(self, key: Hashable, fill: Fill) -> Iterator[tuple[Path, str]]:
        """Yields a temporary file and a note on it. The file is not deleted inside the block.

        Args:
            key: identifies the content of the file.
            fill: makes the file if it is not there.

        Raises:
            UnreadableError: the file does not fit into `max_bytes`.
            UnreachableError: the disk of the temporary files is full.
        """
        # One file is made at a time: two at once might leave no room for each other.
        with self._lock:
            copy = self._copies.get(key)
            if copy is None or not copy.file.exists():
                self._delete(key)
                copy = self._copies[key] = self._make_copy(fill)
            self._copies.move_to_end(key)
            copy.users += 1
        try:
            yield copy.file, copy.note
        finally:
            with self._lock:
                copy.users -= 1

    def _make_copy(self, fill: Fill) -> _Copy:
        """Makes a copy in a new folder; nothing is left of it after a failure."""
        try:
            if self._root is None or not self._root.exists():
                delete_abandoned(Path(tempfile.gettempdir()), _PREFIX)
                self._root = Path(tempfile.mkdtemp(prefix=_PREFIX))
                weakref.finalize(self, shutil.rmtree, self._root, ignore_errors=True)
                with suppress(OSError):  # where nothing can be locked, nobody else deletes it
                    weakref.finalize(self, os.close, lock_folder(self._root))
            copy = _Copy(Path(tempfile.mkdtemp(dir=self._root)))
        except OSError as error:
            raise _disk_full(error) from error
        try:
            copy.file, copy.note = fill(copy.folder, partial(self._reserve, copy))
        except BaseException as error:
            self._bytes -= copy.size
            shutil.rmtree(copy.folder, ignore_errors=True)
            if isinstance(error, OSError) and error.errno in _DISK_FULL:
                raise _disk_full(error) from error
            raise
        return copy

    def _delete(self, key: Hashable) -> None:
        copy = self._copies.pop(key, None)
        if copy is not None:
            self._bytes -= copy.size
            shutil.rmtree(copy.folder, ignore_errors=True)

    def _reserve(self, copy: _Copy, size: int) -> None:
        """Makes room for more bytes of a copy: deletes other copies, the oldest first.

        Raises:
            UnreadableError: they do not fit into `max_bytes`.
        """
        unused = [key for key, other in self._copies.items() if not other.users]
        for key in unused:
            if self._bytes + size <= self._max_bytes:
                break
            self._delete(key)
        if self._bytes + size > self._max_bytes:
            raise UnreadableError(
                f"unpacked it takes more than the {self._max_bytes >> 20} MiB allowed for"
                " temporary files; raise unpack_max_mb"
            )
        self._bytes += size
        copy.size += size


def _disk_full(error: OSError) -> UnreachableError:
    return UnreachableError(
        "it must be unpacked, and nothing can be written into the folder for temporary files"
        f" ({error.strerror or error}); free disk space there, or name another folder in TMPDIR"
    )
