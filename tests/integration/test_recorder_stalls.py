"""Gaps of the real recorder: times in which no message arrived, and no others.

Its process is stopped again and again. What was sent is in the publishers' own log, what was
recorded is in the bags; what the server says is compared with both.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import chain, groupby, pairwise
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from tests.support.live_recorder import (
    NS_PER_S,
    LiveRecorder,
    Machine,
    answer,
    answering,
    bag_files,
    number_of,
    publishing,
    stall,
)
from tests.support.served import Served
from tests.timing import in_time

STALLS = 3
STALL_S = 3.0
LEAST_S = 0.5
"""The shortest gap of topics that come with 6 Hz or more."""
ABSENT_S = 0.6
LATE_S = 0.1
PERIOD_S = 0.02
"""Of the second most frequent topic."""
ROUNDED_S = 2e-6
"""Replies give microseconds."""
EDGE_S = 2 * PERIOD_S + 0.06
TOPICS = ("/odom", "/scan", "/slow")
ROBOTS = {
    "best effort": ("/odom:200:best_effort", "/scan:50:best_effort", "/slow:2:best_effort"),
    "reliable": ("/odom:50:reliable", "/scan:50:reliable", "/slow:2:reliable"),
}
BOTH = ("/odom:50:reliable", "/scan:50:best_effort", "/slow:2:reliable")

Span = tuple[float, float]
"""Unix seconds."""


class Sent(NamedTuple):
    """A message that was published, and when (ns)."""

    topic: str
    number: int
    at: int


class Drive(NamedTuple):
    """What was sent, in order of time, and each message's log times in all files (ns).

    `stalls` are those in which no recorder ran.
    """

    stalls: Sequence[Span]
    recorder: LiveRecorder
    sent: Sequence[Sent]
    logged: Mapping[tuple[str, int], Sequence[int]]

    def pauses(self) -> list[Span]:
        """Between which log times no message lies, of any topic, for more than `LEAST_S`."""
        times = sorted(at for each in self.logged.values() for at in each)
        return [
            (before / NS_PER_S, after / NS_PER_S)
            for before, after in pairwise(times)
            if after - before > LEAST_S * NS_PER_S
        ]

    def is_logged_at(self, edge: float) -> bool:
        times = chain.from_iterable(self.logged.values())
        return any(abs(at / NS_PER_S - edge) < ROUNDED_S for at in times)

    def absences(self) -> list[Span]:
        """From the first to the last of messages in a row, of all topics, that did not arrive.

        No file has them, or they were recorded more than `LATE_S` after they were sent: a recorder
        that stalls reads what DDS has kept for it only then.
        """
        runs = [[*run] for arrived, run in groupby(self.recorded(), self.arrived) if not arrived]
        spans = [(run[0].at / NS_PER_S, run[-1].at / NS_PER_S) for run in runs]
        return [span for span in spans if span[1] - span[0] >= ABSENT_S]

    def arrived(self, sent: Sent) -> bool:
        logged = self.logged.get((sent.topic, sent.number))
        return logged is not None and min(logged) - sent.at <= LATE_S * NS_PER_S

    def recorded(self) -> Sequence[Sent]:
        """What was sent from the first to the last message that a file has."""
        there = [(each.topic, each.number) in self.logged for each in self.sent]
        return self.sent[there.index(True) : len(there) - there[::-1].index(True)]


def drive(
    site: Machine,
    robot: Sequence[str],
    session_s: int,
    stalled: Callable[[LiveRecorder], Sequence[Span]],
) -> Drive:
    """Records a robot from before until after `stalled`."""
    name = f"drive{len(site.recorders)}"
    log = site.folder / f"{name}.sent"
    with publishing(site.env, "--log", str(log), *robot):
        recorder = site.record(
            name,
            "recording.split_duration_s=4",
            f"recording.session_duration_s={session_s}",
            topics=TOPICS,
        )
        stalls = stalled(recorder)
        recorder.stop()
    lines = [line.split() for line in log.read_text().splitlines() if line.count(" ") == 2]
    sent = [Sent(topic, int(number), int(at)) for topic, number, at in lines]
    logged: dict[tuple[str, int], list[int]] = {}
    for file in bag_files(recorder.bag_dir):
        with file.open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages(topics=[*TOPICS]):
                key = (channel.topic, number_of(message.data))
                logged.setdefault(key, []).append(message.log_time)
    return Drive(stalls, recorder, sent, logged)


def stalls_after_each_other(recorder: LiveRecorder) -> Sequence[Span]:
    """Once its queues are deep."""
    recorder.wait_for("rotated")
    stalls: list[Span] = []
    for _ in range(STALLS):
        stalls.append(stall(recorder, STALL_S))
        await_whole_split(recorder)
    return stalls


def await_whole_split(recorder: LiveRecorder) -> None:
    """Returns when the newest recording has closed a split that it opened since."""
    name = recorder.children()[-1].recording
    closed = [each for each in recorder.events("split_closed") if each["recording"] == name]
    recorder.wait_for("split_closed", len(closed) + 2, recording=name)


def stalls_at_rotations(recorder: LiveRecorder) -> Sequence[Span]:
    """Of the recorders of one rotation together; of the next one the new one stalls alone."""
    recorder.wait_for("rotated")
    both, _ = (stall_at_rotation(recorder, every=every) for every in (True, False))
    await_whole_split(recorder)
    return [both]


def stall_at_rotation(recorder: LiveRecorder, *, every: bool) -> Span:
    rotated = len(recorder.events("rotated"))
    recorder.wait_for("rotation_begun", rotated + 1)
    found = stall(recorder, STALL_S, every=every)
    recorder.wait_for("rotated", rotated + 1)
    return found


def gaps_of(served: Served) -> list[Span]:
    reply = answer(served, "data_time_range")
    assert reply["clock_steps"] == []
    return [(gap["start"], gap["end"]) for gap in reply["gaps"]]


def assert_gaps_are_what_did_not_arrive(found: Drive, gaps: Sequence[Span]) -> None:
    """Each gap has a pause of the files, is a stall, and each absence is in a gap.

    It begins and ends with messages, within `EDGE_S` of the stall: two periods of the second most
    frequent topic, and what a process takes to run again.
    """
    absences, pauses = found.absences(), found.pauses()
    assert len(gaps) == len(pauses)
    for gap, pause in zip(gaps, pauses, strict=True):
        assert gap[0] < pause[0] + ROUNDED_S
        assert pause[1] - ROUNDED_S < gap[1]
        assert all(map(found.is_logged_at, gap))
    for first, last in absences:
        assert [gap for gap in gaps if gap[0] < first and last < gap[1]], (first, last)
    assert [edge for gap in gaps for edge in gap] == pytest.approx(
        [edge for stalled in found.stalls for edge in stalled], abs=EDGE_S
    )


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_each_stall_is_a_gap_and_nothing_else_is(site: Machine, robot: Sequence[str]) -> None:
    def stalling() -> None:
        found = drive(site, robot, 600, stalls_after_each_other)
        # But where DDS makes the publishers wait for a process that stands still.
        assert found.absences()
        with answering(found.recorder.bag_dir, site.folder / "server.log") as served:
            gaps = gaps_of(served)
            assert_gaps_are_what_did_not_arrive(found, gaps)
            health = json.loads(served.get("/health")[1])["gaps_last_hour"]
            length_s = sum(end - start for start, end in gaps)
            assert (health["count"], health["seconds"]) == (
                len(gaps),
                pytest.approx(length_s, 1e-3),
            )
            for start, end in gaps:
                told = answer(served, "get_position_at", timestamp=(start + end) / 2)
                assert told["reason"] == "gap", told

    in_time(stalling)


def test_a_stall_at_a_rotation_is_a_gap_where_both_recorders_stall(site: Machine) -> None:
    def stalling() -> None:
        found = drive(site, BOTH, 12, stalls_at_rotations)
        with answering(found.recorder.bag_dir, site.folder / "server.log") as served:
            assert_gaps_are_what_did_not_arrive(found, gaps_of(served))

    in_time(stalling)
