"""Measures the bags in a bag directory that its recorder did not make."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import known_identity
from ros2_memory.retention.delete import size_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from ros2_memory.index.snapshot import Snapshot


class Foreign(NamedTuple):
    """The bags that the recorder did not make, which retention neither counts nor deletes.

    `files` are those that answer queries and `bag_bytes` their size; `total_bytes` is that of all.
    """

    files: frozenset[str]
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
        judges: dict[str, Callable[[str], bool]] = {}

        def is_foreign(file: str) -> bool:
            folder, _, name = file.rpartition("/")
            if folder not in judges:
                judges[folder] = self._judge(folder, recording)
            return not judges[folder](name)

        segments = snapshot.timeline.segments
        bags = {
            bag.file: bag.size for each in segments for bag in each.bags if is_foreign(bag.file)
        }
        asides = (*snapshot.active, *snapshot.damaged, *snapshot.unread)
        beside = [each for each in asides if not each.answers and is_foreign(str(each.path))]
        bag_bytes = sum(bags.values())
        return Foreign(
            frozenset(bags), bag_bytes, bag_bytes + sum(size_of(each.path) for each in beside)
        )

    def _judge(self, folder: str, recording: frozenset[str]) -> Callable[[str], bool]:
        """Returns what decides by its name whether a bag in a directory counts in the budget."""
        name, identity = self._own.name_of(folder), known_identity(folder)
        is_new = name in recording and not self._own.lists(name, identity)
        if is_new or name.partition("/")[0] == MOMENTS_FOLDER:
            return lambda _: True
        return self._own.judge(name, identity)
