"""A week of history without its 5 GB: an hour of bags, linked into 168 recordings.

Every recording is another name for the same 360 files; the newest one tells the truth, and for the
others the catalogue is told what the same bags would have held some hours earlier. So questions
that the catalogue answers see 60,480 bags of a week, and those that read a bag must read one of the
newest hour.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final

from benchmarks import digests, ours
from benchmarks.bags import HOUR, ODOM, SCENE, SPLIT_NS, WEEK
from benchmarks.motion import NOWHERE
from benchmarks.payloads import NEVER_SEEN
from benchmarks.questions import Question, Target
from benchmarks.timing import FLOOR, OURS
from ros2_memory.bootstrap import build_filler
from ros2_memory.catalogue import BagKey, relative

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from benchmarks.links import Linked
    from benchmarks.timing import Ask
    from ros2_memory.catalogue import Catalogue
    from ros2_memory.digest import Digest
    from ros2_memory.memory import Memory
    from ros2_memory.model import JsonValue
    from ros2_memory.settings import Settings

RECORDINGS: Final = WEEK // HOUR
_BATCH: Final = 1_000


@dataclass
class Week:
    """What the questions of a week are asked of."""

    whole: Linked
    settings: Settings

    @cached_property
    def digests(self) -> list[Digest]:
        """Of the bags of the hour, oldest first."""
        digester = digests.digester_of(ours.memory(self.settings), self.settings)
        return [digester.digest(split.path) for split in self.whole.hour.splits()]

    @cached_property
    def filled(self) -> Settings:
        """The settings, once the catalogue was told of every bag.

        Raises:
            RuntimeError: it did not take one of them for the file that lies there.
        """
        memory = ours.memory(self.settings)
        if memory.recall is None:
            raise RuntimeError("the memory has no catalogue, so a week cannot be stood in for")
        self._fill(memory.recall.catalogue)
        filler = build_filler(self.settings, ours.memory(self.settings))
        progress = filler.progress()
        if progress.waiting or progress.closed != self.whole.bags:
            raise RuntimeError(f"not every bag of the week is in the catalogue: {progress}")
        filler.warm()
        return self.settings

    @cached_property
    def memory(self) -> Memory:
        """A memory that knows the folder, by its catalogue."""
        memory = ours.memory(self.filled)
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

    def _fill(self, catalogue: Catalogue) -> None:
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
    newest, settings = (week.whole.hour.end - SPLIT_NS // 2) / 1e9, week.filled

    def first() -> object:
        return ours.position_at(ours.memory(settings), ODOM.name, newest)

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
            FLOOR: lambda: [partial(_searched, week.text)],
        },
        Target(floor=20),
    )


def _searched(text: str) -> int | None:
    """Where the label stands in the text."""
    at = text.find(NEVER_SEEN)
    return None if at < 0 else at
