"""Which bags are of one recording.

Most recordings are a folder. Where somebody copied bags of several recordings into one folder, each
file is a recording. Files that `ros2 bag record` numbered (`run_0.mcap`, `run_1.mcap`), and that
follow each other in time, are one recording together.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BAG_KINDS
from ros2_memory.index.split_order import split_of, stem_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.bag_summary import SummarySchema
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.snapshot import Snapshot

BAG_DIR_ITSELF: Final = "."
"""Names the recording whose bags lie in the bag directory itself, if their names do not."""
_LONE_NUMBER: Final = re.compile(r"_(?:0|[1-9]\d{0,4})$")
_BESIDE_OTHERS: Final[Key[dict[tuple[str, ...], dict[str, str]]]] = Key()
"""Of a timeline: `loose_bags_beside_others`, by the folders with a metadata.yaml."""


def paths_named(path: str) -> re.Pattern[str]:
    """Returns a pattern for the paths of a recording and of the files in it.

    `path` is a folder, a bag with or without its suffix, or a series of bags (`run` for
    `run_0.mcap`, `run_1.mcap`). `folder/.` has what lies in a folder itself.
    """
    if path.endswith(f"/{BAG_DIR_ITSELF}"):
        return re.compile(rf"{re.escape(path.removesuffix(BAG_DIR_ITSELF))}[^/]*", re.DOTALL)
    suffixes = "|".join(map(re.escape, BAG_KINDS))
    return re.compile(rf"{re.escape(path)}(?:/.*|(?:_\d+)?(?:{suffixes}))?", re.DOTALL)


def recordings_of(
    snapshot: Snapshot, is_wanted: Callable[[SummarySchema], object] = lambda _: True
) -> dict[str, list[BagFile]]:
    """Returns the bags of each recording whose schema is wanted.

    The key is the path of the recording: a folder, or a bag without its suffix. `data.recording`
    takes this path, relative to the bag directory.
    """
    loose = loose_bags(snapshot)
    recordings: dict[str, list[BagFile]] = {}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        for bag in bags.at(bags.with_schema(is_wanted)):
            path = loose.get(bag.file) or bag.file.rpartition("/")[0]
            recordings.setdefault(path, []).append(bag)
    return recordings


def name_of(path: str, bags: Sequence[BagFile], root: str) -> str:
    """Returns the name by which `data.recording` selects a recording of the bag directory `root`.

    `path` and `bags` are an item of `recordings_of`.
    """
    if path != root:
        return path.removeprefix(f"{root}/")
    # The bag directory itself is the recording: its bags name it if one name selects all of them.
    series = {stem_of(bag.file) if len(bags) == 1 else _series_of(bag.file) for bag in bags}
    return series.pop().removeprefix(f"{root}/") if len(series) == 1 else BAG_DIR_ITSELF


def loose_bags(snapshot: Snapshot) -> dict[str, str]:
    """Returns by path the recording of each bag whose folder is not one recording.

    A folder is one recording if it has a metadata.yaml, or if its bags are named after it, or just
    by a number.
    """
    series: dict[str, list[BagFile]] = {}
    whole = {*snapshot.metadata_folders}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        # All bags of a stem are loose, or none is: one of each is looked at.
        positions = bags.names.positions
        firsts = bags.files(np.unique(positions, return_index=True)[1])
        are_loose = [
            file.rpartition("/")[0] not in whole and not is_named_after_folder(file)
            for file in firsts
        ]
        for bag in bags.at(np.array(are_loose)[positions]):
            series.setdefault(_series_of(bag.file), []).append(bag)
    recordings: dict[str, str] = {}
    for name, members in series.items():
        are_splits = _are_splits(members)
        recordings |= {bag.file: name if are_splits else stem_of(bag.file) for bag in members}
    return recordings


def loose_bags_beside_others(snapshot: Snapshot) -> dict[str, str]:
    """Returns by path the recording of each loose bag beside bags of another recording."""
    known, folders = snapshot.timeline.memo.of(_BESIDE_OTHERS, dict), snapshot.metadata_folders
    if folders not in known:
        known[folders] = _find_beside_others(snapshot)
    return known[folders]


def _find_beside_others(snapshot: Snapshot) -> dict[str, str]:
    loose = loose_bags(snapshot)
    if not loose:
        return loose
    recordings: dict[str, set[str]] = {}
    for bags in (segment.bags for segment in snapshot.timeline.recorded_segments):
        for file in bags.files():
            folder = file.rpartition("/")[0]
            recordings.setdefault(folder, set()).add(loose.get(file, folder))
    return {
        file: name for file, name in loose.items() if len(recordings[file.rpartition("/")[0]]) > 1
    }


def is_named_after_folder(file: str) -> bool:
    """Returns whether a bag has the name of its folder and a number, or just a number."""
    folder, _, name = file.rpartition("/")
    return name.startswith(f"{folder.rpartition('/')[2]}_") or name.partition(".")[0].isdigit()


def _series_of(file: str) -> str:
    """Returns the path of a bag without its suffixes and its number."""
    name = split_of(file)
    return name.series[:-1] if name and name.series.endswith("_") else stem_of(file)


def _are_splits(bags: Sequence[BagFile]) -> bool:
    """Returns whether bags are numbered, and each ends before the next begins."""
    ordered = sorted(bags, key=lambda bag: (bag.start, bag.end))
    stems = [stem_of(bag.file) for bag in bags]
    # The number at the end of a lone name may be a date: `ros2 bag record` counts without zeros.
    is_numbered = (
        all(_series_of(bag.file) != stem for bag, stem in zip(bags, stems, strict=True))
        if stems[1:]
        else _LONE_NUMBER.search(stems[0]) is not None
    )
    return is_numbered and all(
        bag.end <= next_bag.start + OUT_OF_ORDER_NS for bag, next_bag in pairwise(ordered)
    )
