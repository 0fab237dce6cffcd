"""The tables of a lake, what their rows say, and whom they belong to."""

import json
import math
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from random import Random
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from pyiceberg.catalog.sql import SqlCatalog

from ros2_memory.columns.units import Rows
from ros2_memory.core.errors import LakeError, RefusedError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.detections import Detected, DetectionRows
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.tables import NAMESPACE, TABLES, bags_condition, open_tables
from ros2_memory.lake.warehouse import LakeFile, LakeLocation
from tests.support.bags import Msg, along_x, battery, detections, make, text, tf_of, write_mcap
from tests.support.fleets import NOW, START_S
from tests.support.lakes import lake_in, lake_rows, robot_bags, ship, ship_from
from tests.support.memories import memory_of
from tests.support.unlike_robots import ROBOTS

DAY = date(2026, 11, 20)
KEYS = {"robot": "hall", "bag_id": "a", "day": DAY}


@pytest.fixture
def catalog(tmp_path: Path) -> SqlCatalog:
    return SqlCatalog("lake", uri=f"sqlite:///{tmp_path}/x.sqlite", warehouse=tmp_path.as_uri())


def test_rows_are_sorted_and_lie_by_robot_and_day_in_zstd(catalog: SqlCatalog) -> None:
    table = open_tables(catalog, ["events"])["events"]
    row = {**KEYS, "topic": "/wheel/odom", "kind": "stop", "first_ns": 5_000_000_123, "x": 1.5}
    events = TABLES["events"]
    table.append(events.sort(events.to_arrow([row, {**row, "first_ns": 1_000_000_000}])))
    before, found = table.scan().to_arrow().to_pylist()
    assert before["time"].timestamp() == 1.0
    assert {name: found[name] for name in row} == row
    assert (found["topic_key"], found["last_ns"]) == ("wheel.odom", None)
    assert found["time"].timestamp() == 5.0
    [task] = table.scan().plan_files()
    assert "/robot=hall/day=2026-11-20/" in task.file.file_path
    written = pa.parquet.read_metadata(Path(task.file.file_path.removeprefix("file://")))
    assert written.row_group(0).column(0).compression == "ZSTD"
    names = [table.schema().find_field(part.source_id).name for part in table.sort_order().fields]
    assert names == ["topic_key", "kind", "first_ns"]


def test_an_older_lake_gets_the_columns_that_are_new(catalog: SqlCatalog) -> None:
    catalog.create_namespace_if_not_exists(NAMESPACE)
    kinds = zip(KEYS, (pa.string(), pa.string(), pa.date32()), strict=True)
    keys = pa.schema([pa.field(*kind, nullable=False) for kind in kinds])
    catalog.create_table(f"{NAMESPACE}.things", keys)
    table = open_tables(catalog, ["things"])["things"]
    assert table.schema().column_names == [*TABLES["things"].columns]


def test_bags_of_years_are_deleted_at_once(catalog: SqlCatalog) -> None:
    """Python's limit of nested calls was reached with 500 days."""
    table = open_tables(catalog, ["events"])["events"]
    days = [DAY + timedelta(days=nth) for nth in (0, 1, 599, 600)]
    rows = [{**KEYS, "day": day, "topic": "/odom", "first_ns": 0} for day in days]
    table.append(TABLES["events"].to_arrow(rows))
    bags = [("hall", DAY + timedelta(days=nth), "a") for nth in range(600)]
    table.delete(bags_condition(bags))
    assert table.scan().to_arrow()["day"].to_pylist() == [days[-1]]


def test_lone_surrogates_of_a_hostile_bag_are_escaped() -> None:
    texts = {"value": "bad \udc80", "texts": [("\udc80", "\udc81")]}
    table = TABLES["messages"].to_arrow([{**KEYS, "topic": "/\udc80", "time_ns": 1, **texts}])
    assert table["value"].to_pylist() == ["bad \\udc80"]
    assert table["topic_key"].to_pylist() == ["\\udc80"]
    assert table["texts"].to_pylist() == [[("\\udc80", "\\udc81")]]


def test_a_column_that_a_file_lacks_is_null_and_a_file_that_is_gone_is_reported(
    tmp_path: Path,
) -> None:
    row = {**KEYS, "topic": "/seen", "first_ns": 0}
    whole, path = TABLES["things"].to_arrow([{**row, "label": "cup"}]), tmp_path / "old.parquet"
    pq.write_table(whole.drop_columns(["spread_m"]), path)
    lake, files = (
        Lake(lake_in(tmp_path)),
        [LakeFile("hall", DAY, path.as_uri(), 1, 0, "", "")],
    )
    columns = ("label", "spread_m")
    assert lake.rows("things", files, columns).to_pylist() == [{"label": "cup", "spread_m": None}]
    assert lake.rows("things", files, columns, pc.field("label") == "a").num_rows == 0
    assert lake.rows("things", (), columns).num_rows == 0
    path.unlink()
    with pytest.raises(RefusedError, match="the lake cannot be read") as raised:
        lake.rows("things", files, columns)
    assert str(tmp_path) not in str(raised.value)


def test_messages_of_one_time_have_their_own_numbers_beside_one_that_cannot_be_decoded(
    tmp_path: Path,
) -> None:
    """And numbers in messages are as they were recorded."""

    def seen(at: int, labels: str) -> Msg:
        return detections(at * NS_PER_S, [*labels])

    spoiled = replace(seen(2, "-"), body=b"\x00\x01\x00\x00\xff")
    messages = [seen(1, "ax"), seen(1, "b"), spoiled, seen(2, "c"), seen(2, ""), seen(3, "e")]
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", [*messages, battery(NOW, math.nan)])
    ship_from(tmp_path, messages=["/battery_state"])
    found = lake_rows(tmp_path / "lake", "sightings")
    numbered = [(0, "a"), (0, "x"), (1, "b"), (3, "c"), (5, "e")]
    assert sorted((row["message"], row["label"]) for row in found) == numbered
    assert [row["undecodable"] for row in lake_rows(tmp_path / "lake", "bags")] == [1]
    [row] = lake_rows(tmp_path / "lake", "messages")
    assert math.isnan(dict(row["numbers"])["percentage"])


def test_numbers_of_messages_of_two_types_on_one_topic_are_those_of_their_places(
    tmp_path: Path,
) -> None:
    """Those of one log time had one number in `sightings`, and two in `messages`."""
    topic, found = "/seen", json.dumps({"label": "mug"})
    both = [
        message
        for at in range(3)
        for message in (
            text(at * NS_PER_S + 1, found, topic),
            detections(at * NS_PER_S + 1, ["cup"], topic=topic),
        )
    ]
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", both)
    ship_from(tmp_path, messages=[topic])
    whole = {row["message"]: row["type"] for row in lake_rows(tmp_path / "lake", "messages")}
    assert whole == {nth: message.type for nth, message in enumerate(both)}
    seen = {row["message"]: row["type"] for row in lake_rows(tmp_path / "lake", "sightings")}
    assert seen == whole


def test_messages_that_cannot_be_decoded_are_counted_also_where_nothing_was_seen(
    tmp_path: Path,
) -> None:
    spoiled = [
        replace(detections(at * NS_PER_S, ["cup"]), body=b"\x00\x01\x00\x00\xff") for at in range(4)
    ]
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", [*spoiled, detections(NOW, [])])
    ship_from(tmp_path)
    [row] = lake_rows(tmp_path / "lake", "bags")
    assert (row["undecodable"], row["detections"]) == (4, 0)


def test_a_tie_and_a_message_that_cannot_be_decoded_cost_no_read_for_each_other_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bag of 4,000 messages of detections took 38 s."""
    seen = [detections((START_S + at) * NS_PER_S, ["cup"]) for at in range(40)]
    seen[10] = replace(seen[10], log_time=seen[9].log_time)
    seen[20] = replace(seen[20], body=seen[20].payload[:40])
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", seen)
    reads, read = [], DetectionRows.read

    def counted(self: DetectionRows, rows: Rows) -> Detected:
        reads.append(len(rows))
        return read(self, rows)

    monkeypatch.setattr(DetectionRows, "read", counted)
    ship_from(tmp_path)
    numbers = sorted(row["message"] for row in lake_rows(tmp_path / "lake", "sightings"))
    assert numbers == [*range(20), *range(21, 40)]
    assert len(reads) < 10


def test_rows_of_a_bag_are_the_same_whatever_bags_they_are_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whether their columns are stored."""
    ROBOTS["twin"](tmp_path / "twin")
    found = []
    for together in (1, 3, 0):
        monkeypatch.setattr("ros2_memory.lake.shipper._GROUP", together or 64)
        lake, robot = tmp_path / f"lake_{together}", robot_bags("twin", tmp_path / "twin")
        if not together:
            robot = replace(robot, memory=memory_of(tmp_path / "twin"), filling=None)
        ship(lake, [robot], most_bags=100)
        found.append({name: sorted(map(str, lake_rows(lake, name))) for name in TABLES})
    assert len(found[0]["poses"]) > len(found[0]["bags"]) > 3
    assert found[1:] == found[:1] * 2


@pytest.mark.parametrize("spoiled", [1, 3])
@patch("ros2_memory.columns.plan.MAX_COLUMNS", 3)
def test_a_pose_that_cannot_be_decoded_costs_its_bag_alone_the_poses(
    tmp_path: Path, spoiled: int
) -> None:
    """Where messages have too many fields for columns, those of all bags are read at once."""
    driven = along_x(START_S * NS_PER_S, 40, mps=1.0, hz=2)
    torn = 20 * spoiled + 7
    driven[torn] = replace(driven[torn], body=driven[torn].payload[:40])
    for nth in range(4):
        own = driven[20 * nth : 20 * nth + 20]
        write_mcap(tmp_path / "hall" / "rec" / f"rec_{nth}.mcap", own)
    assert ship_from(tmp_path, most_bags=4).bags == 4
    rows = sorted(lake_rows(tmp_path / "lake", "bags"), key=lambda row: row["bag_id"])
    assert [(row["poses"], row["distance_m"]) for row in rows] == [
        (None, None) if nth == spoiled else (20, 9.5) for nth in range(4)
    ]


def test_the_metres_of_a_robot_that_transforms_alone_place_are_in_the_lake(tmp_path: Path) -> None:
    """An arm goes 1.2 m along its rail and stands for 14 s, in each of two bags."""
    begin, bags = START_S * NS_PER_S, tmp_path / "bags"
    for nth in range(2):
        moves = [begin + (20 * nth * 10 + n) * NS_PER_S // 10 for n in range(200)]
        rail = [(at, min(n, 60) * 0.02) for n, at in enumerate(moves)]
        moved = [tf_of(at, "world", "base_link", (x, 0.0, 0.0)) for at, x in rail]
        write_mcap(bags / f"rec{nth}" / f"rec{nth}_0.mcap", moved)
    assert ship(tmp_path / "lake", [robot_bags("arm", bags)]).bags == 2
    for row in lake_rows(tmp_path / "lake", "bags"):
        assert (row["pose_topic"], row["poses"]) == ("/tf", 200)
        assert row["distance_m"] == pytest.approx(1.2, abs=0.02)
        assert row["stood_s"] == pytest.approx(13.9, abs=0.5)
    assert {row["topic"] for row in lake_rows(tmp_path / "lake", "poses")} == {"/tf"}


@pytest.mark.parametrize("earlier_s", [0, 1200])
def test_bags_beside_one_whose_poses_have_no_position_are_shipped(
    tmp_path: Path, earlier_s: int
) -> None:
    """The robot's places are known, too, where that one lies in no part of theirs."""
    begin = START_S * NS_PER_S
    driven = along_x(begin, 10, mps=0.5, hz=5)
    said = [text(begin + (n - earlier_s) * NS_PER_S + 7, "x", "/odom") for n in range(10)]
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", driven)
    write_mcap(tmp_path / "hall" / "other" / "other_0.mcap", said)
    shipped = ship_from(tmp_path)
    assert (shipped.bags, shipped.problems) == (2, [])
    rows = lake_rows(tmp_path / "lake", "bags")
    assert {row["recording"]: row["poses"] for row in rows} == {"rec": 50, "other": None}
    placed = {row["topic"] for row in lake_rows(tmp_path / "lake", "poses")}
    assert placed == ({"/odom"} if earlier_s else set())


def test_of_large_messages_there_are_the_times_alone_unless_they_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = Random(1).randbytes
    image = [Msg("/camera", "sensor_msgs/msg/Image", nth, noise(9)) for nth in (1, 2, 3)]
    scans = [Msg("/scan", "sensor_msgs/msg/LaserScan", nth, noise(2_000)) for nth in range(1, 30)]
    large_once = Msg("/map", "nav_msgs/msg/OccupancyGrid", 1, noise(9_000))
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", [*image, *scans, large_once])

    def whole(name: str, *messages: str) -> set[str]:
        ship(tmp_path / name, [robot_bags("hall", tmp_path / "hall", messages=messages)])
        rows = lake_rows(tmp_path / name, "channels")
        counts = {row["topic"]: row["messages"] for row in rows}
        assert counts == {"/camera": 3, "/map": 1, "/scan": 29}
        return {row["topic"] for row in rows if row["has_payloads"]}

    assert whole("plain") == {"/map"}
    assert whole("chosen", "/camera") == {"/camera", "/map"}
    # Of more than may be in memory the largest goes.
    monkeypatch.setattr("ros2_memory.lake.rows._MOST_BYTES", 8_000)
    assert whole("short") == set()
    # What is shipped whole takes no room of others.
    assert whole("short_whole", "/map", "/scan") == {"/map", "/scan"}
    monkeypatch.setattr("ros2_memory.lake.rows._MOST_BYTES", 9_000)
    assert whole("beside", "/scan") == {"/map", "/scan"}


def test_values_are_json_also_of_ranges_that_are_not_finite(tmp_path: Path) -> None:
    """A laser scan is infinite where it meets nothing: no program read `Infinity`."""
    ranges = make(
        "std_msgs/msg/Float64MultiArray",
        layout=make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0),
        data=np.array([1.0, math.inf, math.nan]),
    )
    message = Msg("/ranges", "std_msgs/msg/Float64MultiArray", NOW, ranges)
    write_mcap(tmp_path / "hall" / "rec" / "rec_0.mcap", [message])
    ship_from(tmp_path, messages=["/ranges"])
    [row] = lake_rows(tmp_path / "lake", "messages")
    assert json.loads(row["value"], parse_constant=pytest.fail)["data"] == [1.0, None, None]


def hub(folder: Path, name: str) -> LakeLocation:
    state_dir = folder / name
    state_dir.mkdir(exist_ok=True)
    return LakeLocation((folder / "lake").as_uri(), state_dir)


@pytest.fixture
def owner_file(tmp_path: Path) -> Path:
    return tmp_path / "lake" / "ros2_memory" / "writer.json"


def test_the_first_hub_keeps_the_lake_and_another_is_refused_until_it_is_given_up(
    tmp_path: Path, owner_file: Path
) -> None:
    for _ in range(3):  # also after it was killed
        hub(tmp_path, "one").claim()
        with pytest.raises(LakeError, match=f"another writer, with lake.state_dir={tmp_path}/one"):
            hub(tmp_path, "other").claim()
    # The file of an older version keeps others out, too.
    own = json.loads(owner_file.read_text())
    owner_file.write_text(json.dumps({"id": own["id"], "pid": 1, "until": 0}))
    hub(tmp_path, "one").claim()
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "other").claim()
    owner_file.unlink()
    hub(tmp_path, "other").claim()
    # What the first would commit now is refused.
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "one").claim()


def test_an_owner_whose_folder_has_a_long_name_of_other_letters_keeps_the_lake(
    tmp_path: Path,
) -> None:
    """As JSON each of these letters takes six characters."""
    far = tmp_path / ("機" * 80) / ("器" * 80)
    far.mkdir(parents=True)
    LakeLocation((tmp_path / "lake").as_uri(), far).claim()
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "other").claim()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"id": 5}'])
def test_a_damaged_file_keeps_nobody_out(tmp_path: Path, owner_file: Path, text: str) -> None:
    owner_file.parent.mkdir(parents=True)
    owner_file.write_text(text)
    hub(tmp_path, "one").claim()
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "other").claim()
