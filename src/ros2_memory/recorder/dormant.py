"""Closed bags that lie there as they did when the catalogue learned of them: most of a week.

Of each the index keeps the bag and how its file looked, no more. Should anything about the file
change, it is woken: what is known of it is made as if it had been read, and judged anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.model import BagFile, BagState
from ros2_memory.recorder.scan import YOUNG_NS, other_form, settled
from ros2_memory.recorder.standing import FileNotes, Standing, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.recorder.scan import Stamp
    from ros2_memory.recorder.standing import FormerFile, Scene
    from ros2_memory.storage.base import BagReader
    from ros2_memory.timebase import Ns

_KINDS: Final = (".mcap", ".db3")
"""A compressed one may lie beside what it was made from, and is judged together with it."""


class Dormant:
    """The bags of which nothing but the answers is kept. Not for several threads at once."""

    def __init__(self) -> None:
        self._bags: dict[str, BagFile] = {}
        self._stamps: dict[str, Stamp] = {}

    def __len__(self) -> int:
        return len(self._bags)

    def __iter__(self) -> Iterator[str]:
        return iter(self._bags)

    def __contains__(self, path: str) -> bool:
        return path in self._bags

    def take(
        self,
        stamps: dict[str, Stamp],
        known: Mapping[str, FormerFile],
        reader: BagReader,
        scene: Scene,
    ) -> list[BagFile]:
        """Takes over, and out of `stamps`, the files that look as they are known; gives their bags.

        Files of which more is to be weighed are left: young ones, and those that say nothing.
        """
        patience = max(scene.three_splits, YOUNG_NS)
        reads = {kind: reader.reads(Path(f"bag{kind}")) for kind in _KINDS}
        compressed = any(path.endswith(".zstd") for path in stamps)
        taken = self._bags
        for path, file in known.items():
            stamp = stamps.get(path)
            if stamp is None:
                continue
            size, mtime_ns, sidecar_ns, summary, start, end = file
            if (
                (size, mtime_ns, sidecar_ns) != (stamp.size, stamp.mtime_ns, stamp.sidecar_ns)
                or scene.now - mtime_ns <= patience
                or not reads.get(path[path.rfind(".") :])
                or not (summary.shape.complete and summary.shape.topics)
                or (compressed and other_form(path) in stamps)
            ):
                continue
            taken[path] = BagFile(
                path, size, mtime_ns, BagState.CLOSED, summary, start, end, sidecar_ns
            )
        self._stamps = {path: stamps.pop(path) for path in taken}
        return [*taken.values()]

    def is_undisturbed(self, path: str, stamp: Stamp, now: Ns) -> bool:
        """Whether a file is one of these, and looks as before."""
        before = self._stamps.get(path)
        if before is None or not settled(stamp.mtime_ns, now):
            return False
        return stamp.shows(before)

    def wake(self, path: str, now: Ns) -> tuple[FileNotes, Verdict] | None:
        """Gives up a file: what would be known of it, had it been read; None where it is none."""
        bag = self._bags.pop(path, None)
        if bag is None:
            return None
        notes = FileNotes.first(Path(path), self._stamps.pop(path), now)
        notes.recall(bag.summary)
        return notes, Verdict(Standing.CLOSED, bag)
