"""A bag directory that a recorder of ours fills split by split, and a watch of rules over it."""

from collections.abc import Collection, Iterable, MutableMapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import structlog

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, Overlap, read_handover, write_handover
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import utc_stamp
from ros2_memory.bag_dir.moment_file import StoredMoment, stored_moments_in
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import TRIGGERS, RuleRecord
from ros2_memory.insights.saved_moments import fired_rules
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.triggers.rules import Rule, SplitSearch
from ros2_memory.triggers.watch import Triggers
from tests.support.bags import Msg, boolean, write_mcap
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat
from tests.support.housekeepers import keeper_of
from tests.support.memories import shipped_extractor

S = 10**9
T0 = 1_790_000_000 * S
PLENTY = 10**15


def rule(name: str = "bumper", **given: Any) -> Rule:
    """A rule on `/bumper` being true, unless told otherwise."""
    made: dict[str, Any] = {
        "name": name,
        "kind": "message",
        "topic": "/bumper",
        "condition": parse_condition("equals", True, 0.5),
        "before": 5 * S,
        "after": 3 * S,
        "label": name,
        "max_bytes": PLENTY // 100,
        "max_per_hour": 1000,
    }
    return Rule(**made | given)


SILENT: dict[str, Any] = {"kind": "silent", "condition": None}
RESTART: dict[str, Any] = {"kind": "recorder_restart", "topic": None, "condition": None}
"""What makes a rule one over silences, or over restarts of the recorder."""


def flag(second: float, value: bool, topic: str = "/bumper") -> Msg:
    return boolean(T0 + round(second * S), value, topic)


def seconds(begin: int, stop: int, true_at: Collection[int] = ()) -> list[Msg]:
    return [flag(n, n in true_at) for n in range(begin, stop)]


class WatchedBags:
    """Writes splits as the recorder does, and has them looked at.

    Args:
        bag_dir: where the recordings are.
        rules: what to look for.
        limits: of the housekeeper: `max_bytes`, `max_age_h`, `moments_bytes`; and `unrecorded`, the
            topics that the recorder is not to record.
    """

    def __init__(self, bag_dir: Path, rules: Sequence[Rule], **limits: Any) -> None:
        bag_dir.mkdir(exist_ok=True)
        self.bag_dir = bag_dir
        self.rules = rules
        self.limits = limits
        self.unrecorded: set[str] = set(limits.pop("unrecorded", ()))
        self.clock = SettableClock(T0)
        self.now_s = 0.0
        self.own = OwnRecordings(bag_dir)
        self.names: list[str] = []
        self._splits = 0
        self.log: list[MutableMapping[str, Any]] = []
        self.house = self.new_house()
        self.beat()
        self.look()

    def new_house(self) -> Housekeeping:
        """A housekeeper as a recorder that starts anew has one."""
        reader = BagDirReader(McapReader())
        search = SplitSearch(reader, shipped_extractor(), self.rules, monotonic=lambda: self.now_s)
        return keeper_of(
            self.bag_dir,
            clock=self.clock,
            keeps_foreign=True,
            own=self.own,
            rule_bytes={each.name: each.max_bytes for each in self.rules},
            watch=lambda moments: Triggers(
                self.bag_dir,
                self.rules,
                search,
                self.own,
                moments,
                clock=self.clock,
                split_duration_s=10.0,
                is_recorded=lambda topic: topic not in self.unrecorded,
            ),
            **self.limits,
        )

    def beat(self, *live: str, state: RecorderState = RecorderState.RECORDING) -> None:
        beat(self.bag_dir, self.clock.now(), state, recordings=live)

    def begin(self, at: int) -> str:
        """Begins a recording, which is being written from now on."""
        name = f"rec_{utc_stamp(at)}"
        while name in self.names:
            name += "_2"
        self.own.begin(name)
        self.names.append(name)
        self._splits = 0
        self.beat(name)
        return name

    def split(self, messages: Iterable[Msg], name: str | None = None, **layout: Any) -> Path:
        """Writes and closes a split of the newest recording, which begins if there is none."""
        recording = name or (self.names[-1] if self.names else self.begin(T0))
        path = self.bag_dir / recording / f"{recording}_{self._splits}.mcap"
        self._splits += 1
        written = write_mcap(path, messages, **layout)
        if not self.own.owns(path.parent):
            self.own.complete(recording)
        self.own.note_splits(recording, {split.name for split in path.parent.iterdir()})
        return written

    def hand_over(self, old: str, new: str, cut: int, last_of_old: str) -> None:
        """Has messages published from a moment on count in the new recording alone."""
        end, begin = (Overlap(None, None, (each,)) for each in (last_of_old, f"{new}_0.mcap"))
        before = read_handover(self.bag_dir / old).handover
        write_handover(self.bag_dir / old, replace(before, next=new, counts_until=cut, end=end))
        (self.bag_dir / new).mkdir(exist_ok=True)
        write_handover(self.bag_dir / new, Handover(previous=old, counts_from=cut, begin=begin))

    def drive(self, stop: int, true_at: Collection[int] = (), *, first: int = 0) -> list[Path]:
        """Ten seconds of `/bumper` in each split, which is looked at as soon as it is closed."""
        paths = []
        for begin in range(first, stop, 10):
            paths.append(self.split(seconds(begin, begin + 10, true_at)))
            self.look()
        return paths

    def look(self, at: int | None = None) -> None:
        """Has what is there looked at, now or so many seconds after `T0`."""
        if at is not None:
            self.clock.at = T0 + at * S
        with structlog.testing.capture_logs() as log:
            self.house.apply()
        self.log += log

    def logged(self, event: str) -> list[MutableMapping[str, Any]]:
        return [each for each in self.log if each["event"] == event]

    def fired_at(self) -> list[float]:
        """When rules fired, in order, in seconds since `T0`."""
        return sorted((each["at_ns"] - T0) / S for each in self.logged("trigger_fired"))

    def close_all(self, at: int | None = None) -> None:
        """Ends what is being written, and has it looked at."""
        self.beat(state=RecorderState.STOPPED)
        self.look(at)

    def record(self, name: str = "bumper") -> RuleRecord:
        state = TRIGGERS.read(self.bag_dir)
        assert state is not None
        return state.rules[name]

    def problem(self, name: str = "bumper") -> str | None:
        """The problem of a rule, as `memory_status` says it."""
        return {each.name: each.problem for each in fired_rules(self.bag_dir)}[name]

    def moments(self) -> list[StoredMoment]:
        found = [*stored_moments_in(self.bag_dir).readable.values()]
        return sorted(found, key=lambda each: each.moment.request.start)

    def spans(self) -> list[tuple[float, float]]:
        """From when to when each moment is, in seconds since `T0`."""
        requests = [each.moment.request for each in self.moments()]
        return [((each.start - T0) / S, (each.end - T0) / S) for each in requests]
