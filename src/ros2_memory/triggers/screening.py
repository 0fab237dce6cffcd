"""Screens closed splits before they are served: cuts out what `recording.exclude_when` excludes.

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
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.analysis.conditions import Equals, leaves, refusal_for
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
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MAX_NS, Ns, ns_from_unix
from ros2_memory.index.split_order import split_of
from ros2_memory.retention.disk import FailingFiles
from ros2_memory.retention.repair import reason_of, rewritten
from ros2_memory.storage.base import BagReader, BagWriter, Closing, Record
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


_ClosedFiles: TypeAlias = "list[tuple[Path, BagSummary]]"


class _UselessRuleError(EpisodicError):
    """A rule that was never evaluated cannot be evaluated on a split either."""


class Screening:
    """Screens the recordings of one bag directory.

    `announce` and `plan` are for the thread that begins recordings, the step that `plan` returns
    for any one other.

    Args:
        rules: what is excluded, by unique names; with none nothing is announced.
        reader: reads files as they are, also what does not count in answers.
    """

    def __init__(
        self,
        bag_dir: Path,
        rules: Sequence[ExclusionRule],
        reader: BagReader,
        extractor: SchemaExtractor,
        writer: BagWriter,
        *,
        split_duration_s: float,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._monotonic = monotonic
        self._retry_s: dict[Path, float] = {}
        self._failing = FailingFiles(monotonic)
        self._bag_dir = bag_dir
        self._rules = tuple(rules)
        self._reader = reader
        self._extractor = extractor
        self._writer = writer
        self._split = ns_from_unix(split_duration_s)
        self._margin = max((rule.margin for rule in rules), default=0)
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
                state = self._loaded()
                self._write({**state.recordings, recording: RecordingScreen()}, state.excluded)
        except OSError as error:
            target = self._bag_dir / SCREENED_FILE
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
        return self._excluded_latched.difference(rule.topic for rule in self._rules)

    def _run_step(self, names: Sequence[str], live: Collection[str]) -> None:
        """Reads closed files, and releases those that can be released.

        Raises:
            BagUnreachableError: the disk fails to read a bag, and may recover; the next step tries
                again.
            OSError: the disk fails, or the state cannot be written, and nothing more is released.
        """
        with self._lock:
            before = self._loaded()
            state = deepcopy(before)
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
            if (self._bag_dir / name).exists()
        }
        self._commit(before, state, names)
        before, now_s = deepcopy(state), self._monotonic()
        ready = [
            (path, summary)
            for path, summary in self._ready(state, closed, live)
            if self._retry_s.get(path, now_s) <= now_s
        ]
        stretches = self._stretches(state, live) if ready else []
        for path, summary in ready[:MOST_AT_ONCE]:
            try:
                self._cut_split(path, summary, stretches, state.excluded)
            except (EpisodicError, OSError) as error:
                self._report(path, error)
                self._retry_s[path] = now_s + RETRY_S
            else:
                self._release(path, summary, stretches, state)
        for name in names:
            if name not in live:
                self._finish_recording(name, state)
        self._commit(before, state, names)

    def _release(
        self, path: Path, summary: BagSummary, stretches: Sequence[Excluded], state: ScreenState
    ) -> None:
        """Notes in the state that a split is released, and what of its time was excluded."""
        recording = path.parent.name
        state.recordings[recording].files[path.name] = FileStep.RELEASED
        if not summary.empty:
            excluded = add_excluded(state.excluded, stretches, summary.start, summary.end)
            state.excluded = excluded[-MOST_EXCLUDED:]
        self._problems.pop(f"{recording}/{path.name}", None)
        self._retry_s.pop(path, None)

    def _read_recording(
        self, name: str, screen: RecordingScreen, live: Collection[str]
    ) -> tuple[_ClosedFiles, bool]:
        """Reads the closed files of a recording that were not; returns those not released yet.

        With it whether a useless rule left none of them unread.
        """
        paths = self._files(name)
        present = {path.name for path in paths}
        screen.files = {file: step for file, step in screen.files.items() if file in present}
        unreleased: _ClosedFiles = []
        for path in paths:
            step = screen.files.get(path.name)
            if step in {FileStep.RELEASED, FileStep.UNREADABLE}:
                continue
            now_s = self._monotonic()
            if step is None and self._retry_s.get(path, now_s) > now_s:
                return unreleased, False
            try:
                if step is None and self._reader.closing(path) is not Closing.CLOSED:
                    if name in live:
                        break
                    # A crash left it open; it is read once it was repaired.
                    continue
                summary = self._reader.summarize(path)
                if step is None:
                    self._add_conditions(path, summary, screen)
                unreleased.append((path, summary))
                screen.files[path.name] = FileStep.READ
                self._problems.pop(f"{name}/{path.name}", None)
            except _UselessRuleError as error:
                waiting = paths[paths.index(path) :]
                self._problems |= {f"{name}/{left.name}": str(error) for left in waiting}
                self._retry_s[path] = now_s + RETRY_S
                return unreleased, False
            except BagError as error:
                if self._failing.may_recover(path, error):
                    raise
                _doubt(screen)
                screen.files[path.name] = FileStep.UNREADABLE
                self._report(path, error)
        return unreleased, True

    def _files(self, name: str) -> list[Path]:
        """Returns the bags of a recording in the order in which they were written."""
        with suppress(FileNotFoundError, NotADirectoryError):
            paths = bags_in(self._bag_dir / name)
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
        for rule in self._rules:
            heard = heard_by_rule.setdefault(rule.name, [])
            refusal: str | None = None
            for record in self._reader.records(path, (rule.topic,), TimeWindow.everything()):
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
        condition = rule.condition.of_type(type_name, self._extractor)
        try:
            value = self._extractor.exact(self._reader.decode(record), type_name)
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
        now_s = self._monotonic()
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
        """Returns the splits that no later message can affect."""
        ends = {name: state.recordings[name].end or 0 for name in closed}
        written = {name: state.recordings[name].end for name in live if name in state.recordings}
        until = horizons(ends, dict.fromkeys(live) | written, self._split)
        return [
            (path, summary)
            for name, files in closed.items()
            for path, summary in files
            if summary.empty or summary.end + self._margin < until[name]
        ]

    def _stretches(self, state: ScreenState, live: Collection[str]) -> list[Excluded]:
        """Returns what is excluded of the time of recordings that are not done, or were last."""
        stretches: list[Excluded] = []
        for rule in self._rules:
            recordings = [
                RecordingConditions(
                    screen.start,
                    None if name in live else screen.end,
                    screen.heard.get(rule.name, ()),
                    screen.unclear,
                    name,
                    read_handover(self._bag_dir / name).handover.previous,
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
        for record in self._reader.records(path, sorted(topics), TimeWindow.everything()):
            topic, logged, published = record.channel.topic, record.log_time, record.publish_time
            if cut.takes(topic, logged, published):
                gone[topic] += 1
            if topic in latched:
                latched_record = (published or logged, cut.takes_always(logged, published))
                newest[topic] = max(latched_record, newest.get(topic, latched_record))
        if gone:
            self._rewrite_without(path, gone, cut)
        returning = {topic for topic, (_, is_excluded) in newest.items() if is_excluded}
        self._excluded_latched = (self._excluded_latched - newest.keys()) | returning

    def _rewrite_without(self, path: Path, gone: Counter[str], cut: Cut) -> None:
        """Rewrites a split without so many messages of each topic; raises as `_cut_split` does."""
        if split_number(path.parent.name, path.name) is None:
            raise BagError(str(path), "it is not named as a split of its recording")
        status = path.lstat()
        with rewritten(self._bag_dir, path, status, self._writer, takes=cut.takes, expected=gone):
            pass
        _log.info(
            "messages_excluded",
            recording=path.parent.name,
            file=path.name,
            messages=gone.total(),
        )

    def _finish_recording(self, name: str, state: ScreenState) -> None:
        """Marks an ended recording as done once nothing of it is held back."""
        screen, files = state.recordings[name], [file.name for file in self._files(name)]
        if any(screen.files.get(file) is not FileStep.RELEASED for file in files):
            return
        if state.excluded and (reason := why_not_corrected(self._bag_dir / name, self._reader)):
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
                self._state = SCREENED.read(self._bag_dir) or ScreenState()
            except ValueError as error:
                raise RecorderError(
                    f"{self._bag_dir / SCREENED_FILE}: {error}; which splits are still unscreened "
                    "is not known any more: delete the newest recordings, or delete this file to "
                    "have them served"
                ) from error
        return self._state

    def _commit(self, before: ScreenState, state: ScreenState, names: Sequence[str]) -> None:
        """Writes what a step changed, if anything, beside what was announced meanwhile.

        Raises:
            OSError: it cannot be written; the state in memory stays as it was.
        """
        if state == before:
            return
        with self._lock:
            recordings = dict(self._loaded().recordings)
            recordings.update({name: deepcopy(state.recordings[name]) for name in names})
            done = [name for name, screen in recordings.items() if screen.done]
            informative = [name for name in done if recordings[name].start is not None][-DONE_KEPT:]
            for name in {*done} - {*informative}:
                del recordings[name]
            self._write(recordings, list(state.excluded))

    def _write(self, recordings: dict[str, RecordingScreen], excluded: list[Excluded]) -> None:
        state = ScreenState(recordings, excluded)
        SCREENED.write(self._bag_dir, state)
        self._state = state

    def _report(self, path: Path, error: Exception) -> None:
        """Notes why a split is held back, and logs it once."""
        name = f"{path.parent.name}/{path.name}"
        reason = reason_of(error)
        if self._problems.get(name) != reason:
            _log.error("split_held_back", file=name, reason=reason)
        self._problems[name] = reason


def _doubt(screen: RecordingScreen) -> None:
    """Notes a file that cannot be read: the state of the conditions after it is unknown, too."""
    for heard in screen.heard.values():
        if heard and not heard[-1].holds:
            last = heard[-1].last
            begun = max(last, (screen.end or last) + 1)
            heard.append(ConditionInterval(begun, begun, None))
