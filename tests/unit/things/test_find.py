"""Questions about things over bags, with a robot whose map moves under its odometry."""

import math
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, count
from operator import attrgetter
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, TypeVar
from unittest.mock import Mock, patch

import pytest

from ros2_memory.analysis import sights
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.sights import JoinedSights
from ros2_memory.core.arrays import rows_by
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.regions import Place, Rectangle
from ros2_memory.core.text import abbreviate
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import TimeRange
from ros2_memory.storage.base import Record
from ros2_memory.things import estimation, known, places, synonyms, unseen
from ros2_memory.things.find import find_things
from ros2_memory.things.instances import Estimate
from ros2_memory.things.places import places_of
from tests.support.bags import (
    Msg,
    along_x,
    detected,
    detections,
    header,
    in_order,
    make,
    odom,
    text,
    tf,
    tf_of,
    tracked,
    transform,
    write_mcap,
    write_splits,
)
from tests.support.clocks import in_zone
from tests.support.memories import (
    Remember,
    asked,
    clause,
    each_way,
    memory_of,
    noted,
    remembered,
    with_store,
)

S = 10**9
BEGIN = 1_784_000_000
KITCHEN = Place("kitchen", "map", Rectangle(0, 6, -2, 2))
NAMED = QuerySettings(places=(KITCHEN,), labels={"mug": ["coffee mug"]})
OFF = (3.0, -2.0, 0.5)
"""Where odom begins in the map, and its yaw."""

Seen = tuple[str, float, float]
"""A label, and a place in the map."""


def scene(
    at_s: float,
    robot: tuple[float, float, float],
    seen: Sequence[Seen],
    *,
    in_map: bool = True,
    score: float = 0.9,
    map_off: float = 0.0,
) -> list[Msg]:
    """All messages of one moment: the robot at a pose in the map, and what it detects.

    `map_off` is how far (m, along y) the map has moved under odometry.
    """
    at = BEGIN * S + round(at_s * S)
    x, y, yaw = robot
    ox, oy, turn = OFF if in_map else (0.0, 0.0, 0.0)
    oy += map_off
    px, py = turned(x - ox, y - oy, -turn)
    messages = [odom(at, px, py, yaw - turn), tf(at, base(at, px, py, yaw - turn))]
    if in_map:
        messages.append(tf_of(at, "map", "odom", (ox, oy, 0.0), turn))
    things = [(label, score, (*turned(tx - x, ty - y, -yaw), 0.7)) for label, tx, ty in seen]
    return [*messages, detected(at, things)]


def turned(x: float, y: float, by: float) -> tuple[float, float]:
    cos, sin = math.cos(by), math.sin(by)
    return x * cos - y * sin, x * sin + y * cos


def base(at: int, x: float, y: float, yaw: float) -> object:
    return transform(at, "odom", "base_link", (x, y, 0.0), yaw)


HERE = (1.0, 0.0, 0.0)
AWAY = (1.0, 0.0, math.pi)


def looked(
    start: int, stop: int, robot: tuple[float, float, float], *seen: Seen, **more: Any
) -> list[Msg]:
    return [message for at in range(start, stop) for message in scene(at, robot, seen, **more)]


def ask(bag_dir: Path, limits: QuerySettings = NAMED, **given: Any) -> Any:
    memory = memory_of(bag_dir, limits=limits)
    return asked(memory, "find_things", **given)


def told_of(bag_dir: Path, messages: Sequence[Msg], **given: Any) -> Any:
    """The reply about what is seen in some messages."""
    write_splits(bag_dir, messages)
    return ask(bag_dir, **given)


def test_a_question_for_many_labels_looks_through_all_spots_as_often_as_one_for_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice: for the time that was asked about, where all are absent, and for all time."""
    labels = [f"part {nth}" for nth in range(20)]
    parts = [(label, 2.0, 0.0) for label in labels]
    write_splits(tmp_path, [*looked(0, 30, HERE, *parts), *looked(60, 90, HERE)])
    looks = Mock(wraps=rows_by)
    monkeypatch.setattr(unseen, "rows_by", looks)
    for asked_for in (labels[:2], labels):
        looks.reset_mock()
        found = ask(tmp_path, label=asked_for, start=BEGIN + 60)
        missed = noted(found, "and not once in this window")
        assert len(missed) == len(asked_for)
        assert looks.call_count == 2 * 2  # what has a place, and what has none


def test_labels_of_one_kind_are_placed_together_however_many_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pair by pair, the hundred kinds of box of a warehouse took a minute."""
    placing = Mock(wraps=places_of)
    monkeypatch.setattr(synonyms, "places_of", placing)
    for kinds in (3, 12):
        placing.reset_mock()
        boxes = [(f"kind {nth} box", 2.0, nth - 5.0) for nth in range(kinds)]
        found = told_of(tmp_path / str(kinds), looked(0, 30, HERE, *boxes), limit=100)
        assert found["total"] == kinds
        assert placing.call_count == 1


@pytest.mark.parametrize(("recalls", "map_off"), [(False, None), (True, 0.6)])
def test_things_of_a_robot_that_transforms_place_are_those_by_its_poses(
    tmp_path: Path, recalls: bool, map_off: float | None
) -> None:
    """Whether no topic has its poses, or `data.pose_topic` is that of the transforms."""
    more: dict[str, Any] = {"in_map": map_off is not None}
    cup, fork, later = ("cup", 3.0, 0.0), ("fork", 3.0, -1.0), ("cup", 4.0, 1.0)
    messages = [
        *looked(0, 60, HERE, cup, fork, **more),
        *looked(60, 120, AWAY, **more),
        *looked(120, 180, HERE, later, **more, map_off=map_off or 0.0),
    ]
    without_poses = [message for message in messages if message.topic != "/odom"]
    write_splits(tmp_path / "all", messages)
    write_splits(tmp_path / "without", without_poses)
    replies = []
    for name, topic in (("all", "/odom"), ("without", "/odom"), ("all", "/tf")):
        limits = QuerySettings(pose_topic=topic)
        memory = memory_of(tmp_path / name, limits=limits, recalls=recalls)
        windows = {"start": BEGIN, "end": BEGIN + 60, "with_start": BEGIN + 120}
        compared = asked(memory, "compare", **windows, with_end=BEGIN + 180)
        replies.append((asked(memory, "find_things"), compared["frame_id"], compared["things"]))
    assert replies[0][0]["total"] > 1
    assert replies[0][0]["frame_id"] == ("odom" if map_off is None else "map")
    assert replies[1] == replies[2] == replies[0]


@each_way
def test_things_are_in_the_map_also_where_no_transform_leads_there_from_the_robots_poses(
    tmp_path: Path, recalls: bool
) -> None:
    """As of a drone whose autopilot has poses in NED, beside transforms of its computer."""
    seen = [("cup", 3.0, 0.0), ("fork", 3.0, -1.0)]
    messages = [*looked(0, 60, HERE, *seen), *looked(60, 120, AWAY)]
    without_poses = [message for message in messages if message.topic != "/odom"]
    in_ned = []
    for pose in (message for message in messages if message.topic == "/odom"):
        body: Any = pose.body
        in_ned.append(replace(pose, body=replace(body, header=header(pose.log_time, "NED"))))
    write_splits(tmp_path / "without", without_poses)
    write_splits(tmp_path / "ned", sorted([*without_poses, *in_ned], key=attrgetter("log_time")))
    replies = [
        asked(memory_of(tmp_path / name, recalls=recalls), "find_things")
        for name in ("without", "ned")
    ]
    assert replies[0]["frame_id"] == "map"
    assert replies[0]["total"] == 2
    assert replies[1] == replies[0]


def test_where_the_robots_poses_are_to_be_chosen_unplaced_detections_say_so(tmp_path: Path) -> None:
    """Two topics have poses, and none of them is `data.pose_topic`."""
    messages = looked(0, 30, HERE, ("cup", 3.0, 0.0))
    places = [message for message in messages if message.topic == "/odom"]
    detections = [message for message in messages if message.topic.startswith("/vision")]
    renamed = [replace(message, topic=to) for message in places for to in ("/odometry", "/pose")]
    reply = told_of(tmp_path, [*detections, *renamed], label="cup")
    assert reply["notes"] == [
        "30 detections of it could not be placed, and are left out",
        (
            "where the robot was is not known: data.pose_topic is /odom, which these bags do not "
            "have; poses are on /odometry (nav_msgs/msg/Odometry), /pose (nav_msgs/msg/Odometry): "
            "set data.pose_topic (for a fleet: fleet.pose_topics) to one of them (best to odometry "
            "that no localisation corrects), or give topic where the tool takes it"
        ),
    ]


def test_where_no_transforms_are_recorded_unplaced_detections_say_so(tmp_path: Path) -> None:
    messages = looked(0, 30, HERE, ("cup", 3.0, 0.0))
    reply = told_of(tmp_path, [each for each in messages if "/tf" not in each.topic], label="cup")
    assert reply["total"] == 0
    assert "what is detected is placed by transforms, of which /tf has none here" in reply["notes"]


@pytest.mark.parametrize(("noise_m", "is_told"), [(0.5, True), (0.02, False)])
def test_things_that_are_nearer_to_each_other_than_noise_throws_detections_are_told(
    tmp_path: Path, noise_m: float, is_told: bool
) -> None:
    """As of a drone that looks at the ground from 30 m; the second pair is 1.1 m apart."""
    random = Random(5)
    messages: list[Msg] = []
    for at in range(300):
        cups = [(3.0, 0.0)] if at % 3 else [(3.0, 1.1)]
        seen = [
            ("cup", x + random.gauss(0, noise_m), y + random.gauss(0, noise_m)) for x, y in cups
        ]
        messages += scene(at, HERE, seen)
    found = told_of(tmp_path, messages, label="cup")
    assert found["total"] >= 2
    told = noted(found, "they may be one thing")
    assert bool(told) == is_told
    if told:
        assert re.match(r"cup: two of these are only [01]\.\d\d m apart", told[0])
    windows = {"start": BEGIN + 150, "end": BEGIN + 300, "with_start": BEGIN, "with_end": BEGIN}
    compared = asked(memory_of(tmp_path), "compare", **windows)
    assert compared["things"].keys() & {"appeared", "not_looked_at"}
    assert ("they may be one thing" in str(compared["notes"])) == is_told


def test_things_of_two_runs_of_odometry_are_not_said_to_be_near_each_other(tmp_path: Path) -> None:
    """The same coordinates are another place in each run."""
    noise = Random(3)
    for run in range(2):
        cups = (("cup", noise.gauss(3.0, 0.1), noise.gauss(0.0, 0.1)) for _ in range(60))
        messages = (
            scene(1000 * run + at, HERE, [cup], in_map=False) for at, cup in enumerate(cups)
        )
        write_splits(tmp_path / str(run), [*chain.from_iterable(messages)])
    found = ask(tmp_path, label="cup")
    assert found["total"] == 2
    assert "may be listed once for each run of odometry" in str(found["notes"])
    assert "may be one thing" not in str(found["notes"])


def test_a_map_of_another_name_is_proposed_where_things_are_listed_for_each_run(
    tmp_path: Path,
) -> None:
    for run in range(2):
        seen = looked(1000 * run, 1000 * run + 60, HERE, ("cup", 3.0, 0.0), in_map=False)
        begin = (BEGIN + 1000 * run) * S
        mapped = tf_of(begin, "map_ned", "odom", (1.0 * run, 0.0, 0.0))
        write_splits(tmp_path / str(run), [mapped, *seen])
    assert "is a map, set data.map_frame=map_ned" in str(ask(tmp_path)["notes"])


def test_things_of_two_robots_that_transforms_place_are_said_to_be_mixed(tmp_path: Path) -> None:
    for name, robot in (("wren", HERE), ("robin", (5.0, 0.0, 0.0))):
        seen = looked(0, 60, robot, ("cup", 3.0, 0.0))
        own = [message for message in seen if message.topic != "/odom"]
        write_splits(tmp_path, own, name=name)
    assert "recordings differ on /tf at" in str(ask(tmp_path)["notes"])


def test_where_the_robots_pose_is_not_known_a_thing_of_long_ago_is_not_in_view(
    tmp_path: Path,
) -> None:
    cup = '{"label": "cup", "position": {"x": 3, "y": 0, "z": 1}}'
    said = [f'{{"frame_id": "map", "detections": [{cup * (at < 30)}]}}' for at in range(90)]
    messages = [text((BEGIN + at) * S, each) for at, each in enumerate(said)]
    [cup] = told_of(tmp_path, messages, label="cup")["things"]
    assert cup["still_there"].keys() == {"not_looked_at_since"}


@pytest.mark.parametrize(
    ("pan", "state"), [(0.0, "not_seen_where_expected"), (math.pi / 2, "not_looked_at_since")]
)
def test_a_camera_that_is_turned_away_by_its_own_joint_misses_nothing(
    tmp_path: Path, pan: float, state: str
) -> None:
    """The robot stands; an empty message names the frame of the camera, too."""

    def seen_by_camera(at: int, yaw: float, *things: Seen) -> list[Msg]:
        *robot, seen = scene(at, HERE, things)
        seen.body.header.frame_id = "camera"  # type: ignore[attr-defined]
        at_ns = BEGIN * S + at * S
        camera = transform(at_ns, "base_link", "camera", (0.0, 0.0, 1.0), yaw)
        return [*robot, tf(at_ns, camera), seen]

    there = [each for at in range(350, 400) for each in seen_by_camera(at, 0.0, ("cup", 3.0, 0.0))]
    later = [each for at in range(400, 460) for each in seen_by_camera(at, pan)]
    [cup] = told_of(tmp_path, [*there, *later], label="cup")["things"]
    assert next(iter(cup["still_there"])) == state
    assert cup["seen_from"] == {"x": 1.0, "y": 0.0, "yaw_deg": 0.0}


@pytest.mark.parametrize(
    ("height", "roll_deg", "pitch_deg"), [(-0.3, 0, 0), (0.0, 110, 0), (0.0, 0, 35)]
)
def test_a_thing_that_a_robot_which_sits_or_fell_does_not_see_was_never_away(
    tmp_path: Path, height: float, roll_deg: float, pitch_deg: float
) -> None:
    """It stands up, or is put upright, at the same place, and sees the thing again."""
    roll, pitch = math.radians(roll_deg) / 2, math.radians(pitch_deg) / 2
    lying = make(
        "geometry_msgs/msg/Quaternion",
        x=math.sin(roll),
        y=math.sin(pitch),
        z=0.0,
        w=math.cos(roll + pitch),
    )

    def down(message: Msg) -> Msg:
        for moved in getattr(message.body, "transforms", []):
            if moved.child_frame_id == "base_link":
                moved.transform.translation.z = height
                moved.transform.rotation = lying
        if message.topic == "/odom":
            message.body.pose.pose.position.z = height  # type: ignore[attr-defined]
            message.body.pose.pose.orientation = lying  # type: ignore[attr-defined]
        return message

    cup, standing = ("cup", 3.0, 0.0), partial(looked, in_map=False)
    nothing_seen = [down(message) for message in standing(60, 120, (0.0, 0.0, 0.0))]
    there = [standing(*span, (0.0, 0.0, 0.0), cup) for span in ((0, 60), (120, 180))]
    [found] = told_of(tmp_path, [*there[0], *nothing_seen, *there[1]], label="cup")["things"]
    assert (found["count"], found.get("moved")) == (120, None)


@pytest.mark.parametrize("heading", [0.0, math.pi])
def test_a_camera_that_looks_back_misses_nothing_beside_its_field_of_view(
    tmp_path: Path, heading: float
) -> None:
    """The same things, seen by a camera in front and by one that looks back."""

    def thing(label: str, bearing_deg: float) -> Seen:
        bearing = math.radians(bearing_deg)
        return label, 1.0 + 3.0 * math.cos(bearing), 3.0 * math.sin(bearing)

    cup = thing("cup", 33.0)
    others = [thing("book", 0.0), thing("plant", 12.0), thing("fork", -33.0)]
    before, after = ((1.0, 0.0, heading + math.radians(turned_deg)) for turned_deg in (3.0, -2.0))
    seen = [*looked(0, 60, before, cup, *others), *looked(60, 160, after, *others)]
    [cup_then] = told_of(tmp_path, seen, label="cup")["things"]
    assert cup_then["still_there"] == {"not_looked_at_since": BEGIN + 59}


@pytest.mark.parametrize("lost", [math.nan, math.inf])
def test_a_thing_that_is_detected_without_a_place_is_not_missed(
    tmp_path: Path, lost: float
) -> None:
    there, taken = ("cup", 3.0, 0.0), ("fork", 3.0, -1.0)
    seen = [
        *looked(0, 30, HERE, there, taken),
        *looked(30, 90, HERE, ("cup", lost, lost)),
    ]
    reply = told_of(tmp_path, seen)
    states = {each["label"]: each["still_there"].keys() for each in reply["things"]}
    assert states["cup"] == {"not_looked_at_since"}
    assert states["fork"] == {"not_seen_where_expected", "looks"}
    [note] = reply["notes"]
    assert "could not be placed: cup (60 times" in note


@pytest.mark.parametrize(("chairs", "notes"), [(110, 0), (140, 1)])
def test_all_chairs_of_a_hall_are_counted_or_it_is_said_that_some_are_not(
    tmp_path: Path, chairs: int, notes: int
) -> None:
    hall = [("chair", 2.0 + nth % 12, nth // 12 - 5.0) for nth in range(chairs)]
    reply = told_of(tmp_path, looked(0, 5, HERE, *hall), limit=100)
    assert reply["total"] == min(chairs, 128)
    assert sum("of more than 128 at once" in each for each in reply.get("notes", ())) == notes


@pytest.mark.parametrize("most", [2048, 512])
def test_all_pallets_of_a_warehouse_are_counted_or_it_is_said_that_some_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """There are 600, ten in view at a time. With a limit below, as it was, the total is of 512."""
    for module in (places, estimation, unseen):
        monkeypatch.setattr(module, "MAX_PLACES", most)
    messages: list[Msg] = []
    for row in range(60):
        pallets = [("pallet", 1.5 * x, 1.5 * row) for x in range(10)]
        robot = (6.75, 1.5 * row - 3.0, math.pi / 2)
        messages += looked(10 * row, 10 * row + 4, robot, *pallets)
    found = told_of(tmp_path, messages, label="pallet")
    is_said = f"of more than {most} places of one label, the others are left out: pallet"
    assert found["total"] == min(600, most)
    assert (is_said in found.get("notes", ())) == (most < 600)


def test_of_too_many_labels_at_once_it_is_said_that_some_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (sights, unseen):
        monkeypatch.setattr(module, "MAX_LABELS", 3)
    wall = [(f"tag {nth}", 3.0 + nth, 0.0) for nth in range(5)]
    left_out = "of more than 3 labels in 10 s, the others are left out"
    assert "notes" not in told_of(tmp_path / "3", looked(0, 3, HERE, *wall[2:]))
    assert left_out in told_of(tmp_path / "4", looked(0, 3, HERE, *wall[1:]))["notes"]
    # Nothing is said never to have been detected.
    reply = told_of(tmp_path / "5", looked(0, 3, HERE, *wall), label="tag 4")
    assert reply["notes"] == [left_out]


LATER: list[list[Seen]] = [
    [("mug", 3.25, 0.5), ("chair", 4.0, -1.0)],
    [("mug", 3.0, 0.5), ("mug", 3.3, 0.6), ("mug", 3.6, 0.4), ("chair", 4.2, -1.1)],
    [("coffee mug", 3.1, 0.5), ("chair", 4.0, -0.7), ("chair", 4.0, -1.3)],
    [("bottle", 3.0, 0.5), ("person", 4.0, -1.0)],
    [],
]


@pytest.mark.parametrize("seen", LATER)
def test_what_is_said_of_a_past_window_stays_said(tmp_path: Path, seen: list[Seen]) -> None:
    before = [("mug", 3.0, 0.5), ("chair", 4.0, -1.0)]
    side = (3.0, -3.0, math.pi / 2)
    write_splits(tmp_path, [*looked(0, 20, HERE, *before), *looked(20, 40, side, *before)])
    windows = {"start": BEGIN + 20, "end": BEGIN + 39, "with_start": BEGIN, "with_end": BEGIN + 19}
    questions = {"find_things": {"start": BEGIN, "end": BEGIN + 39}, "compare": windows}

    def answers() -> dict[str, Any]:
        memory = memory_of(tmp_path, limits=NAMED)
        return {tool: asked(memory, tool, **q) for tool, q in questions.items()}

    then = answers()
    days = [
        [*looked(at, at + 20, HERE, *seen), *looked(at + 20, at + 40, side, *seen)]
        for at in (86_400, 4 * 86_400)
    ]
    write_splits(tmp_path, [message for day in days for message in day], name="later")
    now = answers()
    since = {thing["label"]: thing.pop("still_there") for thing in now["find_things"]["things"]}
    assert all(thing.pop("still_there") for thing in then["find_things"]["things"])
    assert now["find_things"]["things"] == then["find_things"]["things"]
    assert now["compare"]["things"] == then["compare"]["things"]
    assert since.keys() == {"mug", "chair"}
    last = BEGIN + 4 * 86_400 + 39
    if not seen:
        assert all("not_seen_where_expected" in state for state in since.values())
    if seen and seen[0][:2] == ("coffee mug", 3.1):
        assert since["mug"] == {"seen_since": last}


@each_way
def test_tracked_objects_are_things_of_their_likeliest_class_by_its_name(
    tmp_path: Path, *, recalls: bool
) -> None:
    messages = looked(0, 20, HERE)
    for second in range(20):
        car, walker = ({1: 0.75, 2: 0.25}, 4.0, 1.0), ({0: 0.25, 7: 0.5}, 3.0, -1.0)
        seen = [car, ({9: 0.5}, 2.0, 2.0), *([walker] if 5 <= second < 15 else [])]
        messages.append(tracked((BEGIN + second) * S, seen))
    memory = remembered(tmp_path, messages, split_s=10)
    memory = with_store(memory, tmp_path) if recalls else memory
    found = asked(memory, "find_things")
    assert found["labels"] == {"pedestrian": 1, "car": 1, "9": 1}
    [car_thing] = asked(memory, "find_things", label="car")["things"]
    assert (car_thing["place"]["x"], car_thing["place"]["y"]) == (4.0, 1.0)
    texts = [
        event["text"] for event in asked(memory, "recap", start=BEGIN, end=BEGIN + 30)["events"]
    ]
    assert [text for text in texts if "PEDESTRIAN" in text] == ["PEDESTRIAN in view"]
    assert not [text for text in texts if "TRUCK" in text or "UNKNOWN" in text]
    ask_labels = {"topic": "/perception/objects", "condition_type": "contains", "by": "label"}
    rows = asked(memory, "find_matches", **ask_labels, value="")["rows"]
    assert [row[:3] for row in rows] == [["9", 1, 19.0], ["CAR", 1, 19.0], ["PEDESTRIAN", 1, 9.0]]
    for condition_type, value in (
        ("contains", "pedest"),
        ("contains_word", "pedestrian"),
        ("equals", "Pedestrian"),
    ):
        told = clause("/perception/objects", condition_type, value)
        [seen_row] = asked(memory, "find_matches", **told)["sightings"]
        times = (seen_row["first_seen"] - BEGIN, seen_row["last_seen"] - BEGIN)
        assert (times, seen_row["matched"]) == ((5, 14), ["PEDESTRIAN"])
        assert asked(memory, "find_last_match", **told)["timestamp"] == BEGIN + 14
    told = {"topic": "/perception/objects", "field": "objects.classification.label"}
    numbers = {**told, "condition_type": "equals"}
    assert asked(memory, "find_last_match", **numbers, value=7)["timestamp"] == BEGIN + 14
    assert asked(memory, "find_last_match", **numbers, value=3) is None
    assert (
        "one of UNKNOWN = 0, CAR = 1"
        in asked(memory, "find_matches", **numbers, value="bus")["detail"]
    )


def test_two_of_a_kind_one_above_the_other_are_two_though_no_message_has_both(
    tmp_path: Path,
) -> None:
    """As from open stairs, on which a robot passes both within seconds."""
    messages: list[Msg] = []
    for second in range(60):
        *robot, _ = scene(second, (0.0, 0.0, 0.0), [], in_map=False)
        height = 4.9 if second % 10 > 4 else 0.7
        messages += [*robot, detected((BEGIN + second) * S, [("cup", 0.9, (2.0, 0.0, height))])]
    things = told_of(tmp_path, messages, label="cup")["things"]
    assert sorted((thing["place"]["z"], thing["count"]) for thing in things) == [
        (0.7, 30),
        (4.9, 30),
    ]


def test_what_is_on_another_floor_is_not_near_a_thing(tmp_path: Path) -> None:
    seen = [("cup", 0.9, (2.0, 0.0, 0.7)), ("book", 0.9, (2.3, 0.0, 1.4))]
    above = [("lamp", 0.9, (2.2, 0.0, 4.9)), ("cup", 0.9, (2.0, 0.0, 4.9))]
    messages: list[Msg] = []
    for second in range(60):
        *robot, _ = scene(second, (0.0, 0.0, 0.0), [], in_map=False)
        messages += [*robot, detected((BEGIN + second) * S, [*seen, *above])]
    things = told_of(tmp_path, messages, near={"label": "cup", "radius_m": 1})["things"]
    near = {(thing["label"], thing["place"]["z"], thing["near_m"]) for thing in things}
    assert near == {("book", 1.4, 0.3), ("lamp", 4.9, 0.2)}


def test_people_are_counted_in_the_region_that_is_asked_for(tmp_path: Path) -> None:
    people = [("person", x, 0.0) for x in (2.0, 6.0, 8.0)]
    write_splits(tmp_path, looked(0, 60, HERE, *people, ("cup", 8.3, 0.0)))

    def counted(**given: Any) -> tuple[int, float]:
        reply = ask(tmp_path, label="person", **given)
        return reply["total"], reply["things"][0]["place"]["x"]

    reply = ask(tmp_path, label="people")
    [found] = reply["things"]
    assert (found["moves"], found["at_once"], reply["total"]) == (True, 3, 3)
    assert "still_there" not in found
    assert counted(where={"x": [1, 3], "y": [-1, 1]}) == (1, 2.0)
    assert counted(where={"x": [5, 9], "y": [-1, 1]})[0] == 2
    for x in (2.0, 6.0, 8.0):
        assert counted(near={"x": x, "y": 0.1, "radius_m": 0.5}) == (1, x)
    assert counted(near={"label": "cup", "radius_m": 1}) == (1, 8.0)
    assert ask(tmp_path, label="cup", near={"label": "person", "radius_m": 1})["total"] == 1


@pytest.mark.parametrize(
    ("every_s", "at_once", "is_lone"), [(1, 1, True), (1, 2, False), (8, 1, False)]
)
def test_a_person_last_seen_in_one_of_many_messages_may_be_a_false_detection(
    tmp_path: Path, every_s: int, at_once: int, is_lone: bool
) -> None:
    """Not so where the detector hardly ever has a message, or saw two."""
    there = looked(0, 100, HERE, ("person", 3.0, 0.0))
    later = [
        message
        for at in range(3600, 3664, every_s)
        for message in scene(at, HERE, [("person", 4.0, -1.0)] * at_once if at == 3632 else [])
    ]
    reply = told_of(tmp_path, [*there, *later], label="person")
    assert reply["things"][0]["last_seen"] == BEGIN + 3632
    notes = noted(reply, "false detection")
    assert [note.rpartition(" ")[2] for note in notes] == [f"{BEGIN + 99}.000000"] * is_lone
    assert all("person was last seen in 1 of 30 messages" in note for note in notes)


def alternating(*labels: str, y: float = 0.5, begin: int = 0) -> list[Msg]:
    """A thing that each message names otherwise, with 5 cm of noise."""
    draw = Random(1)
    return [
        message
        for at in range(40)
        for message in scene(
            begin + at,
            HERE,
            [(labels[at % len(labels)], 3.0 + draw.gauss(0, 0.05), y + draw.gauss(0, 0.05))],
        )
    ]


MUG, COFFEE_MUG = ("mug", 3.0, 0.5), ("coffee mug", 3.1, 0.5)


@pytest.mark.parametrize(
    ("messages", "apart", "labels"),
    [
        (lambda: alternating("mug", "coffee mug"), ["mug", "coffee mug"], ["coffee mug", "mug"]),
        (lambda: alternating("coffee mug", "dog bed"), [], ["coffee mug", "dog bed"]),
        (lambda: alternating("coffee mug", "mugshot"), [], ["coffee mug", "mugshot"]),
        (lambda: alternating("coffee mug", "cup"), [], ["coffee mug", "cup"]),
        (lambda: looked(0, 20, HERE, MUG, COFFEE_MUG), [], ["coffee mug", "mug"]),
        (
            lambda: looked(0, 30, HERE, MUG) + looked(30, 60, HERE, COFFEE_MUG),
            [],
            ["coffee mug", "mug"],
        ),
    ],
    ids=["declared", "bed", "mugshot", "cup", "in one message", "one after the other"],
)
def test_labels_of_two_things_stay_two(
    tmp_path: Path, messages: Callable[[], list[Msg]], apart: list[str], labels: list[str]
) -> None:
    write_splits(tmp_path, messages())
    limits = QuerySettings(labels={each: [] for each in apart})
    assert ask(tmp_path, limits)["labels"] == dict.fromkeys(labels, 1)


@pytest.mark.parametrize(
    ("words", "is_told"),
    [(("mug", "coffee mug"), True), (("coffee mug", "mug"), True), (("mug", "cup"), False)],
)
def test_what_a_detector_with_other_words_may_call_a_thing_is_said(
    tmp_path: Path, words: tuple[str, str], is_told: bool
) -> None:
    """An open-vocabulary detector finds only what it was told to look for."""
    seen = [looked(60 * nth, 60 * nth + 30, HERE, (words[nth], 3.0, 0.5)) for nth in range(2)]
    write_splits(tmp_path, [*seen[0], *seen[1]])
    told = f"{words[1]} is seen where {words[0]} was, since {BEGIN + 60}.000000: it may be the same"
    reply = ask(tmp_path, QuerySettings(), label=words[0])
    assert "not_seen_where_expected" in reply["things"][0]["still_there"]
    assert (told in str(reply.get("notes"))) is is_told
    window = {"with_start": BEGIN, "with_end": BEGIN + 29, "start": BEGIN + 60, "end": BEGIN + 89}
    compared = asked(memory_of(tmp_path, limits=QuerySettings()), "compare", **window)
    assert (told in str(compared.get("notes"))) is is_told
    apart = QuerySettings(labels={word: [] for word in words})
    assert told not in str(ask(tmp_path, apart, label=words[0]))


def test_what_a_user_asks_for_and_a_detector_is_to_look_for_was_not_seen(
    remember: Remember,
) -> None:
    """A command has its object in a text of JSON, beside what is to be done with it."""
    key_value = "diagnostic_msgs/msg/KeyValue"
    command = make(key_value, key="find_object", value='{"object": "glasses"}')
    asked_for = Msg("/command", key_value, (BEGIN + 5) * S, command)
    prompts = text((BEGIN + 5) * S, '{"classes": ["cup", "bottle"]}', topic="/prompts")
    memory = remember([*looked(0, 20, HERE, MUG), asked_for, prompts], split_s=10)
    found = str(asked(memory, "find_things"))
    told = str(asked(memory, "recap", start=BEGIN, end=BEGIN + 20))
    for label in ("glasses", "bottle"):
        assert label not in found
        assert f"{label} in view" not in told


@pytest.mark.parametrize("label", ["forklift", "Fork_Lift", "forklifts"])
def test_labels_that_differ_in_spacing_only_name_one_thing(tmp_path: Path, label: str) -> None:
    """Two detectors write it otherwise, and each saw it at another time."""
    seen = (
        looked(0, 30, HERE, ("forklift", 3.0, 0.5)),
        looked(30, 60, HERE, ("fork_lift", 3.0, 0.5)),
    )
    write_splits(tmp_path, [*seen[0], *seen[1]])
    reply = ask(tmp_path, label=label)
    assert [thing["count"] for thing in reply["things"]] == [60]
    declared = QuerySettings(labels={"forklift": [], "fork lift": []})
    assert ask(tmp_path, declared)["labels"] == {"fork lift": 1, "forklift": 1}


def test_a_label_that_is_given_to_two_things_makes_them_none(tmp_path: Path) -> None:
    """By the owner's list these are two; where messages have both of them it needs no list."""
    moved = [
        *alternating("coffee mug", "mug"),
        *looked(40, 60, HERE),
        *alternating("red mug", "mug", y=-1.5, begin=60),
    ]
    write_splits(tmp_path / "moved", moved)
    apart = QuerySettings(labels={"coffee mug": [], "red mug": []})
    reply = ask(tmp_path / "moved", apart)
    assert reply["labels"].keys() == {"coffee mug", "mug", "red mug"}
    for each in ("coffee mug", "red mug"):
        [thing] = [thing for thing in reply["things"] if thing["label"] == each]
        assert "moved" not in thing
    assert ask(tmp_path / "moved", QuerySettings())["labels"] == {"mug": 1}


@pytest.mark.parametrize("stored", [False, True])
def test_what_was_seen_in_a_time_that_a_recording_has_twice_has_no_place(
    tmp_path: Path, stored: bool
) -> None:
    """The clock was set back by a minute: poses of both minutes lie between each other."""
    first = looked(0, 120, HERE, ("cup", 3.0, 0.5))
    second = looked(60, 240, (11.0, 0.0, math.pi / 2), ("plant", 11.5, 3.0))
    write_mcap(tmp_path / "run" / "run_0.mcap", first)
    write_mcap(tmp_path / "run" / "run_1.mcap", second)
    memory = memory_of(tmp_path, limits=NAMED)
    reply = asked(with_store(memory, tmp_path) if stored else memory, "find_things")
    places = {
        thing["label"]: (thing["place"]["x"], thing["place"]["y"]) for thing in reply["things"]
    }
    assert reply["labels"] == {"cup": 1, "plant": 1}
    assert places == {"cup": (3.0, 0.5), "plant": (11.5, 3.0)}
    assert all("moved" not in thing for thing in reply["things"])
    set_back = "twice, as the clock was set back meanwhile: what was where then is not known"
    assert set_back in str(reply)


GUESS = "which one of a label moved is a guess, since others of it came or went meanwhile: "


def pallets(*rows: float) -> list[Seen]:
    return [("pallet", 3.0, y) for y in rows]


@pytest.mark.parametrize(
    ("before", "after", "guess"),
    [
        (pallets(-1.5, 0.0), pallets(1.5), "pallet (or 1 more)"),
        (pallets(-1.5), pallets(0.0, 1.5), "pallet (or 1 more)"),
        (pallets(-1.5), pallets(1.5), ""),
        (pallets(-1.5, 0.0), pallets(0.0, 1.5), ""),
    ],
    ids=["two went", "two came", "alone", "another stayed"],
)
def test_which_of_several_alike_moved_is_a_guess(
    tmp_path: Path, before: list[Seen], after: list[Seen], guess: str
) -> None:
    write_splits(tmp_path, [*looked(0, 40, HERE, *before), *looked(60, 100, HERE, *after)])
    found = ask(tmp_path, label="pallet")
    assert [len(thing["moved"]) for thing in found["things"] if "moved" in thing] == [2]
    windows = {"with_start": BEGIN, "with_end": BEGIN + 39, "start": BEGIN + 60, "end": BEGIN + 99}
    compared = asked(memory_of(tmp_path, limits=NAMED), "compare", **windows)
    assert len(compared["things"]["moved"]) == 1
    for reply in (found, compared):
        guesses = noted(reply, GUESS)
        assert guesses == ([GUESS + guess] if guess else [])


def test_what_is_left_out_for_its_score_is_said_with_the_limit(tmp_path: Path) -> None:
    low = looked(0, 20, HERE, ("mug", 3.0, 0.5), score=0.3)
    strict = QuerySettings(min_score=0.5)
    reply = told_of(tmp_path, low + looked(20, 40, HERE, ("cup", 3.0, 0.5)), limits=strict)
    assert reply["labels"] == {"cup": 1}
    assert reply["notes"] == ["detected only below min_score 0.5 (data.min_score): mug (20 times)"]
    [note] = ask(tmp_path, strict, label="mug")["notes"]
    assert note == (
        "it was detected 20 times below min_score 0.5 (data.min_score), which does not count"
    )
    [note] = ask(tmp_path, label="mug", min_score=0.4)["notes"]
    assert note == "it was detected 20 times below min_score 0.4, which does not count"


def test_a_short_list_says_since_when_what_moved_is_there_and_what_is_left_out(
    tmp_path: Path,
) -> None:
    many = [(f"thing {nth:02}", 1.0 + 1.2 * (nth % 7), 1.2 * (nth // 7) - 6) for nth in range(36)]
    elsewhere = [("thing 00", 2.0, 5.0), *many[1:]]
    write_splits(tmp_path, [*looked(0, 8, HERE, *many), *looked(100, 108, HERE, *elsewhere)])
    answer = ask(tmp_path, limit=100)
    [moved] = [row for row in answer["things"] if row["label"] == "thing 00"]
    assert (moved["moved_times"], moved["since"]) == (1, moved["last_seen"] - 7.0)
    assert all("since" not in row for row in answer["things"] if row is not moved)
    assert {*answer["things"][-1]} - {"in"} == {"label", "place", "last_seen"}
    few = ask(tmp_path, limit=2)
    assert (len(few["things"]), few["total"]) == (2, 36)
    listed = len(answer["things"])
    how_many = "all" if listed == 36 else f"{listed} of 36"
    assert answer["notes"][0].startswith(f"{how_many} things are listed, in short form")


def test_a_place_in_a_frame_in_which_nothing_is_known_is_named(tmp_path: Path) -> None:
    reply = told_of(tmp_path, looked(0, 10, HERE, ("mug", 3.0, 0.5), in_map=False), where="kitchen")
    assert reply["things"] == []
    assert (
        "kitchen is in map, and things are known in odom: nothing is found there" in reply["notes"]
    )
    windows = {"start": BEGIN, "end": BEGIN + 5, "with_start": BEGIN + 5, "with_end": BEGIN + 10}
    memory = memory_of(tmp_path, limits=NAMED)
    compared = asked(memory, "compare", where="kitchen", **windows)
    assert "kitchen is in map" in str(compared["notes"])
    assert "notes" not in ask(tmp_path)


def random_messages(draw: Random) -> list[Msg]:
    """A robot that looks around while a few things are moved, now and then without a map."""
    places = [(3.0, 0.5), (3.5, -1.0), (-1.5, 1.0), (-2.0, -1.0), (2.5, 2.0)]
    where = {label: draw.choice(places) for label in ("mug", "cup", "book", "Mugs")}
    robot, in_map = HERE, draw.random() < 0.8
    messages: list[Msg] = []
    for at in range(draw.choice((15, 60, 120))):
        if draw.random() < 0.1:
            robot = (draw.choice((1.0, 1.2)), draw.choice((0.0, 0.3)), draw.choice((0.0, math.pi)))
        if draw.random() < 0.03:
            where[draw.choice([*where])] = draw.choice(places)
        seen = [
            (label, x + draw.gauss(0, 0.1), y + draw.gauss(0, 0.1))
            for label, (x, y) in where.items()
            if ((x > robot[0]) == (robot[2] == 0.0)) and draw.random() < 0.8
        ]
        messages += scene(at, robot, seen, in_map=in_map, score=draw.uniform(0.2, 0.9))
    return messages


def test_a_window_in_which_no_detector_published_is_said_to_be_one(tmp_path: Path) -> None:
    blind = [each for each in looked(30, 60, HERE) if "vision" not in each.topic]
    write_splits(tmp_path, looked(0, 30, HERE, ("cup", 3.0, 0.5)) + blind)
    window: dict[str, Any] = {"start": BEGIN + 40, "end": BEGIN + 60}
    silent = "/vision/scene/scene_objects published nothing new in this window: "
    reply = ask(tmp_path, **window)
    assert (reply["things"], reply["frame_id"]) == ([], "map")
    assert reply["notes"][0].startswith(silent)
    notes = ask(tmp_path, label="cup", **window)["notes"]
    assert notes[0].startswith(silent)
    assert notes[-1] == "it was detected 30 times in all, and not once in this window"


def test_what_is_no_near_is_named_with_what_to_give(tmp_path: Path) -> None:
    write_splits(tmp_path, looked(0, 3, HERE, ("mug", 3.0, 0.5)))
    for near in (
        "",
        {},
        {"radius_m": 2},
        {"label": 5},
        {"label": "mug", "x": 1},
        {"x": 1},
        {"label": "mug", "radius_m": -1},
        {"label": "mug", "radius_m": "1"},
        {"label": "mug", "radius": 1},
        [1, 2],
        {"x": [0, 1], "y": [0, 1]},
    ):
        reply = ask(tmp_path, near=near)
        assert reply["error"] == "invalid_arguments"
        assert reply["detail"].startswith(f"near was {abbreviate(near)}; give ")


@pytest.mark.parametrize("label", [None, "7"], ids=["all", "one"])
def test_of_a_marker_without_a_place_it_is_said_that_transforms_may_have_it(
    tmp_path: Path, label: str | None
) -> None:
    tag = make("apriltag_msgs/msg/AprilTagDetection", family="f", id=7, decision_margin=9.0)
    name = "apriltag_msgs/msg/AprilTagDetectionArray"
    messages = looked(0, 30, HERE, ("cup", 3.0, 0.0))
    for at in range(BEGIN * S, (BEGIN + 30) * S, S):
        found = make(name, header=header(at, "camera"), detections=[tag])
        messages.append(Msg("/tags", name, at, found))
    write_splits(tmp_path, messages)
    given: dict[str, Any] = {} if label is None else {"label": label}
    assert "places as transforms: list_frames, get_transform_at" in str(ask(tmp_path, **given))
    assert "as transforms" not in str(ask(tmp_path, label="cup"))


def test_transforms_of_a_sighting_are_decoded_once_for_the_robot_and_the_thing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory, decoded = (
        remembered(tmp_path, looked(0, 30, HERE, ("cup", 3.0, 0.0)), split_s=10),
        list[tuple[str, bytes]](),
    )

    def decode(record: Record) -> object:
        decoded.append((record.channel.topic, record.payload))
        return type(reader).decode(reader, record)

    reader = memory.reader
    monkeypatch.setattr(reader, "decode", decode)
    cup = clause("/vision/scene/scene_objects", "contains", "cup")
    [row] = asked(memory, "find_matches", **cup)["sightings"]
    assert (row["robot"]["x"], row["place"]["x"]) == pytest.approx((1.0, 3.0), abs=0.05)
    transforms = [payload for topic, payload in decoded if topic == "/tf"]
    assert len(transforms) == len({*transforms}) > 0


def test_a_place_that_is_given_as_near_is_said_to_be_one(tmp_path: Path) -> None:
    write_splits(tmp_path, looked(0, 30, HERE, ("cup", 3.0, 0.0)))
    assert '"Kitchen" is a place: ask with it as where' in ask(tmp_path, near="Kitchen")["notes"]
    assert [thing["label"] for thing in ask(tmp_path, where="Kitchen")["things"]] == ["cup"]
    notes = ask(tmp_path, label="cup", near="hall")["notes"]
    assert not any("is a place" in note or "does not count" in note for note in notes)


@in_zone("UTC")
def test_a_thing_with_a_routine_has_its_usual_places(tmp_path: Path) -> None:
    """Every morning on the table, every afternoon elsewhere, for two weeks."""
    table, shelf = ("mug", 3.0, 0.5), ("mug", 3.0, -1.0)
    messages: list[Msg] = []
    first = -BEGIN % 86_400
    for day in range(14):
        for hour in (7, 8, 9, 15, 16, 17):
            at = first + day * 86_400 + hour * 3600
            messages += looked(at, at + 4, HERE, table if hour < 12 else shelf)
    write_splits(tmp_path, messages, split_s=86_400.0)
    evening = BEGIN + first + 13 * 86_400 + 18 * 3600
    [mug] = ask(tmp_path, label="mug", end=evening)["things"]
    afternoon, morning = mug["usually"]
    assert (morning["place"], morning["in"]) == ({"x": 3.0, "y": 0.5}, "kitchen")
    assert (morning["share"], afternoon["share"]) == (0.5, 0.5)
    assert (morning["hours"], afternoon["hours"]) == ("07-10", "15-18")
    assert afternoon["likely_now"] > 0.9
    assert morning["likely_now"] < 0.1
    next_morning = evening - 86_400 + 13 * 3600 + 1800
    [mug] = ask(tmp_path, label="mug", end=next_morning)["things"]
    assert mug["usually"][0]["hours"] == "07-10"


@pytest.mark.parametrize("every", [1, 2])
def test_detections_that_cannot_be_decoded_are_no_silence_of_the_detector(
    tmp_path: Path, every: int
) -> None:
    """All of them, or every other one, have lost their ends."""
    messages = [one for at in range(30) for one in scene(at, (0, 0, 0), [("cup", 1, 0)])]
    for nth in [nth for nth, one in enumerate(messages) if "vision" in one.topic][::every]:
        one = messages[nth]
        messages[nth] = Msg(one.topic, one.type, one.log_time, one.payload[:-20])
    write_splits(tmp_path, messages, 30, "rec")
    memory = memory_of(tmp_path)
    whole = {"start": BEGIN, "end": BEGIN + 15, "with_start": BEGIN + 14.5, "with_end": BEGIN + 29}
    found = asked(memory, "find_things")
    assert found["labels"] == ({"cup": 1} if every == 2 else {})
    for reply in (found, asked(memory, "compare", **whole)):
        assert "messages of /vision/scene/scene_objects could not be decoded, so" in str(reply)
    assert "no things are known" not in str(found)


BENCH: list[Seen] = [("cup", 3.0, 0.5), ("kettle", 3.0, -0.5), ("tray", 3.0, 0.0)]


def dark(start: int, stop: int) -> list[Msg]:
    """It stands before the bench for half a minute, turns to the crate, and so on."""
    turns = (looked(at, at + 30, HERE if at % 60 < 30 else AWAY) for at in range(start, stop, 30))
    return [*chain.from_iterable(turns)]


@pytest.mark.parametrize("later", [BENCH, []], ids=["light again", "still dark"])
def test_in_the_dark_nothing_is_missed(tmp_path: Path, later: list[Seen]) -> None:
    """The detector publishes empty messages, as the robot stands and turns."""
    crate = ("crate", -2.0, 0.0)
    seen = [*looked(0, 30, AWAY, crate, ("pot", -2.0, 0.6)), *looked(30, 61, HERE, *BENCH)]
    reply = told_of(tmp_path, [*seen, *dark(61, 601), *looked(610, 640, HERE, *later)])
    found = {thing["label"]: thing for thing in reply["things"]}
    assert found.keys() == {"crate", "cup", "kettle", "pot", "tray"}
    assert not any("moved_times" in thing for thing in found.values())
    assert not any("not_seen_where_expected" in thing["still_there"] for thing in found.values())
    [blind] = noted(reply, "was blind")
    assert blind.startswith(f"/vision/scene/scene_objects was blind from {BEGIN + 70}")
    windows = {"with_start": BEGIN, "with_end": BEGIN + 59, "start": BEGIN + 70, "end": BEGIN + 600}
    compared = asked(memory_of(tmp_path, limits=NAMED), "compare", **windows)
    assert "not_seen_where_expected" not in compared["things"]
    assert blind in compared["notes"]


ALONG_THE_WALL: list[Seen] = [
    ("anode", 2.0, 0.0),
    ("crack", 8.0, 0.0),
    ("anode", 14.0, 0.0),
    ("crack", 20.0, 0.0),
]


def passes(*seen: list[Seen]) -> list[Msg]:
    """The robot stands half a minute before each place of the wall, and so on."""
    poses = [(x - 1.5, 0.0, 0.0) for _, x, _ in ALONG_THE_WALL]
    return [
        message
        for nth, things in enumerate(seen)
        for pose, start in zip(poses, count(200 * nth, 30))
        for message in looked(
            start, start + 30, pose, *(thing for thing in things if thing[1] == pose[0] + 1.5)
        )
    ]


def test_in_black_water_what_is_alone_in_view_along_a_wall_is_not_missed(tmp_path: Path) -> None:
    """What is far apart is not taken away together, and put back."""
    reply = told_of(tmp_path, passes(ALONG_THE_WALL, [], ALONG_THE_WALL))
    assert reply["labels"] == {"anode": 2, "crack": 2}
    assert not any("moved_times" in thing for thing in reply["things"])
    assert "not_seen_where_expected" not in str(reply["things"])
    assert "was blind from" in str(reply["notes"])
    windows = {"with_start": BEGIN, "with_end": BEGIN + 150}
    dark = {"start": BEGIN + 200, "end": BEGIN + 350}
    compared = asked(memory_of(tmp_path, limits=NAMED), "compare", **windows, **dark)
    assert compared["things"].keys() == {"not_looked_at"}


def test_a_robot_whose_clock_is_behind_the_recorders_saw_things_from_where_it_was(
    tmp_path: Path,
) -> None:
    """It drives past a cup with stamps 1.6 s behind the log times, which agree well enough."""
    poses = [(nth / 5, (nth / 10, 0.0, 0.0)) for nth in range(40)]
    drive = [message for at, pose in poses for message in scene(at, pose, [("cup", 6.0, 0.0)])]
    late = [replace(message, log_time=message.log_time + 16 * S // 10) for message in drive]
    seen_from = [
        told_of(tmp_path / name, messages)["things"][0]["seen_from"]
        for name, messages in (("one clock", drive), ("two", late))
    ]
    assert seen_from[1] == seen_from[0]


def test_two_of_one_label_that_were_taken_away_far_apart_are_missed(tmp_path: Path) -> None:
    pallets = [("pallet", 2.0, 0.0), ("pallet", 14.0, 0.0)]
    reply = told_of(tmp_path, passes(pallets, pallets, []))
    states = [thing["still_there"] for thing in reply["things"]]
    assert len(states) == 2
    assert all("not_seen_where_expected" in state for state in states)


def test_what_was_taken_away_one_by_one_is_missed_on_an_empty_bench(tmp_path: Path) -> None:
    messages = [
        *looked(0, 30, HERE, *BENCH),
        *looked(30, 60, HERE, *BENCH[:2]),
        *looked(60, 90, HERE, *BENCH[:1]),
        *looked(90, 150, HERE),
    ]
    reply = told_of(tmp_path, messages)
    assert len(reply["things"]) == 3
    assert all("not_seen_where_expected" in thing["still_there"] for thing in reply["things"])


def test_a_stamp_that_was_not_filled_in_is_no_time_also_where_time_begins_at_zero(
    tmp_path: Path,
) -> None:
    """Of a simulation: its first seconds agree with a stamp of 0."""
    drive = along_x(0, 60, mps=0.5, hz=10)
    drive += [tf_of(n * S // 10, "odom", "base_link", (n * 0.05, 0.0, 0.0)) for n in range(600)]
    for at in range(4, 8):
        seen = detections(0, ["cup"], at=(4.0 - 0.5 * at, 0.0, 0.0))
        drive.append(replace(seen, log_time=at * S))
    memory = remembered(tmp_path, in_order(drive), limits=QuerySettings(now="latest"))
    [cup] = asked(memory, "find_things", label="cup")["things"]
    assert (cup["place"]["x"], cup["count"]) == (4.0, 4)


@pytest.mark.parametrize("repeated", [(), (("crate", 3.0, 0.0),)], ids=["nothing", "a crate"])
def test_a_detector_that_repeats_one_message_looks_at_nothing(
    tmp_path: Path, repeated: Sequence[Seen]
) -> None:
    """It hangs for over ten minutes, as the robot turns to a cup and to a crate."""
    cup, crate = ("cup", 3.0, 0.5), ("crate", -2.0, 0.0)
    seen = [*looked(0, 30, HERE, cup), *looked(30, 60, AWAY, crate), *looked(60, 90, HERE, cup)]
    [*_, frozen] = scene(90, (1.0, -5.0, 0.0), [*repeated])
    hung = []
    for at in range(90, 790):
        *robot, message = scene(at, HERE if at % 60 < 30 else AWAY, ())
        hung += [*robot, replace(message, body=frozen.body)]
    reply = told_of(tmp_path, [*seen, *hung])
    things = reply["things"]
    [hangs] = noted(reply, "seems to hang")
    assert hangs.startswith(f"/vision/scene/scene_objects repeats its message of {BEGIN + 90}.")
    assert hangs in str(asked(memory_of(tmp_path), "memory_status"))
    assert {each["label"]: each["still_there"] for each in things} == {
        "cup": {"in_view": BEGIN + 89},
        "crate": {"not_looked_at_since": BEGIN + 59},
    }
    assert not any("moved_times" in each or "moves" in each for each in things)


def drive(begin: int, x: float, seen_from: Callable[[float], Sequence[Seen]]) -> list[Msg]:
    """20 s along x, 0.5 m/s, with what is seen from each x."""
    xs = [(at, x + at / 2) for at in range(21)]
    return [m for at, x in xs for m in scene(begin + at, (x, 0.0, 0.0), seen_from(x))]


def test_where_the_robot_passed_with_what_it_carries_is_no_place_of_it(remember: Remember) -> None:
    """It picks a cup up at x = 2, holds it 0.6 m ahead, and puts it down at x = 12.1."""
    before, after = ("cup", 2.0, 0.1), ("cup", 12.1, 0.1)
    carries = drive(30, 1.0, lambda x: [("cup", x + 0.6, 0.05)])
    messages = [*looked(0, 30, HERE, before), *carries, *looked(51, 80, (11.0, 0.0, 0.0), after)]
    memory = remember(messages, split_s=10, limits=NAMED)
    find = partial(asked, memory, "find_things", label="cup")
    [cup] = find()["things"]
    assert (cup["place"]["x"], cup["place"]["y"]) == pytest.approx((12.1, 0.1), abs=0.02)
    assert [stay["place"]["x"] for stay in cup["moved"]] == pytest.approx([2.0, 12.1], abs=0.02)
    carrying = find(end=BEGIN + 45)
    [held] = carrying["things"]
    assert (held["place"]["x"], held["last_seen"]) == (2.0, BEGIN + 29)
    goes_along = f"last at {BEGIN + 45}.000000, to go along with the robot"
    assert goes_along in str(carrying["notes"])
    assert "go along" not in str(find().get("notes"))
    window = {
        "start": BEGIN + 51,
        "end": BEGIN + 80,
        "with_start": BEGIN,
        "with_end": BEGIN + 29,
    }
    changed = asked(memory, "compare", **window)["things"]
    [moved] = changed.pop("moved")
    assert (moved["was"]["x"], moved["is"]["x"]) == pytest.approx((2.0, 12.1), abs=0.05)
    assert changed == {}


@pytest.mark.parametrize("in_sight_m", [3.0, 5.0])
def test_a_thing_past_which_the_robot_carries_another_one_stays_where_it_is(
    tmp_path: Path, in_sight_m: float
) -> None:
    """It picks a cup up at x = 2, carries it past a cup at x = 8, and puts it down at x = 12.1."""
    taken, stands = ("cup", 2.0, 0.1), ("cup", 8.0, 0.8)

    def held_and_beside(x: float) -> list[Seen]:
        held = ("cup", x + 0.6, 0.05)
        return [held, stands] if 0.3 < stands[1] - x < in_sight_m else [held]

    carries = drive(30, 1.0, held_and_beside)
    put_down = looked(51, 80, (11.0, 0.0, 0.0), ("cup", 12.1, 0.1))
    found = told_of(tmp_path, [*looked(0, 30, HERE, taken), *carries, *put_down], label="cup")
    places = [[stay["place"]["x"] for stay in cup.get("moved", ())] for cup in found["things"]]
    assert places == [pytest.approx([2.0, 12.1], abs=0.05), []]
    assert found["things"][1]["place"]["x"] == pytest.approx(8.0, abs=0.05)


def test_a_thing_that_the_robot_took_along_is_one_though_nobody_looked_back(tmp_path: Path) -> None:
    """It grasps a cup before it, turns with it, drives to x = -9, and puts it down there."""
    messages = looked(0, 40, HERE, ("cup", 1.9, 0.0))
    for at in range(21):
        x = 1.0 - at / 2
        messages += scene(40 + at, (x, 0.0, math.pi), [("cup", x - 0.6, 0.0)])
    messages += looked(61, 90, (-9.0, 0.0, math.pi), ("cup", -10.1, 0.1))
    [cup] = told_of(tmp_path, messages, label="cup")["things"]
    assert cup["place"]["x"] == pytest.approx(-10.1, abs=0.05)
    assert cup["moved"][0]["place"]["x"] == pytest.approx(1.9, abs=0.05)


def test_two_that_stand_together_did_not_both_become_the_one_that_is_seen_elsewhere(
    tmp_path: Path,
) -> None:
    """Cups are known to be moved. Behind the robot it sees one, and has not looked back since."""
    messages = looked(0, 30, HERE, ("cup", 3.0, -1.5))
    messages += looked(40, 70, HERE, ("cup", 3.0, 0.97), ("cup", 3.0, 1.03))
    messages += looked(80, 110, AWAY, ("cup", -2.0, 0.0))
    found = told_of(tmp_path, messages, label="cup")
    behind, two = found["things"]
    assert (behind["place"]["x"], two["place"]["x"]) == pytest.approx((-2.0, 3.0), abs=0.05)
    assert two["at_once"] == 2
    assert "not_looked_at_since" in two["still_there"]
    assert found["labels"] == {"cup": 3}


def test_two_labels_that_stand_apart_are_two_things_though_no_message_has_both(
    tmp_path: Path,
) -> None:
    """A narrow camera sees one of them at a time, 40 cm from the other, with 2 cm of noise."""
    noise = Random(5)

    def near(label: str, x: float, y: float) -> Seen:
        return label, x + noise.gauss(0, 0.02), y + noise.gauss(0, 0.02)

    turns = [(at, 0.3 if at // 10 % 8 else -0.3) for at in range(170)]
    messages = [
        scene(
            at, (1.0, 0.0, turn), [near("ball", 2.0, 0.2) if turn > 0 else near("can", 2.0, -0.2)]
        )
        for at, turn in turns
    ]
    found = told_of(tmp_path, [*chain.from_iterable(messages)])
    assert found["labels"] == {"ball": 1, "can": 1}
    assert not any("misread_as" in thing for thing in found["things"])


def test_what_was_only_seen_while_the_robot_carried_it_has_no_place(tmp_path: Path) -> None:
    write_splits(tmp_path, drive(0, 0.0, lambda x: [("cup", x + 0.6, 0.05)]))
    found = ask(tmp_path, label="cup")
    assert (found["things"], found["total"]) == ([], 0)
    note = (
        f"it was seen 21 times, last at {BEGIN + 20}.000000, to go along with the robot, "
        "as what it carries: that is no place of it"
    )
    assert found["notes"] == [note]


def test_what_is_carried_at_two_times_of_one_clock_has_no_place(tmp_path: Path) -> None:
    """As where the clock was set back: every other second is of 20 m farther on."""
    xs = [(at, at / 10 + 20 * (at % 2)) for at in range(40)]
    messages = [m for at, x in xs for m in scene(at, (x, 0.0, 0.0), [("cup", x + 0.6, 0.05)])]
    found = told_of(tmp_path, messages, label="cup")
    assert found["things"] == []
    assert found["notes"][0].startswith("it was seen 40 times, last at ")


def test_what_stands_in_a_row_beside_the_way_is_not_carried(tmp_path: Path) -> None:
    """A camera that looks to the side sees each of them abreast, for 1.2 m of the way."""
    boxes = [("box", 1.0 + 2 * nth, 0.9) for nth in range(5)]
    passes = [
        drive(30 * nth, 0.5, lambda x: [box for box in boxes if abs(box[1] - x) < 0.6])
        for nth in range(3)
    ]
    found = told_of(tmp_path, [*chain.from_iterable(passes)], label="box")
    assert sorted(box["place"]["x"] for box in found["things"]) == [1, 3, 5, 7, 9]


def test_people_who_go_along_are_not_carried(tmp_path: Path) -> None:
    along = told_of(tmp_path, drive(0, 0.0, lambda x: [("person", x + 1.0, 0.2)]), label="person")
    [person] = along["things"]
    assert (person["moves"], person["count"]) == (True, 21)


@pytest.mark.parametrize("far", [1e12, 1.7e308])
def test_things_farther_than_any_place_are_not_placed_and_others_are(
    tmp_path: Path, far: float
) -> None:
    """A detector that says DBL_MAX where it knows no distance."""
    messages: list[Msg] = []
    for at in range(BEGIN * S, (BEGIN + 20) * S, S):
        seen = [("mug", 0.9, (far, 0.0, 0.0)), ("cup", 0.9, (1.0, 0.0, 0.0))]
        messages += [odom(at), tf(at, base(at, 0.0, 0.0, 0.0)), detected(at, seen)]
    reply = told_of(tmp_path, messages, limits=QuerySettings())
    assert reply["labels"] == {"cup": 1}
    assert "could not be placed: mug (20 times" in reply["notes"][0]


T = TypeVar("T")

APART_S = 600
"""Each bag is in ten minutes of its own, which are gathered together."""
THINGS = [(f"thing {number}", 3.0 + number % 3, number / 3) for number in range(8)]


def call(looks: int) -> Call:
    """A call whose time is over after so many looks at the clock."""
    return Call(Deadline.after(looks, map(float, count()).__next__))


def eight_bags(bag_dir: Path, part: float = 1.0) -> Memory:
    """A memory of eight bags, each with a thing of its own; a part of them is stored."""
    moments = [looked(APART_S * n, APART_S * n + 3, HERE, thing) for n, thing in enumerate(THINGS)]
    write_splits(bag_dir, [message for some in moments for message in some])
    return with_store(memory_of(bag_dir, limits=NAMED), bag_dir, part=part)


@pytest.fixture
def fresh(tmp_path: Path) -> Callable[[], Memory]:
    """Makes memories of eight bags, of which two are stored; none knows what another has read."""
    stored = eight_bags(tmp_path, 0.25).scanner
    assert stored is not None
    return lambda: replace(
        memory_of(tmp_path, limits=NAMED), scanner=Scanner(stored.store, tmp_path)
    )


def begin_of(nth: int) -> int:
    """When the ten minutes of a bag begin."""
    return (BEGIN + APART_S * nth) // APART_S * APART_S


def in_time(ask: Callable[[Call], T]) -> list[T]:
    """The answers after some numbers of looks at the clock, without the refusals."""
    answers = []
    for looks in (*range(1, 60, 16), *range(60, 600, 90), 100_000):
        with suppress(QueryTimeoutError):
            answers.append(ask(call(looks)))
    return answers


def test_find_things_answers_from_the_newest_bags_and_says_since_when(
    fresh: Callable[[], Memory],
) -> None:
    answers = in_time(lambda short: find_things(fresh(), short))
    assert len({each.total for each in answers} - {0}) > 2
    for answer in answers:
        newest = {label for label, *_ in THINGS[len(THINGS) - answer.total :]}
        assert {each.label for each in answer.things} == newest
        told = [note for note in answer.notes if "2 of 8 bags" in note]
        assert (answer.total < len(THINGS)) == bool(told)
        first = begin_of(len(THINGS) - answer.total)
        assert all(str(first) in note for note in told), told


def labels_and_notes(memory: Memory) -> tuple[set[str], list[str]]:
    found = find_things(memory, Call(Deadline.after(60)))
    notes = [note for note in found.notes if "too many sightings" in note]
    assert found.all_counted == (not notes)
    return {each.label for each in found.things}, notes


def test_where_a_machine_was_slow_for_a_while_all_are_compared_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is still busy: by the clock each estimate takes ten seconds, but hardly any of its own."""
    crowded, clock = eight_bags(tmp_path), count(0, 10)
    monkeypatch.setattr(known, "_FEWER", 100)
    busy = SimpleNamespace(monotonic=lambda: next(clock), thread_time=time.thread_time)
    monkeypatch.setattr(known, "time", busy)
    with monkeypatch.context() as slow:

        def of_one(seen: JoinedSights, *others: Any) -> Estimate:
            if len(seen.spots) > 1:
                raise known._TakesTooLongError
            return estimation.estimate(seen, *others)

        slow.setattr(known, "estimate", of_one)
        assert len(labels_and_notes(crowded)[0]) == 1
    compared = [len(labels_and_notes(crowded)[0]) for _ in range(4)]
    assert compared == [2, 4, 8, 8]


@patch.object(known, "_MOST_SPOTS", 3)
def test_of_a_window_before_what_was_compared_no_never_is_said(tmp_path: Path) -> None:
    crowded, start_s = eight_bags(tmp_path), float(begin_of(0))
    for labels, seen in (((), THINGS[2:5]), (("thing 0",), ()), (("thing 7",), ())):
        found = find_things(
            crowded, Call(Deadline.after(60)), labels, span=TimeRange(start_s, begin_of(5) - 1)
        )
        assert {thing.label for thing in found.things} == {label for label, *_ in seen}
        assert not found.all_counted
        assert "too many sightings" in str(found.notes)
        text = " ".join(found.notes)
        assert "published nothing" not in text
        assert "not once" not in text
        assert "no detector reported" not in text or f'" from {begin_of(2)}' in text
