"""A week of history without its 5 GB: an hour of bags, linked into 168 recordings.

Every recording is another name for the same 360 files; the newest one tells the truth, and for the
others the catalogue is told what the same bags would have held some hours earlier. So questions
that the catalogue answers see 60,480 bags of a week, and those that read a bag must read one of the
newest hour.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final

from benchmarks import digests, ours
from benchmarks.bags import ODOM, SCENE, SPLIT_NS, WEEK
from benchmarks.motion import NOWHERE
from benchmarks.payloads import NEVER_SEEN
from benchmarks.questions import FLOOR, HOUR, OURS, Case, Question, Target
from ros2_memory.catalogue import BagKey, relative

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from benchmarks.bags import History
    from benchmarks.timing import Ask
    from ros2_memory.catalogue import Catalogue
    from ros2_memory.digest import Digest
    from ros2_memory.memory import Memory
    from ros2_memory.model import JsonValue
    from ros2_memory.settings import Settings

RECORDINGS: Final = WEEK // HOUR
_BATCH: Final = 1_000


@dataclass(frozen=True, slots=True)
class Linked:
    """Recordings in a folder, each of them links to the bags of one history."""

    folder: Path
    hour: History
    recordings: int

    @property
    def bags(self) -> int:
        """How many bag files there are."""
        return self.hour.bags * self.recordings

    def links(self) -> Iterator[tuple[Path, Path, int]]:
        """Link, file, and by how many nanoseconds the link's bag is later; oldest first."""
        for recording in range(self.recordings):
            later = (recording - self.recordings + 1) * self.hour.bags * SPLIT_NS
            name = f"rec_{recording:04}"
            for split in self.hour.splits():
                yield self.folder / name / f"{name}_{split.number}.mcap", split.path, later


def linked(hour: History, recordings: int = RECORDINGS) -> Linked:
    """The recordings beside the history that they are made of, made anew."""
    folder = hour.folder.with_name(f"linked_{hour.bags}_{recordings}")
    shutil.rmtree(folder, ignore_errors=True)
    whole = Linked(folder, hour, recordings)
    for link, file, _ in whole.links():
        if not link.parent.is_dir():
            link.parent.mkdir(parents=True)
        link.hardlink_to(file)
    # A folder that changed within the last two seconds is looked through again at every scan.
    for place in (*folder.iterdir(), folder):
        os.utime(place, ns=(hour.end, hour.end))
    return whole


@dataclass
class Week:
    """What the questions of a week are asked of; `made_of` is the hour that it consists of."""

    whole: Linked
    settings: Settings
    made_of: Case

    @cached_property
    def digests(self) -> list[Digest]:
        """Of the bags of the hour, oldest first."""
        digester = digests.digester(self.made_of)
        return [digester.digest(split.path) for split in self.whole.hour.splits()]

    @cached_property
    def memory(self) -> Memory:
        """A memory that knows the folder."""
        memory = ours.memory(self.settings)
        memory.index.refresh()
        return memory

    @cached_property
    def text(self) -> str:
        """The searchable words of every bag's scene objects, as its digest has them."""
        words = [
            topic.evidence.words or ""
            for digest in self.digests
            for topic in digest.topics
            if topic.topic == SCENE.name
        ]
        return "\n".join(words * self.whole.recordings)

    def fill(self, catalogue: Catalogue) -> None:
        """Tells the catalogue of every bag."""
        batch: list[tuple[BagKey, Digest]] = []
        for nth, (link, _, later) in enumerate(self.whole.links()):
            stat = link.stat()
            key = BagKey(relative(link, self.whole.folder), stat.st_size, stat.st_mtime_ns, 0)
            batch.append((key, digests.moved(self.digests[nth % len(self.digests)], later)))
            if len(batch) == _BATCH:
                catalogue.put_all(batch)
                batch = []
        catalogue.put_all(batch)


def never_seen(week: Week) -> Question:
    """A thing that was never seen."""
    return _never(week, f'find_last_match "{NEVER_SEEN}", never seen', SCENE.name, NEVER_SEEN)


def never_near(week: Week) -> Question:
    """A place where the robot never was."""
    place: JsonValue = {"x": NOWHERE[0], "y": NOWHERE[1]}
    return _never(week, "near_position, never there", ODOM.name, place)


def rescan(week: Week) -> Question:
    """Looking through the folder where nothing changed."""

    def mine() -> Sequence[Ask]:
        # The first look after a while finds folders that are too young to be trusted.
        week.memory.index.refresh()
        return [lambda: len(week.memory.index.refresh().bags)] * 10

    words = f"rescan of {week.whole.bags} bags in {week.whole.recordings} recordings, unchanged"
    return Question(words, {OURS: mine}, Target(seconds=0.003))


def start(week: Week) -> Question:
    """From a configuration to the first answer."""
    newest = (week.whole.hour.end - SPLIT_NS // 2) / 1e9

    def first() -> object:
        return ours.position_at(ours.memory(week.settings), ODOM.name, newest)

    words = f"start over {week.whole.bags} bags to the first answer, imports not counted"
    return Question(words, {OURS: lambda: [first]}, Target(seconds=0.5))


WEEK_QUESTIONS: Final[Mapping[str, Callable[[Week], Question]]] = {
    "week-start": start,
    "week-rescan": rescan,
    "week-never-seen": never_seen,
    "week-never-near": never_near,
}


def _never(week: Week, words: str, topic: str, value: JsonValue) -> Question:
    condition = "contains" if isinstance(value, str) else "near_position"
    return Question(
        f"{words}, {week.whole.bags} bags (floor: substring search over the digests' text)",
        {
            OURS: lambda: [partial(ours.last_match, week.memory, topic, condition, value)],
            FLOOR: lambda: [lambda: None if NEVER_SEEN not in week.text else 0],
        },
        Target(floor=20),
    )
