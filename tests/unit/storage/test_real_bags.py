"""Public robots' bags, and answers over them, against what independent tools found in them.

`expected.json` was made with other tools over the same files.
"""

import json
import math
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from ros2_memory import queries
from ros2_memory.core.errors import NoDataError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.memories import memory_of
from tests.support.shared_bags import REAL, needs_real

pytestmark = needs_real

FIRST = "rosbag2_v1_2018_db3"
CONFORMANCE = "mcap_conformance_2022"
DAMAGED = {"tiryoh_small_and_truncated": {"Dockerfile.mcap"}}
REFUSED = {
    FIRST: {
        "test_msgs/msg/StaticArrayPrimitives": "no definition",
        "test_msgs/msg/Primitives": "no definition",
    },
    "novatel_customtypes_nometa_db3": dict.fromkeys(
        [
            *(f"novatel_oem7_msgs/msg/{name}" for name in ("INSPVA", "BESTPOS", "BESTVEL")),
            "novatel_oem7_msgs/msg/BESTUTM",
            "gps_msgs/msg/GPSFix",
        ],
        "reader.custom_msg_paths",
    ),
    "rerun_json_protobuf_mcap": {"foxglove.PoseInFrame": "message encoding 'protobuf'"},
    "tiryoh_small_and_truncated": {"sensor_msgs/msg/PointCloud2": "does not fit the definition"},
    CONFORMANCE: {"Example": "message encoding 'a'"},
}
"""Which types may be refused, and why: everything else must decode."""


@cache
def expected() -> dict[str, Any]:
    if not REAL.is_dir():
        return {}
    text = (REAL / "expected.json").read_text()
    return {name: entry["expected"] for name, entry in json.loads(text).items()}


@cache
def memory(name: str) -> Memory:
    return memory_of(REAL / name, storage="rosbag2")


READER = Rosbag2Reader()


def files_of(name: str) -> list[Path]:
    paths = [path for path in (REAL / name).iterdir() if READER.reads(path)]
    return [path for path in paths if path.name != "Dockerfile.mcap"]


@pytest.mark.parametrize("name", [name for name in expected() if name != CONFORMANCE])
def test_counts_types_and_times_are_exact_and_silent_topics_counted(name: str) -> None:
    truth = expected()[name]
    rows = queries.list_recorded_topics(memory(name), Call())
    assert {row.topic: (row.type, row.count, row.first, row.last) for row in rows} == {
        # The first bags were written before type names had their /msg/.
        topic: (
            each["type"].replace("/", "/msg/") if each["type"].count("/") == 1 else each["type"],
            *(each[key] for key in ("count", "first_ns", "last_ns")),
        )
        for topic, each in truth["topics"].items()
    }
    answer = queries.data_time_range(memory(name), Call())
    assert (answer.earliest, answer.latest) == (truth.get("start_ns"), truth.get("end_ns"))
    assert {each.path.name for each in answer.damaged} == DAMAGED.get(name, set())
    # The reader that made the expectation could not list the topics of the first bag.
    silent = 2 if name == FIRST else len(truth.get("empty_topics") or ())
    assert answer.silent_topics == silent


@pytest.mark.parametrize("name", expected())
def test_only_what_may_be_refused_is_refused_and_with_its_reason(name: str) -> None:
    refused: dict[str, str] = {}
    decoded: Counter[str] = Counter()
    for path in files_of(name):
        topics = {topic.topic for topic in READER.summarize(path).topics}
        for record in READER.records(path, topics, TimeWindow.everything()):
            try:
                READER.decode(record)
            except UndecodableError as error:
                refused[record.channel.type] = error.reason
            else:
                decoded[record.channel.type] += 1
    allowed = REFUSED.get(name, {})
    assert refused.keys() == allowed.keys()
    for type_name, words in allowed.items():
        assert words in refused[type_name]
        assert decoded[type_name] == 0


def test_every_legal_layout_of_the_summary_section_is_read() -> None:
    found = {path.name: READER.summarize(path) for path in files_of(CONFORMANCE)}
    for name, truth in expected()[CONFORMANCE]["per_file"].items():
        summary = found.pop(name)
        assert summary.count == truth["messages"], name
        assert sorted(topic.topic for topic in summary.topics) == truth["topics"]
        assert (summary.complete, summary.notes) == (True, ())
        if truth["log_ns"] is not None:
            assert [summary.start, summary.end] == truth["log_ns"]
    assert found == {}


NOISY = ("cougars_auv_mcap", "/coug2/depth_data")
"""What carries noise, and more than a handful of poses: a pressure sensor that sinks."""
ROUNDED = 5e-5
"""What it makes of a path's length that positions are those of the store, in steps of 0.1 mm."""
ROUNDED_NOISE = 1.5e-3
"""Of the plain sum of steps that are not much longer than that."""


@pytest.mark.parametrize(
    ("name", "topic"),
    [
        (name, topic)
        for name, truth in expected().items()
        for topic, each in truth.get("trajectories", {}).items()
        if each.get("path_length_3d_m_log_order") is not None
    ],
)
def test_paths_and_positions_equal_those_of_independent_tools(name: str, topic: str) -> None:
    truth = expected()[name]["trajectories"][topic]
    asked = replace(memory(name), limits=QuerySettings(max_plausible_speed_mps=1e9))
    span = TimeRange(start_s=0.0, end_s=4e9)
    found = queries.trajectory_summary(asked, Call(), span, topic=topic).trajectory
    assert found.poses == truth["n"]
    length_m, is_noisy = truth["path_length_3d_m_log_order"], (name, topic) == NOISY
    assert found.totals.path_sum_m == pytest.approx(
        length_m, abs=2e-6, rel=ROUNDED_NOISE if is_noisy else ROUNDED
    )
    if is_noisy:
        straight_m = truth["straight_line_first_last_m"]
        assert straight_m - 1e-3 < found.totals.distance_m < found.totals.path_sum_m
        assert found.is_noisy
    else:
        assert found.totals.distance_m == pytest.approx(length_m, abs=2e-6, rel=ROUNDED)
    by_log = [each for each in truth.get("position_at", []) if each["time_base"] == "log"]
    assert by_log or truth["n"] < 3
    for each in by_log:
        moment = AtTime(at_s=each["t_ns"] / 1e9)
        answer = queries.position(memory(name), Call(), moment, topic=topic, tolerance_s=10.0)
        assert answer.time == each["last_before"]["t_ns"]
        assert math.dist(answer.pose.position, each["last_before"]["position"]) < 2e-6


@pytest.mark.parametrize(
    ("name", "truth"),
    [(name, each) for name, truth in expected().items() for each in truth.get("tf_lookup", [])],
)
def test_transforms_equal_those_of_independent_tools_at_header_stamps(
    name: str, truth: dict[str, Any]
) -> None:
    asked = replace(memory(name), limits=QuerySettings(tf_clock="stamp"))
    given = truth["target"], truth["source"], AtTime(at_s=truth["stamp_ns"] / 1e9)
    if "error" in truth:
        with pytest.raises(NoDataError):
            queries.transform(asked, Call(), *given)
        return
    found = queries.transform(asked, Call(), *given).transform
    assert math.dist(found.translation, truth["translation"]) < 2e-6
    dot = sum(a * b for a, b in zip(found.rotation, truth["q_xyzw"], strict=True))
    assert abs(dot) == pytest.approx(1.0, abs=2e-6)


def test_stamps_days_off_are_recognised_and_log_time_counts_instead() -> None:
    asked = memory("cougars_auv_mcap"), Call(), "enu", "coug2.robot"
    assert queries.transform(*asked, AtTime(at_s=1744320608.0)).clock == "log"
    with pytest.raises(NoDataError):
        queries.transform(*asked, AtTime(at_s=1743805390.0))
