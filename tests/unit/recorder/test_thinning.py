"""Which messages of a topic stay of a day: what changes, what is seen, and enough of the rest."""

from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS, THINNED_NS
from ros2_memory.columns.decode import undecoded
from ros2_memory.columns.detections import DetectionColumns
from ros2_memory.recorder.thinning import (
    EXTREMES_NS,
    MINUTE_NS,
    STANDING_NS,
    TopicThinning,
    rounded,
)
from ros2_memory.storage.base import Definition, Field
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, boolean, detections, make, odom, write_mcap
from tests.support.memories import shipped_extractor

S = 10**9
T0 = 1_790_000_001 * S


def times_that_stay(
    folder: Path, bags: Sequence[Sequence[Msg]], *, numbers_ns: int = THINNED_NS
) -> list[int]:
    """The log times that stay of one topic in some bags, in ns since `T0`."""
    reader = McapReader()
    thinned = TopicThinning(DetectionColumns(shipped_extractor()), numbers_ns)
    for nth, messages in enumerate(bags):
        path = write_mcap(folder / f"{nth}.mcap", messages)
        for group in undecoded(reader, path):
            for table in group.tables():
                thinned.add(table)
        path.unlink()
    return [time - T0 for time in thinned.times().tolist()]


def number(at: int, value: float) -> Msg:
    body = make("std_msgs/msg/Float64", data=value)
    return Msg("/level", "std_msgs/msg/Float64", at, body)


def cut(messages: Sequence[Msg], at: Sequence[int]) -> list[Sequence[Msg]]:
    edges = [0, *sorted(at), len(messages)]
    parts = [messages[a:b] for a, b in pairwise(edges)]
    return [part for part in parts if part]


def by_slot(count: int, step: int, length: int) -> list[list[int]]:
    """The numbers of so many messages, one each step (ns), by slots of a length."""
    slots = groupby(range(count), key=lambda n: (T0 + n * step) // length)
    return [[*inside] for _, inside in slots]


def test_a_robot_that_drives_has_a_pose_a_second_and_one_that_stands_half_as_many(
    tmp_path: Path,
) -> None:
    """Driving from 30 s to 60 s, at 0.5 m/s."""
    at = np.arange(0, 90 * S, S // 10)
    poses = [odom(T0 + int(t), 0.5 * min(max(t / S - 30, 0), 30), 0.0) for t in at]
    stays = times_that_stay(tmp_path, [poses])
    driving = [t for t in stays if 31 * S <= t < 60 * S]
    assert len(driving) >= 29
    assert all(after - before <= S for before, after in pairwise(driving))
    standing = [t for t in stays if t < 29 * S or t > 62 * S]
    assert len(standing) <= 2 * 30 * S * (1 / STANDING_NS + 1 / THINNED_NS)
    assert all(after - before <= STANDING_NS for before, after in pairwise(stays))


@given(
    st.lists(st.booleans(), min_size=2, max_size=60),
    st.lists(st.integers(1, 59), max_size=4, unique=True),
)
def test_every_change_of_a_boolean_stays_wherever_bags_are_cut(
    tmp_path_factory: pytest.TempPathFactory, values: list[bool], at: list[int]
) -> None:
    messages = [boolean(T0 + n * S, value) for n, value in enumerate(values)]
    parts = cut(messages, [edge for edge in at if edge < len(messages)])
    stays = {t // S for t in times_that_stay(tmp_path_factory.mktemp("bags"), parts)}
    changes = {n for n in range(1, len(values)) if values[n] != values[n - 1]}
    assert changes | {n - 1 for n in changes} <= stays


@pytest.mark.parametrize(
    ("kind", "cuts"),
    [("UInt8", range(20, 1200, 20)), ("Int32", ()), ("Int64", range(50, 1200, 50))],
)
def test_of_integers_states_and_extremes_stay_and_measurements_do_not(
    tmp_path: Path, kind: str, cuts: Sequence[int]
) -> None:
    """Twelve states of 5 s each; others for one message each; and a counter, all at 5 Hz."""
    of = f"std_msgs/msg/{kind}"
    at = np.arange(1200)
    short = np.where((at > 240) & (at < 252), at % 100, 0)
    spike = np.where(at == 777, 222, at % 97)
    for values in (at // 25 % 12, short, spike):
        messages = [
            Msg("/state", of, T0 + n * S // 5, make(of, data=value))
            for n, value in enumerate(values.tolist())
        ]
        stays = {5 * t // S for t in times_that_stay(tmp_path, cut(messages, cuts))}
        changes = np.flatnonzero(values[1:] != values[:-1])
        if values is spike:
            assert 777 in stays
            assert len(stays) < 120
        else:
            assert {*changes.tolist(), *(changes + 1).tolist()} <= stays


@given(st.lists(st.integers(S // 20, 12 * S), min_size=2, max_size=120))
def test_no_silence_is_made_that_was_not_there(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int]
) -> None:
    """Between two messages that stay lie no 10 s, unless these followed each other."""
    at = np.cumsum(steps).tolist()
    messages = [number(T0 + t, 1.0) for t in at]
    stays = times_that_stay(tmp_path_factory.mktemp("bags"), cut(messages, [len(at) // 2]))
    following = dict(pairwise(at))
    for before, after in pairwise(stays):
        assert after - before < SILENCE_NS or following[before] == after


def test_the_extremes_of_numbers_stay(tmp_path: Path) -> None:
    chance = np.random.default_rng(3)
    numbers = chance.normal(size=3000).tolist()
    messages = [number(T0 + n * S // 2, value) for n, value in enumerate(numbers)]
    for numbers_ns in (THINNED_NS, MINUTE_NS):
        parts = cut(messages, range(200, 3000, 200))
        stays = {2 * t // S for t in times_that_stay(tmp_path, parts, numbers_ns=numbers_ns)}
        slots = by_slot(3000, S // 2, EXTREMES_NS)
        for inside in slots:
            assert min(inside, key=numbers.__getitem__) in stays
            assert max(inside, key=numbers.__getitem__) in stays
        assert len(stays) <= 1500 * S // numbers_ns + 2 * len(slots) + 2


def test_all_labels_of_a_slot_are_seen_in_it_and_as_many_at_once(tmp_path: Path) -> None:
    """A detector that misses: each message has a third of what is there."""
    chance = np.random.default_rng(5)
    there = ["mug", "mug", "chair", "chair", "chair", "book", "plant"]
    seen = [[label for label in there if chance.random() < 0.3] for _ in range(500)]
    messages = [detections(T0 + n * S // 5, labels) for n, labels in enumerate(seen)]
    stays = {5 * t // S for t in times_that_stay(tmp_path, cut(messages, [130, 133, 350]))}
    for inside in by_slot(500, S // 5, THINNED_NS):
        for label in there:
            most = max(seen[n].count(label) for n in inside)
            assert max(seen[n].count(label) for n in inside if n in stays) == most
    assert len(stays) < 250


def test_a_label_stays_with_the_highest_score_of_each_second(tmp_path: Path) -> None:
    chance = np.random.default_rng(7)
    scores = np.round(chance.random(300), 2).tolist()
    messages = [detections(T0 + n * S // 5, ["cup"], score=one) for n, one in enumerate(scores)]
    stays = {5 * t // S for t in times_that_stay(tmp_path, cut(messages, [130, 133]))}
    for second in range(60):
        inside = range(5 * second, 5 * second + 5)
        best, left = (max(scores[n] for n in some) for some in (inside, stays & {*inside}))
        assert best == left
    assert len(stays) < 80


POSE = Definition(
    "geometry_msgs/msg/Pose",
    tuple(
        Field(name, Definition(f"geometry_msgs/msg/{kind}", tuple(Field(n, "float64") for n in of)))
        for name, kind, of in (("position", "Point", "xyz"), ("orientation", "Quaternion", "xyzw"))
    ),
)


@given(st.floats(-1e6, 1e6), st.floats(0.0, 6.28))
def test_a_rounded_pose_is_within_the_steps_of_columns(x: float, yaw: float) -> None:
    message: Any = odom(T0, x, -x / 3, yaw=yaw).body
    before = message.pose.pose
    after: Any = rounded(before, POSE)
    assert abs(after.position.x - before.position.x) <= 0.5e-4
    assert abs(after.orientation.z - before.orientation.z) <= 2.5e-5
