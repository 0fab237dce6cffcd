"""When rules fire: over streams of messages alone, and over splits and rotations."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.bag_dir.state_files import RunRecord
from tests.support.bags import Msg, battery, boolean, diagnostics
from tests.support.examples import examples
from tests.support.watched_bags import SILENT, T0, S, WatchedBags, flag, rule

Stream = list[tuple[int, bool | None]]

STEPS = st.tuples(
    st.sampled_from([S // 2, S, 4 * S, 11 * S]), st.sampled_from([True, True, False, None])
)


def stream_of(steps: list[tuple[int, bool | None]]) -> Stream:
    times = accumulate(step for step, _ in steps)
    return [(time, matches) for time, (_, matches) in zip(times, steps, strict=True)]


STREAMS = st.lists(STEPS, max_size=30).map(stream_of)
HOLDS = st.sampled_from([0, S, 5 * S, 20 * S])


def fired(
    stream: Stream,
    hold: int,
    cuts: Sequence[int] = (),
    *,
    latched: bool = False,
    end: int = 0,
    **kind: Any,
) -> list[int]:
    """When the rule fires, if the stream is looked at in pieces that end at these times."""
    times: list[int] = []
    runs: dict[str, RunRecord] = {}
    for until in (*sorted(cuts), max(end, stream[-1][0] + 1 if stream else 0)):
        piece = [each for each in stream if each[0] < until]
        stream = stream[len(piece) :]
        watched = rule(hold=hold, **kind)
        for time, matches in piece:
            found = watched.take(runs, "/bumper", time, matches=matches, latched=latched)
            times += [] if found is None else [found.at]
        times += [each.at for each in watched.reach(runs, until)]
    return times


def expected(stream: Stream, hold: int) -> list[int]:
    """The same from the whole stream: every run of matches, then how long it held."""
    runs: list[list[int]] = []
    previous: tuple[int, bool] | None = None
    for time, matches in stream:
        if previous is not None and time - previous[0] > SILENCE_NS:
            previous = None
        in_run = previous is not None and previous[1]
        if matches and not in_run:
            runs.append([])
        if matches:
            runs[-1].append(time)
        # A message that cannot be decoded keeps a match alive, and says nothing.
        previous = (time, in_run if matches is None else matches)
    return [run[0] + hold for run in runs if run[-1] - run[0] >= hold]


@given(STREAMS, HOLDS, st.lists(st.integers(0, 200).map(lambda n: n * S // 2), max_size=8))
def test_however_the_stream_is_cut_a_rule_fires_at_the_same_times(
    stream: Stream, hold: int, cuts: list[int]
) -> None:
    assert fired(stream, hold, cuts) == expected(stream, hold)


@given(STREAMS, HOLDS, st.lists(st.integers(0, 200).map(lambda n: n * S // 2), max_size=8))
def test_on_a_latched_topic_a_value_holds_until_the_next_one(
    stream: Stream, hold: int, cuts: list[int]
) -> None:
    end = 500 * S
    known = [each for each in stream if each[1] is not None]
    times, begun = [], None
    for time, value in [*known, (end, None)]:
        if begun is not None and time - begun >= hold and (value is not True or time == end):
            times.append(begun + hold)
        if value is False:
            begun = None
        elif value and begun is None:
            begun = time
    assert fired(stream, hold, cuts, latched=True, end=end) == times


@given(st.lists(st.integers(1, 30), max_size=20), st.lists(st.integers(0, 400), max_size=8))
def test_a_silence_fires_once_and_again_after_the_topic_spoke(
    pauses: list[int], cuts: list[int]
) -> None:
    hold, end = 9 * S, 1000 * S
    times = [sum(pauses[: n + 1]) * S for n in range(len(pauses))]
    stream: Stream = [(time, False) for time in times]
    found = fired(stream, hold, [cut * S for cut in cuts], end=end, **SILENT)
    gaps = zip(times, [*times[1:], end], strict=True) if times else ()
    assert found == [last + hold for last, after in gaps if after - last >= hold]


@pytest.mark.parametrize("latched", [True, False])
def test_a_clock_that_was_set_back_ends_what_goes_on(*, latched: bool) -> None:
    watched, runs = rule(hold=5 * S), dict[str, RunRecord]()
    fires = [
        watched.take(runs, "/bumper", at * S, matches=True, latched=latched) for at in (100, 50, 55)
    ]
    assert [fire and fire.at for fire in fires] == [None, None, 55 * S]


VALUES = st.lists(st.sampled_from([True, True, True, False]), min_size=4, max_size=24)


def published(at: int, value: bool, late: int) -> Msg:
    """A message that is received so many milliseconds after it was published."""
    return replace(boolean(at + late * 1_000_000, value), publish_time=at)


@settings(max_examples=examples(15), deadline=None)
@given(
    VALUES,
    st.sampled_from([0, S * 3 // 2, S * 7 // 2]),
    st.lists(st.sampled_from(["split", "rotate", "look", "kill", ""]), min_size=24, max_size=24),
)
def test_a_rule_fires_at_the_times_of_the_uncut_stream(
    values: list[bool], hold: int, steps: list[str]
) -> None:
    stream: list[tuple[int, bool | None]] = []
    with TemporaryDirectory() as folder:
        robot = WatchedBags(Path(folder) / "bags", [rule(hold=hold)])
        name = robot.begin(T0)
        held: list[Msg] = []
        number = 0
        for at, (value, step) in enumerate(zip(values, steps, strict=False)):
            time = T0 + at * S
            stream.append((time, value))
            held.append(published(time, value, 0))
            if step in {"split", "rotate"}:
                # The new recording runs beside the old one, and has its last two messages too.
                overlap = held[-2:]
                robot.split(held, name)
                last = f"{name}_{number}.mcap"
                held, number = [], number + 1
                if step == "rotate":
                    old, name = name, robot.begin(time + S // 2)
                    robot.beat(old, name)
                    robot.hand_over(old, name, overlap[-1].published, last)
                    held = [
                        published(each.published, bool(each.body.data), 1)  # type: ignore[attr-defined]
                        for each in overlap
                    ]
                    number = 0
                    robot.beat(name)
            elif step == "look":
                robot.look()
            elif step == "kill":
                robot.house = robot.new_house()
        if held:
            robot.split(held, name)
        robot.close_all()
    # Log times of the copies that count may be a millisecond late.
    wanted = [(each - T0) / S for each in expected(stream, hold)]
    assert robot.fired_at() == pytest.approx(wanted, abs=0.002, rel=0)


def test_a_message_that_is_written_late_into_the_next_split_counts_in_its_place(
    tmp_path: Path,
) -> None:
    # As rosbag2 does: by less than a second, also across two splits.
    robot = WatchedBags(tmp_path / "bags", [rule(hold=S * 3 // 2)])
    robot.begin(T0)
    robot.split([flag(0, False), flag(8, True), flag(9, True), flag(10, True)])
    robot.look()
    robot.split([flag(9.5, False), flag(11, True), flag(12, True)])
    robot.close_all()
    assert robot.fired_at() == [11.5]


def test_the_field_of_a_rule_may_be_a_full_path(tmp_path: Path) -> None:
    pressed = parse_condition("equals", True, 0.5, "data")
    robot = WatchedBags(tmp_path / "bags", [rule(condition=pressed)])
    robot.begin(T0)
    robot.split([flag(0, False), flag(1, True)])
    robot.close_all()
    assert robot.fired_at() == [1]


def test_a_full_battery_does_not_end_the_low_charge_of_another_on_its_topic(
    tmp_path: Path,
) -> None:
    low = parse_condition("below", 0.2, 0.5, "percentage")
    robot = WatchedBags(
        tmp_path / "bags", [rule(topic="/battery_state", condition=low, hold=3 * S)]
    )
    robot.begin(T0)
    messages = []
    for second in range(20):
        charge = 0.1 if second >= 5 else 0.3
        messages.append(battery(T0 + second * S, charge, location="left"))
        messages.append(battery(T0 + second * S + 1000, 0.9, location="right"))
    robot.split(messages)
    robot.close_all()
    assert robot.fired_at() == [8]


@pytest.mark.parametrize(("hold_s", "fires_at"), [(0, [600]), (60, [660])])
def test_a_battery_that_comes_every_twenty_seconds_is_low_once(
    tmp_path: Path, hold_s: int, fires_at: list[float]
) -> None:
    """It fired for each of its messages, or never where it was to be low for a minute."""
    low = parse_condition("below", 0.2, 0.5, "percentage")
    held = rule(topic="/battery_state", condition=low, hold=hold_s * S)
    robot = WatchedBags(tmp_path / "bags", [held])
    robot.begin(T0)
    for begin in range(0, 900, 60):
        seconds = range(begin, begin + 60, 20)
        robot.split([battery(T0 + at * S, 0.1 if at >= 600 else 0.3) for at in seconds])
        robot.look()
    robot.close_all()
    assert robot.fired_at() == fires_at


@pytest.mark.parametrize(("hold_s", "fires_at"), [(0, [5]), (3, [8]), (30, [])])
def test_what_other_nodes_report_does_not_end_the_error_of_one(
    tmp_path: Path, hold_s: int, fires_at: list[float]
) -> None:
    """The lidar has an error from 5 s on; the camera, which is fine, reports between."""
    lost = parse_condition("contains", "no data", 0.5)
    robot = WatchedBags(
        tmp_path / "bags", [rule(topic="/diagnostics", condition=lost, hold=hold_s * S)]
    )
    robot.begin(T0)
    messages = []
    for second in range(20):
        at = T0 + second * S
        messages.append(diagnostics(at, lidar=(2, "no data") if second >= 5 else (0, "")))
        messages.append(diagnostics(at + 1000, camera=(0, "")))
    robot.split(messages)
    robot.close_all()
    assert robot.fired_at() == fires_at
