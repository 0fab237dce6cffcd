"""`.episodic/erasing.json`: messages that are being taken out of bags, until all of them are out.

It is written before the first bag is changed and removed after the last trace has gone, so one that
was interrupted is known, and can be finished: the files are named, and what was to go.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from pydantic import TypeAdapter

from ros2_memory.bag_dir.durable_write import flush, read_small_file, write_durably
from ros2_memory.bag_dir.json_fields import Count, Int64, json_object, validated
from ros2_memory.bag_dir.layout import ERASING_FILE, OWN_FOLDER

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns

FORMAT: Final = 1
_READABLE: Final = 0o644


@dataclass(frozen=True, slots=True)
class Erased:
    """How many messages of a topic go, between two log times (half-open)."""

    topic: str
    start: Int64
    stop: Int64
    count: Count


@dataclass(frozen=True, slots=True)
class Erasure:
    """Which messages are taken out of bags.

    Attributes:
        topics: by name.
        windows: of log time, half-open, in order and apart.
        latched: those of the topics whose messages go also where they were published in a window
            and received again later, as each recording receives them.
        files: the bags that hold some, by their paths in the bag directory, with all hard links.
        counts: what they hold.
    """

    topics: tuple[str, ...]
    windows: tuple[tuple[Int64, Int64], ...]
    latched: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    counts: tuple[Erased, ...] = ()

    @classmethod
    def of(
        cls, topics: Iterable[str], windows: Iterable[TimeWindow], latched: Iterable[str]
    ) -> Erasure:
        """Returns what is to go, of windows in any order that may overlap."""
        merged: list[tuple[Ns, Ns]] = []
        for start, stop in sorted((each.start, each.stop) for each in windows if not each.empty):
            if merged and start <= merged[-1][1]:
                merged[-1] = merged[-1][0], max(stop, merged[-1][1])
            else:
                merged.append((start, stop))
        return cls(tuple(sorted(topics)), tuple(merged), tuple(sorted(latched)))

    def window_of(self, topic: str, log_time: Ns, publish_time: Ns) -> tuple[Ns, Ns] | None:
        """Returns the window by which a message goes; None where it stays."""
        if topic not in self.topics:
            return None
        times = (log_time, publish_time) if topic in self.latched else (log_time,)
        for time in times:
            nth = bisect_right(self.windows, time, key=lambda each: each[0])
            if nth and time < self.windows[nth - 1][1]:
                return self.windows[nth - 1]
        return None

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a message is deleted."""
        return self.window_of(topic, log_time, publish_time) is not None


_ERASURE: Final = TypeAdapter(Erasure)


def read_erasure(bag_dir: Path) -> Erasure | None:
    """Returns what was not finished; None where nothing was begun.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or of another format.
    """
    try:
        text = read_small_file(bag_dir / ERASING_FILE)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return validated(_ERASURE, json_object(text, FORMAT))
    except RecursionError as error:
        raise ValueError("it is nothing but brackets") from error


def write_erasure(bag_dir: Path, erasure: Erasure) -> None:
    """Writes to disk what is about to be deleted.

    Raises:
        OSError: it cannot be written.
    """
    (bag_dir / OWN_FOLDER).mkdir(exist_ok=True)
    text = json.dumps({"format": FORMAT, **asdict(erasure)}, separators=(",", ":"))
    write_durably(bag_dir / ERASING_FILE, text, mode=_READABLE)


def remove_erasure(bag_dir: Path) -> None:
    """Removes the file: everything in it is deleted.

    Raises:
        OSError: it cannot be removed.
    """
    path = bag_dir / ERASING_FILE
    path.unlink(missing_ok=True)
    flush(path.parent)
