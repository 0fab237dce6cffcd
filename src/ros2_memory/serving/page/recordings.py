"""One recording of many, for the page: which there are, and a memory that holds one alone."""

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
            near = similar(name, [str(row["name"]) for row in self._list()])
            hint = f"; similar: {', '.join(near)}" if near else ""
            raise InvalidArgumentsError(f"no recording is named {shortened(name)}{hint}")
        return alone

    def shown(self, chosen: Memory, call: Call) -> JsonObject:
        """Returns the recordings, newest first, and where robots are mixed in what is chosen."""
        rows = self._list()
        return {
            "recordings": [*rows[:MOST_RECORDINGS]],
            "recordings_total": len(rows),
            "mixed": [note.removesuffix(ADVICE) for note in describe_mixed(chosen, call)],
        }

    def paths(self, chosen: Memory, call: Call, window: TimeWindow) -> JsonObject:
        """Returns a path for each robot, where recordings are plainly of several; else none.

        Each is of one recording, or of a folder of recordings that do not overlap each other.
        Of more than `MOST_PATHS` the newest are there; in order of name.
        """
        names = _robots(chosen, call, window)
        robot_paths: list[JsonValue] = []
        for name in sorted(names[:MOST_PATHS]):
            try:
                alone = self.alone(name)
                limits = replace(alone.limits, pose_topic=chosen.limits.pose_topic)
                path = path_in(replace(alone, limits=limits), call, window)
            except EpisodicError as error:
                late = {"late": True} if isinstance(error, QueryTimeoutError) else {}
                robot_paths.append({"name": name, "error": str(error), **late})
                continue
            if path is not None:
                robot_paths.append({"name": name, **path})
        return {"paths": robot_paths, "paths_left_out": len(names[MOST_PATHS:])}

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


def _robots(memory: Memory, call: Call, window: TimeWindow) -> list[str]:
    """Returns the names under which the robots of a window are found, if there are several.

    Some of their recordings overlap in time, or have frames of other robots. A folder is one, but
    for one whose own recordings overlap: there each recording is. The newest come first.
    """
    root, ends = str(memory.index.bag_dir), dict[str, Ns]()
    for path, bags in recordings_of(memory.index.snapshot()).items():
        if any(bag.reaches_into(window) for bag in bags):
            ends[name_of(path, bags, root)] = max(bag.end for bag in bags)
    present = {*map(_folder, ends)}
    unlike = (
        {_folder(path.removeprefix(f"{root}/")) for path in contradiction.recordings}
        for contradiction in contradicting_frames(memory, call)
    )
    overlaps = [
        {_folder(str(path).removeprefix(f"{root}/")) for path in (pair.first, pair.second)}
        for pair, topic in mixed_recordings(memory, call)
        if topic is not None and window.overlaps(pair.start, pair.end)
    ]
    if not overlaps and not any(len(pair) > 1 and pair <= present for pair in unlike):
        return []
    split = {folder for pair in overlaps if len(pair) == 1 for folder in pair}
    robots: dict[str, Ns] = {}
    for name, end in ends.items():
        robot = name if _folder(name) in split else _folder(name)
        robots[robot] = max(end, robots.get(robot, end))
    return sorted(robots, key=lambda robot: (robots[robot], robot), reverse=True)


def _folder(name: str) -> str:
    """Returns the folder of the bag directory that holds a recording, or the recording itself."""
    return name if is_kept_apart(name) else name.partition("/")[0]


def _row(name: str, bags: list[BagFile]) -> JsonObject:
    start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
    return {
        "name": name,
        "start": round(unix_from_ns(start), 1),
        "end": round(unix_from_ns(end), 1),
    }
