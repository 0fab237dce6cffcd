"""Public robots' bags and recorded sessions, read by the storage room alone.

`expected.json` was made with other tools over the same files; `truth.json` says what was published.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BagReader, Closing, Record
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.shared_bags import BAGS, REAL, RECORDED, needs_real, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary

EVERYTHING = TimeWindow.everything()
NO_BAG = {"Dockerfile.mcap"}

# Why a type may be refused, and which: everything else must decode.
REFUSED = {
    "rosbag2_v1_2018_db3": {
        "test_msgs/msg/StaticArrayPrimitives": "no definition",
        "test_msgs/msg/Primitives": "no definition",
    },
    "novatel_customtypes_nometa_db3": {
        "novatel_oem7_msgs/msg/INSPVA": "reader.custom_msg_paths",
        "novatel_oem7_msgs/msg/BESTPOS": "reader.custom_msg_paths",
        "novatel_oem7_msgs/msg/BESTVEL": "reader.custom_msg_paths",
        "novatel_oem7_msgs/msg/BESTUTM": "reader.custom_msg_paths",
        "gps_msgs/msg/GPSFix": "reader.custom_msg_paths",
    },
    "rerun_json_protobuf_mcap": {"foxglove.PoseInFrame": "message encoding 'protobuf'"},
    "tiryoh_small_and_truncated": {"sensor_msgs/msg/PointCloud2": "does not fit the definition"},
    "mcap_conformance_2022": {"Example": "message encoding 'a'"},
}


@functools.cache
def expectations() -> dict[str, Any]:
    path = REAL / "expected.json"
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


@functools.cache
def rosbag2() -> Rosbag2Reader:
    return Rosbag2Reader()


@functools.cache
def mcap() -> McapReader:
    return McapReader()


def readers_of(path: Path) -> list[BagReader]:
    return [reader for reader in (mcap(), rosbag2()) if reader.reads(path)]


def files_of(name: str) -> list[Path]:
    paths = sorted(path for path in (REAL / name).iterdir() if rosbag2().reads(path))
    return [path for path in paths if path.name not in NO_BAG]


def topics_of(summary: BagSummary) -> set[str]:
    return {topic.topic for topic in summary.topics}


def all_records(reader: BagReader, path: Path) -> list[Record]:
    return list(reader.records(path, topics_of(reader.summarize(path)), EVERYTHING))


every_set = pytest.mark.parametrize("name", list(expectations()))
every_recorded_file = pytest.mark.parametrize(
    "path",
    sorted(p for p in RECORDED.rglob("*") if rosbag2().reads(p)) if RECORDED.is_dir() else [],
    ids=lambda path: str(path.relative_to(BAGS)),
)


@needs_real
@every_set
def test_only_what_may_be_refused_is_refused_and_with_its_reason(name: str) -> None:
    refused: dict[str, str] = {}
    decoded: Counter[str] = Counter()
    for path in files_of(name):
        reader = readers_of(path)[0]
        for record in all_records(reader, path):
            try:
                reader.decode(record)
            except UndecodableError as error:
                refused[record.channel.type] = error.reason
            else:
                decoded[record.channel.type] += 1
    allowed = REFUSED.get(name, {})
    assert refused.keys() == allowed.keys()
    for type_name, words in allowed.items():
        assert words in refused[type_name]
        assert decoded[type_name] == 0


@needs_real
def test_every_legal_layout_of_the_summary_section_is_read() -> None:
    per_file = expectations()["mcap_conformance_2022"]["expected"]["per_file"]
    paths = files_of("mcap_conformance_2022")
    assert {path.name for path in paths} == set(per_file)
    for path in paths:
        expected = per_file[path.name]
        summary = mcap().summarize(path)
        assert summary.count == expected["messages"], path
        assert sorted(topics_of(summary)) == expected["topics"]
        assert summary.complete
        assert summary.notes == ()
        assert mcap().closing(path) is Closing.CLOSED
        if expected["log_ns"] is not None:
            assert [summary.start, summary.end] == expected["log_ns"]


@needs_recorded
@every_recorded_file
def test_every_recorded_file_is_read_or_reports_why_not(path: Path) -> None:
    for reader in readers_of(path):
        if not path.stat().st_size:
            with pytest.raises(BagError):
                reader.summarize(path)
            continue
        summary = reader.summarize(path)
        assert summary.complete == (reader.closing(path) is Closing.CLOSED)
        records = all_records(reader, path)
        assert len(records) == summary.count
        for record in records:
            if reader.undecodable(record.channel) is None:
                reader.decode(record)
            else:
                assert path.parent.name == "nodef"
                assert record.channel.topic == "/desc"
