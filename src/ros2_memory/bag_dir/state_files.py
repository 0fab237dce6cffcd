"""The files below `.episodic/`: what each row, or document, holds, and who may read it.

    recorded.jsonl     the recorder: how long it has recorded (see `retention.recorded_time`)
    lost.jsonl         the recorder, `forget`: messages that are in no bag, for the notes of answers
    expired.json       the recorder: messages that `retention.topics` takes out of bags, likewise
    deleted.jsonl      the recorder: what retention deletes, so that nobody calls it lost
    superseded.json    the recorder: bags of which thinned days have what stays, for the index
    leaving.json       the recorder: when `memory/` is deleted, since `memory.keep` is false
    shipped.jsonl      `ship`: which bags are in a lake, for retention
    forgotten.jsonl    `forget`: what is deleted here, for the lake that may have it
    erasing.json       `forget`: messages that are being taken out of bags
    screened.json      the recorder: what `recording.exclude_when` holds back, and has excluded
    triggers.json      the recorder: how far the rules of `recording.keep_when` know the recordings

What is about to be deleted is written before it is, so a kill hides nothing. Elsewhere are
`recordings.jsonl` (`own_recordings`), the folder of requests (`moment_file`), and, beside the days
that it completes, `memory/thinned.json`.
"""

from __future__ import annotations

from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import chain
from operator import attrgetter, itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, TypeAlias

from pydantic import Field, StrictBool

from ros2_memory.bag_dir.json_files import (
    MOST_BYTES,
    Count,
    Int64,
    JsonDocument,
    JsonLog,
    until_changed,
)
from ros2_memory.bag_dir.layout import (
    DELETED_FILE,
    ERASING_FILE,
    EXPIRED_FILE,
    FORGOTTEN_FILE,
    LEAVING_FILE,
    LOST_FILE,
    RECORDED_FILE,
    SCREENED_FILE,
    SHIPPED_FILE,
    SUPERSEDED_FILE,
    THINNED_FILE,
    TRIGGERS_FILE,
    has_own_name,
    utc_day,
)
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow

# recorded.jsonl

_Seconds: TypeAlias = Annotated[float, Field(strict=True, ge=0, le=1e9)]


@dataclass(frozen=True, slots=True)
class Recorded:
    """The total recorded time when a recording (its path in the bag directory) last grew.

    `clock_right`: the system clock was synchronised while it grew, and was not set.
    """

    recording: str
    recorded_s: _Seconds
    clock_right: StrictBool = False


RECORDED: Final = JsonLog(RECORDED_FILE, Recorded)

# lost.jsonl

MOST_LOST_BYTES: Final = 1 << 20
"""A longer file loses its older half, unless it is half as long once stretches are joined."""
EVERY_TOPIC: Final = "*"
"""Stands for the topics of a recording that ended unexpectedly."""
INTERRUPTIONS: Final = MappingProxyType(
    {
        "died": "ros2 bag record died",
        "hung": "ros2 bag record hung",
        "unclean": "the recorder ended without a shutdown",
        "paused": "recording was paused: the disk was full, or unmounted",
    }
)
"""How a recording may end unexpectedly, and the words for it."""
Interruption: TypeAlias = Literal["died", "hung", "unclean", "paused"]
"""A key of `INTERRUPTIONS`."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Messages of a topic that are missing between two log times.

    `by` is what shows it: a counter in the messages, the cadence of their header stamps (then they
    may never have been published either), or rosbag2's own count; or they were deleted by request,
    or since they had `expired` (`retention.topics`). Of a publisher that was `refused`, as its QoS
    or type did not fit the subscription, it is not known how many there were, and `lost` 0.
    The unexpected end of a recording is of `EVERY_TOPIC`, from when it last grew to when that was
    noticed, or while it was `paused`, with a key of `INTERRUPTIONS`. How many messages it cost is
    not known, and `lost` 0.
    """

    topic: str
    start: Int64
    stop: Int64
    lost: Count
    by: Literal["counter", "stamps", "rosbag2", "refused", "forgotten", "expired"] | Interruption


LOST: Final = JsonLog(LOST_FILE, Loss, most_bytes=2 * MOST_LOST_BYTES)


def append_losses(bag_dir: Path, losses: Iterable[Loss]) -> None:
    """Appends losses. Where the file is too long, joins stretches, then drops the oldest.

    Raises:
        OSError: they cannot be written, and none is appended.
    """
    if LOST.append(bag_dir, losses) > MOST_LOST_BYTES:
        with suppress(OSError):  # or with the next ones
            rows = LOST.rows(bag_dir)
            # A publisher that is refused has a row for each split.
            refused = _joined(row for row in rows if row.by == "refused")
            rows = [*refused, *(row for row in rows if row.by != "refused")]
            if len(LOST.text(rows)) > MOST_LOST_BYTES // 2:
                rows = rows[len(rows) // 2 :]
            LOST.replace(bag_dir, rows)


def _joined(losses: Iterable[Loss]) -> list[Loss]:
    """Returns losses in order of time; stretches of a topic that lie close together are one."""
    topics: dict[str, list[Loss]] = {}
    for loss in sorted(losses, key=attrgetter("start")):
        of_topic = topics.setdefault(loss.topic, [])
        if of_topic and loss.start - of_topic[-1].stop <= _APART_NS:
            last = of_topic.pop()
            stop, lost = max(last.stop, loss.stop), last.lost + loss.lost
            of_topic.append(replace(last, stop=stop, lost=lost))
        else:
            of_topic.append(loss)
    return sorted(chain.from_iterable(topics.values()), key=attrgetter("start", "topic"))


def read_losses(bag_dir: Path, start: Ns, stop: Ns) -> Sequence[Loss]:
    """Returns the losses that fall between two log times; none where a file cannot be read."""
    expired = EXPIRED.current(bag_dir) or Expired()
    losses = (*(LOST.current(bag_dir) or ()), *expired.gone, *expired.going)
    return [loss for loss in losses if loss.start < stop and start < loss.stop]


# expired.json

_MOST_EXPIRED: Final = 2000


@dataclass(frozen=True, slots=True)
class Expired:
    """The messages that `retention.topics` took out of bags.

    `gone` in order of time; stretches of a topic that lie close together are one. `going` are those
    of the bag at the path `bag` below the bag directory, which was being rewritten; a kill may have
    left them there.
    """

    gone: tuple[Loss, ...] = ()
    bag: str = ""
    going: tuple[Loss, ...] = ()

    def then(self, bag: str, going: Iterable[Loss]) -> Expired:
        """Returns it with the messages of a bag that go next."""
        going = tuple(going)
        # What a kill left in the bag goes again.
        again = {loss.topic for loss in going} if bag == self.bag else set()
        before = [loss for loss in self.going if loss.topic not in again]
        gone = _joined([*self.gone, *before])
        return Expired((*gone[-_MOST_EXPIRED:],), bag, going)


EXPIRED: Final = JsonDocument(EXPIRED_FILE, Expired)


# deleted.jsonl

_MOST_DELETED_BYTES: Final = 1 << 18
_MOST_SPANS: Final = 1000
_APART_NS: Final[Ns] = 20 * NS_PER_S
"""From one split of a recording to the next no message may come for so long."""
_TOUCHING_NS: Final[Ns] = NS_PER_S
"""From one recording to the next."""
_LONGEST_NS: Final[Ns] = 86_400 * NS_PER_S
"""The clock was set within a split that lasts for longer: it shows nothing."""


@dataclass(frozen=True, slots=True)
class Deleted:
    """What was deleted of a recording (its path below the bag directory); "" for some.

    `files` are the names of its splits, without the suffix of compression; `spans` the log times
    (half-open) of their first and last messages, joined.
    """

    recording: str
    files: tuple[str, ...] = ()
    spans: tuple[tuple[Int64, Int64], ...] = ()


DELETED: Final = JsonLog(DELETED_FILE, Deleted, most_bytes=4 * _MOST_DELETED_BYTES)


def deleted_of(recording: str, splits: Iterable[tuple[str, Ns, Ns]]) -> Deleted:
    """Returns the entry for splits of a recording: each its name, first and last log time."""
    named = [*splits]
    spans = [(first, last + 1) for _, first, last in named if 0 <= last - first <= _LONGEST_NS]
    return Deleted(recording, tuple(name for name, _, _ in named), (*united(spans, _APART_NS),))


def append_deleted(bag_dir: Path, deleted: Iterable[Deleted]) -> None:
    """Appends what is about to be deleted; nobody asks about a split that is still there.

    A file that is too long is written again: a row for each recording that is still there, and one
    for all that have gone, whose files nothing lists any more. Where it cannot be read at that
    moment, it stays long until the next time.

    Raises:
        OSError: the file cannot be written.
    """
    if DELETED.append(bag_dir, deleted) <= _MOST_DELETED_BYTES:
        return
    known = _deleted_by_recording(bag_dir)
    if known is None:
        return
    present = {name for name in known if name and (bag_dir / name).is_dir()}
    gone = (span for name, row in known.items() if name not in present for span in row.spans)
    rows, size = [Deleted("", (), (*united(gone, _TOUCHING_NS)[-_MOST_SPANS:],))], 0
    # The newest recordings come last, so they are the first to stay.
    for name in reversed([name for name in known if name in present]):
        size += len(DELETED.text([known[name]]))
        if size > _MOST_DELETED_BYTES // 2:
            break
        rows.append(known[name])
    DELETED.replace(bag_dir, rows)


@until_changed(DELETED_FILE)
def _deleted_by_recording(bag_dir: Path) -> Mapping[str, Deleted]:
    files: dict[str, dict[str, None]] = {}
    spans: dict[str, list[Span]] = {}
    for row in DELETED.rows(bag_dir):
        files.setdefault(row.recording, {}).update(dict.fromkeys(row.files))
        spans.setdefault(row.recording, []).extend(row.spans)
    return {
        name: Deleted(
            name, (*names_of_files,), (*united(spans[name], _APART_NS if name else _TOUCHING_NS),)
        )
        for name, names_of_files in files.items()
    }


def read_deleted(bag_dir: Path) -> Mapping[str, Deleted]:
    """Returns what was deleted, by recording; nothing where the file cannot be read."""
    return _deleted_by_recording(bag_dir) or {}


def deleted_spans(bag_dir: Path) -> Sequence[Span]:
    """Returns the log times (half-open) of all that was deleted, sorted and apart."""
    spans = (span for row in read_deleted(bag_dir).values() for span in row.spans)
    return tuple(united(spans, _TOUCHING_NS))


# superseded.json


@dataclass(frozen=True, slots=True)
class Superseded:
    """Bags that no longer count, since thinned days have what stays of them.

    A kill may leave them there. One does count until its day is as it is listed.

    Attributes:
        days: size (bytes) and mtime (ns) of the file of each day, by its path below the bag
            directory.
        bags: the day that each is in, by its path below the bag directory.
    """

    days: dict[str, tuple[Count, Int64]] = field(default_factory=dict)
    bags: dict[str, str] = field(default_factory=dict)


SUPERSEDED: Final = JsonDocument(SUPERSEDED_FILE, Superseded, most_bytes=MOST_BYTES)


def read_superseded(bag_dir: Path) -> Superseded:
    """Returns the bags that no longer count; none where the file cannot be read."""
    return SUPERSEDED.current(bag_dir) or Superseded()


# memory/thinned.json


@dataclass(frozen=True, slots=True)
class Thinned:
    """What bags showed that days have in place of them, and that is in no message of a day.

    Attributes:
        since: log time from which on it is known; None: of no bag.
        silences: of each the topic, its first and last log time, for how long (ns) the robot was
            on in it, and whether it went on.
        pauses: in which the clock may have been set forward; log times of the messages around.
        set_back: when the clock was set back, and by how much (ns).
        left_open: the last log time of each bag that a crash left open.
    """

    since: Int64 | None = None
    silences: tuple[tuple[str, Int64, Int64, Int64, StrictBool], ...] = ()
    pauses: tuple[tuple[Int64, Int64], ...] = ()
    set_back: tuple[tuple[Int64, Int64], ...] = ()
    left_open: tuple[Int64, ...] = ()

    def from_day(self, day: str) -> Thinned:
        """Returns what does not end before a day (UTC), as names have it.

        Of silences that go on, what does not begin before it.
        """

        def stays(last: Ns) -> bool:
            return utc_day(last) >= day

        return Thinned(
            self.since,
            tuple(
                silence
                for silence in self.silences
                if stays(silence[1] if silence[4] else silence[2])
            ),
            tuple(pause for pause in self.pauses if stays(pause[1])),
            tuple(step for step in self.set_back if stays(step[0])),
            tuple(filter(stays, self.left_open)),
        )


THINNED: Final = JsonDocument(THINNED_FILE, Thinned, most_bytes=MOST_BYTES)


def read_thinned(bag_dir: Path) -> Thinned:
    """Returns what is known of bags that days stand for; nothing where the file cannot be read."""
    return THINNED.current(bag_dir) or Thinned()


# leaving.json


@dataclass(frozen=True, slots=True)
class Leaving:
    """The days of `memory/` are deleted once the recorder has run for so much longer (s)."""

    left_s: _Seconds


LEAVING: Final = JsonDocument(LEAVING_FILE, Leaving)


def describe_leaving(bag_dir: Path) -> str | None:
    """Returns a sentence on when `memory/` is deleted; None where it is not to be."""
    leaving = LEAVING.current(bag_dir)
    if leaving is None:
        return None
    return (
        f"memory/ is deleted once the recorder has run for {leaving.left_s / 3600:.1f} h more, "
        "since memory.keep is false: set it to true to keep it, or delete the folder at once"
    )


# shipped.jsonl

_SPARE_RECEIPTS: Final = 1000


@dataclass(frozen=True, slots=True)
class Receipt:
    """One bag that is in a lake.

    Attributes:
        bag: its path below the bag directory.
        size: of its file when it was shipped (bytes).
        at: when it was committed (ns).
    """

    bag: str
    bag_id: str
    size: Count
    sha256: str
    lake: str
    at: Int64


SHIPPED: Final = JsonLog(SHIPPED_FILE, Receipt)


def read_receipts(bag_dir: Path) -> dict[str, Receipt]:
    """Returns the newest receipt of each bag, by its path; none where there is no file.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        return {receipt.bag: receipt for receipt in SHIPPED.rows(bag_dir)}
    except ValueError:
        return {}


def append_receipts(bag_dir: Path, receipts: Iterable[Receipt]) -> None:
    """Appends receipts. Those of bags that are gone are dropped where most lines are.

    Raises:
        OSError: the file cannot be written, as where the bag directory is mounted read-only.
    """
    SHIPPED.append(bag_dir, receipts)
    rows = SHIPPED.rows(bag_dir)
    if len(rows) > _SPARE_RECEIPTS:
        newest = {receipt.bag: receipt for receipt in rows}
        present = [receipt for path, receipt in newest.items() if (bag_dir / path).exists()]
        if len(rows) > _SPARE_RECEIPTS + 2 * len(present):
            SHIPPED.replace(bag_dir, present)


# Sizes alone: a week has 60,000 bags.
@until_changed(SHIPPED_FILE)
def _shipped_sizes(bag_dir: Path) -> Mapping[str, int]:
    return {path: receipt.size for path, receipt in read_receipts(bag_dir).items()}


def unshipped(bag_dir: Path, bags: Iterable[tuple[str, int]]) -> frozenset[str]:
    """Returns those of some bags, given by path and size (bytes), that are in no lake.

    That is all of them where the receipts cannot be read.
    """
    sizes = _shipped_sizes(bag_dir) or {}
    return frozenset(path for path, size in bags if sizes.get(path) != size)


def is_shipped(receipts: Mapping[str, Receipt], bag: str, size: int) -> bool:
    """Returns whether a bag of this path and size is in a lake."""
    receipt = receipts.get(bag)
    return receipt is not None and receipt.size == size


# forgotten.jsonl


@dataclass(frozen=True, slots=True)
class ForgottenBag:
    """A bag that was deleted as a whole: its recording, its file, and its first log time."""

    recording: str
    file: str
    first: Int64


@dataclass(frozen=True, slots=True)
class Forgetting:
    """What was deleted between two log times (half-open): messages of topics, or whole bags."""

    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[ForgottenBag, ...] = ()


FORGOTTEN: Final = JsonLog(FORGOTTEN_FILE, Forgetting)


def read_forgettings(bag_dir: Path) -> Sequence[Forgetting]:
    """Returns what was deleted, the oldest first and each once; no line is ever removed.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is damaged, or the file too large: what was deleted is unknown.
    """
    forgettings: dict[Forgetting, None] = {}
    for number, row in FORGOTTEN.all_rows(bag_dir):
        if not (row.topics or row.bags):
            raise ValueError(f"line {number}: it names no topics and no bags")
        forgettings[row] = None
    return [*forgettings]


# erasing.json


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

    The file is written before the first bag is changed, and removed after the last trace has gone:
    an erasure that was interrupted can be finished.

    Attributes:
        windows: of log time, half-open, in order and apart.
        latched: those of the topics whose messages go also where they were published in a window
            and received again later, as each recording receives them.
        files: the bags that hold some, by their paths in the bag directory, with all hard links.
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
        spans = united((window.start, window.stop) for window in windows if not window.empty)
        return cls(tuple(sorted(topics)), tuple(spans), tuple(sorted(latched)))

    def window_of(self, topic: str, log_time: Ns, publish_time: Ns) -> Span | None:
        """Returns the window by which a message goes; None where it stays."""
        if topic not in self.topics:
            return None
        times = (log_time, publish_time) if topic in self.latched else (log_time,)
        for time in times:
            begun = bisect_right(self.windows, time, key=itemgetter(0))
            if begun and time < self.windows[begun - 1][1]:
                return self.windows[begun - 1]
        return None

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a message is deleted."""
        return self.window_of(topic, log_time, publish_time) is not None


ERASING: Final = JsonDocument(ERASING_FILE, Erasure, most_bytes=MOST_BYTES)

# screened.json


@dataclass(slots=True)
class ConditionInterval:
    """An interval in which a topic's condition kept its value, in one recording.

    Attributes:
        holds: whether the condition held; None: a message could not be read.
        lasts: the topic is latched: it says nothing while nothing changes.
    """

    first: Int64
    last: Int64
    holds: StrictBool | None
    lasts: StrictBool = False


class FileStep(StrEnum):
    """How far a closed file has come."""

    READ = "read"  # by the rules, and not served yet
    RELEASED = "released"
    UNREADABLE = "unreadable"  # it stays as it is, and is not served


@dataclass(slots=True)
class RecordingScreen:
    """The state of one recording.

    Attributes:
        done: nothing of it is held back any more.
        start: log time of its first message; None before one was read.
        end: log time of its last message that was read; None likewise.
        heard: for each rule the values of its topic, in the order in which they were written.
        unclear: spans of log time in which the clock was set back, so that no order is known.
    """

    done: StrictBool = False
    start: Int64 | None = None
    end: Int64 | None = None
    files: dict[str, FileStep] = field(default_factory=dict)
    heard: dict[str, list[ConditionInterval]] = field(default_factory=dict)
    unclear: list[tuple[Int64, Int64]] = field(default_factory=list)


@dataclass(slots=True)
class Excluded:
    """A stretch of log time (half-open) of which nothing stays.

    `held`: the condition held; else it was not known.
    """

    start: Int64
    stop: Int64
    held: StrictBool = True

    @property
    def span(self) -> Span:
        """Its start and its stop (log time, ns)."""
        return self.start, self.stop


@dataclass(slots=True)
class ScreenState:
    """All that is known: recordings in the order in which they began, and what was excluded.

    The recorder lists a recording before anything of it exists. From then on none of its files is
    served, nor read by what the recorder does with closed bags, until it is listed as released: by
    then what is to be excluded has been cut out of it. What the rules know is written before a file
    is cut: what the cut takes cannot be read again.
    """

    recordings: dict[str, RecordingScreen] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)


class Withheld(NamedTuple):
    """Which files are not served yet.

    `state` is None where the file cannot be read: then no file of a recording is.
    """

    state: ScreenState | None

    def holds(self, recording: str, file: str) -> bool:
        """Returns whether a file of a recording is held back; both by their names."""
        if not self.holds_some(recording):
            return False
        if self.state is None:
            return True
        return self.state.recordings[recording].files.get(file) is not FileStep.RELEASED

    def holds_some(self, recording: str) -> bool:
        """Returns whether files of a recording are held back, or may come to be."""
        if self.state is None:
            return has_own_name(recording)
        screen = self.state.recordings.get(recording)
        return screen is not None and not screen.done


NOTHING_WITHHELD: Final = Withheld(ScreenState())
"""Holds nothing back."""
SCREENED: Final = JsonDocument(SCREENED_FILE, ScreenState, most_bytes=MOST_BYTES)


@until_changed(SCREENED_FILE)
def _screen_state(bag_dir: Path) -> ScreenState | None:
    return SCREENED.read(bag_dir) or NOTHING_WITHHELD.state


def read_withheld(bag_dir: Path) -> Withheld:
    """Returns what is held back at this moment. Raises nothing."""
    return Withheld(_screen_state(bag_dir))


def excluded_between(bag_dir: Path, start: Ns, stop: Ns) -> list[Excluded]:
    """Returns the stretches that were excluded between two log times."""
    state = read_withheld(bag_dir).state
    stretches = () if state is None else state.excluded
    return [stretch for stretch in stretches if stretch.start < stop and start < stretch.stop]


# triggers.json

_Number: TypeAlias = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]


@dataclass(slots=True)
class RunRecord:
    """A match that goes on: the log times of its first and its newest message.

    `fired`: the rule has fired for it. `lasts`: a silence of the topic does not end it.
    """

    first: Int64
    last: Int64
    fired: StrictBool = False
    lasts: StrictBool = False


@dataclass(slots=True)
class RuleMoment:
    """A moment of a rule, which its next match may extend; log times, inclusive.

    `matches` is how often the rule fired in it. `known`: it was stored before, perhaps shorter;
    `stored`: it is stored as it is here.
    """

    number: _Number
    start: Int64
    end: Int64
    matches: Count = 1
    known: StrictBool = False
    stored: StrictBool = False


@dataclass(slots=True)
class RuleRecord:
    """The state of one rule.

    Attributes:
        refused: how often it fired and no bag was kept.
        problem: why it may have missed something, or keeps nothing; None where nothing is wrong.
        always_since: since when it has matched without an end, where that is long; else None.
        begun: log times at which its moments of the last hour began.
        newest: its moments that are not stored yet, and the newest one, in order.
        runs: its matches that go on, by topic.
    """

    fired: Count = 0
    moments: Count = 0
    refused: Count = 0
    last_fired: Int64 | None = None
    problem: str | None = None
    always_since: Int64 | None = None
    begun: list[Int64] = field(default_factory=list)
    newest: list[RuleMoment] = field(default_factory=list)
    runs: dict[str, RunRecord] = field(default_factory=dict)


@dataclass(slots=True)
class LatchedMark:
    """How far a latched topic is known: each recording receives its messages again.

    By recording, `published` is the latest publish time and `begun` the first log time; `payload`
    is a hash of the last message.
    """

    published: dict[str, Int64] = field(default_factory=dict)
    begun: dict[str, Int64] = field(default_factory=dict)
    payload: str = ""


@dataclass(slots=True)
class TriggerState:
    """All that the rules know, as it is written after each look at closed splits.

    A recorder that was killed goes on from here, so what it had found since is found again.

    Attributes:
        rules: by name; those that are not configured any more are dropped.
        searched: until which log time (excluded) the newest recordings were searched.
        before: a recording; it and all that were listed before it were searched, or lie before the
            rules. None if there is none.
    """

    rules: dict[str, RuleRecord] = field(default_factory=dict)
    searched: dict[str, Int64] = field(default_factory=dict)
    before: str | None = None
    latched: dict[str, LatchedMark] = field(default_factory=dict)


TRIGGERS: Final = JsonDocument(TRIGGERS_FILE, TriggerState)
