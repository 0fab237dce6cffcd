"""Screens closed splits before they are served: cuts out what `recording.exclude_when` excludes.

Which times those are is computed from the values of a topic in each recording. A message is valid
from its log time on: on a latched topic until the next one, on any other topic for `stale` after
the last one. It is valid only in its own recording, since the next one receives the topic again.
Exception: a condition that is true at the end of a recording stays true in the following ones, for
at most `stale`, until one of them receives the topic. If another recording has taken over by then,
the last value is valid for `stale` more, until that recording must have received the topic. All
other times are unknown, and so are spans in which the clock was set back.

Each split is read once for what the rules' topics show in it. It is released once nothing that
comes can reach into it any more, with its margin: mostly when the next split was read. Before that
what falls into an excluded stretch is cut out of it. While no message has ever shown whether a rule
holds, for want of its field, splits stay as they are and are not served: a corrected rule reads
them.

What was learned is written before the first cut, since a cut takes the messages that showed it. A
kill in between does no harm: what is not released yet is cut again, to the same result.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import suppress
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.analysis.conditions import Equals, leaves
from ros2_memory.analysis.refusals import refusal_for
from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import (
    SCREENED_FILE,
    bags_in,
    split_number,
)
from ros2_memory.bag_dir.metadata_yaml import why_not_corrected
from ros2_memory.bag_dir.state_files import (
    SCREENED,
    ConditionInterval,
    Excluded,
    FileStep,
    RecordingScreen,
    ScreenState,
)
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS, BagSummary
from ros2_memory.core.errors import (
    BagError,
    EpisodicError,
    RecorderError,
    UndecodableError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import Spans, lies_inside, overlaps_any, united, without
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns, Span, ns_from_unix
from ros2_memory.index.split_order import split_of
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.retention.repair import reason_of, rewritten
from ros2_memory.storage.base import BagReader, BagWriter, Closing, Record
from ros2_memory.triggers.rules import horizons

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.extract import SchemaExtractor

MOST_AT_ONCE: Final = 16
"""So many splits are released in one step, which is then written down."""
DONE_KEPT: Final = 2
"""Recordings that are done but still matter to later ones."""
MOST_EXCLUDED: Final = 1000
"""Stretches that are remembered, the newest ones."""
RETRY_S: Final = 30.0
"""How long until a split that could not be cut is tried again."""
REMIND_S: Final = 600.0
"""How long until a rule that still cannot be evaluated is logged again."""

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExclusionRule:
    """A rule of `recording.exclude_when`.

    Attributes:
        margin: how long before and after is excluded, too.
        stale: for how long a message is valid if its topic is not latched.
        excludes_unknown: whether times with an unknown value are excluded, too.
    """

    name: str
    topic: str
    condition: Condition
    margin: Ns
    stale: Ns
    excludes_unknown: bool = True


class RecordingConditions(NamedTuple):
    """The values of a topic in one recording, in the order in which they were written.

    `end` is None while it is being written. `previous` is the recording that it took over from
    while both ran, if there is one: the clock of any other may have been set since.
    """

    start: Ns
    end: Ns | None
    heard: Sequence[ConditionInterval]
    unclear: Sequence[Span] = ()
    name: str = ""
    previous: str | None = None

    @property
    def stop(self) -> Ns:
        """The end, excluded."""
        return MAX_NS if self.end is None else self.end + 1


def add_message(
    heard: list[ConditionInterval], time: Ns, holds: bool | None, *, latched: bool, stale: Ns
) -> None:
    """Adds the next message; `holds` is None if it cannot be read.

    A message that lies before the last one was logged out of order, and changes nothing unless the
    condition holds.
    """
    last = heard[-1] if heard else None
    if last is not None and time < last.last:
        if holds is False:
            return
        if holds is None:
            time = last.last
        elif last.holds and last.lasts == latched:
            last.first = min(last.first, time)
            return
    if (
        last is not None
        and (last.holds, last.lasts) == (holds, latched)
        and (latched or time - last.last <= stale)
    ):
        last.last = time
    else:
        heard.append(ConditionInterval(time, time, holds, latched))


def excluded_intervals(
    rule: ExclusionRule, recordings: Sequence[RecordingConditions]
) -> list[Excluded]:
    """Returns the intervals to cut out, with the margin, in order of time.

    Those in which the condition held, and those in which it was not known, are apart, and may
    overlap. Recordings come in the order in which they began; one that begins before the one before
    it follows a clock that was set back, and learns from it only that the condition held.
    """
    held: Spans = []
    free: list[Spans] = []
    for place, recording in enumerate(recordings, 1):
        later = recordings[place:]
        free_here: Spans = []
        for run, following in zip_longest(recording.heard, recording.heard[1:]):
            stop = _valid_until(run, following, recording, rule.stale)
            if following is None and stop >= recording.stop < MAX_NS:
                stop = _valid_past_end(run, recording, later, rule.stale)
                if run.holds:
                    held += _carried(run.first, recording, later, rule.stale)
            if run.holds is True:
                held.append((run.first, stop))
            elif run.holds is False:
                free_here.append((run.first, stop))
        free.append(free_here)
    unknown = [span for recording in recordings for span in recording.unclear]
    if rule.excludes_unknown:
        unknown += _unknown(recordings, held, free)
    return [
        *(Excluded(*span, held=True) for span in _widened(held, rule.margin)),
        *(Excluded(*span, held=False) for span in _widened(unknown, rule.margin)),
    ]


def _unknown(
    recordings: Sequence[RecordingConditions], held: Spans, free: Sequence[Spans]
) -> Iterator[Span]:
    """Yields where recordings did not know, by themselves or by others, whether it holds."""
    for recording in recordings:
        # Of those alone that ran beside it by one clock.
        beside = (
            spans
            for spans, other in zip(free, recordings, strict=True)
            if other is recording
            or (recording.previous == other.name and not other.unclear)
            or other.previous == recording.name
        )
        yield from without([(recording.start, recording.stop)], united(chain(held, *beside)))


def _valid_until(
    run: ConditionInterval,
    following: ConditionInterval | None,
    recording: RecordingConditions,
    stale: Ns,
) -> Ns:
    """Returns until when a recording itself knows the value."""
    stop = recording.stop
    if following is not None and following.first >= run.last:
        stop = following.first
    elif following is not None and not run.holds:
        # The clock was set back: nothing is sure but that the condition may hold.
        return run.last + 1
    return stop if run.lasts else min(stop, run.last + stale)


def _valid_past_end(
    run: ConditionInterval,
    recording: RecordingConditions,
    later: Iterable[RecordingConditions],
    stale: Ns,
) -> Ns:
    """Returns until when the last value of a recording is valid; longer if another took over."""
    was_taken_over = any(
        recording.start <= other.start < recording.stop < other.stop for other in later
    )
    if run.holds or not was_taken_over:
        return recording.stop
    return (recording.stop if run.lasts else run.last) + stale


def _carried(
    since: Ns, ended: RecordingConditions, others: Iterable[RecordingConditions], stale: Ns
) -> Spans:
    """Returns where a condition that held from `since` to the end of a recording goes on after it.

    One that took over may have begun, and received the topic, before the condition held.
    """
    spans: Spans = []
    until: Ns | None = None
    for other in others:
        start = other.start
        if other.previous == ended.name and not (ended.unclear or other.unclear):
            start = max(since, start)
        if other.start < ended.start:  # the clock was set back
            start, until = other.start, other.start + stale
        elif until is None:
            until = max(other.start, ended.stop) + stale
        stop = min(until, other.heard[0].first if other.heard else MAX_NS)
        if start < stop:
            spans.append((start, stop))
        if other.heard:
            break
    return spans


class Cut:
    """Which messages of one bag are deleted.

    The time of receipt decides, but on a latched topic, which each recording receives again, the
    publish time: a message is deleted if it lies in a stretch in which the condition held, or in
    one in which that was not known and the message was received in a stretch, too.

    Args:
        stretches: those of the bag's own time.
        before: those that were excluded before, in which latched messages may have been published.
        latched: the latched topics.
    """

    def __init__(
        self, stretches: Sequence[Excluded], before: Sequence[Excluded], latched: Collection[str]
    ) -> None:
        self._latched = frozenset(latched)
        self._all = united(stretch.span for stretch in stretches)
        known = (*before, *stretches)
        self._known = united(stretch.span for stretch in known)
        self._held = united(stretch.span for stretch in known if stretch.held)

    def takes(self, topic: str, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a message is deleted."""
        if topic not in self._latched:
            return lies_inside(self._all, log_time)
        return self.takes_always(log_time, publish_time) or (
            lies_inside(self._known, _published(log_time, publish_time))
            and lies_inside(self._all, log_time)
        )

    def takes_always(self, log_time: Ns, publish_time: Ns) -> bool:
        """Returns whether a latched message is deleted whenever it is received."""
        return lies_inside(self._held, _published(log_time, publish_time))

    def touches(self, topic: str, first: Ns, last: Ns) -> bool:
        """Returns whether messages of a topic between two log times may be deleted."""
        if topic in self._latched:
            return bool(self._known)
        return overlaps_any(self._all, first, last)


def add_excluded(
    known: Sequence[Excluded], stretches: Iterable[Excluded], start: Ns, end: Ns
) -> list[Excluded]:
    """Returns what is known with the parts of stretches that touch a file from `start` to `end`.

    What lies between two files, less than messages are out of order, counts with both.
    """
    low, high = start - OUT_OF_ORDER_NS, end + OUT_OF_ORDER_NS + 1
    parts = [
        Excluded(max(stretch.start, low), min(stretch.stop, high), stretch.held)
        for stretch in stretches
        if stretch.start <= end and start < stretch.stop
    ]
    joined: list[Excluded] = []
    for held in (True, False):
        spans = [stretch.span for stretch in (*known, *parts) if stretch.held is held]
        joined += (Excluded(*span, held=held) for span in united(spans))
    return sorted(joined, key=lambda stretch: stretch.span)


def _published(log_time: Ns, publish_time: Ns) -> Ns:
    return publish_time if 0 < publish_time < log_time else log_time


def _widened(spans: Iterable[Span], margin: Ns) -> Spans:
    return united(
        (max(start - margin, MIN_NS), min(stop + margin, MAX_NS))
        for start, stop in spans
        if start < stop
    )


_ClosedFiles: TypeAlias = "list[tuple[Path, BagSummary]]"


class _UselessRuleError(EpisodicError):
    """A rule that was never evaluated cannot be evaluated on a split either."""


@dataclass(eq=False, repr=False)
class Screening:
    """Screens the recordings of one bag directory.

    `announce` and `plan` are for the thread that begins recordings, the step that `plan` returns
    for any one other.

    Args:
        rules: what is excluded, by unique names; with none nothing is announced.
        reader: reads files as they are, also what does not count in answers.
    """

    bag_dir: Path
    rules: Sequence[ExclusionRule]
    reader: BagReader
    extractor: SchemaExtractor
    writer: BagWriter
    _: KW_ONLY
    split_duration_s: float
    monotonic: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Sets what is known at the beginning."""
        self._retry_s: dict[Path, float] = {}
        self._failing = FailingFiles(self.monotonic)
        self._split = ns_from_unix(self.split_duration_s)
        self._margin = max((rule.margin for rule in self.rules), default=0)
        self._lock = threading.Lock()
        self._state: ScreenState | None = None
        self._problems: dict[str, str] = {}
        self._refusals: dict[str, str] = {}
        self._evaluated: set[str] = set()
        self._logged_s: dict[str, float] = {}
        self._excluded_latched = frozenset[str]()

    def announce(self, recording: str) -> None:
        """Holds back a recording of which nothing exists yet.

        Raises:
            RecorderError: that cannot be written down, and the recording must not begin.
        """
        try:
            with self._lock:
                known = self._loaded()
                recordings = {**known.recordings, recording: RecordingScreen()}
                self._write(ScreenState(recordings, known.excluded))
        except OSError as error:
            target = self.bag_dir / SCREENED_FILE
            raise RecorderError(f"{target}: {error.strerror or error}") from error

    def plan(self, live: Collection[str]) -> Callable[[], None]:
        """Returns the next step, which may take some seconds; `live` are being written now.

        Raises:
            EpisodicError: what is known cannot be read.
            OSError: likewise.
        """
        with self._lock:
            names = [name for name, screen in self._loaded().recordings.items() if not screen.done]
        written = frozenset(live)
        return lambda: self._run_step(names, written)

    def failing_rules(self) -> tuple[str, ...]:
        """Describes each rule that cannot be evaluated at present, and why."""
        return (*self._refusals.values(),)

    def problem(self) -> str | None:
        """Describes the splits that a fault or a useless rule holds back, or None."""
        problems = [*self._problems.items()]
        if not problems:
            refused = "; ".join(self.failing_rules())
            return f"recording.exclude_when does not work: {refused}" if refused else None
        name, reason = problems[-1]
        held = counted(len(problems), "split is", "splits are")
        return (
            f"{held} not served, because recording.exclude_when could not be applied: "
            f"{name}: {reason}"
        )

    def excluded_latched(self) -> frozenset[str]:
        """Returns the latched topics whose newest message is excluded whenever it is received.

        Not those that decide: each recording needs their value.
        """
        return self._excluded_latched.difference(rule.topic for rule in self.rules)

    def _run_step(self, names: Sequence[str], live: Collection[str]) -> None:
        """Reads closed files, and releases those that can be released.

        Raises:
            BagUnreachableError: the disk fails to read a bag, and may recover; the next step tries
                again.
            OSError: the disk fails, or the state cannot be written, and nothing more is released.
        """
        with self._lock:
            state = deepcopy(self._loaded())
        closed: dict[str, _ClosedFiles] = {}
        is_held = False
        for name in names:
            files, is_whole = self._read_recording(name, state.recordings[name], live)
            is_held |= not is_whole
            # What a condition was in a recording that is held back may matter to later ones.
            closed[name] = [] if is_held else files
        self._problems = {
            name: reason
            for name, reason in self._problems.items()
            if (self.bag_dir / name).exists()
        }
        self._commit(state, names)
        ready = self._ready(state, closed, live)
        stretches = self._stretches(state, live) if ready else []
        for path, summary in ready[:MOST_AT_ONCE]:
            try:
                self._cut_split(path, summary, stretches, state.excluded)
            except (EpisodicError, OSError) as error:
                self._report(path, error)
                self._put_off(path)
                continue
            state.recordings[path.parent.name].files[path.name] = FileStep.RELEASED
            if not summary.empty:
                excluded = add_excluded(state.excluded, stretches, summary.start, summary.end)
                state.excluded = excluded[-MOST_EXCLUDED:]
            self._problems.pop(_file_name(path), None)
            self._retry_s.pop(path, None)
        for name in names:
            if name not in live:
                self._finish_recording(name, state)
        self._commit(state, names)

    def _read_recording(
        self, name: str, screen: RecordingScreen, live: Collection[str]
    ) -> tuple[_ClosedFiles, bool]:
        """Reads the closed files of a recording that were not; returns those not released yet.

        With it whether all closed files are read: none where a useless rule waits for another.
        """
        unreleased: _ClosedFiles = []
        paths, known = self._files(name), screen.files
        screen.files = {path.name: known[path.name] for path in paths if path.name in known}
        for nth, path in enumerate(paths):
            step = screen.files.get(path.name)
            if step in {FileStep.RELEASED, FileStep.UNREADABLE}:
                continue
            if step is None and self._is_put_off(path):
                return unreleased, False
            try:
                summary = self._read_file(path, screen)
            except _UselessRuleError as error:
                self._problems |= dict.fromkeys(map(_file_name, paths[nth:]), str(error))
                self._put_off(path)
                return unreleased, False
            if summary is not None:
                unreleased.append((path, summary))
            elif name in live and path.name not in screen.files:
                break  # what comes after an open file has not been written
        return unreleased, True

    def _read_file(self, path: Path, screen: RecordingScreen) -> BagSummary | None:
        """Adds what a file shows to the state, once; returns its summary.

        None where it is open, or cannot be read. One that a crash left open is read once it was
        repaired.

        Raises:
            BagUnreachableError: the disk fails to read it, and may recover.
            _UselessRuleError: as `_add_conditions`.
        """
        is_new = path.name not in screen.files
        try:
            if is_new and self.reader.closing(path) is not Closing.CLOSED:
                return None
            summary = self.reader.summarize(path)
            if is_new:
                self._add_conditions(path, summary, screen)
        except BagError as error:
            if self._failing.may_recover(path, error):
                raise
            _doubt(screen)
            screen.files[path.name] = FileStep.UNREADABLE
            self._report(path, error)
            return None
        screen.files[path.name] = FileStep.READ
        self._problems.pop(_file_name(path), None)
        return summary

    def _is_put_off(self, path: Path) -> bool:
        return self.monotonic() < self._retry_s.get(path, 0.0)

    def _put_off(self, path: Path) -> None:
        self._retry_s[path] = self.monotonic() + RETRY_S

    def _files(self, name: str) -> list[Path]:
        """Returns the bags of a recording in the order in which they were written."""
        with suppress(FileNotFoundError, NotADirectoryError):
            paths = bags_in(self.bag_dir / name)
            return sorted(paths, key=lambda path: (split_of(path.name) or ("", 0), path.name))
        return []

    def _add_conditions(self, path: Path, summary: BagSummary, screen: RecordingScreen) -> None:
        """Adds what a file shows to the state.

        Raises:
            BagError: it cannot be read or rewritten.
            _UselessRuleError: no message has shown yet whether a rule holds that excludes what is
                not known; the state stays as it is.
        """
        if path.suffix != ".mcap" or not summary.complete:
            raise BagError(str(path), "it is not a complete MCAP file")
        if summary.empty:
            return
        heard_by_rule = deepcopy(screen.heard)
        for rule in self.rules:
            heard = heard_by_rule.setdefault(rule.name, [])
            refusal: str | None = None
            for record in self.reader.records(path, (rule.topic,), TimeWindow.everything()):
                holds, refused = self._test(rule, record)
                refusal = refused or refusal
                latched = record.channel.latched
                add_message(heard, record.log_time, holds, latched=latched, stale=rule.stale)
            if refusal and rule.excludes_unknown and rule.name not in self._evaluated:
                raise _UselessRuleError(refusal)
        screen.heard = heard_by_rule
        # Latched messages may be written again with the times that they had.
        first_unlatched = min(
            (topic.first for topic in summary.topics if not topic.latched), default=MAX_NS
        )
        was_set_back = screen.end is not None and first_unlatched < screen.end - OUT_OF_ORDER_NS
        if was_set_back or summary.schema.set_back:
            screen.unclear.append((summary.start, summary.end + 1))
        screen.start = min(summary.start, MAX_NS if screen.start is None else screen.start)
        screen.end = summary.end if screen.end is None else max(screen.end, summary.end)

    def _test(self, rule: ExclusionRule, record: Record) -> tuple[bool | None, str | None]:
        """Returns whether a rule's condition holds; None where a message cannot show it.

        With it the reason, where no message of this shape can show it.
        """
        type_name = record.channel.type
        condition = rule.condition.of_type(type_name, self.extractor)
        try:
            value = self.extractor.exact(self.reader.decode(record), type_name)
        except UndecodableError as error:
            self._refuse(rule, str(error))
            return None, None
        holds = condition.matches(value)
        refusal = None
        if not holds and condition.can_be_refused:
            refusal = refusal_for(condition, value)
        if not holds and refusal is None and isinstance(condition.test, Equals):
            is_number = any(isinstance(leaf, bool | int | float) for leaf in leaves(value))
            if isinstance(condition.test.value, bool) and not is_number:
                refusal = "the values hold no boolean"
        if refusal is not None:
            return None, self._refuse(rule, f"{rule.topic}: {refusal}")
        self._refusals.pop(rule.name, None)
        self._evaluated.add(rule.name)
        return holds, None

    def _refuse(self, rule: ExclusionRule, reason: str) -> str:
        """Notes why a rule cannot be evaluated, and logs it, again every ten minutes."""
        sentence = f"the rule {rule.name}: {reason}"
        self._refusals[rule.name] = sentence
        now_s = self.monotonic()
        if now_s >= self._logged_s.get(rule.name, now_s):
            self._logged_s[rule.name] = now_s + REMIND_S
            _log.error("exclusion_rule_fails", rule=rule.name, reason=reason)
        return sentence

    def _ready(
        self,
        state: ScreenState,
        closed: dict[str, _ClosedFiles],
        live: Collection[str],
    ) -> _ClosedFiles:
        """Returns the splits that no later message can affect, but for those that wait."""
        ends = {name: state.recordings[name].end or 0 for name in closed}
        written = {name: state.recordings[name].end for name in live if name in state.recordings}
        until = horizons(ends, dict.fromkeys(live) | written, self._split)
        return [
            (path, summary)
            for name, files in closed.items()
            for path, summary in files
            if summary.empty or summary.end + self._margin < until[name]
            if not self._is_put_off(path)
        ]

    def _stretches(self, state: ScreenState, live: Collection[str]) -> list[Excluded]:
        """Returns what is excluded of the time of recordings that are not done, or were last."""
        stretches: list[Excluded] = []
        for rule in self.rules:
            recordings = [
                RecordingConditions(
                    screen.start,
                    None if name in live else screen.end,
                    screen.heard.get(rule.name, ()),
                    screen.unclear,
                    name,
                    read_handover(self.bag_dir / name).handover.previous,
                )
                for name, screen in state.recordings.items()
                if screen.start is not None
            ]
            stretches += excluded_intervals(rule, recordings)
        return stretches

    def _cut_split(
        self,
        path: Path,
        summary: BagSummary,
        stretches: Sequence[Excluded],
        before: Sequence[Excluded],
    ) -> None:
        """Cuts the excluded data out of a split; see `Cut`.

        Raises:
            EpisodicError: it cannot be rewritten.
            OSError: likewise, or it has gone.
        """
        latched = {topic.topic for topic in summary.topics if topic.latched}
        cut = Cut(stretches, before, latched)
        topics = {
            topic.topic
            for topic in summary.topics
            if cut.touches(topic.topic, topic.first, topic.last)
        }
        gone = Counter[str]()
        newest: dict[str, tuple[Ns, bool]] = {}  # when it was published, and if it is excluded
        for record in self.reader.records(path, sorted(topics), TimeWindow.everything()):
            topic, logged, published = record.channel.topic, record.log_time, record.publish_time
            if cut.takes(topic, logged, published):
                gone[topic] += 1
            if topic in latched:
                latched_record = (published or logged, cut.takes_always(logged, published))
                newest[topic] = max(latched_record, newest.get(topic, latched_record))
        if gone:
            recording, file = path.parent.name, path.name
            if split_number(recording, file) is None:
                raise BagError(str(path), "it is not named as a split of its recording")
            status = path.lstat()
            with rewritten(self.bag_dir, path, status, self.writer, takes=cut.takes, expected=gone):
                pass
            _log.info("messages_excluded", recording=recording, file=file, messages=gone.total())
        returning = {topic for topic, (_, is_excluded) in newest.items() if is_excluded}
        self._excluded_latched = (self._excluded_latched - newest.keys()) | returning

    def _finish_recording(self, name: str, state: ScreenState) -> None:
        """Marks an ended recording as done once nothing of it is held back."""
        screen, files = state.recordings[name], [file.name for file in self._files(name)]
        if any(screen.files.get(file) is not FileStep.RELEASED for file in files):
            return
        if state.excluded and (reason := why_not_corrected(self.bag_dir / name, self.reader)):
            _log.warning(
                "metadata_not_corrected",
                recording=name,
                reason=f"metadata.yaml may still count what was excluded: {reason}",
            )
        screen.done = True
        screen.files = {}

    def _loaded(self) -> ScreenState:
        """Returns the state; call it with the lock held.

        Raises:
            RecorderError: it is damaged.
            OSError: it cannot be read.
        """
        if self._state is None:
            try:
                self._state = SCREENED.read(self.bag_dir) or ScreenState()
            except ValueError as error:
                raise RecorderError(
                    f"{self.bag_dir / SCREENED_FILE}: {error}; which splits are still unscreened "
                    "is not known any more: delete the newest recordings, or delete this file to "
                    "have them served"
                ) from error
        return self._state

    def _commit(self, state: ScreenState, names: Sequence[str]) -> None:
        """Writes what a step changed, if anything, beside what was announced meanwhile.

        Raises:
            OSError: it cannot be written; the state in memory stays as it was.
        """
        with self._lock:
            recordings = dict(self._loaded().recordings)
            recordings.update({name: deepcopy(state.recordings[name]) for name in names})
            done = [name for name, screen in recordings.items() if screen.done]
            informative = [name for name in done if recordings[name].start is not None][-DONE_KEPT:]
            for name in {*done} - {*informative}:
                del recordings[name]
            self._write(ScreenState(recordings, list(state.excluded)))

    def _write(self, state: ScreenState) -> None:
        """Writes a state, if it is another one; call it with the lock held."""
        if state != self._state:
            SCREENED.write(self.bag_dir, state)
            self._state = state

    def _report(self, path: Path, error: Exception) -> None:
        """Notes why a split is held back, and logs it once."""
        name, reason = _file_name(path), reason_of(error)
        if self._problems.get(name) != reason:
            _log.error("split_held_back", file=name, reason=reason)
        self._problems[name] = reason


def _file_name(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _doubt(screen: RecordingScreen) -> None:
    """Notes a file that cannot be read: the state of the conditions after it is unknown, too."""
    for heard in screen.heard.values():
        if heard and not heard[-1].holds:
            last = heard[-1].last
            begun = max(last, (screen.end or last) + 1)
            heard.append(ConditionInterval(begun, begun, None))
