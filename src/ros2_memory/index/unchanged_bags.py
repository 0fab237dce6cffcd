"""Closed bags that do not change any more, or not since their columns were stored: most of a week.

Of each the index keeps the bag and its inode, and nothing else. Should its file change, it is
reactivated: the notes on it are made as if it had been read, and it is classified again.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.layout import COMPRESSED, other_form
from ros2_memory.index.file_state import Classification, FileNotes, FileState
from ros2_memory.index.scan import YOUNG_NS, Stamp, settled

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.file_state import ScanContext
    from ros2_memory.storage.base import BagReader

KINDS: Final = (".mcap", ".db3")
"""A compressed bag may lie beside the file it was made from, and is classified with that."""


class UnchangedBags:
    """The bags of which only answers are kept. Not for several threads at once."""

    def __init__(self) -> None:
        self._bags: dict[str, BagFile] = {}
        self._inodes: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._bags)

    def __iter__(self) -> Iterator[str]:
        return iter(self._bags)

    def __contains__(self, path: str) -> bool:
        return path in self._bags

    def take(
        self,
        stamps: dict[str, Stamp],
        known: Mapping[str, BagFile],
        reader: BagReader,
        context: ScanContext,
    ) -> list[BagFile]:
        """Takes the files that are unchanged out of `stamps`.

        Files that need a closer look stay: young ones, and empty or incomplete ones.

        Returns:
            Their bags in the order of their starts.
        """
        last = context.now - max(context.three_splits, YOUNG_NS)
        kinds = tuple(kind for kind in KINDS if reader.reads(Path(f"bag{kind}")))
        compressed = {path for path in stamps if path.endswith(COMPRESSED)}
        taken, inodes = self._bags, self._inodes
        for path, (size, mtime_ns, _, inode, sidecar_ns) in stamps.items():
            file = known.get(path)
            if (
                file is not None
                and file.mtime_ns == mtime_ns < last
                and (file.size, file.sidecar_ns) == (size, sidecar_ns)
                and path.endswith(kinds)
                and (schema := file.summary.schema).complete
                and schema.topics
                and not (compressed and other_form(path) in compressed)
            ):
                taken[file.file], inodes[file.file] = file, inode
        rest = {path: stamp for path, stamp in stamps.items() if path not in taken}
        stamps.clear()
        stamps.update(rest)
        # Sorted here by numpy: sorting what is sorted takes no time later.
        bags = [*taken.values()]
        order = np.argsort(np.array([bag.start for bag in bags], np.int64), kind="stable")
        return [bags[at] for at in order.tolist()]

    def add(self, bag: BagFile, inode: int) -> None:
        """Adds a bag that has proved to be closed, and old enough not to change."""
        self._bags[bag.file], self._inodes[bag.file] = bag, inode

    def rows(self) -> Iterator[tuple[BagFile, int]]:
        """Yields each bag with its inode."""
        return zip(self._bags.values(), map(self._inodes.__getitem__, self._bags), strict=True)

    def is_unchanged(self, path: str, stamp: Stamp, now: Ns) -> bool:
        """Returns whether a file is one of these, and looks as before."""
        known = self.stamp(path)
        return known is not None and settled(stamp.mtime_ns, now) and stamp.matches(known)

    def stamp(self, path: str) -> Stamp | None:
        """Returns the stamp of one of these files; None for any other.

        Its ctime is 0: that counts only where a file could not be read.
        """
        bag = self._bags.get(path)
        if bag is None:
            return None
        return Stamp(bag.size, bag.mtime_ns, 0, self._inodes[path], bag.sidecar_ns)

    def reactivate(self, path: str, now: Ns) -> tuple[FileNotes, Classification] | None:
        """Removes a file, and returns what would be known had it been read; None for any other."""
        stamp = self.stamp(path)
        if stamp is None:
            return None
        bag = self._bags.pop(path)
        del self._inodes[path]
        notes = FileNotes.first(path, stamp, now)
        notes.restore(bag.summary)
        return notes, Classification(FileState.CLOSED, bag)
