"""One recording of many, for the page: which there are, and a memory that holds one alone."""

from __future__ import annotations

from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache, partial
from itertools import chain
from typing import TYPE_CHECKING, Final, cast

from ros2_memory.bag_dir.layout import is_kept_apart
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.memo import Memo
from ros2_memory.core.text import shortened
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.robots import (
    ADVICE,
    describe_mixed,
)
from ros2_memory.index.recordings import name_of, recordings_of

if TYPE_CHECKING:
    from ros2_memory.core.model import BagFile
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.recorder.index_manager import IndexManager

MOST_RECORDINGS: Final = 300
"""The newest are listed: a week of recordings of an hour is 168."""
_MOST_MEMORIES: Final = 16
"""Recordings that pages look at and that stay at hand."""


class Recordings:
    """The recordings of a memory, and a memory for each that is looked at. Thread-safe."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._narrowed = lru_cache(_MOST_MEMORIES)(partial(_narrowed, memory))

    def alone(self, name: str) -> Memory:
        """Returns a memory that holds one recording, or those of one folder, and nothing else.

        Raises:
            InvalidArgumentsError: none is named so.
        """
        alone = self._narrowed(name)
        snapshot = alone.index.snapshot()
        if not (snapshot.bags or snapshot.active or snapshot.damaged or snapshot.unread):
            near = get_close_matches(name, [str(row["name"]) for row in self._list()], n=3)
            similar = f"; similar: {', '.join(near)}" if near else ""
            raise InvalidArgumentsError(f"no recording is named {shortened(name)}{similar}")
        return alone

    def shown(self, chosen: Memory, call: Call) -> JsonObject:
        """Returns the recordings, newest first, and where robots are mixed in what is chosen."""
        rows = self._list()
        return {
            "recordings": [*rows[:MOST_RECORDINGS]],
            "recordings_total": len(rows),
            "mixed": [note.removesuffix(ADVICE) for note in describe_mixed(chosen, call)],
        }

    def _list(self) -> list[JsonObject]:
        index = self._memory.index
        return _rows(index.published or index.snapshot(), str(index.bag_dir))


def _narrowed(memory: Memory, name: str) -> Memory:
    """Returns a memory of one recording: its ages count from its newest message.

    It has neither a recorder nor a budget.
    """
    index = cast("IndexManager", memory.index)  # a page is of one bag directory
    limits = replace(memory.limits, now="latest", kept=None, recording=name)
    return replace(memory, index=index.alone(name), limits=limits, memo=Memo())


def _rows(snapshot: Snapshot, root: str) -> list[JsonObject]:
    """Returns recordings, and the folders of the bag directory that hold several of them."""
    by_name = {name_of(path, bags, root): bags for path, bags in recordings_of(snapshot).items()}
    folders: dict[str, list[list[BagFile]]] = {}
    for name, bags in by_name.items():
        if "/" in name and not is_kept_apart(name):
            folders.setdefault(name.partition("/")[0], []).append(bags)
    rows = [_row(name, bags) for name, bags in by_name.items()]
    for folder, inside in folders.items():
        if len(inside) > 1 and folder not in by_name:
            rows.append({**_row(folder, [*chain.from_iterable(inside)]), "holds": len(inside)})
    return sorted(rows, key=lambda row: (-float(str(row["end"])), str(row["name"])))


def _row(name: str, bags: list[BagFile]) -> JsonObject:
    start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
    return {
        "name": name,
        "start": round(unix_from_ns(start), 1),
        "end": round(unix_from_ns(end), 1),
    }
