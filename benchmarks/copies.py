"""Many recordings from one: copies of its bag files.

The newest recording is hard links, which cost no disk. The others are files of their own, since an
index counts two names of one file once.
"""

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
class Copies:
    """Recordings in a folder, each of them the bags of one history."""

    folder: Path
    hour: History
    recordings: int

    @property
    def bags(self) -> int:
        """How many bag files there are."""
        return self.hour.bags * self.recordings

    def files(self) -> Iterator[tuple[Path, Path, int]]:
        """Copy, original, and by how many nanoseconds the copy's bag is later; oldest first."""
        for recording in range(self.recordings):
            later = (recording - self.recordings + 1) * self.hour.bags * SPLIT_NS
            name = f"rec_{recording:04}"
            for split in self.hour.splits():
                yield self.folder / name / f"{name}_{split.number}.mcap", split.path, later


def copied(hour: History, recordings: int) -> Copies:
    """The recordings beside the history that they are made of, made anew."""
    folder = hour.folder.with_name(f"copied_{hour.bags}_{recordings}")
    shutil.rmtree(folder, ignore_errors=True)
    whole = Copies(folder, hour, recordings)
    for copy, file, later in whole.files():
        if not copy.parent.is_dir():
            copy.parent.mkdir(parents=True)
        if later:
            shutil.copy2(file, copy)
        else:
            copy.hardlink_to(file)
    # A folder that changed within the last two seconds is looked through again at every scan.
    for place in (*folder.iterdir(), folder):
        os.utime(place, ns=(hour.end, hour.end))
    return whole
