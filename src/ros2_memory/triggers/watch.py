"""Evaluates the rules of one bag directory, and stores the moments that they ask for.

Each look copies the state, searches the bags that were closed since, begins or extends moments, and
writes the state. A kill in between does no harm: the next look finds the same again, and a moment
that was begun is recognised by its number. A moment that cannot be stored, for example because the
disk is full, is tried again with every look.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import defaultdict
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.handover_file import Counting, read_handover
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.moment_file import SaveRequest
from ros2_memory.bag_dir.state_files import TRIGGERS, RuleMoment, RuleRecord, TriggerState
from ros2_memory.core.bag_summary import OUT_OF_ORDER_NS
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import MIN_NS, NS_PER_HOUR, NS_PER_S, Clock, Ns, Span, ns_from_unix
from ros2_memory.retention.saved_moments import MomentKeeper, Refusal
from ros2_memory.triggers.rules import (
    Firing,
    Rule,
    SplitSearch,
    chains_to_search,
    parts_of,
    recording_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.index.snapshot import Snapshot

GLOB_MARKS: Final = "*?["
"""Characters that make a topic of a rule a glob."""
LOOK_S: Final = 2.0
"""How long one look searches: meanwhile nothing is deleted, and no other moment is saved."""
LONGEST_NS: Final[Ns] = 600 * NS_PER_S
"""Matches join to moments that are no longer than this, or than one match needs."""
MOST_WAITING: Final = 100
"""So many moments of a rule may wait to be stored."""
MOST_UNREAD: Final = 100
"""So many splits that cannot be read are remembered."""
MOST_SEARCHED: Final = 64
"""So many recordings are remembered one by one; older ones were searched to their end."""

_log = get_logger(__name__)


@dataclass(eq=False, repr=False)
class Triggers:
    """The rules of one bag directory.

    Not thread-safe, except for `note_restart` and `note_deleted`.

    Args:
        rules: the rules, with unique names.
        own: the recordings that the recorder made. No other recording is searched.

    Attributes:
        restarts: the restarts of the recording (wall times) that are still to be evaluated.
        reported: when each rule last fired with a problem, by the kind of the problem.
    """

    bag_dir: Path
    rules: Sequence[Rule]
    search: SplitSearch
    own: OwnRecordings
    moments: MomentKeeper
    _: KW_ONLY
    clock: Clock
    split_duration_s: float
    is_recorded: Callable[[str], bool]

    def __post_init__(self) -> None:
        """Starts with nothing known."""
        self._rules = {rule.name: rule for rule in self.rules}
        self._split = ns_from_unix(self.split_duration_s)
        self._state: TriggerState | None = None
        self._lock = threading.Lock()
        self.restarts: list[Span] = []
        self.reported: defaultdict[str, dict[str, Ns]] = defaultdict(dict)
        self._deleted = 0
        self._is_written = False

    def note_restart(self, first: Ns, at: Ns) -> None:
        """Records that the recording ended unexpectedly and restarted between two wall times."""
        with self._lock:
            self.restarts.append((first, at))

    def look(self, snapshot: Snapshot) -> None:
        """Searches the bags that were closed since the last look. Nothing may be deleted meanwhile.

        Raises:
            EpisodicError: the disk fails while bags are read; the next look tries again.
            OSError: the state or the list of recordings cannot be read, or the state not written.
        """
        state = deepcopy(self._current_state(snapshot))
        looks = {
            name: _RuleLook(self, rule, state.rules[name], snapshot)
            for name, rule in self._rules.items()
        }
        for firing in self._search_closed(state, snapshot):
            looks[firing.rule].add(firing)
        with self._lock:
            restarts, self.restarts = self.restarts, []
            deleted, self._deleted = self._deleted, 0
        for look in looks.values():
            look.finish(restarts)
        if deleted:
            sentence = (
                f"{counted(deleted, 'bag')} that rules may have needed were deleted to make room "
                "(retention.max_total_gb, min_free_gb)"
            )
            _log.warning("needed_bags_deleted", bags=deleted, reason=sentence)
            for record in state.rules.values():
                record.problem = sentence
        names = [*dict.fromkeys(map(recording_of, state.searched))]
        for name in names[:-MOST_SEARCHED]:
            state.before = name
            for part in [part for part in state.searched if recording_of(part) == name]:
                del state.searched[part]
        # Set before it is written: if that fails, nothing is searched twice.
        self._is_written &= state == self._state
        self._state = state
        if not self._is_written:
            TRIGGERS.write(self.bag_dir, state)
            self._is_written = True

    def _search_closed(self, state: TriggerState, snapshot: Snapshot) -> Iterator[Firing]:
        """Searches the closed bags for so long as a look may take; yields what fires."""
        deadline = time.monotonic() + LOOK_S
        closed, live = self._closed_bags(snapshot, state)
        unread = self._unread_splits(snapshot, closed)
        missed = self._missed_splits(snapshot, closed, state, unread)
        for chain in chains_to_search(closed, live, state.searched, self._previous, self._split):
            found = self.search.search(chain, state, lambda: time.monotonic() > deadline)
            yield from found.firings
            for part, window, _ in chain.parts:
                state.searched[part] = max(min(window.stop, found.until), window.start)
            if not found.is_complete:
                break
        if snapshot.problem is not None:
            return
        if missed:
            for record in state.rules.values():
                record.problem = record.problem or state.unread[missed[0]]
        state.unread = dict(islice(unread.items(), MOST_UNREAD))

    def _unread_splits(self, snapshot: Snapshot, parts: Iterable[str]) -> dict[str, str]:
        """Returns the splits that cannot be read, each with a sentence that says so."""
        names = {*map(recording_of, parts)}
        unread: dict[str, str] = {}
        for aside in snapshot.damaged:
            if self.own.name_of(aside.path.parent) in names:
                problem = f"not all could be searched: {aside.path.name}: {aside.reason}"
                unread[self.own.name_of(aside.path)] = problem
        return unread

    def _missed_splits(
        self,
        snapshot: Snapshot,
        closed: Mapping[str, Iterable[BagFile]],
        state: TriggerState,
        unread: Collection[str],
    ) -> list[str]:
        """Returns the splits that could not be read before, and will never be searched.

        They are not there any more, or the search of their part is beyond them.
        """
        no_longer = [split for split in state.unread if split not in unread]
        if not no_longer:
            return []
        paths = [*snapshot.empty, *(aside.path for aside in snapshot.active)]
        for part, bags in closed.items():
            reached = state.searched.get(part, MIN_NS) - OUT_OF_ORDER_NS
            paths += [bag.path for bag in bags if bag.start >= reached]
        searchable = {*map(self.own.name_of, paths)}
        return [split for split in no_longer if split not in searchable]

    def needed(self, snapshot: Snapshot) -> frozenset[str]:
        """Returns the bags that are not searched, and those before that a match may save."""
        state = self._current_state(snapshot)
        before = max((rule.before + rule.hold for rule in self._rules.values()), default=0)
        reached = next(reversed(state.searched.values()), None)
        since = MIN_NS if reached is None else reached - before
        closed, _ = self._closed_bags(snapshot, state)
        needed: set[str] = set()
        for part, bags in closed.items():
            earliest = min(state.searched.get(part, MIN_NS), since)
            needed.update(bag.file for bag in bags if bag.end >= earliest)
        return frozenset(needed)

    def note_deleted(self, bags: int) -> None:
        """Records how many needed bags were deleted: the size budget comes first."""
        with self._lock:
            self._deleted += bags

    def _current_state(self, snapshot: Snapshot) -> TriggerState:
        """Returns the state. Without a state file, only what is recorded from now on is searched.

        Raises:
            OSError: the state cannot be read.
        """
        if self._state is not None:
            return self._state
        state, problem = None, None
        try:
            state = TRIGGERS.read(self.bag_dir)
        except ValueError as error:
            problem = f"the state of the rules is lost: .episodic/triggers.json: {error}"
            _log.error("trigger_state_lost", reason=problem)
        if state is not None:
            state.searched = self._searched_by_part(state, snapshot)
        state = state or self._new_state(snapshot)
        state.rules = {name: state.rules.get(name, RuleRecord()) for name in self._rules}
        for record in state.rules.values():
            record.problem = problem or record.problem
        self._state = state
        return state

    def _new_state(self, snapshot: Snapshot) -> TriggerState:
        """Returns a state in which all closed bags are searched."""
        closed, live = self._closed_bags(snapshot, TriggerState())
        ended = [name for name in self.own.in_order() if name not in live]
        newest = {part: max(bag.end for bag in bags) for part, bags in closed.items()}
        searched = {part: end + 1 for part, end in newest.items() if recording_of(part) in live}
        return TriggerState(before=ended[-1] if ended else None, searched=searched)

    def _searched_by_part(self, state: TriggerState, snapshot: Snapshot) -> dict[str, Ns]:
        """Returns until which log time each part was searched.

        Version 0.1.0 knew no parts: it stored how far it had searched a recording as a whole.
        """
        closed, _ = self._closed_bags(snapshot, state)
        ends = {part: max(bag.end for bag in bags) for part, bags in closed.items()}
        searched: dict[str, Ns] = {}
        for name, until in state.searched.items():
            searched[name] = until
            if until > ends.get(name, until) + 1:
                others = (part for part in ends if recording_of(part) == name != part)
                searched |= {part: min(until, ends[part] + 1) for part in others}
        return searched | state.searched

    def _closed_bags(
        self, snapshot: Snapshot, state: TriggerState
    ) -> tuple[dict[str, list[BagFile]], frozenset[str]]:
        """Returns the closed bags by part, of recordings that are not searched to their end.

        Also returns the names of the recordings that are being written.
        """
        active = (self.own.name_of(aside.path.parent) for aside in snapshot.active)
        live = frozenset((*read_heartbeat(self.bag_dir).recordings, *active))
        names = self.own.in_order()
        if state.before in names:
            first = names.index(state.before) + 1
        else:
            known = {*map(recording_of, state.searched)}.intersection(names)
            first = min(map(names.index, known), default=0)
        folders = {str(self.bag_dir / name): name for name in names[first:]}
        closed: dict[str, list[BagFile]] = {name: [] for name in folders.values()}
        for segment in snapshot.timeline.segments:
            if folders.keys().isdisjoint(segment.bags.folders):
                continue
            for bag in segment.bags:
                name = folders.get(str(bag.recording))
                if name is not None and (bag.state is BagState.CLOSED or name not in live):
                    closed[name].append(bag)
        parts: dict[str, list[BagFile]] = {}
        for name, bags in closed.items():
            parts |= parts_of(name, bags, state.searched)
        return parts, live

    def _previous(self, recording: str) -> str | None:
        handover = read_handover(self.bag_dir / recording).handover
        return None if handover.state is Counting.PENDING else handover.previous


@dataclass(eq=False, repr=False)
class _RuleLook:
    """One look for one rule, which changes the rule's record."""

    triggers: Triggers
    rule: Rule
    record: RuleRecord
    snapshot: Snapshot

    def add(self, firing: Firing) -> None:
        """Counts a firing, and saves what the rule wants of it."""
        self.record.fired += 1
        self.record.last_fired = firing.at
        _log.info("trigger_fired", rule=self.rule.name, topic=firing.topic, at_ns=firing.at)
        self._save(firing)

    def _save(self, firing: Firing) -> None:
        """Joins the window of a firing to the newest moment of the rule, or begins another."""
        rule, record = self.rule, self.record
        window = rule.window(firing.first, firing.at)
        newest = record.newest[-1] if record.newest else None
        if newest is not None and _joins(newest, window):
            newest.start, newest.end = min(newest.start, window.start), max(newest.end, window.stop)
            newest.matches += 1
            newest.stored = False
            return
        record.begun = [begun for begun in record.begun if abs(firing.at - begun) < NS_PER_HOUR]
        if len(record.begun) >= rule.max_per_hour:
            reason = (
                f"it fires more often than it may begin moments (max_per_hour: "
                f"{rule.max_per_hour}): narrow its condition, or raise for_s"
            )
            self._refuse(Refusal("often", reason))
            return
        if newest is not None and not newest.stored:
            self._store_moments()
        if len(record.newest) >= MOST_WAITING:
            self._refuse(Refusal("waiting", f"{MOST_WAITING} of its moments wait to be stored"))
            return
        record.begun.append(firing.at)
        if not self._reported_recently():
            record.problem = None
        # The same number after a kill, so that the moment is recognised.
        number = uuid.uuid5(uuid.NAMESPACE_OID, f"{rule.name}/{firing.topic}/{firing.at}").hex
        record.newest.append(RuleMoment(number, window.start, window.stop))

    def finish(self, restarts: Iterable[Span]) -> None:
        """Counts restarts, stores the moments that wait, and what keeps the rule from firing."""
        if self.rule.kind == "recorder_restart":
            for first, at in restarts:
                is_long = at - first > LONGEST_NS
                if is_long:
                    # Nothing was recorded meanwhile: bags that are dated there had another clock.
                    self._save(Firing(self.rule.name, "", first, first))
                self.add(Firing(self.rule.name, "", at if is_long else first, at))
        self._check_topic()
        self._store_moments()
        self._note_lasting_match()

    def _check_topic(self) -> None:
        """Stores and logs whether the rule can never fire since its topic is not recorded now."""
        topic, record = self.rule.topic, self.record
        said, record.never = record.never, None
        if topic is None or any(mark in topic for mark in GLOB_MARKS):
            return
        if not self.triggers.is_recorded(topic):
            record.never = f"it can never fire: {topic} is not recorded; list it in topics.yaml"
            if record.never != said:
                _log.warning("rule_not_recorded", rule=self.rule.name, reason=record.never)

    def _store_moments(self) -> None:
        """Stores the waiting moments. Drops refused ones, and stored ones but the newest.

        The next match may extend the newest moment.
        """
        record = self.record
        record.unstored = None
        left = [moment for moment in record.newest if moment.stored or self._store(moment)]
        record.newest = [moment for moment in left[:-1] if not moment.stored] + left[-1:]

    def _store(self, moment: RuleMoment) -> bool:
        """Stores a moment, or reports why the disk cannot; returns False if it is refused."""
        name, record = self.rule.name, self.record
        request = SaveRequest(
            moment.number, self.rule.label, moment.start, moment.end, self.triggers.clock.now()
        )
        try:
            keep = self.triggers.moments.keep_for_rule
            refused = keep(request, name, moment.matches, self.snapshot)
        except OSError as error:
            record.unstored = f"its moments cannot be stored: {error.strerror or error}"
            self._report(Refusal("disk", record.unstored))
            return True
        moment.stored = True
        if refused is not None:
            # A recorder that restarts may have recorded nothing before.
            if (self.rule.kind, refused.kind) != ("recorder_restart", "unrecorded"):
                self._refuse(refused)
            if not moment.known:
                # What saved nothing does not count in `max_per_hour`.
                first, last = moment.start, moment.end
                record.begun = [at for at in record.begun if not first <= at <= last]
            return False
        record.moments += not moment.known
        moment.known = True
        return True

    def _refuse(self, refusal: Refusal) -> None:
        self.record.refused += 1
        self.record.problem = refusal.sentence
        self._report(refusal)

    def _report(self, refusal: Refusal) -> None:
        """Logs why the rule saves nothing, each kind once for as long as it goes on."""
        if refusal.kind not in self._reported_recently():
            _log.warning("trigger_not_kept", rule=self.rule.name, reason=refusal.sentence)
        self.triggers.reported[self.rule.name][refusal.kind] = self.record.last_fired or 0

    def _reported_recently(self) -> set[str]:
        """Returns the kinds of problems that the rule had in the hour before it last fired."""
        at, reported = self.record.last_fired or 0, self.triggers.reported[self.rule.name]
        return {kind for kind, last in reported.items() if abs(at - last) < NS_PER_HOUR}

    def _note_lasting_match(self) -> None:
        """Stores since when the rule has matched for more than an hour, and logs it once."""
        record = self.record
        lasting = [
            run.first
            for run in record.runs.values()
            if run.fired and run.last - run.first > NS_PER_HOUR
        ]
        since = min(lasting, default=None)
        if since is not None and record.always_since is None:
            _log.warning("trigger_matches_always", rule=self.rule.name, since_ns=since)
        record.always_since = since


def _joins(moment: RuleMoment, window: TimeWindow) -> bool:
    """Whether a window touches a moment, and the two together are not too long."""
    if window.start > moment.end or moment.start > window.stop:
        return False
    longest = max(LONGEST_NS, moment.end - moment.start, window.stop - window.start)
    return max(moment.end, window.stop) - min(moment.start, window.start) <= longest
