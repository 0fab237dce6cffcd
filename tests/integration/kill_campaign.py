"""Kills a recorder over and over while a robot drives, and tells what was lost by it.

Every fault is SIGKILL to the recorder process, to the daemon, or to both at once, at a random
moment. What may be lost: the newest messages before the kill, which had not reached the disk, and
what was published while nobody recorded. Everything else must count, once.
"""

import math
import random
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.closed_form import position
from tests.support.live_recorder import (
    NS_PER_S,
    Answer,
    LiveRecorder,
    Machine,
    Tick,
    answering,
    answers,
    await_moment,
    bag_files,
    closed_files,
    machine,
    moment_of,
    ticks,
)
from tests.support.real_recorder import RealRecorder
from tests.support.ros_processes import end, publishing_robot
from tests.support.served import Served

KINDS: Final = ("child", "daemon", "both")
RECORD_OVERHEAD_BYTES: Final = 31  # of one MCAP message besides its payload


@dataclass(frozen=True)
class Terms:
    """Under which a campaign is run. Times in seconds; a kill comes at most `longest_s` after
    everything is subscribed again."""

    name: str
    hz: float
    split_s: int
    session_s: int
    kills: int
    longest_s: float
    seed: int


@dataclass(frozen=True)
class Fault:
    """One kill, and what was known just before and just after it.

    `at` and `gone` (ns): when it was killed, and when nothing of it was left.
    """

    at: int
    gone: int
    victims: tuple[str, ...]  # recordings whose recorder was killed, or ended with the daemon
    closed: frozenset[int]  # ticks in splits that were closed before
    topics: Answer  # list_recorded_topics, right after
    place: Answer | None  # get_position_at a message of a closed split, right after
    place_t: float  # that message's time since T0


class Loss(NamedTuple):
    """What a recording lost at the end: messages published in its last `seconds`, so many ticks.

    `holds_any`: whether any message reached the disk, so that it certainly received some.
    """

    seconds: float
    ticks: int
    holds_any: bool


@dataclass
class Campaign:
    """What came of it."""

    terms: Terms
    robot_late_s: float = 0.0
    t0: int = 0
    faults: list[Fault] = field(default_factory=list)
    subscribed: dict[str, int] = field(default_factory=dict)
    """When each recording had subscribed to everything (ns); those that did."""
    started: dict[str, int] = field(default_factory=dict)
    """When the recorder of each recording was started (ns)."""
    reached: list[int] = field(default_factory=list)
    """When the robot first reached a further recorder (ns)."""
    held: dict[str, list[Tick]] = field(default_factory=dict)
    """What stands in each recording, counting or not; those that hold something."""
    found: list[Tick] = field(default_factory=list)
    """What counts."""
    counted_by_server: int = 0
    after: dict[str, Any] = field(default_factory=dict)
    bytes_of_a_tick: float = 0.0

    def moment(self, tick: int) -> int:
        """When a tick was published, in ns; the robot is a little late, never early."""
        return self.t0 + round(tick / self.terms.hz * NS_PER_S)

    def losses(self) -> list[Loss]:
        """What each killed recording lost that was receiving everything before."""
        found: list[Loss] = []
        for fault in self.faults:
            for name in fault.victims:
                since = self._received_since(name)
                if since is None or since >= fault.at:
                    continue
                last = max([since, *(t.publish_time for t in self.held.get(name, []))])
                lost_s = max(0, fault.at - last) / NS_PER_S
                lost_ticks = math.floor(lost_s * self.terms.hz)
                found.append(Loss(lost_s, lost_ticks, bool(self.held.get(name))))
        return found

    def _received_since(self, name: str) -> int | None:
        """When a recording had subscribed to everything, and the robot reached it; None: never."""
        reached = next((at for at in self.reached if at >= self.started[name]), None)
        if reached is None or name not in self.subscribed:
            return None
        return max(reached, self.subscribed[name])

    def holes(self) -> dict[str, list[int]]:
        """Ticks missing between the first and the last of a recording, since it had subscribed."""
        found: dict[str, list[int]] = {}
        for name, held in self.held.items():
            since = self.subscribed.get(name, held[-1].publish_time)
            found[name] = _missing({t.number for t in held if t.publish_time >= since})
        return found

    def unexplained(self) -> list[tuple[int, int]]:
        """Gaps in what counts (last tick before, first after) in which nothing was killed."""
        numbers = [tick.number for tick in self.found]
        gaps = [(a, b) for a, b in pairwise(numbers) if b > a + 1]
        return [
            (a, b)
            for a, b in gaps
            if not any(self.moment(a) <= f.gone and f.at < self.moment(b) for f in self.faults)
        ]


def run_campaign(terms: Terms, folder: Path, real: RealRecorder) -> Campaign:
    """Records a robot, kills `terms.kills` times, and looks at what is left."""
    folder.mkdir()
    campaign, chance = Campaign(terms), random.Random(terms.seed)
    with machine(folder, real) as site:
        recorder = _record(site, terms)
        options = ("--hz", f"{terms.hz:g}", "--subscribers", "1")
        with (
            answering(recorder.bag_dir, folder / "server.log") as served,
            publishing_robot(site.env, folder / "truth.json", *options) as robot,
        ):
            campaign.t0 = robot.t0
            for kind in _kinds(terms.kills, chance):
                # Some kills come while it is still starting.
                if chance.random() < 0.75:
                    recorder.wait_for_subscriptions()
                wait = round(chance.uniform(0.0, terms.longest_s) * NS_PER_S)
                await_moment(time.time_ns() + wait)
                campaign.faults.append(_kill(campaign, recorder, kind, served, chance))
                if kind != "child":
                    recorder = _record(site, terms)
            recorder.wait_for_subscriptions()
            await_moment(time.time_ns() + terms.split_s * NS_PER_S)
            recorder.stop()
            campaign.reached = robot.reached()
            campaign.robot_late_s = robot.late_s
            end(robot.process)
            # The recorder that was killed last may have been replaced by the same daemon, which
            # repairs what is left in its own time. The next start does it at once.
            recorder = _record(site, terms)
            recorder.wait_for_state(RecorderState.RECORDING)
            recorder.stop()
            _look_back(campaign, site, served)
    return campaign


def _record(site: Machine, terms: Terms) -> LiveRecorder:
    return site.record(
        terms.name,
        f"recording.split_duration_s={terms.split_s}",
        f"recording.session_duration_s={terms.session_s}",
    )


def _kinds(count: int, chance: random.Random) -> list[str]:
    """Each kind about as often as the others, in no order."""
    kinds = [KINDS[number % len(KINDS)] for number in range(count)]
    chance.shuffle(kinds)
    return kinds


def _kill(
    campaign: Campaign, recorder: LiveRecorder, kind: str, served: Served, chance: random.Random
) -> Fault:
    hz = campaign.terms.hz
    closed = ticks(closed_files(recorder.bag_dir), campaign.t0, hz)
    if kind == "child":
        killed = recorder.kill_child(chance)
    else:
        killed = recorder.kill(with_children=kind == "both")
    # A float of seconds does not tell messages apart that were logged within a microsecond.
    asked_for = alone(closed)
    chosen = chance.choice(asked_for) if asked_for else None
    questions: list[tuple[str, dict[str, Any]]] = [("list_recorded_topics", {})]
    if chosen is not None:
        questions.append(("get_position_at", {"timestamp": chosen.log_time / NS_PER_S}))
    topics, *place = answers(served, *questions)
    return Fault(
        killed.at,
        killed.gone,
        killed.recordings,
        frozenset(tick.number for tick in closed),
        topics,
        place[0] if place else None,
        chosen.number / hz if chosen else 0.0,
    )


def _look_back(campaign: Campaign, site: Machine, served: Served) -> None:
    files = bag_files(site.recorders[0].bag_dir)
    hz = campaign.terms.hz
    campaign.found = ticks(files, campaign.t0, hz)
    campaign.bytes_of_a_tick = _bytes_of(files) / len(campaign.found)
    for folder in {file.parent for file in files}:
        own = [file for file in files if file.parent == folder]
        if held := ticks(own, campaign.t0, hz, counting=False):
            campaign.held[folder.name] = held
    for recorder in site.recorders:
        campaign.subscribed |= recorder.subscribed_all()
        started = recorder.events("recorder_started")
        campaign.started |= {event["recording"]: moment_of(event) for event in started}
    listed, after = answers(served, ("list_recorded_topics", {}), ("data_time_range", {}))
    campaign.counted_by_server = {row["topic"]: row["count"] for row in listed.reply}["/odom"]
    campaign.after = after.reply


def _missing(numbers: set[int]) -> list[int]:
    span = range(min(numbers), max(numbers)) if numbers else range(0)
    return [number for number in span if number not in numbers]


def _bytes_of(files: Sequence[Path]) -> int:
    """What the messages that count take in a chunk, before compression."""
    reader, total = BagDirReader(McapReader()), 0
    for path in files:
        with suppress(BagError):
            topics = [each.topic for each in reader.summarize(path).topics if not each.latched]
            for record in reader.records(path, topics, TimeWindow.everything()):
                total += len(record.payload) + RECORD_OVERHEAD_BYTES
    return total


def alone(among: Sequence[Tick]) -> list[Tick]:
    """The messages within a millisecond of which no other was logged."""
    ordered = sorted(among, key=lambda tick: tick.log_time)
    near = {
        tick
        for before, after in pairwise(ordered)
        if after.log_time - before.log_time < NS_PER_S // 1000
        for tick in (before, after)
    }
    return [tick for tick in among if tick not in near]


def place_is_right(fault: Fault) -> bool:
    """Whether the position asked for right after the kill was that of the message asked for."""
    if fault.place is None:
        return True
    x, y = position(fault.place_t)
    told = fault.place.reply
    return "x" in told and math.hypot(told["x"] - x, told["y"] - y) < 0.05
