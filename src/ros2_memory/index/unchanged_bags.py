"""Closed bags that lie there as they did when the catalogue learned of them: most of a week.

Of each the index keeps the bag and the number of its file, no more. Should anything about the file
change, it is woken: what is known of it is made as if it had been read, and judged anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.bag_dir.layout import COMPRESSED, other_form
from ros2_memory.core.model import BagFile, BagState
from ros2_memory.index.file_state import Classification, FileNotes, FileState
from ros2_memory.index.scan import YOUNG_NS, Stamp, settled

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.file_state import KnownFile, ScanContext
    from ros2_memory.storage.base import BagReader

_KINDS: Final = (".mcap", ".db3")
"""A compressed one may lie beside what it was made from, and is judged together with it."""
_CLOSED: Final = BagState.CLOSED


class UnchangedBags:
    """The bags of which nothing but the answers is kept. Not for several threads at once."""

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
        known: Mapping[str, KnownFile],
        reader: BagReader,
        scene: ScanContext,
    ) -> list[BagFile]:
        """Takes over, and out of `stamps`, the files that look as they are known.

        Files of which more is to be weighed are left: young ones, and those that say nothing.
        Gives the bags in the order of their starts.
        """
        last = scene.now - max(scene.three_splits, YOUNG_NS)
        kinds = tuple(kind for kind in _KINDS if reader.reads(Path(f"bag{kind}")))
        compressed = {path for path in stamps if path.endswith(COMPRESSED)}
        taken, inodes = self._bags, self._inodes
        for path, (size, mtime_ns, _, inode, sidecar_ns) in stamps.items():
            file = known.get(path)
            if (
                file is not None
                and file[:3] == (size, mtime_ns, sidecar_ns)
                and mtime_ns < last
                and path.endswith(kinds)
                and (summary := file.summary).shape.complete
                and summary.shape.topics
                and not (compressed and other_form(path) in compressed)
            ):
                taken[path] = BagFile(
                    path, size, mtime_ns, _CLOSED, summary, file.start, file.end, sidecar_ns
                )
                inodes[path] = inode
        rest = {path: stamp for path, stamp in stamps.items() if path not in taken}
        stamps.clear()
        stamps.update(rest)
        return _in_time([*taken.values()])

    def is_undisturbed(self, path: str, stamp: Stamp, now: Ns) -> bool:
        """Whether a file is one of these, and looks as before."""
        bag = self._bags.get(path)
        if bag is None or not settled(stamp.mtime_ns, now):
            return False
        return stamp.shows(self._stamp(bag))

    def stamp(self, path: str) -> Stamp | None:
        """How a file of these looked; None where it is none."""
        bag = self._bags.get(path)
        return None if bag is None else self._stamp(bag)

    def wake(self, path: str, now: Ns) -> tuple[FileNotes, Classification] | None:
        """Gives up a file: what would be known of it, had it been read; None where it is none."""
        bag = self._bags.pop(path, None)
        if bag is None:
            return None
        notes = FileNotes.first(Path(path), self._stamp(bag), now)
        del self._inodes[path]
        notes.recall(bag.summary)
        return notes, Classification(FileState.CLOSED, bag)

    def _stamp(self, bag: BagFile) -> Stamp:
        """How the file looked. The ctime counts only where a file could not be read."""
        return Stamp(bag.size, bag.mtime_ns, 0, self._inodes[bag.file], bag.sidecar_ns)


def _in_time(bags: list[BagFile]) -> list[BagFile]:
    """The bags by their starts: sorting what is sorted takes no time later."""
    order = np.argsort(np.array([bag.start for bag in bags], np.int64), kind="stable")
    return [bags[at] for at in order.tolist()]
