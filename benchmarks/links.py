"""Many recordings from one: other names for the same bag files, which cost no disk."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.bags import SPLIT_NS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from benchmarks.bags import History


@dataclass(frozen=True, slots=True)
class Linked:
    """Recordings in a folder, each of them links to the bags of one history."""

    folder: Path
    hour: History
    recordings: int

    @property
    def bags(self) -> int:
        """How many bag files there are."""
        return self.hour.bags * self.recordings

    def links(self) -> Iterator[tuple[Path, Path, int]]:
        """Link, file, and by how many nanoseconds the link's bag is later; oldest first."""
        for recording in range(self.recordings):
            later = (recording - self.recordings + 1) * self.hour.bags * SPLIT_NS
            name = f"rec_{recording:04}"
            for split in self.hour.splits():
                yield self.folder / name / f"{name}_{split.number}.mcap", split.path, later


def linked(hour: History, recordings: int) -> Linked:
    """The recordings beside the history that they are made of, made anew."""
    folder = hour.folder.with_name(f"linked_{hour.bags}_{recordings}")
    shutil.rmtree(folder, ignore_errors=True)
    whole = Linked(folder, hour, recordings)
    for link, file, _ in whole.links():
        if not link.parent.is_dir():
            link.parent.mkdir(parents=True)
        link.hardlink_to(file)
    # A folder that changed within the last two seconds is looked through again at every scan.
    for place in (*folder.iterdir(), folder):
        os.utime(place, ns=(hour.end, hour.end))
    return whole
