"""The files below `.episodic/`: what a row or document holds, and which program writes it.

    recorded.jsonl     the recorder: how long it has recorded (see `retention.recorded_time`)
    lost.jsonl         the recorder, `forget`: messages that are in no bag, for the notes of answers
    expired.json       the recorder: messages that `retention.topics` takes out of bags, likewise
    deleted.jsonl      the recorder: bags that retention deletes, so that nobody calls them lost
    superseded.json    the recorder: bags whose messages are in thinned days, for the index
    leaving.json       the recorder: when it deletes `memory/`, since `memory.keep` is false
    shipped.jsonl      `ship`: the bags that are in a lake, for retention
    forgotten.jsonl    `forget`: messages and bags deleted here, for the lake that may have them
    erasing.json       `forget`: messages that are being taken out of bags
    screened.json      the recorder: splits that `recording.exclude_when` holds back, or has cut
    triggers.json      the recorder: how far the rules of `recording.keep_when` have read

A row is written before the bag is deleted, so a kill hides nothing. Other files are
`recordings.jsonl` (`own_recordings`), the folder of requests (`moment_file`), and
`memory/thinned.json`, which lies beside the days that it completes.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import chain
from operator import attrgetter, itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, TypeAlias

from pydantic import Field, StrictBool

from ros2_memory.bag_dir.json_files import (
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
    MEMORY_FOLDER,
    RECORDED_FILE,
    SCREENED_FILE,
    SHIPPED_FILE,
    SUPERSEDED_FILE,
    THINNED_FILE,
    TRIGGERS_FILE,
    has_own_name,
    utc_day,
)
from ros2_memory.core.spans import Spans, overlaps_any, united
from ros2_memory.core.timebase import NS_PER_DAY, NS_PER_S, Ns, Span

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import TimeWindow

_Span: TypeAlias = tuple[Int64, Int64]
"""A span of log time (ns)."""

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
"""A longer file is shortened."""
_APART_NS: Final[Ns] = 20 * NS_PER_S
"""The longest time without a message from one split of a recording to the next."""
EVERY_TOPIC: Final = "*"
"""Stands for all topics of a recording that ended unexpectedly."""
INTERRUPTIONS: Final = MappingProxyType(
    {
        "died": "ros2 bag record died",
        "hung": "ros2 bag record hung",
        "unclean": "the recorder ended without a shutdown",
        "paused": "recording was paused: the disk was full, or unmounted",
    }
)
"""The ways in which a recording may end unexpectedly, with words for them."""
Interruption: TypeAlias = Literal["died", "hung", "unclean", "paused"]
"""A key of `INTERRUPTIONS`."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Messages of a topic that are missing between two log times.

    Attributes:
        topic: the topic; `EVERY_TOPIC` if a recording ended unexpectedly or was paused.
        lost: the number of missing messages; 0 if it is not known.
        by: what shows the loss. `counter`, `stamps`: a counter in the messages, or the cadence of
            their header stamps (then they may never have been published). `rosbag2`: its own count.
            `refused`: the QoS or the type of a publisher did not fit. `forgotten`, `expired`: a
            request or `retention.topics` deleted them. Or a key of `INTERRUPTIONS`: the time from
            when the recording last grew to when recording went on, or of the pause.
    """

    topic: str
    start: Int64
    stop: Int64
    lost: Count
    by: Literal["counter", "stamps", "rosbag2", "refused", "forgotten", "expired"] | Interruption


LOST: Final = JsonLog(LOST_FILE, Loss)


def append_losses(bag_dir: Path, losses: Iterable[Loss]) -> None:
    """Appends losses. A file that is too long is shortened, see `_shortened`.

    Raises:
        OSError: the losses cannot be written, and none is appended.
    """
    if LOST.append(bag_dir, losses) > MOST_LOST_BYTES:
        with suppress(OSError):  # the next call tries again
            LOST.rewrite(bag_dir, _shortened)


def _shortened(losses: Sequence[Loss]) -> Sequence[Loss]:
    """Returns losses without the older half, unless joining rows is enough.

    What was forgotten stays as it is: without its row, "never" would be answered of its time.
    """
    forgotten = [loss for loss in losses if loss.by == "forgotten"]
    # A refused publisher has a row for each split.
    refused = _joined(loss for loss in losses if loss.by == "refused")
    others = [loss for loss in losses if loss.by not in {"forgotten", "refused"}]
    others = sorted([*refused, *others], key=attrgetter("stop"))
    if len(LOST.text(others)) > MOST_LOST_BYTES // 2:
        others = others[len(others) // 2 :]
    return [*forgotten, *others]


def _joined(losses: Iterable[Loss], apart: Ns = _APART_NS) -> list[Loss]:
    """Returns losses in order of time; those of a topic that lie close together are one."""
    topics: dict[str, list[Loss]] = {}
    for loss in sorted(losses, key=attrgetter("start")):
        of_topic = topics.setdefault(loss.topic, [])
        if of_topic and loss.start - of_topic[-1].stop <= apart:
            last = of_topic.pop()
            stop, lost = max(last.stop, loss.stop), last.lost + loss.lost
            of_topic.append(replace(last, stop=stop, lost=lost))
        else:
            of_topic.append(loss)
    return sorted(chain.from_iterable(topics.values()), key=attrgetter("start", "topic"))


def read_losses(bag_dir: Path, start: Ns, stop: Ns) -> Sequence[Loss]:
    """Returns the losses between two log times; files that cannot be read have none."""
    expired = EXPIRED.current(bag_dir) or Expired()
    losses = (*(LOST.current(bag_dir) or ()), *expired.gone, *expired.going)
    return [loss for loss in losses if loss.start < stop and start < loss.stop]


# expired.json

_MOST_EXPIRED: Final = 2000
_LONGEST_APART_NS: Final[Ns] = 30 * NS_PER_DAY


@dataclass(frozen=True, slots=True)
class Expired:
    """The messages that `retention.topics` took out of bags.

    Attributes:
        gone: in order of time; losses of a topic that lie close together are one.
        bag: the path, below the bag directory, of the bag that was being rewritten.
        going: the messages that go from that bag; a kill may have left them there.
    """

    gone: tuple[Loss, ...] = ()
    bag: str = ""
    going: tuple[Loss, ...] = ()

    def then(self, bag: str, going: Iterable[Loss]) -> Expired:
        """Returns the document with the messages that go next, from another bag."""
        going = tuple(going)
        # Messages that a kill left in the bag go again.
        again = {loss.topic for loss in going} if bag == self.bag else set()
        before = [loss for loss in self.going if loss.topic not in again]
        gone = _joined([*self.gone, *before])
        if len(gone) > _MOST_EXPIRED:
            # All older messages of a topic expire, so none is left between its losses.
            gone = _joined(gone, _LONGEST_APART_NS)
        return Expired((*gone[-_MOST_EXPIRED:],), bag, going)


EXPIRED: Final = JsonDocument(EXPIRED_FILE, Expired)


# deleted.jsonl

_MOST_DELETED_BYTES: Final = 1 << 18
_MOST_SPANS: Final = 1000
_TOUCHING_NS: Final[Ns] = NS_PER_S
"""The longest time without a message from one recording to the next."""
_LONGEST_NS: Final[Ns] = NS_PER_DAY
"""The clock was set within a longer split: its times mean nothing."""


@dataclass(frozen=True, slots=True)
class Deleted:
    """Splits that were deleted.

    Attributes:
        recording: the path of the recording below the bag directory; "" for many recordings.
        files: their names, without the suffix of compression.
        spans: their log times (half-open), joined.
    """

    recording: str
    files: tuple[str, ...] = ()
    spans: tuple[_Span, ...] = ()


DELETED: Final = JsonLog(DELETED_FILE, Deleted, most_bytes=4 * _MOST_DELETED_BYTES)


def deleted_of(recording: str, splits: Iterable[tuple[str, Ns, Ns]]) -> Deleted:
    """Returns the row for splits of a recording: the name, first and last log time of each."""
    names: list[str] = []
    spans: list[Span] = []
    for name, first, last in splits:
        names.append(name)
        if 0 <= last - first <= _LONGEST_NS:
            spans.append((first, last + 1))
    return Deleted(recording, tuple(names), tuple(united(spans, _APART_NS)))


def append_deleted(bag_dir: Path, deleted: Iterable[Deleted]) -> None:
    """Appends splits that are about to be deleted.

    A file that is too long is shortened, see `_without_gone`.

    Raises:
        OSError: the file cannot be written.
    """
    if DELETED.append(bag_dir, deleted) > _MOST_DELETED_BYTES:
        with suppress(OSError):  # the next call tries again
            DELETED.rewrite(bag_dir, partial(_without_gone, bag_dir))


def _without_gone(bag_dir: Path, rows: Iterable[Deleted]) -> list[Deleted]:
    """Returns one row for each recording that still exists, and one for all others.

    Nothing lists the files of recordings that are gone any more. The files of the oldest that exist
    are dropped, too, where the list would be too long.
    """
    present: list[Deleted] = []
    gone: list[Span] = []
    for name, row in _by_recording(rows).items():
        if name and (bag_dir / name).is_dir():
            present.append(row)
        else:
            gone += row.spans
    left: list[Deleted] = []
    # The newest recordings come last, and stay longest.
    size = 0
    for row in reversed(present):
        size += len(DELETED.text([row]))
        if size <= _MOST_DELETED_BYTES // 2:
            left.append(row)
        else:
            gone += row.spans
    rest = Deleted("", spans=tuple(united(gone, _TOUCHING_NS)[-_MOST_SPANS:]))
    return [rest, *reversed(left)]


def _by_recording(rows: Iterable[Deleted]) -> Mapping[str, Deleted]:
    files: defaultdict[str, dict[str, None]] = defaultdict(dict)
    spans: defaultdict[str, list[Span]] = defaultdict(list)
    for row in rows:
        files[row.recording] |= dict.fromkeys(row.files)
        spans[row.recording] += row.spans
    return {
        name: Deleted(
            name, (*of_name,), (*united(spans[name], _APART_NS if name else _TOUCHING_NS),)
        )
        for name, of_name in files.items()
    }


@until_changed(DELETED_FILE)
def _deleted_by_recording(bag_dir: Path) -> Mapping[str, Deleted]:
    return _by_recording(DELETED.rows(bag_dir))


def read_deleted(bag_dir: Path) -> Mapping[str, Deleted]:
    """Returns the deleted splits, by recording; none if the file cannot be read."""
    return _deleted_by_recording(bag_dir) or {}


def deleted_spans(bag_dir: Path) -> Sequence[Span]:
    """Returns the log times (half-open) of all deleted splits, sorted and apart."""
    spans = (span for row in read_deleted(bag_dir).values() for span in row.spans)
    return tuple(united(spans, _TOUCHING_NS))


# superseded.json


@dataclass(frozen=True, slots=True)
class Superseded:
    """Bags that no longer count, since thinned days have the messages that stay of them.

    A kill may leave such a bag. It counts until its day has the listed size and time.

    Attributes:
        days: the size (bytes) and mtime (ns) of each day's file, by its path below the bag
            directory.
        bags: the path of its day for each bag, by the bag's path; both below the bag directory.
    """

    days: dict[str, tuple[Count, Int64]] = field(default_factory=dict)
    bags: dict[str, str] = field(default_factory=dict)


SUPERSEDED: Final = JsonDocument(SUPERSEDED_FILE, Superseded)


def read_superseded(bag_dir: Path) -> Superseded:
    """Returns the bags that no longer count; none if the file cannot be read."""
    return SUPERSEDED.current(bag_dir) or Superseded()


# memory/thinned.json


@dataclass(frozen=True, slots=True)
class Thinned:
    """What deleted bags showed that no message of a day shows. Times are log times (ns).

    Attributes:
        since: the time from which on this is known; None before the first bag.
        silences: the topic, the first and the last time, for how long the robot was on (ns), and
            whether the silence went on.
        pauses: the times of the messages around each pause in which the clock may have been set
            forward.
        set_back: when the clock was set back, and by how much (ns).
        left_open: the last time of each bag that a crash left open.
    """

    since: Int64 | None = None
    silences: tuple[tuple[str, Int64, Int64, Int64, StrictBool], ...] = ()
    pauses: tuple[_Span, ...] = ()
    set_back: tuple[tuple[Int64, Int64], ...] = ()
    left_open: tuple[Int64, ...] = ()

    def from_day(self, day: str) -> Thinned:
        """Returns what ended on a day or later, and silences that go on and began then.

        The day is a date in UTC, as `20261120`.
        """
        left = self._where(lambda _, last: utc_day(last) >= day)
        silences = (
            silence for silence in left.silences if not silence[4] or utc_day(silence[1]) >= day
        )
        return replace(left, silences=tuple(silences))

    def without(self, spans: Spans, topics: Collection[str] | None = None) -> Thinned:
        """Returns what is not in spans of log time; of some topics only their silences go."""
        if topics is None:
            return self._where(lambda first, last: not overlaps_any(spans, first, last))
        silences = (
            silence
            for silence in self.silences
            if silence[0] not in topics or not overlaps_any(spans, *silence[1:3])
        )
        return replace(self, silences=tuple(silences))

    def _where(self, stays: Callable[[Ns, Ns], bool]) -> Thinned:
        """Returns what `stays` is true of, by its first and last time."""
        return Thinned(
            self.since,
            tuple(silence for silence in self.silences if stays(*silence[1:3])),
            tuple(pause for pause in self.pauses if stays(*pause)),
            tuple(step for step in self.set_back if stays(step[0], step[0])),
            tuple(time for time in self.left_open if stays(time, time)),
        )


THINNED: Final = JsonDocument(THINNED_FILE, Thinned)


def read_thinned(bag_dir: Path) -> Thinned:
    """Returns what deleted bags showed; nothing if the file cannot be read."""
    return THINNED.current(bag_dir) or Thinned()


# leaving.json


@dataclass(frozen=True, slots=True)
class Leaving:
    """For how long (s) the recorder must still run before it deletes the days of `memory/`."""

    left_s: _Seconds


LEAVING: Final = JsonDocument(LEAVING_FILE, Leaving)


def describe_leaving(bag_dir: Path) -> str | None:
    """Returns a sentence on when `memory/` is deleted; None if it stays, or is not there."""
    leaving = LEAVING.current(bag_dir)
    if leaving is None or not (bag_dir / MEMORY_FOLDER).is_dir():
        return None
    return (
        f"memory/ is deleted once the recorder has run for {leaving.left_s / 3600:.1f} h more, "
        "since memory.keep is false: set it to true to keep it, or delete the folder at once"
    )


# shipped.jsonl

_SPARE_RECEIPTS: Final = 1000


@dataclass(frozen=True, slots=True)
class Receipt:
    """A bag that is in a lake.

    Attributes:
        bag: its path below the bag directory.
        size: the size of its file when it was shipped (bytes).
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
    """Returns the newest receipt of each bag, by its path; none if there is no file.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        return {receipt.bag: receipt for receipt in SHIPPED.rows(bag_dir)}
    except ValueError:
        return {}


def append_receipts(bag_dir: Path, receipts: Iterable[Receipt]) -> None:
    """Appends receipts. Once most lines are of bags that are gone, these are dropped.

    Raises:
        OSError: the file cannot be written, as in a bag directory that is mounted read-only.
    """
    SHIPPED.append(bag_dir, receipts)
    rows = SHIPPED.rows(bag_dir)
    most = len(rows) - _SPARE_RECEIPTS
    if most > 0 and most > 2 * len(_present(bag_dir, rows)):
        SHIPPED.rewrite(bag_dir, partial(_present, bag_dir))


def _present(bag_dir: Path, receipts: Iterable[Receipt]) -> list[Receipt]:
    """Returns the newest receipt of each bag that exists."""
    newest = {receipt.bag: receipt for receipt in receipts}
    return [receipt for path, receipt in newest.items() if (bag_dir / path).exists()]


# Sizes alone: a week has 60,000 bags.
@until_changed(SHIPPED_FILE)
def _shipped_sizes(bag_dir: Path) -> Mapping[str, int]:
    return {path: receipt.size for path, receipt in read_receipts(bag_dir).items()}


def unshipped(bag_dir: Path, bags: Iterable[tuple[str, int]]) -> frozenset[str]:
    """Returns the paths of bags that are in no lake; all of them if receipts cannot be read.

    `bags` are paths in the bag directory, and sizes in bytes.
    """
    sizes, root = _shipped_sizes(bag_dir) or {}, f"{bag_dir}/"
    return frozenset(path for path, size in bags if sizes.get(path.removeprefix(root)) != size)


def is_shipped(receipts: Mapping[str, Receipt], bag: str, size: int) -> bool:
    """Whether a bag of this path and size (bytes) is in a lake."""
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
    """A deletion between two log times (half-open): of messages of topics, or of whole bags."""

    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[ForgottenBag, ...] = ()


FORGOTTEN: Final = JsonLog(FORGOTTEN_FILE, Forgetting)


def read_forgettings(bag_dir: Path) -> Sequence[Forgetting]:
    """Returns the deletions, oldest first and each once. No line is ever removed.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is damaged, or the file is too large: deletions may be unknown.
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
    """The number of a topic's messages that go between two log times (half-open)."""

    topic: str
    start: Int64
    stop: Int64
    count: Count


@dataclass(frozen=True, slots=True)
class Erasure:
    """The messages that are being taken out of bags.

    The file is written before the first bag is changed, and removed after the last trace has gone.
    So an interrupted erasure can be finished.

    Attributes:
        windows: log times, half-open, in order and apart.
        latched: topics whose messages also go if they were published in a window and received again
            later, as each recording receives them.
        files: the paths, below the bag directory, of the bags that hold such messages, with all
            hard links.
    """

    topics: tuple[str, ...]
    windows: tuple[_Span, ...]
    latched: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    counts: tuple[Erased, ...] = ()

    @classmethod
    def of(
        cls, topics: Iterable[str], windows: Iterable[TimeWindow], latched: Iterable[str]
    ) -> Erasure:
        """Returns an erasure; the windows may overlap, and come in any order."""
        spans = united((window.start, window.stop) for window in windows if not window.empty)
        return cls(tuple(sorted(topics)), tuple(spans), tuple(sorted(latched)))

    def window_of(self, topic: str, log_time: Ns, publish_time: Ns) -> Span | None:
        """Returns the window by which a message goes; None if it stays."""
        if topic not in self.topics:
            return None
        times = (log_time, publish_time) if topic in self.latched else (log_time,)
        for time in times:
            begun = bisect_right(self.windows, time, key=itemgetter(0))
            if begun:
                start, stop = self.windows[begun - 1]
                if time < stop:
                    return start, stop
        return None

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Whether a message goes."""
        return self.window_of(topic, log_time, publish_time) is not None


ERASING: Final = JsonDocument(ERASING_FILE, Erasure)

# screened.json


@dataclass(slots=True)
class ConditionInterval:
    """An interval in which a topic's condition kept its value, in one recording.

    Attributes:
        holds: whether the condition held; None if a message could not be read.
        lasts: whether the topic is latched: it is silent while nothing changes.
    """

    first: Int64
    last: Int64
    holds: StrictBool | None
    lasts: StrictBool = False


class FileStep(StrEnum):
    """The state of a closed file."""

    READ = "read"  # the rules have read it; it is not served yet
    RELEASED = "released"
    UNREADABLE = "unreadable"  # it stays as it is, and is not served


@dataclass(slots=True)
class RecordingScreen:
    """The state of one recording.

    Attributes:
        done: whether no file of it is held back any more.
        start: the log time of its first message; None before one was read.
        end: the log time of its last message that was read; None before one was read.
        heard: for each rule the values of its topic's condition, in the order of writing.
        unclear: spans of log time in which the clock was set back, so that the order is unknown.
        holding: for each rule, by the source (`facts.source_of`) of messages that last met its
            condition, the log time of the newest of them.
    """

    done: StrictBool = False
    start: Int64 | None = None
    end: Int64 | None = None
    files: dict[str, FileStep] = field(default_factory=dict)
    heard: dict[str, list[ConditionInterval]] = field(default_factory=dict)
    unclear: list[_Span] = field(default_factory=list)
    holding: dict[str, dict[str, Int64]] = field(default_factory=dict)


@dataclass(slots=True)
class Excluded:
    """A span of log time (half-open) whose messages were excluded.

    `held`: whether the condition held; otherwise it was not known.
    """

    start: Int64
    stop: Int64
    held: StrictBool = True

    @property
    def span(self) -> Span:
        """The start and the stop (log time, ns)."""
        return self.start, self.stop


@dataclass(slots=True)
class ScreenState:
    """The recordings, in the order in which they began, and the excluded spans.

    The recorder lists a recording before anything of it exists. From then on no file of it is
    served, or read by other tasks of the recorder, until the file is listed as released: by then
    its excluded messages have been cut out. The state of the rules is written before a file is cut,
    since the messages cannot be read again.

    `earlier` has the spans before those in `excluded`, and `earlier_held` those of them in which
    the condition held; spans close to each other are one.
    """

    recordings: dict[str, RecordingScreen] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)
    earlier: list[_Span] = field(default_factory=list)
    earlier_held: list[_Span] = field(default_factory=list)


class Withheld(NamedTuple):
    """The files that are not served yet.

    `state` is None if `screened.json` cannot be read: then no file of a recording is served.
    """

    state: ScreenState | None

    def holds(self, recording: str, file: str) -> bool:
        """Whether a file of a recording is held back; both by their names."""
        if not self.holds_some(recording):
            return False
        if self.state is None:
            return True
        return self.state.recordings[recording].files.get(file) is not FileStep.RELEASED

    def holds_some(self, recording: str) -> bool:
        """Whether files of a recording are held back, or new ones would be."""
        if self.state is None:
            return has_own_name(recording)
        screen = self.state.recordings.get(recording)
        return screen is not None and not screen.done


NOTHING_WITHHELD: Final = Withheld(ScreenState())
SCREENED: Final = JsonDocument(SCREENED_FILE, ScreenState)


@until_changed(SCREENED_FILE)
def _screen_state(bag_dir: Path) -> ScreenState | None:
    return SCREENED.read(bag_dir) or NOTHING_WITHHELD.state


def read_withheld(bag_dir: Path) -> Withheld:
    """Returns the files that are held back at this moment. Raises nothing."""
    return Withheld(_screen_state(bag_dir))


def excluded_between(bag_dir: Path, start: Ns, stop: Ns) -> Spans:
    """Returns the excluded spans that overlap a window of log time, in no order."""
    state = read_withheld(bag_dir).state
    if state is None:
        return []
    spans = [*state.earlier, *(excluded.span for excluded in state.excluded)]
    return [span for span in spans if span[0] < stop and start < span[1]]


# triggers.json

_Number: TypeAlias = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]


@dataclass(slots=True)
class RunRecord:
    """A match that goes on: the log times of its first and its newest message.

    `fired`: whether the rule has fired for it. `lasts`: whether it survives a silence of the topic.
    """

    first: Int64
    last: Int64
    fired: StrictBool = False
    lasts: StrictBool = False


@dataclass(slots=True)
class RuleMoment:
    """A moment of a rule, which its next match may extend; log times, inclusive.

    Attributes:
        matches: how often the rule fired in it.
        known: whether it was stored before, perhaps shorter.
        stored: whether it is stored as it is here.
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
        problem: why it may have missed a match, or keeps nothing; None if it works. See also
            `TriggerState.unread`.
        unstored: why moments wait to be stored; None if none waits.
        never: why it can never fire as things are; None if it can.
        always_since: since when it has matched without an end; None unless that is long.
        begun: the log times at which the moments of the last hour began.
        newest: the moments that are not stored yet, and the newest one, in order.
        runs: the matches that go on, by topic; those of diagnostics by topic and node.
    """

    fired: Count = 0
    moments: Count = 0
    refused: Count = 0
    last_fired: Int64 | None = None
    problem: str | None = None
    unstored: str | None = None
    never: str | None = None
    always_since: Int64 | None = None
    begun: list[Int64] = field(default_factory=list)
    newest: list[RuleMoment] = field(default_factory=list)
    runs: dict[str, RunRecord] = field(default_factory=dict)


@dataclass(slots=True)
class LatchedMark:
    """How far a latched topic was read: each recording receives its messages again.

    Attributes:
        published: the latest publish time, by recording.
        begun: the first log time, by recording.
        payload: a hash of the last message.
    """

    published: dict[str, Int64] = field(default_factory=dict)
    begun: dict[str, Int64] = field(default_factory=dict)
    payload: str = ""


@dataclass(slots=True)
class TriggerState:
    """The state of all rules, written after each look at closed splits.

    A recorder that was killed continues from here, and finds later matches again.

    Attributes:
        rules: by name; rules that are not configured any more are dropped.
        searched: the log time (excluded) up to which each part of the newest recordings was
            searched; see `triggers.rules.parts_of`.
        before: the newest recording that needs no search any more; None if there is none.
        unread: why all rules may miss a match now: by split that cannot be read, a sentence.
    """

    rules: dict[str, RuleRecord] = field(default_factory=dict)
    searched: dict[str, Int64] = field(default_factory=dict)
    before: str | None = None
    latched: dict[str, LatchedMark] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)


TRIGGERS: Final = JsonDocument(TRIGGERS_FILE, TriggerState)
