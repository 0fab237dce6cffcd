"""JSON files that the two programs share, and that another version, or a person, may have written.

A log is one object a line. Rows are appended and flushed, all of them or none, so a power cut
leaves at most a part of the last line, which the next append ends. A line ends with a check, so
that a flipped bit makes no other number; one without is not believed. A line that is damaged, or
of another version, spoils no other. A document is one object, which is replaced by rename.

They stay files, not a database: a person reads them, and so does a server that may not write here,
while the recorder is killed; SQLite needs to write before it can read what a kill left.
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
    MAX_SMALL_FILE,
    append_durably,
    flush,
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
"""Of a log, and of a document that grows with the number of bags or messages."""
_FORMAT: Final = 1  # of each document
_SURROGATE: Final = re.compile(r"\\ud[89a-f]", re.IGNORECASE)
_CHECK: Final = b', "crc32": "'


class Line(NamedTuple, Generic[_T]):
    """One line of a log: its row, or None and what is wrong with it.

    `number` counts from 1; 0 stands for all lines that are left out, for they are too many.
    """

    number: int
    text: bytes
    row: _T | None
    error: ValueError | None


@dataclass(eq=False, repr=False)
class JsonLog(Generic[_T]):
    """A log in the bag directory, whose rows are of one dataclass.

    Args:
        most_bytes: of a longer file only the end is read.
        is_brief: whether fields that have their default are not written.

    Attributes:
        current: returns the same as `rows`, which it calls only once the file has changed; None
            where that fails.
    """

    name: str
    row: type[_T]
    _: KW_ONLY
    most_bytes: int = MOST_BYTES
    is_brief: bool = False

    def __post_init__(self) -> None:
        self.current = until_changed(self.name)(self.rows)

    @cached_property
    def _adapter(self) -> TypeAdapter[_T]:  # takes some ms to make, and most files are never there
        return TypeAdapter(self.row)

    def lines(self, bag_dir: Path) -> Iterator[Line[_T]]:
        """Yields the lines that are not empty.

        Raises:
            OSError: the file cannot be read, or there is none.
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
                    try:
                        row = parsed(self._adapter, text)
                        _require_check(text)
                        yield Line(number, text, row, None)
                    except ValueError as error:
                        yield Line(number, text, None, error)

    def rows(self, bag_dir: Path) -> list[_T]:
        """Returns the rows, the oldest first, whatever other lines hold; none without a file.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a regular file.
        """
        try:
            return [line.row for line in self.lines(bag_dir) if line.row is not None]
        except FileNotFoundError:
            return []

    def all_rows(self, bag_dir: Path) -> Iterator[tuple[int, _T]]:
        """Yields every row with the number of its line, of a log that is of no use without one.

        A line that a crash cut short is left out: what it announces was not begun.

        Raises:
            OSError: the file cannot be read.
            ValueError: a line is damaged, which the sentence names, or the file is too large.
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
            # A whole line ends with its check; one whose check was cut off, with a list.
            elif not line.text.startswith(b"{") or line.text.endswith((b"]}", b'"}')):
                raise ValueError(f"line {line.number}: it is damaged: {line.error}")

    def text(self, rows: Iterable[_T]) -> str:
        """Returns rows as lines."""
        dumped = (self._adapter.dump_python(row, exclude_defaults=self.is_brief) for row in rows)
        lines = (json.dumps(fields).removesuffix("}").encode() for fields in dumped)
        return "".join(f"{_with_check(line).decode()}\n" for line in lines)

    def append(self, bag_dir: Path, rows: Iterable[_T]) -> int:
        """Appends rows durably; returns how many bytes the file has then.

        Raises:
            OSError: they cannot be written, and none is appended.
        """
        target = bag_dir / self.name
        directories.make(bag_dir, target.parent)
        append_durably(target, self.text(rows))
        give_to_owner(target, bag_dir)
        return target.stat().st_size

    def replace(self, bag_dir: Path, rows: Iterable[_T]) -> None:
        """Replaces the file by one with these rows.

        Raises:
            OSError: it cannot be written; the old one remains.
        """
        target = bag_dir / self.name
        directories.make(bag_dir, target.parent)
        write_durably(target, self.text(rows))
        give_to_owner(target, bag_dir)


@dataclass(eq=False, repr=False)
class JsonDocument(Generic[_T]):
    """A document in the bag directory, which holds one value of a dataclass.

    Args:
        most_bytes: a longer file is not read.

    Attributes:
        current: returns the same as `read`, which it calls only once the file has changed; None
            where that fails.
    """

    name: str
    content: type[_T]
    _: KW_ONLY
    most_bytes: int = MAX_SMALL_FILE

    def __post_init__(self) -> None:
        self.current = until_changed(self.name)(self.read)

    @cached_property
    def _adapter(self) -> TypeAdapter[_T]:
        return TypeAdapter(self.content)

    def read(self, bag_dir: Path) -> _T | None:
        """Returns the value; None where there is no file.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is damaged, or of another format.
        """
        try:
            text = read_small_file(state_path(bag_dir, self.name), self.most_bytes)
        except FileNotFoundError:
            return None
        return parsed(self._adapter, text, _FORMAT)

    def write(self, bag_dir: Path, value: _T) -> None:
        """Replaces the file durably.

        Raises:
            OSError: it cannot be written; the old one remains.
        """
        target = bag_dir / self.name
        directories.make(bag_dir, target.parent)
        content = {"format": _FORMAT, **self._adapter.dump_python(value)}
        # Escaped, as paths need that are not UTF-8.
        text = json.dumps(content, separators=(",", ":"))
        write_durably(target, text, mode=READABLE)

    def remove(self, bag_dir: Path) -> None:
        """Removes the file durably.

        Raises:
            OSError: it cannot be removed.
        """
        target = bag_dir / self.name
        target.unlink(missing_ok=True)
        flush(target.parent)


def until_changed(
    name: str, most: int = 2
) -> Callable[[Callable[[Path], _T]], Callable[[Path], _T | None]]:
    """Has a function of a directory called again only once a file there has changed.

    For files that every answer needs, in `most` directories. Where there is none, the function is
    called each time; where it cannot be read, None is returned.
    """

    def decorate(read: Callable[[Path], _T]) -> Callable[[Path], _T | None]:
        @lru_cache(most)
        def known(bag_dir: Path, _stamp: tuple[int, int, int]) -> _T:
            return read(bag_dir)

        @wraps(read)
        def current(bag_dir: Path) -> _T | None:
            with suppress(OSError, ValueError):
                try:
                    status = (bag_dir / name).lstat()
                except (FileNotFoundError, NotADirectoryError):
                    return read(bag_dir)
                return known(bag_dir, (status.st_ino, status.st_mtime_ns, status.st_size))
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
    """Returns the value that a JSON object describes; keys of other versions are ignored.

    Its `format` must be the version, where one is given.

    Raises:
        ValueError: it is none, or of another format, or a key is missing or wrong; the sentence
            names the first one. Or it has a lone surrogate that is no byte of a path.
    """
    try:
        # Of bytes json.loads accepts what is no UTF-8.
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
        OSError: its folder is a symbolic link, so that nothing shows whether there is a file.
    """
    path = bag_dir / name
    if path.parent != bag_dir and path.parent.is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link, which is not followed", str(path.parent))
    return path


def give_to_owner(path: Path, bag_dir: Path) -> None:
    """Gives a file that root made to the owner of the bag directory, as whom the recorder runs."""
    with suppress(OSError):
        owner = bag_dir.stat()
        if path.lstat().st_uid != owner.st_uid:
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _with_check(begun: bytes) -> bytes:
    """Returns the line that begins so, closed by the CRC-32 of that."""
    return b'%b%b%08x"}' % (begun, _CHECK, crc32(begun))


def _require_check(line: bytes) -> None:
    """Raises ValueError where a line has no check, or that fails."""
    if line != _with_check(line.rpartition(_CHECK)[0]):
        raise ValueError("its check (crc32) is missing or fails: it is damaged, or was edited")
