"""JSON files that the two programs share. Another version, or a person, may have written them.

A log has one object a line. Rows are appended and flushed, all of them or none, so a power cut
leaves at most a part of the last line, which the next append ends. Each line ends with a checksum;
a line without one is not believed. A line that is damaged, or of another version, spoils no other.
A document is one object, which is replaced by rename.

They are files and no database: a person can read them, and so can a server that may not write here
after the recorder was killed. SQLite must write before it can read what a kill left.
"""

from __future__ import annotations

import errno
import json
import os
import re
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, lru_cache, wraps
from typing import (
    TYPE_CHECKING,
    Annotated,
    Final,
    Generic,
    NamedTuple,
    TypeAlias,
    TypeVar,
)
from zlib import crc32

from pydantic import Field, TypeAdapter, ValidationError

from ros2_memory.bag_dir.durable_write import (
    append_durably,
    flush,
    locked,
    open_plain,
    read_small_file,
    write_durably,
)
from ros2_memory.core import directories
from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

_T = TypeVar("_T")

Int64: TypeAlias = Annotated[int, Field(strict=True, ge=MIN_NS, le=MAX_NS)]
"""An integer of 64 bits, and no boolean."""
Count: TypeAlias = Annotated[int, Field(strict=True, ge=0, le=MAX_NS)]
READABLE: Final = 0o644
"""Permissions of a file that the other program reads; it may run as another user."""

MOST_BYTES: Final = 64 << 20
"""The size limit of a log, and of a document: it grows with the number of bags or messages."""
_FORMAT: Final = 1  # of each document
_SURROGATE: Final = re.compile(r"\\ud[89a-f]", re.IGNORECASE)
_CHECK: Final = b', "crc32": "'


class Line(NamedTuple, Generic[_T]):
    """One line of a log: its row, or the error if it has none.

    `number` counts from 1; 0 stands for the lines at the start of a file that is too large.
    """

    number: int
    text: bytes
    row: _T | None
    error: ValueError | None


@dataclass(eq=False, repr=False)
class _JsonFile(Generic[_T]):
    """A file in the bag directory with one value of a dataclass, or many."""

    name: str
    content: type[_T]
    _: KW_ONLY
    most_bytes: int = MOST_BYTES

    @cached_property
    def _adapter(self) -> TypeAdapter[_T]:  # takes some ms to make, and most files never exist
        return TypeAdapter(self.content)

    def _replace(self, bag_dir: Path, text: str, mode: int | None = None) -> None:
        target = bag_dir / self.name
        directories.make(bag_dir, target.parent)
        write_durably(target, text, mode=mode)
        give_to_owner(target, bag_dir)


@dataclass(eq=False, repr=False)
class JsonLog(_JsonFile[_T]):
    """A log, whose rows are of one dataclass.

    Args:
        most_bytes: only the end of a longer file is read.
        is_brief: whether fields with their default value are left out of the file.

    Attributes:
        current: `rows`, cached until the file changes; returns None instead of raising.
    """

    is_brief: bool = False

    def __post_init__(self) -> None:
        self.current = until_changed(self.name)(self.rows)

    def lines(self, bag_dir: Path) -> Iterator[Line[_T]]:
        """Yields the lines that are not empty.

        Raises:
            OSError: the file does not exist, or cannot be read.
            ValueError: it is not a regular file.
        """
        with open_plain(state_path(bag_dir, self.name)) as stream:
            if stream.seek(0, os.SEEK_END) > self.most_bytes:
                yield Line(0, b"", None, ValueError(f"it is larger than {self.most_bytes} bytes"))
                stream.seek(-self.most_bytes, os.SEEK_END)
                stream.readline()
            else:
                stream.seek(0)
            for number, line in enumerate(stream, 1):
                text = line.strip()
                if text:
                    yield self._parse(number, text)

    def _parse(self, number: int, text: bytes) -> Line[_T]:
        try:
            row = parsed(self._adapter, text)
            _require_check(text)
        except ValueError as error:
            return Line(number, text, None, error)
        return Line(number, text, row, None)

    def rows(self, bag_dir: Path) -> list[_T]:
        """Returns the rows, oldest first, without damaged lines; none if there is no file.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a regular file.
        """
        try:
            return [line.row for line in self.lines(bag_dir) if line.row is not None]
        except FileNotFoundError:
            return []

    def all_rows(self, bag_dir: Path) -> Iterator[tuple[int, _T]]:
        """Yields every row with its line number, of a log that is useless with a row missing.

        A line that a crash cut short is left out: the work that it announces was not begun.

        Raises:
            OSError: the file cannot be read.
            ValueError: the file is too large, or a line is damaged; the sentence names the line.
        """
        try:
            lines = [*self.lines(bag_dir)]
        except FileNotFoundError:
            return
        for line in lines:
            if line.row is not None:
                yield line.number, line.row
            elif not isinstance(line.error, json.JSONDecodeError):
                raise ValueError(f"line {line.number}: {line.error}")
            # A line that a crash cut short has no end; a whole one ends with its checksum (or, if
            # only that was cut off, with a list).
            elif not line.text.startswith(b"{") or line.text.endswith((b"]}", b'"}')):
                raise ValueError(f"line {line.number}: it is damaged: {line.error}")

    def text(self, rows: Iterable[_T]) -> str:
        """Returns rows as lines."""
        dumped = (self._adapter.dump_python(row, exclude_defaults=self.is_brief) for row in rows)
        lines = (json.dumps(fields).removesuffix("}").encode() for fields in dumped)
        return "".join(f"{_with_check(line).decode()}\n" for line in lines)

    def append(self, bag_dir: Path, rows: Iterable[_T]) -> int:
        """Appends rows durably; returns the size of the file in bytes.

        Raises:
            OSError: the rows cannot be written, and none is appended.
        """
        target = bag_dir / self.name
        directories.make(bag_dir, target.parent)
        append_durably(target, self.text(rows))
        give_to_owner(target, bag_dir)
        return target.stat().st_size

    def rewrite(self, bag_dir: Path, changed: Callable[[list[_T]], Iterable[_T]]) -> None:
        """Replaces the rows by what `changed` returns of them. Who appends waits meanwhile.

        Raises:
            OSError: the file cannot be read, or as by `write_durably`.
            ValueError: it is not a regular file.
        """
        with locked(bag_dir / self.name):
            self.replace(bag_dir, changed(self.rows(bag_dir)))

    def replace(self, bag_dir: Path, rows: Iterable[_T]) -> None:
        """Replaces all rows, of a log that has one writer.

        Raises:
            OSError: as by `write_durably`.
        """
        self._replace(bag_dir, self.text(rows))


@dataclass(eq=False, repr=False)
class JsonDocument(_JsonFile[_T]):
    """A document: one value of a dataclass. A file longer than `most_bytes` is not read.

    Attributes:
        current: `read`, cached until the file changes; returns None instead of raising.
    """

    def __post_init__(self) -> None:
        self.current = until_changed(self.name)(self.read)

    def read(self, bag_dir: Path) -> _T | None:
        """Returns the value; None if there is no file.

        Raises:
            OSError: the file cannot be read.
            ValueError: the file is damaged, or of another format.
        """
        try:
            text = read_small_file(state_path(bag_dir, self.name), self.most_bytes)
        except FileNotFoundError:
            return None
        return parsed(self._adapter, text, _FORMAT)

    def write(self, bag_dir: Path, value: _T) -> None:
        """Replaces the file durably.

        Raises:
            OSError: as by `write_durably`.
        """
        content = {"format": _FORMAT, **self._adapter.dump_python(value)}
        # ASCII with escapes: a path that is not UTF-8 has lone surrogates.
        text = json.dumps(content, separators=(",", ":"))
        self._replace(bag_dir, text, READABLE)

    def remove(self, bag_dir: Path) -> None:
        """Removes the file durably.

        Raises:
            OSError: the file cannot be removed; or it was, and a power cut may undo that.
        """
        target = bag_dir / self.name
        target.unlink(missing_ok=True)
        flush(target.parent)


def until_changed(
    name: str, most: int = 2
) -> Callable[[Callable[[Path], _T]], Callable[[Path], _T | None]]:
    """Returns a decorator that caches a function of a directory until a file there changes.

    The function is called each time while the file does not exist. If the file cannot be read, the
    result is None. `most` is the number of directories that are cached.
    """

    def decorate(read: Callable[[Path], _T]) -> Callable[[Path], _T | None]:
        @lru_cache(most)
        def cached(bag_dir: Path, _stamp: tuple[int, int, int]) -> _T:
            return read(bag_dir)

        @wraps(read)
        def current(bag_dir: Path) -> _T | None:
            with suppress(OSError, ValueError):
                try:
                    status = (bag_dir / name).lstat()
                except (FileNotFoundError, NotADirectoryError):
                    return read(bag_dir)
                return cached(bag_dir, (status.st_ino, status.st_mtime_ns, status.st_size))
            return None

        return current

    return decorate


def parsed(
    adapter: TypeAdapter[_T],
    text: str | bytes,
    version: int | None = None,
    *,
    has_paths: bool = True,
) -> _T:
    """Returns the value of a JSON object. Unknown keys are ignored: another version may write more.

    Args:
        adapter: validates the object.
        text: the object.
        version: the `format` that the object must have; None for any.
        has_paths: whether texts may have lone surrogates, as bytes of paths that are not UTF-8.

    Raises:
        ValueError: the text is not such an object, or is of another format; or a key is missing or
            wrong, which the sentence names.
    """
    try:
        # json.loads accepts bytes that are not UTF-8.
        text = text if isinstance(text, str) else text.decode()
        value: object = json.loads(text)
        if has_paths and _SURROGATE.search(text):
            os.fsencode(json.dumps(value, ensure_ascii=False))
    except RecursionError as error:
        raise ValueError("it is nothing but brackets") from error
    if not isinstance(value, dict):
        raise ValueError("it is not a JSON object")  # noqa: TRY004 - a value in a text
    if version is not None and value.get("format") != version:
        raise ValueError(f"its format is {value.get('format')!r}, and only {version} is known")
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise ValueError(f"{key}: {first['msg']}") from error


def state_path(bag_dir: Path, name: str) -> Path:
    """Returns the path of a file in the bag directory.

    Raises:
        OSError: its folder is a symbolic link, which is not followed.
    """
    path = bag_dir / name
    if path.parent != bag_dir and path.parent.is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link, which is not followed", str(path.parent))
    return path


def give_to_owner(path: Path, bag_dir: Path) -> None:
    """Gives a file that root made to the owner of the bag directory, whom the recorder runs as."""
    with suppress(OSError):
        owner = bag_dir.stat()
        if path.lstat().st_uid != owner.st_uid:
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _with_check(begun: bytes) -> bytes:
    """Returns a line of JSON without its last brace, closed with its CRC-32."""
    return b'%b%b%08x"}' % (begun, _CHECK, crc32(begun))


def _require_check(line: bytes) -> None:
    """Raises ValueError if the checksum of a line is missing or wrong."""
    if line != _with_check(line.rpartition(_CHECK)[0]):
        raise ValueError("its check (crc32) is missing or fails: it is damaged, or was edited")
