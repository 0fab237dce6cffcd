"""The page's choice of a recording: their list, and a memory of one alone."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from typing import TYPE_CHECKING, Final, cast

from ros2_memory.bag_dir.layout import is_kept_apart
from ros2_memory.core.errors import EpisodicError, InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.memo import Memo
from ros2_memory.core.text import shortened, similar
from ros2_memory.core.timebase import Ns, unix_from_ns
from ros2_memory.history.robots import (
    ADVICE,
    contradicting_frames,
    describe_mixed,
    mixed_recordings,
)
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.serving.page.span import path_in

if TYPE_CHECKING:
    from ros2_memory.core.model import BagFile, JsonValue, TimeWindow
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.recorder.index_manager import IndexManager

MOST_RECORDINGS: Final = 300
"""The newest are listed: a week of recordings of an hour is 168."""
MOST_PATHS: Final = 6
"""Colours that can be told apart on one map."""
_MOST_MEMORIES: Final = 16
"""Memories of single recordings that are cached."""


class Recordings:
    """The recordings of a memory, and a memory for each that a page looks at. Thread-safe."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._memory_of = lru_cache(_MOST_MEMORIES)(partial(_memory_of, memory))

    def alone(self, name: str) -> Memory:
        """Returns the memory of one recording, or of the recordings in one folder.

        Raises:
            InvalidArgumentsError: there is no recording or folder of this name.
        """
        alone = self._memory_of(name)
        snapshot = alone.index.snapshot()
        if not (snapshot.bags or snapshot.active or snapshot.damaged or snapshot.unread):
            near = similar(name, [str(row["name"]) for row in self._list()])
            hint = f"; similar: {', '.join(near)}" if near else ""
            raise InvalidArgumentsError(f"no recording is named {shortened(name)}{hint}")
        return alone

    def shown(self, chosen: Memory, call: Call) -> JsonObject:
        """Returns the recordings, newest first, and notes on mixed robots in the chosen memory."""
        rows = self._list()
        return {
            "recordings": [*rows[:MOST_RECORDINGS]],
            "recordings_total": len(rows),
            "mixed": [note.removesuffix(ADVICE) for note in describe_mixed(chosen, call)],
        }

    def paths(self, chosen: Memory, call: Call, window: TimeWindow) -> JsonObject:
        """Returns a path for each robot if recordings are plainly of several robots; else none.

        A robot is one recording, or a folder of recordings that do not overlap each other. The
        newest `MOST_PATHS` robots have a path, by name.
        """
        names = _robots(chosen, call, window)
        robot_paths: list[JsonValue] = []
        for name in sorted(names[:MOST_PATHS]):
            try:
                alone = self.alone(name)
                limits = replace(alone.limits, pose_topic=chosen.limits.pose_topic)
                path = path_in(replace(alone, limits=limits), call, window)
            except QueryTimeoutError as error:
                robot_paths.append({"name": name, "error": str(error), "late": True})
            except EpisodicError as error:
                robot_paths.append({"name": name, "error": str(error)})
            else:
                if path is not None:
                    robot_paths.append({"name": name, **path})
        return {"paths": robot_paths, "paths_left_out": len(names[MOST_PATHS:])}

    def _list(self) -> list[JsonObject]:
        index = self._memory.index
        return _rows(index.published or index.snapshot(), str(index.bag_dir))


def _memory_of(memory: Memory, name: str) -> Memory:
    """Returns a memory of one recording: its ages count from its newest message.

    It has neither a recorder nor a budget.
    """
    index = cast("IndexManager", memory.index)  # a page is of one bag directory
    limits = replace(memory.limits, now="latest", kept=None, recording=name)
    return replace(memory, index=index.alone(name), limits=limits, memo=Memo())


def _rows(snapshot: Snapshot, root: str) -> list[JsonObject]:
    """Returns the recordings, and the folders that have several; the newest first."""
    by_name = {name_of(path, bags, root): bags for path, bags in recordings_of(snapshot).items()}
    rows: list[JsonObject] = []
    bags_by_folder: dict[str, list[list[BagFile]]] = {}
    for name, bags in by_name.items():
        rows.append(_row(name, bags))
        folder = _folder(name)
        if folder not in by_name:
            bags_by_folder.setdefault(folder, []).append(bags)
    for folder, recordings in bags_by_folder.items():
        if len(recordings) > 1:
            row = _row(folder, [*chain.from_iterable(recordings)])
            rows.append({**row, "holds": len(recordings)})
    return sorted(rows, key=lambda row: (-float(str(row["end"])), str(row["name"])))


def _robots(memory: Memory, call: Call, window: TimeWindow) -> list[str]:
    """Returns the names of robots in a window, the newest first; none unless there are several.

    There are several if recordings overlap in time, or have contradicting frames. A folder of
    recordings is one robot. If its recordings overlap each other, each recording is one.
    """
    root, ends = str(memory.index.bag_dir), dict[str, Ns]()
    for path, bags in recordings_of(memory.index.snapshot()).items():
        if any(bag.reaches_into(window) for bag in bags):
            ends[name_of(path, bags, root)] = max(bag.end for bag in bags)
    is_mixed = False
    folders_with_overlaps: set[str] = set()
    for pair, topic in mixed_recordings(memory, call):
        if topic is not None and window.overlaps(pair.start, pair.end):
            is_mixed = True
            first, second = (
                _folder(str(path).removeprefix(f"{root}/")) for path in (pair.first, pair.second)
            )
            if first == second:
                folders_with_overlaps.add(first)
    if not is_mixed and not _has_contradictions(memory, call, {*map(_folder, ends)}):
        return []
    robots: dict[str, Ns] = {}
    for name, end in ends.items():
        folder = _folder(name)
        robot = name if folder in folders_with_overlaps else folder
        robots[robot] = max(end, robots.get(robot, end))
    return sorted(robots, key=lambda robot: (robots[robot], robot), reverse=True)


def _has_contradictions(memory: Memory, call: Call, folders: set[str]) -> bool:
    """Returns whether recordings of two of these folders have contradicting frames."""
    root = str(memory.index.bag_dir)
    for contradiction in contradicting_frames(memory, call):
        involved = {_folder(path.removeprefix(f"{root}/")) for path in contradiction.recordings}
        if len(involved) > 1 and involved <= folders:
            return True
    return False


def _folder(name: str) -> str:
    """Returns the folder of the bag directory that has a recording, or the recording itself."""
    return name if is_kept_apart(name) else name.partition("/")[0]


def _row(name: str, bags: list[BagFile]) -> JsonObject:
    start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
    return {
        "name": name,
        "start": round(unix_from_ns(start), 1),
        "end": round(unix_from_ns(end), 1),
    }
