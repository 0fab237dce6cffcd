"""`.episodic/shipped.jsonl`: which bags are in a lake: `ros2-memory ship` confirms its commits.

A line for each bag that was shipped. Lines of other versions, and a last line that a crash cut
short, are ignored.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from pydantic import TypeAdapter

from ros2_memory.bag_dir.durable_write import append_durably, open_plain, write_durably
from ros2_memory.bag_dir.json_fields import Count, Int64, json_object, validated
from ros2_memory.bag_dir.layout import SHIPPED_FILE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_MOST_BYTES: Final = 64 << 20
_SPARE_LINES: Final = 1000


@dataclass(frozen=True, slots=True)
class Receipt:
    """One bag that is in a lake.

    Attributes:
        bag: its path below the bag directory.
        bag_id: its id in the lake.
        size: of its file when it was shipped (bytes).
        sha256: of its file, in hexadecimal.
        lake: the id of the lake.
        at: when it was committed (ns).
    """

    bag: str
    bag_id: str
    size: Count
    sha256: str
    lake: str
    at: Int64


_RECEIPT: Final = TypeAdapter(Receipt)


def read_receipts(bag_dir: Path) -> dict[str, Receipt]:
    """Returns the newest receipt of each bag, by its path; none where there is no file.

    Raises:
        OSError: the file cannot be read.
    """
    return _read(bag_dir)[0]


def append_receipts(bag_dir: Path, receipts: Iterable[Receipt]) -> None:
    """Appends receipts durably. Those of bags that are gone are dropped where most lines are.

    Raises:
        OSError: the file cannot be written, as where the bag directory is mounted read-only.
    """
    target = bag_dir / SHIPPED_FILE
    target.parent.mkdir(exist_ok=True)
    append_durably(target, _lines(receipts))
    known, lines = _read(bag_dir)
    if lines <= _SPARE_LINES:
        return
    present = {path: each for path, each in known.items() if (bag_dir / path).exists()}
    if lines > _SPARE_LINES + 2 * len(present):
        write_durably(target, _lines(present.values()))


class ReceiptBook:
    """The receipts of a bag directory, read again where the file has changed. Not thread-safe.

    Keeps sizes alone: a week has 60,000 bags.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._stamp: tuple[int, int, int] | None = None
        self._sizes: Mapping[str, int] = {}

    def lacking(self, bags: Iterable[tuple[str, int]]) -> frozenset[str]:
        """Returns those of some bags, given by path and size (bytes), that are in no lake.

        That is all of them where the receipts cannot be read.
        """
        try:
            status = (self._bag_dir / SHIPPED_FILE).stat()
            stamp = status.st_ino, status.st_size, status.st_mtime_ns
            if stamp != self._stamp:
                receipts = read_receipts(self._bag_dir)
                self._sizes = {path: each.size for path, each in receipts.items()}
                self._stamp = stamp
        except OSError:
            self._stamp, self._sizes = None, {}
        return frozenset(path for path, size in bags if self._sizes.get(path) != size)


def _lines(receipts: Iterable[Receipt]) -> str:
    return "".join(f"{json.dumps(asdict(each))}\n" for each in receipts)


def _read(bag_dir: Path) -> tuple[dict[str, Receipt], int]:
    """Returns the receipts, and how many lines there are."""
    try:
        with open_plain(bag_dir / SHIPPED_FILE) as stream:
            lines = stream.read(_MOST_BYTES).decode(errors="replace").splitlines()
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}, 0
    found: dict[str, Receipt] = {}
    for line in lines:
        try:
            receipt = validated(_RECEIPT, json_object(line))
        except (ValueError, RecursionError):
            continue
        found[receipt.bag] = receipt
    return found, len(lines)


def is_shipped(receipts: Mapping[str, Receipt], bag: str, size: int) -> bool:
    """Returns whether a bag of this path and size is in a lake."""
    receipt = receipts.get(bag)
    return receipt is not None and receipt.size == size
