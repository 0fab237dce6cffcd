"""Measures the bags in a bag directory that its recorder did not make."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.bag_dir.layout import is_kept_apart
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import known_identity
from ros2_memory.retention.delete import size_of

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from ros2_memory.index.snapshot import Snapshot


class Foreign(NamedTuple):
    """The bags that the recorder did not make, which retention neither counts nor deletes.

    `folders` are the directories that they lie in. `bag_bytes` is the size of those that answer
    queries, `total_bytes` that of all.
    """

    folders: frozenset[str]
    bag_bytes: int
    total_bytes: int


class ForeignBags:
    """Measures the foreign bags of one bag directory. Thread-safe.

    The last result is returned again while neither the index nor the list changed.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._own = OwnRecordings(bag_dir)
        self._known: tuple[tuple[object, ...], Foreign] | None = None

    def measured(self, snapshot: Snapshot, recording: Collection[str]) -> Foreign | None:
        """Measures them; returns None if no recorder has listed yet which recordings are its own.

        `recording` are the recordings that the recorder's heartbeat names.
        """
        try:
            if not self._own.exists():
                return None
        except OSError:
            return None
        set_aside = (snapshot.active, snapshot.damaged, snapshot.unread)
        key = (snapshot.timeline, *set_aside, self._own.stamp, tuple(recording))
        known = self._known
        if known is None or known[0] != key:
            known = self._known = (key, self._measured(snapshot, frozenset(recording)))
        return known[1]

    def _measured(self, snapshot: Snapshot, recording: frozenset[str]) -> Foreign:
        sizes: dict[str, int] = {}
        for run in snapshot.timeline.segments:
            for folder, tally in run.tallies.items():
                sizes[folder] = sizes.get(folder, 0) + tally.size
        asides = [
            aside
            for aside in (*snapshot.active, *snapshot.damaged, *snapshot.unread)
            if not aside.answers
        ]
        folders = {str(aside.path.parent) for aside in asides} | sizes.keys()
        foreign = frozenset(each for each in folders if not self._is_own(each, recording))
        bag_bytes = sum(size for folder, size in sizes.items() if folder in foreign)
        beside = sum(size_of(each.path) for each in asides if str(each.path.parent) in foreign)
        return Foreign(foreign, bag_bytes, bag_bytes + beside)

    def _is_own(self, folder: str, recording: frozenset[str]) -> bool:
        """Whether a directory is the recorder's; bags of others may lie in it all the same."""
        name = self._own.name_of(folder)
        if name in recording or is_kept_apart(name):
            return True
        return self._own.lists(name, known_identity(folder))
