"""What a query gets: `Memory`, the recorded past with its settings, and `Call`, the question."""

from __future__ import annotations

import math
import os
import time
from collections import defaultdict
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Protocol

from ros2_memory.bag_dir.layout import CARRY_FOLDER, is_carried
from ros2_memory.columns.store import relative
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.large_reads import LargeReads
from ros2_memory.core.memo import Key, Memo
from ros2_memory.core.text import Reason, match_topics
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Clock, Deadline, Ns, ms_from_ns, unix_from_ns
from ros2_memory.index.listed_splits import (
    Absent,
    Listings,
    absent_splits,
    listing_from_json,
    listing_to_json,
)
from ros2_memory.retention.inventory import Foreign, ForeignBags
from ros2_memory.retention.latched_carry import origin_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.frames import ClockOfTransforms
    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.regions import Place
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.policy import RetentionLimits
    from ros2_memory.storage.base import BagReader

NowOfMemory = Literal["wall", "latest"]
_LISTINGS: Final[Key[Listings]] = Key()
_FOREIGN: Final[Key[ForeignBags]] = Key()


@dataclass(frozen=True, slots=True)
class QuerySettings:
    """The part of the configuration that queries need; docs/reference has the meaning of each key.

    Attributes:
        screened: whether a split answers only after it was searched for what is to be excluded.
        recording: the only recording that answers; empty if all do.
        kept: how much the recorder keeps; None if nothing is recorded or deleted.
        labels: other spellings of a label, by the spelling that is shown.
        places_file: the file that `places` were read from.
    """

    position_tolerance_m: float = 0.5
    time_tolerance_s: float = 0.1
    pose_topic: str = "/odom"
    map_frame: str | None = "map"
    tf_topics: tuple[str, ...] = ("/tf",)
    tf_static_topics: tuple[str, ...] = ("/tf_static",)
    now: NowOfMemory = "wall"
    tf_clock: ClockOfTransforms = "auto"
    max_plausible_speed_mps: float = 10.0
    split_duration_s: float = 10.0
    screened: bool = False
    recording: str = ""
    include_active: bool = False
    kept: RetentionLimits | None = None
    latching: Latching = field(default_factory=lambda: Latching(("/tf_static",)))
    min_score: float = 0.0
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    places: tuple[Place, ...] = ()
    places_file: str = ""

    @property
    def closed_after_s(self) -> float:
        """The age (s) at which a message certainly answers: its split is closed by then.

        A split that is screened first waits for the next split, and for the search.
        """
        return 2.5 * self.split_duration_s if self.screened else self.split_duration_s


class SnapshotSource(Protocol):
    """The index of a bag directory, as queries need it; `IndexManager` is one.

    Attributes:
        bag_dir: the bag directory.
    """

    bag_dir: Path

    @property
    def published(self) -> Snapshot | None:
        """The result of the last scan, however old; None before the first."""

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns a current snapshot; scans again if it does not reach the log time `reach`."""

    def refresh(self) -> Snapshot:
        """Scans now, and returns the result."""

    def heartbeat(self) -> Heartbeat | None:
        """Returns the last heartbeat of the directory's recorder, if it can be read."""

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns the names of the recordings in the same folder that handovers join with one."""


@dataclass(frozen=True, slots=True)
class Memory:
    """The robot's recorded past: an index of bags, what reads and decodes them, and a clock.

    Attributes:
        index: the index of the bags.
        reader: reads them.
        extractor: reads decoded messages.
        clock: the wall clock.
        limits: the settings.
        scanner: scans topics, quickly if its store has the bags. The store changes no answer.
        large: the turn to hold a large part of a bag in memory.
        memo: what was found out about the bags and stays true.
        fixed: the snapshot that answers all queries; None for the current one.
        hides_topics: whether bags have topics of other robots, which are in no count.
    """

    index: SnapshotSource
    reader: BagReader
    extractor: SchemaExtractor
    clock: Clock
    limits: QuerySettings
    scanner: Scanner
    large: LargeReads = field(default_factory=LargeReads)
    memo: Memo = field(default_factory=Memo)
    fixed: Snapshot | None = None
    hides_topics: bool = False

    @property
    def bag_dir(self) -> Path:
        """Where its bags are."""
        return self.index.bag_dir

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns the fixed snapshot, else a current one that reaches the log time `reach`."""
        return self.fixed or self.index.snapshot(reach)

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """Returns the bags that retention leaves alone, as another recorder made them.

        None if retention deletes nothing, or any bags, or if no recorder has listed its own.
        """
        if self.limits.kept is None or not self.limits.kept.keeps_foreign:
            return None
        bags = self.memo.of(_FOREIGN, lambda: ForeignBags(self.bag_dir))
        heartbeat = self.index.heartbeat()
        return bags.measured(snapshot, () if heartbeat is None else heartbeat.recordings)

    def absent_splits(self, snapshot: Snapshot) -> list[Absent]:
        """Returns the splits that a recording's metadata.yaml lists and that are missing."""
        absent = absent_splits(snapshot, self.bag_dir, self._listings())
        if self.hides_topics:
            return [each._replace(messages=0) for each in absent if each.files or each.unreadable]
        return absent

    def store_listings(self, snapshot: Snapshot) -> None:
        """Stores what each metadata.yaml lists, so that the next start need not read them."""
        store = self.scanner.store
        if store is None:
            return
        self.absent_splits(snapshot)
        listings, root = self._listings(), str(self.bag_dir)
        store.put_listings(
            {
                relative(folder, root): listing_to_json(*listings[folder])
                for folder in snapshot.metadata_folders
                if folder in listings
            }
        )

    def _listings(self) -> Listings:
        """Returns the listings that were read or stored. A damaged one is read again."""

        def load() -> Listings:
            listings: Listings = {}
            texts = {} if self.scanner.store is None else self.scanner.store.listings()
            for folder, text in texts.items():
                with suppress(ValueError, TypeError, OverflowError):
                    listings[str(self.bag_dir / folder)] = listing_from_json(text)
            return listings

        return self.memo.of(_LISTINGS, load)

    def heartbeat(self) -> Heartbeat | None:
        """Returns the last heartbeat of the recorder of these bags; None without one.

        If old bags are replayed (`recorder=none`, `data.now=latest`), only a live heartbeat counts:
        an old one was copied with the bags.
        """
        heartbeat = self.index.heartbeat()
        replays = self.limits.kept is None and self.limits.now == "latest"
        if replays and heartbeat is not None and not heartbeat.is_live(self.clock.now()):
            return None
        return heartbeat

    def now(self, latest: Ns | None, call: Call | None = None) -> Ns:
        """Returns the time that ages count from: the wall clock's, or the newest recorded one.

        A `call` whose answer has ages remembers the latter.
        """
        if self.limits.now == "wall" or latest is None:
            return self.clock.now()
        if call is not None:
            call.now = latest
        return latest


class _StageTimer:
    # No `contextmanager`: its generators took 10 % of the time of a question about one moment.

    __slots__ = ("_begin", "_stage", "_stages")

    def __init__(self, stages: Stages, stage: str) -> None:
        self._stages, self._stage, self._begin = stages, stage, 0

    def __enter__(self) -> None:
        self._begin = time.perf_counter_ns()

    def __exit__(self, *_: object) -> None:
        self._stages.add(self._stage, time.perf_counter_ns() - self._begin)


class Stages:
    """How long one call spent in each stage: `index`, `read`, `extract`, `wait`.

    Attributes:
        spent: by stage, ns.
    """

    __slots__ = ("spent",)

    def __init__(self) -> None:
        self.spent: dict[str, Ns] = {}

    def add(self, stage: str, spent: Ns) -> None:
        """Adds nanoseconds to a stage."""
        self.spent[stage] = self.spent.get(stage, 0) + spent

    def timed(self, stage: str) -> _StageTimer:
        """Returns a context manager that adds the time of its block to a stage."""
        return _StageTimer(self, stage)

    def as_ms(self) -> dict[str, float]:
        """Returns milliseconds by stage, for the log event of the call."""
        return {stage: round(ms_from_ns(spent), 3) for stage, spent in self.spent.items()}


WAIT: Final = "wait"
"""The stage in which a call waits for its turn to hold much of a bag; part of another stage."""
READING_S: Final = 4.0
"""After reading bags that are not stored for so long, a call gives a partial answer."""


@dataclass(slots=True)
class Call:
    """One call: its deadline, where its time went, and what its answer is made of.

    Attributes:
        deadline: when it must be over.
        stages: where its time went.
        used_active: whether the answer is partly from a bag that is still being written.
        used_thinned: whether the answer is partly from a thinned day, at a time in `asked`.
        asked: the times that the question is about; empty if unknown.
        robots: the robots of a fleet that it may ask about; None for all.
        rows_in: the window in which a row of the reply must end to be shown; other rows are counted
            only. None for all.
        now: the time that the answer's ages count from, if not the wall clock's.
        older: the last log time of bags that the call was not shown: a lake is shown some days at a
            time. None if it was shown all bags, `MAX_NS` before the first snapshot.
        stored: whether it fills the store with what follows from stored bags. Other bags are left
            out then.
    """

    deadline: Deadline = field(default_factory=Deadline.never)
    stages: Stages = field(default_factory=Stages)
    used_active: bool = False
    used_thinned: bool = False
    asked: tuple[TimeWindow, ...] = ()
    robots: frozenset[str] | None = None
    rows_in: TimeWindow | None = None
    now: Ns | None = None
    older: Ns | None = MAX_NS
    stored: bool = False

    def saw(self, snapshot: Snapshot) -> None:
        """Updates `older` by a snapshot that the call was shown."""
        if snapshot.older is None or self.older is None:
            self.older = None
        else:
            self.older = min(self.older, snapshot.older)

    def wants(self, row_end: Ns) -> bool:
        """Returns whether a row of the reply that ends then must be shown."""
        return self.rows_in is None or self.rows_in.contains(row_end)

    def within(self, budget_s: float) -> Call:
        """Returns the same call with no more than `budget_s` seconds left."""
        return replace(self, deadline=self.deadline.within(budget_s))

    def partial_after(self, budget_s: float) -> Deadline:
        """Returns the deadline after which the call answers with what it has read.

        It is `budget_s` seconds from now; waiting for other calls does not count. A call without a
        deadline (`Deadline.never()`) reads everything.
        """
        if self.deadline.at_s == math.inf:
            return self.deadline
        return Deadline.after(budget_s, self._reading_time)

    def _reading_time(self) -> float:
        return time.monotonic() - unix_from_ns(self.stages.spent.get(WAIT, 0))

    def reading(self, large: LargeReads) -> AbstractContextManager[None]:
        """Returns a context manager for reading: it waits for the call's turn if need be."""
        return large.during(self._require_time, partial(self.stages.add, WAIT))

    def _require_time(self) -> None:
        if self.deadline.expired():
            raise QueryTimeoutError(
                "other questions that hold large parts of bags in memory came first; ask again, "
                "with fewer at once"
            )


@dataclass(frozen=True, slots=True)
class Latching:
    """Decides which topics are latched: their last message holds until the next, however old.

    Durability is not enough: PX4 publishes telemetry of 100 Hz as transient local, and `/rosout` is
    always transient local. A topic is latched if it is transient local, no log, and rare in its
    recording (see `Pace.is_rare`). Topics of static transforms are latched even if their writers
    record no QoS. The configuration overrides this by topic.

    Attributes:
        static_topics: the topics of static transforms.
        include: names or globs of topics that are latched whatever their publishers offer.
        exclude: names or globs of topics that are not latched; stronger than `include`.
    """

    static_topics: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def may_latch(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether some message of a topic may be latched."""
        return self._without_pace(snapshot, topic) is not False

    def holds(self, snapshot: Snapshot, stored: StoredMessage) -> bool:
        """Whether a message is latched, by the pace of its topic in its own recording."""
        decided = self._without_pace(snapshot, stored.topic)
        if decided is not None:
            return decided
        if is_carried(stored.bag.file):
            origin = origin_of(stored.record.channel)
            return origin is None or not origin.often
        return snapshot.timeline.pace(stored.topic, stored.recording).is_rare

    def is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether a topic is latched, by its pace in the newest recording that holds it.

        Carried messages count as a recording only if there is no other.
        """
        decided = self._without_pace(snapshot, topic)
        if decided is not None:
            return decided
        spans = snapshot.timeline.recordings(topic)
        newest = max(
            spans,
            key=lambda path: (path.name != CARRY_FOLDER, spans[path][1], str(path)),
            default=None,
        )
        return newest is not None and snapshot.timeline.pace(topic, newest).is_rare

    def _without_pace(self, snapshot: Snapshot, topic: str) -> bool | None:
        """Returns whether a topic is latched; None if that depends on its pace."""
        if any(match_topics((topic,), glob) for glob in self.exclude):
            return False
        if topic in self.static_topics or any(
            match_topics((topic,), glob) for glob in self.include
        ):
            return True
        return None if snapshot.timeline.is_transient_state(topic) else False


class Note(NamedTuple):
    """What is wrong with one file, topic or recording. Notes of one kind make one sentence.

    Attributes:
        kind: the sentence.
        file: the path of the bag, or the name of the topic or recording in replies.
        detail: what is special about it; may be empty.
        since: first log time that it concerns.
        until: last log time that it concerns (inclusive).
    """

    kind: Reason
    file: str
    detail: str = ""
    since: Ns = MIN_NS
    until: Ns = MAX_NS


UNDECODED: Final = Reason("could not be decoded", "topic", of="messages of ")


class Notes:
    """Collects notes, each once.

    Attributes:
        complete: False once something could not be read that the answer needs.
        added: how many times a file could not be read, or a message not be decoded. If a
            computation leaves it the same, all of its data was read, and it may be remembered.
    """

    def __init__(self) -> None:
        self.complete = True
        self.added = 0
        self._sentences: dict[str, None] = {}
        self._notes: dict[Note, None] = {}
        self._remarks: dict[str, tuple[str, ...]] = {}

    def add(self, *notes: str | Note) -> None:
        """Adds sentences, and notes that become one sentence for each kind."""
        for note in notes:
            if isinstance(note, str):
                self._sentences.setdefault(note)
                continue
            self.added += 1
            self._notes.setdefault(note)

    def add_lack(self, note: str | Note) -> None:
        """Adds a note on data that the answer needs and that could not be read."""
        self.complete = False
        self.add(note)

    @contextmanager
    def apart(self) -> Iterator[None]:
        """Within the block, what is noted of files, and `complete`, is not of the answer.

        Only `added` shows it afterwards.
        """
        complete, notes = self.complete, dict(self._notes)
        try:
            yield
        finally:
            self.complete, self._notes = complete, notes

    def sentences(self) -> tuple[str, ...]:
        """Returns the sentences for the reply: one for each kind of note, then all others.

        The first are sorted. In which order files are read depends on the store, and a reply must
        not.
        """
        by_kind: dict[Reason, dict[str, str]] = {}
        names = _names_of({note.file for note in self._notes if note.kind.noun == "bag"})
        for note in _farthest(self._notes):
            # Another sentence may have reported it already, from the summary of the bag.
            if note.detail not in self._remarks.get(note.file, ()):
                name = names.get(note.file, note.file)
                by_kind.setdefault(note.kind, {})[name] = note.detail
        shared = sorted(kind.sentence(files) for kind, files in by_kind.items())
        return (*shared, *self._sentences)

    def add_remarks(self, bags: Iterable[BagFile]) -> None:
        """Records that sentences have reported the remarks of these bags' summaries."""
        self._remarks |= {bag.file: bag.summary.remarks for bag in bags}

    def so_far(self) -> frozenset[Note]:
        """Returns all notes, for `retract_outside`."""
        return frozenset(self._notes)

    def retract_outside(self, *windows: TimeWindow, keep: Collection[Note] = frozenset()) -> None:
        """Removes the notes that concern none of the windows, except the notes to `keep`.

        Which bags are read besides depends on what is stored, and the reply must not.
        """
        self._notes = {
            note: None
            for note in self._notes
            if note in keep or any(window.overlaps(note.since, note.until) for window in windows)
        }


def _farthest(notes: Iterable[Note]) -> Iterable[Note]:
    """Returns one note for each kind and file: the one that reaches farthest."""
    ascending = sorted(notes, key=attrgetter("until", "since", "detail"))
    return {(note.kind, note.file): note for note in ascending}.values()


def _names_of(files: Iterable[str]) -> dict[str, str]:
    """Returns the names of bags by their paths: the `short_name`, unless several share it."""
    by_name: dict[str, list[str]] = defaultdict(list)
    for file in files:
        by_name[short_name(Path(file))].append(file)
    return {
        file: name if len(alike) == 1 else os.path.relpath(file, os.path.commonpath(alike))
        for name, alike in by_name.items()
        for file in alike
    }


def short_name(path: Path) -> str:
    """Returns the name of a bag in replies: recording and file, never a path of this machine."""
    return f"{path.parent.name}/{path.name}"
