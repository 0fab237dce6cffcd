"""What queries are asked of, `Memory` with its settings, and what one call carries, `Call`."""

from __future__ import annotations

import math
import time
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Protocol, TypeAlias

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
    from pathlib import Path

    from ros2_memory.analysis.frames import ClockOfTransforms
    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.columns.scanner import Scanner
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.regions import Place
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.retention.policy import RetentionLimits
    from ros2_memory.storage.base import BagReader

NowOfMemory = Literal["wall", "latest"]
_LISTINGS: Final[Key[Listings]] = Key()
_FOREIGN: Final[Key[ForeignBags]] = Key()


@dataclass(frozen=True, slots=True)
class QuerySettings:
    """The part of the configuration that queries need.

    Units are the last word of each name. `kept` is how much the recorder keeps; None where nothing
    is recorded, and nothing deleted. `labels` has other spellings by the name that is to be shown.
    `screened`: no split answers before it was searched for what is to be excluded. `recording`: the
    name of the recording that alone answers; empty where all do. `places_file`: where the places
    were read.
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
        """How old (s) a message is at most when the split that holds it answers.

        A split that is searched first waits for the next one, and for the search.
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
        """Returns a current snapshot, which reaches the log time `reach` if there is data."""

    def refresh(self) -> Snapshot:
        """Scans now, and returns the result."""

    def heartbeat(self) -> Heartbeat | None:
        """Returns the last heartbeat of the directory's recorder, if it can be read."""

    def joined_with(self, recording: Path) -> tuple[str, ...]:
        """Returns the names of the recordings beside one that handovers join with it."""


@dataclass(frozen=True, slots=True)
class Memory:
    """The robot's recorded past: an index of bags, what reads and decodes them, and a clock.

    `scanner` scans topics, from its store where that has the bags; every answer is the same without
    the store. `large` is the turn to hold much of a bag, which the reader takes. `memo` has what
    was found out about the bags and stays true. `fixed` is the snapshot that answers, where it is
    to be one and the same for several.
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

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """Returns what the index has, to a log time `reach` if there is data; or what is fixed."""
        return self.fixed or self.index.snapshot(reach)

    def foreign(self, snapshot: Snapshot) -> Foreign | None:
        """Returns the bags that retention neither deletes nor counts: not made by the recorder.

        None where nothing is deleted, or bags of any origin are, or no recorder has listed its own.
        """
        if self.limits.kept is None or not self.limits.kept.keeps_foreign:
            return None
        bags = self.memo.of(_FOREIGN, lambda: ForeignBags(self.index.bag_dir))
        heartbeat = self.index.heartbeat()
        return bags.measured(snapshot, () if heartbeat is None else heartbeat.recordings)

    def absent_splits(self, snapshot: Snapshot) -> list[Absent]:
        """Returns the splits that metadata.yaml of a recording lists and that are missing."""
        return absent_splits(snapshot, self.index.bag_dir, self._listings())

    def store_listings(self, snapshot: Snapshot) -> None:
        """Stores what metadata.yaml of each recording lists, for the programs that start later."""
        store = self.scanner.store
        if store is None:
            return
        self.absent_splits(snapshot)
        listings, folders = self._listings(), snapshot.metadata_folders
        store.put_listings(
            {
                relative(folder, str(self.index.bag_dir)): listing_to_json(*listings[folder])
                for folder in folders
                if folder in listings
            }
        )

    def _listings(self) -> Listings:
        """Returns what was stored of each metadata.yaml; one that is damaged is read again."""

        def stored() -> Listings:
            listings: Listings = {}
            texts = {} if self.scanner.store is None else self.scanner.store.listings()
            for folder, text in texts.items():
                with suppress(ValueError, TypeError, OverflowError):
                    listings[str(self.index.bag_dir / folder)] = listing_from_json(text)
            return listings

        return self.memo.of(_LISTINGS, stored)

    def heartbeat(self) -> Heartbeat | None:
        """Returns the last heartbeat of the recorder of these bags; None if there is none.

        None for bags of another day, too (`recorder=none`, `data.now=latest`), unless it beats
        today: one that was copied with them is not about their recorder.
        """
        heartbeat = self.index.heartbeat()
        replays = self.limits.kept is None and self.limits.now == "latest"
        if replays and heartbeat is not None and not heartbeat.is_live(self.clock.now()):
            return None
        return heartbeat

    def now(self, wall: Ns, latest: Ns | None, call: Call | None = None) -> Ns:
        """Returns what ages count from: the wall clock, or the newest recorded time.

        A `call` that has ages in its answer notes the latter.
        """
        if self.limits.now == "wall" or latest is None:
            return wall
        if call is not None:
            call.now = latest
        return latest


class _StageTimer:
    # A class: as generators, the timers of a question about one moment took 10 % of its time.

    __slots__ = ("_begin", "_stage", "_stages")

    def __init__(self, stages: Stages, stage: str) -> None:
        self._stages, self._stage, self._begin = stages, stage, 0

    def __enter__(self) -> None:
        self._begin = time.perf_counter_ns()

    def __exit__(self, *_: object) -> None:
        self._stages.add(self._stage, time.perf_counter_ns() - self._begin)


class Stages:
    """How long one call spent where (`index`, `read`, `extract`, `wait`); `spent` has ns."""

    __slots__ = ("spent",)

    def __init__(self) -> None:
        self.spent: dict[str, Ns] = {}

    def add(self, stage: str, spent: Ns) -> None:
        """Adds nanoseconds to a stage."""
        self.spent[stage] = self.spent.get(stage, 0) + spent

    def timed(self, stage: str) -> _StageTimer:
        """Returns a context manager that adds the time that its block takes."""
        return _StageTimer(self, stage)

    def as_ms(self) -> dict[str, float]:
        """Returns milliseconds by stage, for the log event of the call."""
        return {stage: round(ms_from_ns(spent), 3) for stage, spent in self.spent.items()}


WAIT: Final = "wait"
"""The stage of a call that waits until it may hold much of a bag; it is part of another one."""
READING_S: Final = 4.0
"""How long a call reads bags that are not stored, before its answer is partial."""


@dataclass(slots=True)
class Call:
    """One call: when it must be over, and where its time went.

    Attributes:
        used_active: whether the answer is partly from a bag that is still being written.
        used_thinned: whether it is partly from a day of which only some messages stayed.
        asked: the times that the question is about, where these are known: the rest does not count
            for that.
        robots: those of a fleet that it may ask about; None for all.
        rows_in: rows that end outside of it are dropped by who asks, so they may be left out; they
            count all the same. None for all.
        now: what the answer's ages count from, where that is not the wall clock.
        older: up to which log time (inclusive) there are bags that it was not shown, as those of a
            lake are shown some days at a time; None where it was shown all, `MAX_NS` before any.
        stored: whether it makes what follows from what is stored, and leaves out other bags.
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
        """Lowers `older` to that of a snapshot that the call was shown; None once one had all."""
        if snapshot.older is None or self.older is None:
            self.older = None
        else:
            self.older = min(self.older, snapshot.older)

    def note_thinned(self, first: Ns, last: Ns) -> None:
        """Records that messages between two log times are from a thinned day."""
        self.used_thinned |= not self.asked or any(
            window.overlaps(first, last) for window in self.asked
        )

    def wants(self, row_end: Ns) -> bool:
        """Returns whether a row that ends then may not be left out."""
        return self.rows_in is None or self.rows_in.contains(row_end)

    def within(self, budget_s: float) -> Call:
        """Returns the same call with no more than `budget_s` seconds left."""
        return replace(self, deadline=self.deadline.within(budget_s))

    def partial_after(self, budget_s: float) -> Deadline:
        """Returns when an answer is given with what was read until then, `budget_s` from now.

        To wait for others does not count. A call that may take as long as it needs
        (`Deadline.never()`) is answered whole.
        """
        if self.deadline.at_s == math.inf:
            return self.deadline
        return Deadline.after(budget_s, self._reading_time)

    def _reading_time(self) -> float:
        return time.monotonic() - unix_from_ns(self.stages.spent.get(WAIT, 0))

    def reading(self, large: LargeReads) -> AbstractContextManager[None]:
        """Returns the block in which this call reads, and may have to wait for its turn."""
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

    Durability alone does not: PX4 publishes telemetry of 100 Hz as transient local, and `/rosout`
    is transient local everywhere. A topic is latched where it is transient local, no log, and has a
    message every 5 s or less often over its recording (see `is_rare`); so are the topics of static
    transforms, which some writers record without QoS. The configuration overrides this by topic.

    Attributes:
        static_topics: those of static transforms.
        include: names or globs of topics that are latched whatever their publishers offer.
        exclude: names or globs of topics that are not; it wins.
    """

    static_topics: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def may_hold(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether some message of a topic may be latched."""
        return self._whatever_pace(snapshot, topic) is not False

    def holds(self, snapshot: Snapshot, stored: StoredMessage) -> bool:
        """Whether a message is latched, by the pace of its topic in its own recording."""
        settled = self._whatever_pace(snapshot, stored.topic)
        if settled is not None:
            return settled
        if is_carried(stored.bag.file):
            origin = origin_of(stored.record.channel)
            return origin is None or not origin.often
        return snapshot.timeline.pace(stored.topic, stored.bag.recording).is_rare

    def is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether a topic is latched, by its pace in the newest recording that holds it.

        Carried messages count as a recording only where there is no other.
        """
        settled = self._whatever_pace(snapshot, topic)
        if settled is not None:
            return settled
        last = {path: last for path, (_, last) in snapshot.timeline.recordings(topic).items()}
        newest = max(
            last, key=lambda path: (path.name != CARRY_FOLDER, last[path], str(path)), default=None
        )
        return newest is not None and snapshot.timeline.pace(topic, newest).is_rare

    def _whatever_pace(self, snapshot: Snapshot, topic: str) -> bool | None:
        """Returns whether a topic is latched; None where that depends on its pace."""
        if any(match_topics((topic,), glob) for glob in self.exclude):
            return False
        if topic in self.static_topics or any(
            match_topics((topic,), glob) for glob in self.include
        ):
            return True
        return None if snapshot.timeline.is_transient_state(topic) else False


NoteKey: TypeAlias = "tuple[Reason, str, Ns, Ns]"
"""The kind of a note, the file that it is on, and the log times between which it is."""


class Note(NamedTuple):
    """What is wrong with one file (or topic, or recording); all of a kind make one sentence.

    Attributes:
        kind: the sentence.
        file: its name as replies have it.
        detail: what is special about this one; may be empty.
        since: no part of it is before this log time.
        until: none is after this one.
    """

    kind: Reason
    file: str
    detail: str = ""
    since: Ns = MIN_NS
    until: Ns = MAX_NS


class Notes:
    """Collects notes, each once.

    Attributes:
        complete: False once something that bears on the answer could not be read.
        added: how many notes on files were added, again or not, and how many messages were left
            out that cannot be decoded. What was computed while it stays the same was read whole;
            `keys` would not show that a file failed twice.
    """

    def __init__(self) -> None:
        self.complete = True
        self.added = 0
        self._sentences: dict[str, None] = {}
        self._notes: dict[NoteKey, Note] = {}
        self._remarks: dict[str, tuple[str, ...]] = {}

    def add(self, *notes: str | Note) -> None:
        """Adds sentences, or notes that share one with others of their kind."""
        for note in notes:
            if isinstance(note, str):
                self._sentences.setdefault(note)
                continue
            self.added += 1
            self._notes.setdefault((note.kind, note.file, note.since, note.until), note)

    def add_lack(self, note: str | Note) -> None:
        """Adds a note on data that the answer needs and that could not be read."""
        self.complete = False
        self.add(note)

    @contextmanager
    def isolated(self) -> Iterator[None]:
        """Within the block, `complete` is about the block alone.

        So a result that was computed from readable bags is stored, whatever failed before.
        """
        before, self.complete = self.complete, True
        try:
            yield
        finally:
            self.complete = self.complete and before

    def sentences(self) -> tuple[str, ...]:
        """Returns the sentences for the reply: those that files share, then the others as added.

        Which file is read first, and for what, depends on which bags are stored, and the reply must
        not: so the shared ones are sorted.
        """
        by_kind: dict[Reason, dict[str, str]] = {}
        for note in _farthest(self._notes.values()):
            # A sentence on the bag's summary may report the same already.
            if note.detail not in self._remarks.get(note.file, ()):
                by_kind.setdefault(note.kind, {})[note.file] = note.detail
        shared = sorted(kind.sentence(files) for kind, files in by_kind.items())
        return (*shared, *self._sentences)

    def add_remarks(self, bags: Iterable[BagFile]) -> None:
        """Records that sentences already have what the summaries of these bags remark."""
        self._remarks |= {short_name(bag.path): bag.summary.remarks for bag in bags}

    def notes_cover_remarks(self, bag: BagFile) -> bool:
        """Returns whether the notes on a bag have all remarks of its summary.

        False where a sentence has them (`add_remarks`): then such notes are left out.
        """
        name = short_name(bag.path)
        if name in self._remarks:
            return False
        own = [note for note in self._notes.values() if note.file == name]
        details = {note.detail for note in _farthest(own)}
        return details.issuperset(bag.summary.remarks)

    def keys(self) -> frozenset[NoteKey]:
        """Returns which notes there are, for `retract_outside`."""
        return frozenset(self._notes)

    def retract_outside(
        self, *windows: TimeWindow, keep: Collection[NoteKey] = frozenset()
    ) -> None:
        """Removes the notes on what lies outside of all windows, except those to `keep`.

        For a question about these alone: what is read besides depends on what is stored, and the
        reply must not.
        """
        self._notes = {
            key: note
            for key, note in self._notes.items()
            if key in keep or any(window.overlaps(note.since, note.until) for window in windows)
        }


def _farthest(notes: Iterable[Note]) -> Iterable[Note]:
    """Returns, of the notes of each kind on each file, the one that reaches farthest."""
    in_order = sorted(notes, key=attrgetter("until", "since"))
    return {(note.kind, note.file): note for note in in_order}.values()


def short_name(path: Path) -> str:
    """Returns a bag's name for a reply: recording and file, never a path of this machine."""
    return f"{path.parent.name}/{path.name}"
