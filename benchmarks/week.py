"""A week of history from one hour of bags, copied into 168 recordings (5 GB).

The newest recording is true; for the others the catalogue is given what the same bags would hold
had they been recorded some hours earlier. So questions that the catalogue answers see 60,480 bags
of a week, and those that read a bag must read one of the newest hour.
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
from ros2_memory.bootstrap import build_backfill
from ros2_memory.catalogue.store import BagKey, relative
from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.insights.sightings import find_matches
from ros2_memory.insights.status import memory_status
from ros2_memory.places.visits import visits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from benchmarks.copies import Copies
    from benchmarks.timing import Ask
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.store import Catalogue
    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Memory

RECORDINGS: Final = WEEK // HOUR
_BATCH: Final = 1_000


@dataclass
class Week:
    """What the questions of a week are asked of."""

    whole: Copies
    settings: Settings

    @cached_property
    def digests(self) -> list[Digest]:
        """Of the bags of the hour, oldest first."""
        digest = digests.digesting(ours.memory(self.settings))
        return [digest(copy) for copy, _, later in self.whole.files() if not later]

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
        filler = build_backfill(self.settings, ours.memory(self.settings))
        progress = filler.progress()
        if progress.waiting or progress.closed != self.whole.bags:
            raise RuntimeError(f"not every bag of the week is in the catalogue: {progress}")
        filler.precompute()
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
            topic.zone_map.words or ""
            for digest in self.digests
            for topic in digest.topics
            if topic.topic == SCENE.name
        ]
        return "\n".join(words * self.whole.recordings)

    def _fill(self, catalogue: Catalogue) -> None:
        """Tells the catalogue of every bag."""
        batch: list[tuple[BagKey, Digest]] = []
        for nth, (copy, _, later) in enumerate(self.whole.files()):
            stat = copy.stat()
            key = BagKey(
                relative(str(copy), str(self.whole.folder)), stat.st_size, stat.st_mtime_ns, 0
            )
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


def sightings(week: Week) -> Question:
    """All sightings of a thing that was never seen."""

    def found() -> object:
        memory = week.memory
        return find_matches(memory, Call(), SCENE.name, "contains", NEVER_SEEN).sightings

    return _beside_a_search(week, f'find_matches "{NEVER_SEEN}"', found)


def recap_of_an_hour(week: Week) -> Question:
    """What happened in an hour in the middle of the week."""
    hour = week.whole.hour
    back = week.whole.recordings // 2 * (hour.end - hour.start)
    span = TimeRange(start_s=(hour.start - back) / 1e9, end_s=(hour.end - back) / 1e9 - 1e-3)
    return _beside_a_search(
        week, "recap of an hour", lambda: len(recap(week.memory, Call(), span).events)
    )


def visits_nowhere(week: Week) -> Question:
    """Visits to a place where the robot never was."""
    x, y = NOWHERE
    return _beside_a_search(
        week, "visits, never there", lambda: visits(week.memory, Call(), x, y).visits
    )


def status(week: Week) -> Question:
    """How far the memory can be trusted."""
    return _beside_a_search(
        week, "memory_status", lambda: memory_status(week.memory, Call()).damaged
    )


WEEK_QUESTIONS: Final[Mapping[str, Callable[[Week], Question]]] = {
    "week-start": start,
    "week-rescan": rescan,
    "week-never-seen": never_seen,
    "week-never-near": never_near,
    "week-sightings": sightings,
    "week-recap": recap_of_an_hour,
    "week-visits": visits_nowhere,
    "week-status": status,
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


def _beside_a_search(week: Week, words: str, ask: Ask) -> Question:
    """A question that should take little longer than a search for what was never seen."""
    search = partial(ours.last_match, week.memory, SCENE.name, "contains", NEVER_SEEN)

    def asked() -> None:
        # What the two answer has nothing in common: they stand side by side for their time alone.
        ask()

    return Question(
        f"{words}, {week.whole.bags} bags (floor: find_last_match, never seen)",
        {OURS: lambda: [asked], FLOOR: lambda: [search]},
        Target(floor=10),
    )


def _searched(text: str) -> int | None:
    """Where the label stands in the text."""
    at = text.find(NEVER_SEEN)
    return None if at < 0 else at
