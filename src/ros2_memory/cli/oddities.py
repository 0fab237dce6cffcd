"""What `info` and `doctor` say of a bag directory beyond what the tools reply."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.timebase import Ns, ns_from_unix
from ros2_memory.index.overlaps import named, overlapping_recordings
from ros2_memory.recorder.index_manager import SPLITS_OF_PATIENCE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class Merged:
    """Two recordings by name, and when they overlap (log times, inclusive)."""

    first: str
    second: str
    start: Ns
    end: Ns


def merged(snapshot: Snapshot) -> list[Merged]:
    """The recordings that overlap, and are answered together without being one."""
    pairs = overlapping_recordings(snapshot)
    return [
        Merged(first, second, pair.start, pair.end)
        for pair, (first, second) in zip(pairs, named(pairs), strict=True)
    ]


def counted_as_active(memory: Memory, snapshot: Snapshot) -> Iterator[tuple[Path, Ns]]:
    """Files without an end that count as being written for no other reason than being fresh.

    Each with the moment (wall clock) from which it counts as left open by a crash. There are none
    where a recorder says what it writes.
    """
    heartbeat = memory.index.heartbeat()
    if heartbeat is not None and heartbeat.is_live(memory.clock.now()):
        return
    patience = ns_from_unix(SPLITS_OF_PATIENCE * memory.limits.split_duration_s)
    for each in snapshot.active:
        try:
            yield each.path, each.path.stat().st_mtime_ns + patience
        except OSError:
            continue  # it was moved or deleted meanwhile
