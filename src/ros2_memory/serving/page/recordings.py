"""The page's choice of a recording: their list, and a memory of one alone."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final, cast

from ros2_memory.bag_dir.layout import is_kept_apart
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.memo import Memo
from ros2_memory.core.text import shortened, similar
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.robots import ADVICE, describe_mixed
from ros2_memory.index.recordings import name_of, paths_named, recordings_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.recorder.index_manager import IndexManager

MOST_RECORDINGS: Final = 300
"""The newest are listed: a week of recordings of an hour is 168."""
_MOST_MEMORIES: Final = 16
"""Memories of single recordings that are cached."""


class Recordings:
    """The recordings of a memory, and a memory for each that a page looks at. Thread-safe."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._memory_of = lru_cache(_MOST_MEMORIES)(self._find)

    def alone(self, name: str) -> Memory:
        """Returns the memory of one recording, or of the recordings in one folder.

        Raises:
            InvalidArgumentsError: there is no recording or folder of this name.
        """
        return self._memory_of(name)

    def _find(self, name: str) -> Memory:
        """Returns the memory of a recording, as `alone`: its ages count from its newest message.

        It has neither a recorder nor a budget.
        """
        index = cast("IndexManager", self._memory.index)  # a page is of one bag directory
        snapshot = index.snapshot()
        is_named = paths_named(f"{index.bag_dir}/{name.strip('/')}").fullmatch
        aside = (*snapshot.active, *snapshot.damaged, *snapshot.unread)
        if not any(is_named(str(file.path)) for file in (*snapshot.bags, *aside)):
            near = similar(name, [str(row["name"]) for row in self._list()])
            hint = f"; similar: {', '.join(near)}" if near else ""
            raise InvalidArgumentsError(f"no recording is named {shortened(name)}{hint}")
        limits = replace(self._memory.limits, now="latest", kept=None, recording=name)
        return replace(self._memory, index=index.alone(name), limits=limits, memo=Memo())

    def shown(self, chosen: Memory, call: Call) -> JsonObject:
        """Returns the recordings, newest first, and notes on mixed robots in the chosen memory."""
        rows = self._list()
        return {
            "recordings": [*rows[:MOST_RECORDINGS]],
            "recordings_total": len(rows),
            "mixed": [note.removesuffix(ADVICE) for note in describe_mixed(chosen, call)],
        }

    def _list(self) -> list[JsonObject]:
        index = self._memory.index
        return _rows(index.published or index.snapshot(), str(index.bag_dir))


def _rows(snapshot: Snapshot, root: str) -> list[JsonObject]:
    """Returns the recordings, and the folders that have several; the newest first."""
    by_name = {name_of(path, bags, root): bags for path, bags in recordings_of(snapshot).items()}
    by_folder: dict[str, list[str]] = {}
    for name in by_name:
        # The folder of the bag directory that has the recording, or the recording itself.
        folder = name if is_kept_apart(name) else name.partition("/")[0]
        by_folder.setdefault(folder, []).append(name)
    rows = [_row(name, bags) for name, bags in by_name.items()]
    for folder, names in by_folder.items():
        if len(names) > 1 and folder not in by_name:
            bags = [bag for name in names for bag in by_name[name]]
            rows.append({**_row(folder, bags), "holds": len(names)})
    return sorted(rows, key=lambda row: (-float(str(row["end"])), str(row["name"])))


def _row(name: str, bags: Sequence[BagFile]) -> JsonObject:
    start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
    return {
        "name": name,
        "start": round(unix_from_ns(start), 1),
        "end": round(unix_from_ns(end), 1),
    }
