"""Screens closed splits before they are served: cuts out what `recording.exclude_when` excludes.

Which times are excluded is computed in `exclusion`.

Each split is read once for the values of the rules' topics. It is released once no later message
can exclude any of it, margins included: mostly when the next split was read. Before that, the
messages in excluded stretches are cut out of it. While no message has ever shown whether a rule
holds, since none has its field, splits stay as they are and are not served: a corrected rule reads
them again.

The values are written down before the first cut, since a cut takes the messages that showed them. A
kill in between does no harm: a split that is not released is cut again, to the same result.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import suppress
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass, replace
from itertools import pairwise, starmap
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.analysis.conditions import Equals, leaves
from ros2_memory.analysis.facts import source_of
from ros2_memory.analysis.refusals import refusal_for
from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import SCREENED_FILE, bags_in, split_number
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
from ros2_memory.core.errors import BagError, EpisodicError, RecorderError, UndecodableError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import MCAP, TimeWindow
from ros2_memory.core.spans import Spans, united
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, Ns, ns_from_unix
from ros2_memory.index.split_order import split_of
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.retention.repair import UnflushedError, reason_of, rewrite_without
from ros2_memory.triggers.exclusion import (
    Cut,
    ExclusionRule,
    RecordingConditions,
    add_excluded,
    add_message,
    excluded_intervals,
)
from ros2_memory.triggers.rules import horizons

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.model import JsonValue
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, BagWriter, Record

MOST_AT_ONCE: Final = 16
"""So many splits are released in one step, which is then written down."""
DONE_KEPT: Final = 2
"""So many finished recordings are remembered, since their values matter to later ones."""
MOST_EXCLUDED: Final = 1000
"""So many excluded stretches are remembered one by one, and as many spans that join older ones."""
RETRY_S: Final = 30.0
"""How long until a split that could not be cut is tried again."""
REMIND_S: Final = 600.0
"""How long until a rule that still cannot be evaluated is logged again."""

_log = get_logger(__name__)


_ClosedFiles: TypeAlias = "list[tuple[Path, BagSummary]]"


class _UselessRuleError(EpisodicError):
    """A rule could not be evaluated on a split, nor on any split before."""


class _TestResult(NamedTuple):
    """Whether a condition holds; None if the message cannot show it.

    `refusal` is the reason if no message of this type could show it, `source` whose message it is.
    """

    holds: bool | None
    refusal: str | None = None
    source: str = ""


@dataclass(eq=False, repr=False)
class Screening:
    """Screens the recordings of one bag directory.

    The thread that begins recordings calls `announce` and `plan`. One other thread runs the steps
    that `plan` returns.

    Args:
        rules: the rules, with unique names.
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
        """Starts with nothing known."""
        self._retry_s: dict[Path, float] = {}
        self._failing = FailingFiles(self.monotonic)
        self._split = ns_from_unix(self.split_duration_s)
        self._margin = max((rule.margin for rule in self.rules), default=0)
        self._lock = threading.Lock()
        self._state: ScreenState | None = None
        self._problems: dict[Path, str] = {}
        self._refusals: dict[str, str] = {}
        self._evaluated: set[str] = set()
        self._logged_s: dict[str, float] = {}
        self._excluded_latched = frozenset[str]()

    def announce(self, recording: str) -> None:
        """Holds back a recording that has not begun yet.

        Raises:
            RecorderError: that cannot be written down, and the recording must not begin.
        """
        try:
            with self._lock:
                known = self._loaded()
                recordings = {**known.recordings, recording: RecordingScreen()}
                self._write(replace(known, recordings=recordings))
        except OSError as error:
            target = self.bag_dir / SCREENED_FILE
            raise RecorderError(f"{target}: {error.strerror or error}") from error

    def plan(self, live: Collection[str]) -> Callable[[], None]:
        """Returns the next step, which may take some seconds; `live` are being written now.

        Raises:
            RecorderError: the state file is damaged.
            OSError: the state file cannot be read.
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
        path, reason = problems[-1]
        held = counted(len(problems), "split is", "splits are")
        return (
            f"{held} not served, because recording.exclude_when could not be applied: "
            f"{_file_name(path)}: {reason}"
        )

    def excluded_latched(self) -> frozenset[str]:
        """Returns the latched topics whose newest message is excluded whenever it is received.

        The rules' own topics are not among them: each recording needs their value.
        """
        return self._excluded_latched.difference(rule.topic for rule in self.rules)

    def _run_step(self, names: Sequence[str], live: Collection[str]) -> None:
        """Reads new closed splits, and releases the splits that no later message can affect.

        Raises:
            BagUnreachableError: the disk fails to read a bag, and may recover; the next step tries
                again.
            OSError: the disk fails, or the state cannot be written, and nothing more is released.
        """
        with self._lock:
            state = deepcopy(self._loaded())
        unreleased: dict[str, _ClosedFiles] = {}
        is_held_back = False
        for name in names:
            files, is_read = self._read_recording(name, state.recordings[name], live)
            is_held_back = is_held_back or not is_read
            # Values in a recording that is not read yet may matter to later ones.
            unreleased[name] = [] if is_held_back else files
        for path in [*self._problems]:
            if not path.exists():
                del self._problems[path]
        self._commit(state, names)
        ready = self._ready(state, unreleased, live)
        stretches = self._stretches(state, live) if ready else []
        for path, summary in ready[:MOST_AT_ONCE]:
            self._release(path, summary, stretches, state)
        for name in names:
            if name not in live:
                self._finish_recording(name, state)
        self._commit(state, names)

    def _release(
        self, path: Path, summary: BagSummary, stretches: Sequence[Excluded], state: ScreenState
    ) -> None:
        """Cuts a split and marks it as released in the state; a fault is reported."""
        try:
            self._cut_split(path, summary, stretches, _excluded_before(state))
        except (EpisodicError, OSError) as error:
            self._report(path, error)
            self._put_off(path)
            return
        state.recordings[path.parent.name].files[path.name] = FileStep.RELEASED
        if not summary.empty:
            excluded = add_excluded(state.excluded, stretches, summary.start, summary.end)
            older, state.excluded = excluded[:-MOST_EXCLUDED], excluded[-MOST_EXCLUDED:]
            held = [stretch.span for stretch in older if stretch.held]
            state.earlier = _joined([*state.earlier, *(stretch.span for stretch in older)])
            state.earlier_held = _joined([*state.earlier_held, *held])
        self._problems.pop(path, None)
        self._retry_s.pop(path, None)

    def _read_recording(
        self, name: str, screen: RecordingScreen, live: Collection[str]
    ) -> tuple[_ClosedFiles, bool]:
        """Reads the new closed files of a recording into its state.

        Returns the closed files that are not released, and whether all of them are read. A useless
        rule, or a file that is put off, ends the reading.
        """
        unreleased: _ClosedFiles = []
        paths, known = self._files(name), screen.files
        screen.files = {path.name: known[path.name] for path in paths if path.name in known}
        for number, path in enumerate(paths):
            step = screen.files.get(path.name)
            if step in {FileStep.RELEASED, FileStep.UNREADABLE}:
                continue
            if step is None and self._is_put_off(path):
                return unreleased, False
            try:
                summary = self._read_file(path, screen)
            except _UselessRuleError as error:
                self._problems |= dict.fromkeys(paths[number:], str(error))
                self._put_off(path)
                return unreleased, False
            if summary is not None:
                unreleased.append((path, summary))
            elif name in live and path.name not in screen.files:
                break  # what comes after an open file has not been written
        return unreleased, True

    def _read_file(self, path: Path, screen: RecordingScreen) -> BagSummary | None:
        """Adds the values of a file to the state, once; returns its summary.

        None if the file is open, or cannot be read. A file that a crash left open is read when it
        is repaired.

        Raises:
            BagUnreachableError: the disk fails to read the file, and may recover.
            _UselessRuleError: see `_add_conditions`.
        """
        is_new = path.name not in screen.files
        try:
            if is_new and not self.reader.is_finished(path):
                return None
            summary = self.reader.summarize(path)
            if is_new:
                self._add_conditions(path, summary, screen)
        except BagError as error:
            if self._failing.may_recover(path, error):
                raise
            _add_unknown(screen)
            screen.files[path.name] = FileStep.UNREADABLE
            self._report(path, error)
            return None
        screen.files[path.name] = FileStep.READ
        self._problems.pop(path, None)
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
        """Adds the values of a file to the state.

        Raises:
            BagError: the file cannot be read or rewritten.
            _UselessRuleError: a rule excludes times of unknown state, and no message has ever shown
                whether it holds; the state is unchanged.
        """
        if path.suffix != MCAP or not summary.complete:
            raise BagError(str(path), "it is not a complete MCAP file")
        if summary.empty:
            return
        heard_by_rule, holding = deepcopy((screen.heard, screen.holding))
        for rule in self.rules:
            heard = heard_by_rule.setdefault(rule.name, [])
            refusal: str | None = None
            for record in self.reader.records(path, (rule.topic,), TimeWindow.everything()):
                result = self._test(rule, record)
                refusal = result.refusal or refusal
                time, latched = record.log_time, record.channel.latched
                in_sources = holding.setdefault(rule.name, {})
                holds = _holds_of_any(in_sources, result, time, MAX_NS if latched else rule.stale)
                add_message(heard, time, holds, latched=latched, stale=rule.stale)
            if refusal and rule.excludes_unknown and rule.name not in self._evaluated:
                raise _UselessRuleError(refusal)
        screen.heard, screen.holding = heard_by_rule, holding
        # Latched messages may be written again with the times that they had.
        first_unlatched = min(
            (topic.first for topic in summary.topics if not topic.latched), default=MAX_NS
        )
        was_set_back = screen.end is not None and first_unlatched < screen.end - OUT_OF_ORDER_NS
        if was_set_back or summary.schema.set_back:
            screen.unclear.append((summary.start, summary.end + 1))
        screen.start = min(summary.start, MAX_NS if screen.start is None else screen.start)
        screen.end = summary.end if screen.end is None else max(screen.end, summary.end)

    def _test(self, rule: ExclusionRule, record: Record) -> _TestResult:
        type_name = record.channel.type
        condition = rule.condition.of_type(type_name, self.extractor)
        try:
            value = self.extractor.exact(self.reader.decode(record), type_name)
        except UndecodableError as error:
            self._refuse(rule, str(error))
            return _TestResult(None)
        holds = condition.matches(value)
        refusal = None if holds else _refusal_of(condition, value)
        if refusal is not None:
            return _TestResult(None, self._refuse(rule, f"{rule.topic}: {refusal}"))
        self._refusals.pop(rule.name, None)
        self._evaluated.add(rule.name)
        return _TestResult(holds, source=source_of(value, type_name))

    def _refuse(self, rule: ExclusionRule, reason: str) -> str:
        """Stores and returns why a rule cannot be evaluated; logs it every `REMIND_S`."""
        sentence = f"the rule {rule.name}: {reason}"
        self._refusals[rule.name] = sentence
        now_s = self.monotonic()
        if now_s >= self._logged_s.get(rule.name, now_s):
            self._logged_s[rule.name] = now_s + REMIND_S
            _log.error("exclusion_rule_fails", rule=rule.name, reason=reason)
        return sentence

    def _ready(
        self, state: ScreenState, unreleased: dict[str, _ClosedFiles], live: Collection[str]
    ) -> _ClosedFiles:
        """Returns the splits that no later message can affect, and that are not put off."""
        ends = {name: state.recordings[name].end or 0 for name in unreleased}
        live_ends = {name: state.recordings.get(name, RecordingScreen()).end for name in live}
        until = horizons(ends, live_ends, self._split)
        return [
            (path, summary)
            for name, files in unreleased.items()
            for path, summary in files
            if summary.empty or summary.end + self._margin < until[name]
            if not self._is_put_off(path)
        ]

    def _stretches(self, state: ScreenState, live: Collection[str]) -> list[Excluded]:
        """Returns the excluded stretches of the recordings in the state."""
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
        """Cuts the excluded messages out of a split; see `Cut`.

        Raises:
            EpisodicError: the split cannot be rewritten.
            OSError: the split cannot be rewritten, or has gone.
        """
        latched = {topic.topic for topic in summary.topics if topic.latched}
        cut = Cut(stretches, before, latched)
        topics = {
            topic.topic
            for topic in summary.topics
            if cut.touches(topic.topic, topic.first, topic.last)
        }
        gone = Counter[str]()
        # By latched topic: when the newest message was published, and whether it is excluded.
        newest: dict[str, tuple[Ns, bool]] = {}
        for record in self.reader.records(path, sorted(topics), TimeWindow.everything()):
            topic, logged, published = record.channel.topic, record.log_time, record.publish_time
            if cut.takes(topic, logged, published):
                gone[topic] += 1
            if topic in latched:
                candidate = (published or logged, cut.takes_always(logged, published))
                newest[topic] = max(candidate, newest.get(topic, candidate))
        if gone:
            recording, file = path.parent.name, path.name
            if split_number(recording, file) is None:
                raise BagError(str(path), "it is not named as a split of its recording")
            status = path.lstat()
            try:
                with rewrite_without(
                    self.bag_dir, path, status, self.writer, takes=cut.takes, expected=gone
                ):
                    pass
            except UnflushedError as error:
                _log.warning("exclusion_unflushed", recording=recording, reason=str(error))
            _log.info("messages_excluded", recording=recording, file=file, messages=gone.total())
        self._excluded_latched -= newest.keys()
        self._excluded_latched |= {topic for topic, (_, excluded) in newest.items() if excluded}

    def _finish_recording(self, name: str, state: ScreenState) -> None:
        """Marks an ended recording as done when all of its files are released."""
        screen = state.recordings[name]
        if any(screen.files.get(f.name) is not FileStep.RELEASED for f in self._files(name)):
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
            RecorderError: the state file is damaged.
            OSError: the state file cannot be read.
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
        """Writes what a step changed, with the recordings that were announced meanwhile.

        Raises:
            OSError: it cannot be written; the state in memory is unchanged.
        """
        with self._lock:
            recordings = dict(self._loaded().recordings)
            recordings.update({name: deepcopy(state.recordings[name]) for name in names})
            done = [name for name, screen in recordings.items() if screen.done]
            with_values = [name for name in done if recordings[name].start is not None]
            for name in {*done}.difference(with_values[-DONE_KEPT:]):
                del recordings[name]
            self._write(replace(state, recordings=recordings))

    def _write(self, state: ScreenState) -> None:
        """Writes a state if it has changed; call it with the lock held."""
        if state != self._state:
            SCREENED.write(self.bag_dir, state)
            self._state = state

    def _report(self, path: Path, error: Exception) -> None:
        """Stores why a split is held back, and logs it once."""
        reason = reason_of(error)
        if self._problems.get(path) != reason:
            _log.error("split_held_back", file=_file_name(path), reason=reason)
        self._problems[path] = reason


def _excluded_before(state: ScreenState) -> list[Excluded]:
    """Returns the stretches that were excluded; in older ones it is known where they held."""
    unknown = [Excluded(*span, held=False) for span in state.earlier]
    return [*unknown, *starmap(Excluded, state.earlier_held), *state.excluded]


def _joined(spans: Spans) -> Spans:
    """Returns few spans that cover these: those that are closest to each other are joined."""
    spans = united(spans)
    gaps = sorted(start - stop for (_, stop), (start, _) in pairwise(spans))
    too_many = len(spans) - MOST_EXCLUDED
    return united(spans, gaps[too_many - 1]) if too_many > 0 else spans


def _file_name(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _holds_of_any(
    holding: dict[str, Ns], result: _TestResult, time: Ns, valid_for: Ns
) -> bool | None:
    """Returns whether a condition holds from the next message on; updates `holding`.

    What one source said is not ended by the message of another.
    """
    others = (at for source, at in holding.items() if source != result.source)
    is_held = any(abs(time - at) <= valid_for for at in others)
    if result.holds:
        holding[result.source] = time
    elif result.holds is False:
        holding.pop(result.source, None)
    return is_held or result.holds


def _refusal_of(condition: Condition, value: JsonValue) -> str | None:
    """Returns why no message like this one can meet a condition; None if one could."""
    if condition.can_be_refused and (refusal := refusal_for(condition, value)):
        return refusal
    test = condition.test
    if not isinstance(test, Equals) or not isinstance(test.value, bool):
        return None
    has_number = any(isinstance(leaf, bool | int | float) for leaf in leaves(value))
    return None if has_number else "the values hold no boolean"


def _add_unknown(screen: RecordingScreen) -> None:
    """Adds a file that cannot be read: after it, a condition that did not hold is unknown."""
    for heard in screen.heard.values():
        if heard and not heard[-1].holds:
            last = heard[-1].last
            begun = max(last, (screen.end or last) + 1)
            heard.append(ConditionInterval(begun, begun, None))
