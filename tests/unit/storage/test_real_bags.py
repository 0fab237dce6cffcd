"""Answers over public robots' bags against what independent tools found in them."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest

from ros2_memory import queries
from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange
from tests.support.memories import memory_of
from tests.support.shared_bags import REAL, needs_real

pytestmark = needs_real

DAMAGED: Final = {"tiryoh_small_and_truncated": {"Dockerfile.mcap"}}


@cache
def expected() -> dict[str, Any]:
    if not REAL.is_dir():
        return {}
    text = (REAL / "expected.json").read_text(encoding="utf-8")
    return {name: entry["expected"] for name, entry in json.loads(text).items()}


@cache
def memory(name: str) -> Memory:
    return memory_of(REAL / name, storage="rosbag2")


sets = pytest.mark.parametrize(
    "name", [name for name in expected() if name != "mcap_conformance_2022"]
)


@sets
def test_counts_types_and_times_are_exact_and_silent_topics_counted(name: str) -> None:
    rows = queries.list_recorded_topics(memory(name), Call())
    answered = {row.topic: (row.type, row.count, row.first, row.last) for row in rows}
    truth = {
        topic: (each["type"], each["count"], each["first_ns"], each["last_ns"])
        for topic, each in expected()[name]["topics"].items()
    }
    if name == "rosbag2_v1_2018_db3":  # written before type names had their /msg/
        truth = {
            topic: (each[0].replace("/", "/msg/"), *each[1:]) if "/msg/" not in each[0] else each
            for topic, each in truth.items()
        }
    assert answered == truth
    answer = queries.data_time_range(memory(name), Call())
    truth = expected()[name]
    assert answer.earliest == truth.get("start_ns")
    assert answer.latest == truth.get("end_ns")
    assert {each.path.name for each in answer.damaged} == DAMAGED.get(name, set())
    assert answer.active == ()
    silent = len(truth.get("empty_topics") or ())
    if name == "rosbag2_v1_2018_db3":
        silent = 2  # the reader that made the expectation could not list that file's topics
    assert answer.silent_topics == silent


@sets
def test_every_decodable_topic_gives_its_last_message(name: str) -> None:
    asked = memory(name)
    read = unreadable = 0
    rows = [row for row in queries.list_recorded_topics(asked, Call()) if not row.undecodable]
    for row in rows:
        try:
            answer = queries.topic_value(
                asked, Call(), row.topic, AtTime(at_s=unix_from_ns(row.last)), tolerance_s=0.001
            )
        except NoDataError as error:
            unreadable += error.reason is NoDataReason.UNDECODABLE
            continue
        assert answer.sample.time == row.last
        json.dumps(answer.sample.value, allow_nan=False)
        read += 1
    # payloads that are no CDR: the point clouds of one file
    assert read + unreadable == len(rows)
    assert unreadable == (1 if name == "tiryoh_small_and_truncated" else 0)


def trajectories() -> list[tuple[str, str]]:
    return [
        (name, topic)
        for name, truth in expected().items()
        for topic, each in truth.get("trajectories", {}).items()
        if each.get("path_length_3d_m_log_order") is not None
    ]


NOISY = [("cougars_auv_mcap", "/coug2/depth_data")]
"""What carries noise, and more than a handful of poses: a pressure sensor that sinks."""
ROUNDED = 5e-5
"""What it makes of a path's length that positions are those of the store, in steps of 0.1 mm."""
ROUNDED_NOISE = 1.5e-3
"""Of the plain sum of steps that are not much longer than that."""


@pytest.mark.parametrize(("name", "topic"), trajectories())
def test_path_lengths_equal_those_of_independent_tools(name: str, topic: str) -> None:
    truth = expected()[name]["trajectories"][topic]
    span = TimeRange(start_s=0.0, end_s=4e9)
    asked = replace(memory(name), limits=QuerySettings(max_plausible_speed_mps=1e9))
    answer = queries.trajectory_summary(asked, Call(), span, topic=topic)
    assert answer.trajectory.poses == truth["n"]
    is_noisy = (name, topic) in NOISY
    assert answer.trajectory.totals.path_sum_m == pytest.approx(
        truth["path_length_3d_m_log_order"], abs=2e-6, rel=ROUNDED_NOISE if is_noisy else ROUNDED
    )
    if is_noisy:
        straight_m = truth["straight_line_first_last_m"]
        assert (
            straight_m - 1e-3
            < answer.trajectory.totals.distance_m
            < answer.trajectory.totals.path_sum_m
        )
        assert answer.trajectory.is_noisy
    else:
        assert answer.trajectory.totals.distance_m == pytest.approx(
            truth["path_length_3d_m_log_order"], abs=2e-6, rel=ROUNDED
        )


@pytest.mark.parametrize(("name", "topic"), trajectories())
def test_positions_are_those_of_the_last_message_before(name: str, topic: str) -> None:
    compared = 0
    for each in expected()[name]["trajectories"][topic].get("position_at", []):
        if each["time_base"] != "log":
            continue
        moment = AtTime(at_s=each["t_ns"] / 1e9)
        answer = queries.position(memory(name), Call(), moment, topic=topic, tolerance_s=10.0)
        assert answer.time == each["last_before"]["t_ns"]
        assert math.dist(answer.pose.position, each["last_before"]["position"]) < 2e-6
        compared += 1
    assert compared or expected()[name]["trajectories"][topic]["n"] < 3


def lookups() -> list[tuple[str, int]]:
    return [
        (name, number)
        for name, truth in expected().items()
        for number in range(len(truth.get("tf_lookup", [])))
    ]


@pytest.mark.parametrize(("name", "number"), lookups())
def test_transforms_equal_those_of_independent_tools_at_header_stamps(
    name: str, number: int
) -> None:
    truth = expected()[name]["tf_lookup"][number]
    asked = replace(memory(name), limits=QuerySettings(tf_clock="stamp"))
    moment = AtTime(at_s=truth["stamp_ns"] / 1e9)
    if "error" in truth:
        with pytest.raises(NoDataError):
            queries.transform(asked, Call(), truth["target"], truth["source"], moment)
        return
    answer = queries.transform(asked, Call(), truth["target"], truth["source"], moment)
    assert math.dist(answer.transform.translation, truth["translation"]) < 2e-6
    dot = sum(a * b for a, b in zip(answer.transform.rotation, truth["q_xyzw"], strict=True))
    assert abs(dot) == pytest.approx(1.0, abs=2e-6)


def test_stamps_days_off_are_recognised_and_log_time_counts_instead() -> None:
    asked = memory("cougars_auv_mcap")
    moment = AtTime(at_s=1744320608.0)
    answer = queries.transform(asked, Call(), "enu", "coug2.robot", moment)
    assert answer.clock == "log"
    with pytest.raises(NoDataError):
        queries.transform(asked, Call(), "enu", "coug2.robot", AtTime(at_s=1743805390.0))


@pytest.mark.parametrize(
    ("name", "cut"),
    [(name, cut) for name, truth in expected().items() for cut in truth.get("truncate", [])],
)
def test_a_file_cut_short_by_a_power_failure_is_read_as_far_as_it_goes(
    tmp_path: Path, name: str, cut: dict[str, int]
) -> None:
    source = next((REAL / name).glob("*.mcap"))
    target = tmp_path / source.name
    target.write_bytes(source.read_bytes()[: cut["bytes"]])
    shutil.copystat(source, target)
    asked = memory_of(tmp_path)
    count = sum(row.count for row in queries.list_recorded_topics(asked, Call()))
    least = cut.get("messages_if_partial_uncompressed_chunk_is_walked")
    assert count >= (cut["messages_in_complete_chunks"] if least is None else least)
    answer = queries.data_time_range(asked, Call())
    assert [each.path.name for each in (*answer.incomplete, *answer.damaged)] == [source.name]
