"""Which bags are of one recording: mostly those of one folder.

Bags that somebody copied into one folder are of several: each file is a recording of its own, and
so are files that `ros2 bag record` numbered (`run_0.mcap`, `run_1.mcap`) and that follow each
other.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import BagFile
    from ros2_memory.index.snapshot import Snapshot

_NUMBERED: Final = re.compile(
    r"(?P<series>.+?)(?:_(?P<number>\d+))?\.(?:mcap|db3)(?:\.zstd)?", re.IGNORECASE
)


def recordings_of(snapshot: Snapshot) -> dict[str, list[BagFile]]:
    """Returns the bags of each recording, by its path: a folder, or that of a bag less its suffix.

    With `data.recording` each of these names, below the bag directory, is one recording.
    """
    loose = loose_bags(snapshot)
    found: dict[str, list[BagFile]] = {}
    for bag in snapshot.bags:
        found.setdefault(loose.get(bag.file) or folder_of(bag.file), []).append(bag)
    return found


def loose_bags(snapshot: Snapshot) -> dict[str, str]:
    """Returns the recording of each bag that lies loose in a folder, by path of the bag.

    A folder with a metadata.yaml is one recording, and so is one whose bags are
    named after it, or with a number alone.
    """
    folders: dict[str, list[BagFile]] = {}
    whole = {*snapshot.metadata_folders}
    for bag in snapshot.bags:
        folder, _, name = bag.file.rpartition("/")
        is_split = (
            name.startswith(f"{folder.rpartition('/')[2]}_") or name.partition(".")[0].isdigit()
        )
        if not is_split and folder not in whole:
            folders.setdefault(folder, []).append(bag)
    found: dict[str, str] = {}
    for bags in folders.values():
        series: dict[str, list[BagFile]] = {}
        for bag in bags:
            series.setdefault(_series_of(bag.file)[0], []).append(bag)
        for name, members in series.items():
            is_one = _follow(members)
            found.update({bag.file: name if is_one else stem_of(bag.file) for bag in members})
    return found


def folder_of(file: str) -> str:
    """Returns the folder of a file."""
    return file.rpartition("/")[0]


def stem_of(file: str) -> str:
    """Returns the path of a bag without its suffixes."""
    series, number = _series_of(file)
    return series if number is None else f"{series}_{number}"


def _series_of(file: str) -> tuple[str, str | None]:
    found = _NUMBERED.fullmatch(file)
    return (file, None) if found is None else (found["series"], found["number"])


def _follow(bags: Sequence[BagFile]) -> bool:
    """Returns whether bags are numbered, and each ends before the next begins."""
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end))
    is_numbered = len(bags) == 1 or all(_series_of(bag.file)[1] is not None for bag in bags)
    return is_numbered and all(
        one.end <= next_one.start + OUT_OF_ORDER_NS for one, next_one in pairwise(ordered)
    )
