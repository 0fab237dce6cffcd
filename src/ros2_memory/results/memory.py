"""Results about the memory itself: its time range, its status, saved moments."""

from __future__ import annotations

from dataclasses import field
from typing import TYPE_CHECKING, Final

from ros2_memory.core.reply import (
    AGO,
    FILE,
    ISO_LOCAL,
    LASTED,
    LOCAL,
    OBJECT,
    OBJECTS,
    PAIRS,
    PLAIN,
    SECONDS,
    TIME,
    AnswerWithNotes,
    an_object,
    digits,
    keys,
    objects,
    result,
    seconds,
    unit,
)
from ros2_memory.core.text import counted
from ros2_memory.retention.policy import GB

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.analysis.clock_steps import ClockStep
    from ros2_memory.analysis.silences import Silence
    from ros2_memory.bag_dir.moment_file import StoredMoment
    from ros2_memory.bag_dir.state_files import RuleRecord
    from ros2_memory.core.model import SetAside
    from ros2_memory.core.timebase import Ns

ANOTHER: Final = "another recorder"
"""The recorder of a status where this program has none, and files are being written."""
_MAX_LISTED: Final = 20
_MAX_TOPICS: Final = 10
_S_PER_DAY: Final = 86_400
_SMALL_BYTES: Final = GB // 10
"""Smaller sizes are given to the kilobyte."""

_GIGABYTES: Final = unit(lambda size: round(size / GB, 3 if size >= _SMALL_BYTES else 6))


def _known_end(silence: Silence) -> Ns | None:
    return None if silence.goes_on else silence.end


_SILENCES: Final = objects(
    keys(
        "topic",
        TIME("start"),
        TIME("end", _known_end),
        SECONDS("silent_s", "length"),
        LOCAL("local", "start", _known_end),
    )
)
"""`silent_s` is how long the robot was on in it."""
_CLOCK_STEPS: Final = objects(keys(TIME("at"), SECONDS("step_s", "by"), LOCAL("local", "at", "at")))
"""`step_s` is negative where the clock was set back."""
_FILES: Final = objects(keys(FILE("file", "path"), "reason"))


@result("topic", "type", "reason")
class Undecodable:
    """A topic with messages under a type that cannot be decoded, and why."""

    topic: str
    type: str
    reason: str


@result(
    TIME("start"),
    TIME("end"),
    LASTED("duration_s", "start", "end"),
    SECONDS("deleted_s").if_any,
    LOCAL("local", "start", "end"),
)
class Gap:
    """A time without a bag, up to the `end`, where data begins again.

    `deleted` is how much of the time was recorded, and has been deleted by retention.
    """

    start: Ns
    end: Ns
    deleted: Ns = 0


@result(
    TIME("earliest").in_short,
    TIME("latest").in_short,
    ISO_LOCAL("earliest_local"),
    ISO_LOCAL("latest_local"),
    TIME("now"),
    ISO_LOCAL("now_local"),
    PLAIN("bags").in_short,
    OBJECTS("gaps").last(_MAX_LISTED),
    _SILENCES("silences").last(_MAX_LISTED),
    _CLOCK_STEPS("clock_steps").last(_MAX_LISTED),
    _FILES("active").last(_MAX_LISTED),
    _FILES("damaged").last(_MAX_LISTED),
    _FILES("incomplete").last(_MAX_LISTED),
    _FILES("unread").last(_MAX_LISTED),
    _FILES("clock_faults").last(_MAX_LISTED),
    OBJECTS("undecodable").last(_MAX_LISTED),
    "silent_topics",
    span=("earliest", "now"),
)
class DataTimeRange(AnswerWithNotes):
    """The recorded time range, and unreadable files; no times if nothing is recorded."""

    earliest: Ns | None
    latest: Ns | None
    now: Ns
    bags: int
    gaps: tuple[Gap, ...]
    incomplete: tuple[SetAside, ...]
    active: tuple[SetAside, ...]
    damaged: tuple[SetAside, ...]
    unread: tuple[SetAside, ...]
    silent_topics: int
    undecodable: tuple[Undecodable, ...] = ()
    clock_faults: tuple[SetAside, ...] = ()
    silences: tuple[Silence, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()


@result("topic", TIME("last_ts", "last"), AGO("ago_s", "last"), LOCAL("local", "last", "last"))
class SilentTopic:
    """A topic without recent messages, and its last one."""

    topic: str
    last: Ns


@result(
    _GIGABYTES("used_gb", "used"),
    _GIGABYTES("max_gb", "most"),
    _GIGABYTES("state_gb", "state").if_any,
    _GIGABYTES("foreign_gb", "foreign"),
    _GIGABYTES("growth_gb_per_day", "per_day"),
    digits(2)("full_in_days").if_known,
    digits(2)("keeps_days").if_known,
)
class Budget:
    """The disk budget, in bytes; None for a number that is not known.

    Attributes:
        used: by all that counts.
        most: the limit.
        per_day: growth.
        max_age: after which bags are deleted (ns).
        foreign: used by bags that the recorder did not make; in none of the other numbers.
        state: the part of `used` that is stored beside the bags.
    """

    used: int
    most: int | None
    per_day: int | None
    max_age: Ns | None
    foreign: int | None = None
    state: int = 0

    @property
    def full_in_days(self) -> float | None:
        """For how many days there is room left."""
        if self.most is None or not self.per_day:
            return None
        return max(self.most - self.used, 0) / self.per_day

    @property
    def keeps_days(self) -> float | None:
        """For how many days bags stay before they are deleted."""
        if self.most is None or not self.per_day:
            return None
        lasting = self.most / self.per_day
        return lasting if self.max_age is None else min(lasting, seconds(self.max_age) / _S_PER_DAY)


@result("moment", "label", TIME("start"), TIME("end"), "bags", "pending")
class RememberedMoment:
    """A moment that the recorder saves: its name, and how many bags it has so far.

    `start` and `end` (inclusive) are as requested. If it is `pending`, the other bags are still
    being written.
    """

    moment: str
    label: str
    start: Ns
    end: Ns
    bags: int
    pending: bool


@result(
    PLAIN("rule", "name"),
    PLAIN("fired", "record.fired"),
    PLAIN("moments", "record.moments"),
    TIME("last_ts", "record.last_fired").if_known,
    AGO("last_ago_s", "record.last_fired").if_known,
    PLAIN("refused", "record.refused").if_any,
    TIME("matches_since", "record.always_since").if_known,
    PLAIN("problem").if_known,
)
class FiredRule:
    """How often a rule of `recording.keep_when` fired, and how many moments that made.

    Attributes:
        unread: why it may miss a match for as long as a split cannot be read; None if all can be.
    """

    name: str
    record: RuleRecord
    unread: str | None = None

    @property
    def problem(self) -> str | None:
        """Why it may have missed a match, or stores or searches nothing now; None if it works."""
        record = self.record
        problems = dict.fromkeys([record.never, record.problem, record.unstored, self.unread])
        return "; ".join(filter(None, problems)) or None


def _size_gb(stored: StoredMoment) -> float:
    return sum(stored.files.values()) / GB


def _is_complete(stored: StoredMoment) -> bool:
    return not (stored.moment.pending or stored.moment.missing)


_STORED: Final = keys(
    PLAIN("moment", "folder.name"),
    PLAIN("label", "moment.request.label"),
    TIME("start", "moment.request.start"),
    TIME("end", "moment.request.end"),
    LOCAL("local", "moment.request.start", "moment.request.end"),
    AGO("ago_s", "moment.request.end"),
    unit(len)("bags", "files"),
    digits(6)("size_gb", _size_gb),
    PLAIN("complete", _is_complete),
    PLAIN("rule", "moment.rule").if_known,
    PLAIN("matches", "moment.matches").when("moment.rule"),
    PLAIN("pending", "moment.pending").if_any,
    PLAIN("notes", "moment.missing").if_any,
)
_MOMENTS: Final = objects(_STORED)("moments")
_RULES: Final = OBJECTS("rules").first(_MAX_LISTED).if_any


@result(_MOMENTS, PLAIN("more").if_any, _RULES, span=("oldest", "now"))
class MomentList:
    """The saved moments, newest first, and the rules. `more` is how many moments are not listed."""

    moments: tuple[StoredMoment, ...]
    more: int
    now: Ns
    rules: tuple[FiredRule, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def oldest(self) -> Ns | None:
        """When the earliest of the listed moments began."""
        return min((stored.moment.request.start for stored in self.moments), default=None)

    @property
    def total(self) -> int | None:
        """How many moments there are; None if all are listed."""
        return len(self.moments) + self.more if self.more else None


@result(an_object(_STORED).spread("stored"), span=("stored.moment.request.start", "now"))
class ShownMoment:
    """One saved moment; `now` is what "ago" counts from."""

    stored: StoredMoment
    now: Ns


_NEWEST_MOMENTS: Final = keys(
    _MOMENTS, PLAIN("moments_count", "total").if_known, _RULES, span=("oldest", "now")
)


@result(
    PLAIN("doubts").in_short,
    PLAIN("recorder").in_short,
    "recorder_alive",
    "restarts",
    PAIRS("lost_last_hour", "lost").if_any,
    TIME("now"),
    TIME("earliest"),
    TIME("latest").in_short,
    LOCAL("local", "earliest", "latest"),
    SECONDS("newest_age_s").in_short,
    OBJECTS("fell_silent").first(_MAX_TOPICS),
    _SILENCES("silences", lambda status: status.silences[::-1]).first(_MAX_TOPICS),
    OBJECTS("gaps", lambda status: status.gaps[::-1]).first(_MAX_TOPICS),
    _CLOCK_STEPS("clock_steps", lambda status: status.clock_steps[::-1]).first(_MAX_TOPICS),
    PLAIN("never_heard").first(_MAX_TOPICS),
    PLAIN("missing").first(_MAX_TOPICS),
    PLAIN("damaged").in_short,
    "incomplete",
    "unread",
    OBJECT("budget"),
    an_object(_NEWEST_MOMENTS).spread("moments"),
    span=("earliest", "now"),
)
class Status(AnswerWithNotes):
    """How complete and how recent the recorded data is.

    Attributes:
        now: what ages count from.
        earliest: the oldest recorded time; None if nothing is recorded.
        latest: the newest recorded time; None if nothing is recorded.
        heard: while a recorder runs, the newest time of a topic that it does not publish itself;
            else `latest`.
        recorder: the state of the recorder; None if no recorder has written here.
        live: whether the recorder is running.
        restarts: how often it restarted `ros2 bag record`; 0 without a recorder.
        missing: topics that it should record by name, and that no publisher offers.
        never_heard: topics that it subscribed to, and of which no message is recorded.
        fell_silent: topics that had messages, but not lately.
        damaged: files that cannot be read.
        incomplete: bags that a crash left open.
        unread: files of a kind that is not read here.
        budget: the use of the disk budget.
        moments: the newest saved moments; None if they cannot be listed.
        problems: why answers may be incomplete.
        silences: when topics with a usual rate were silent although the robot was on.
        clock_steps: when the clock was set by 2 s or more.
        gaps: when nothing was recorded.
        stalled: in how many gaps the recorder ran on, and for how long in all.
        lost: how many messages of each topic are known to be missing of the recorder's last hour.
    """

    now: Ns
    earliest: Ns | None
    latest: Ns | None
    heard: Ns | None
    recorder: str | None
    live: bool
    restarts: int
    missing: tuple[str, ...]
    never_heard: tuple[str, ...]
    fell_silent: tuple[SilentTopic, ...]
    damaged: int
    incomplete: int
    unread: int
    budget: Budget
    moments: MomentList | None
    problems: tuple[str, ...]
    silences: tuple[Silence, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()
    gaps: tuple[Gap, ...] = ()
    stalled: tuple[int, Ns] = (0, 0)
    lost: Mapping[str, int] = field(default_factory=dict)

    @property
    def doubts(self) -> str:
        """Why answers may be missing something, or be wrong, in short."""
        return "; ".join(self._reasons()) or "no loss or fault was found"

    @property
    def recorder_alive(self) -> bool | None:
        """Whether the recorder of this program is running; None if it has no recorder."""
        is_ours = self.recorder != ANOTHER and bool(self.recorder or self.budget.most)
        return self.live if is_ours else None

    @property
    def newest_age(self) -> Ns | None:
        """How old the newest data is."""
        return None if self.heard is None else max(self.now - self.heard, 0)

    def _reasons(self) -> Iterator[str]:
        """Yields the problems, and one sentence each on silences, stalls and steps of the clock."""
        yield from self.problems
        topics = {silence.topic for silence in self.silences}
        if len(self.silences) == 1:
            [silence] = self.silences
            still = ", and still is" if silence.goes_on else ""
            yield f"{silence.topic} was silent for {seconds(silence.length):.0f} s{still}"
        elif topics:
            named = next(iter(topics)) if len(topics) == 1 else counted(len(topics), "topic")
            yield f"{named} fell silent {len(self.silences)} times (see silences)"
        count, length = self.stalled
        if count:
            times = "once" if count == 1 else f"{count} times"
            yield f"while the recorder ran, nothing was recorded {times} ({seconds(length):.10g} s)"
        if len(self.clock_steps) == 1:
            [(_, by)] = self.clock_steps
            how = (
                f"{seconds(by):.10g} s ahead"
                if by > 0
                else f"back by {seconds(-by):.10g} s or more"
            )
            yield f"the clock was set {how}"
        elif self.clock_steps:
            yield f"the clock was set {len(self.clock_steps)} times (see clock_steps)"
