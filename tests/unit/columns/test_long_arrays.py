"""Arrays that are too long to be held: whether a condition holds is answered as from the bags."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from random import Random

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from ros2_memory.columns.table import MAX_NUMBERS
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import (
    Msg,
    header,
    make,
    octets,
    point,
    quaternion,
    stamp,
    typestore,
)
from tests.support.memories import Remember, asked, clause, remembered, with_store
from tests.support.noting_reader import NotingReader
from tests.support.tables import table

T0 = 1_790_000_000 * NS_PER_S


def joint_state(nth: int, names: Sequence[str], positions: Sequence[float]) -> Msg:
    at, kind = T0 + nth * NS_PER_S, "sensor_msgs/msg/JointState"
    none = np.zeros(0)
    arrays = {"position": np.array(positions), "velocity": none, "effort": none}
    return Msg("/joints", kind, at, make(kind, header=header(at, ""), name=[*names], **arrays))


def grid() -> Msg:
    """A map of which nothing is known."""
    pose = make("geometry_msgs/msg/Pose", position=point(0, 0), orientation=quaternion(0))
    numbers = {"resolution": 0.05, "width": 10, "height": 10}
    info = make("nav_msgs/msg/MapMetaData", map_load_time=stamp(0), origin=pose, **numbers)
    kind, unknown = "nav_msgs/msg/OccupancyGrid", np.full(100, -1, np.int8)
    return Msg("/data", kind, T0, make(kind, header=header(0, "map"), info=info, data=unknown))


@pytest.mark.parametrize("field", ["position.nope", "positions.nope"])
def test_a_joint_that_no_message_names_is_answered_with_those_that_they_do(
    remember: Remember, field: str
) -> None:
    """Two nodes publish joints of one robot."""
    messages: list[Msg] = []
    for nth in range(0, 20, 2):
        messages.append(joint_state(nth, ["elbow", "wrist"], [nth / 10, 1.0]))
        messages.append(joint_state(nth + 1, ["wheel"], [nth]))
    memory = remember(messages)
    ask = partial(asked, memory, topic="/joints")
    window = {"start": T0 / NS_PER_S, "end": T0 / NS_PER_S + 19}
    note = f"the newest messages of /joints have no {field}, but name elbow, wheel, wrist"
    at_once = {"timestamp": window["end"], "fields": [field]}
    assert note in ask("get_topic_at_time", **at_once)["notes"]
    assert note in ask("get_topic_in_range", fields=[field], **window)["notes"]
    assert note in ask("get_topic_in_range", fields=[field], by="hour", **window)["notes"]
    for how in ({"changes": True}, {"by": "value"}):
        refused = ask("get_topic_in_range", fields=[field], **how, **window)
        assert refused["detail"].endswith(note)
    moved = {"condition_type": "above", "value": 1.0, "field": "positions.elbow"}
    assert note in ask("find_matches", **moved, fields=[field])["notes"]
    elbow = field.replace("nope", "elbow")
    at_once |= {"fields": [elbow], "tolerance_s": 1.5}
    assert ask("get_topic_at_time", **at_once)["value"] == {elbow: 1.8}
    for reply in (
        ask("get_topic_at_time", **at_once),
        ask("get_topic_in_range", fields=[elbow], **window),
        ask("get_topic_in_range", fields=[elbow], changes=True, **window),
        ask("find_matches", **moved, fields=[elbow]),
    ):
        assert "but name" not in str(reply)


@pytest.mark.parametrize("message", [grid(), octets(T0, [7] * 100, "/data")], ids=lambda m: m.type)
def test_what_a_summarised_array_holds_is_not_compared_with_its_size(
    remember: Remember, message: Msg
) -> None:
    memory = remember([message])
    tried = ("above", 50), ("below", 0), ("equals", 100), ("equals", -1), ("contains", 10)
    for condition, number in tried:
        asks = clause("/*", condition, number)
        ask = partial(asked, memory, "find_last_match", **asks)
        assert "ask about data.bytes" in ask(field="data")["detail"]
        if condition == "equals":  # in the whole message
            assert "data is long it is only summarised" in ask()["notes"][0]
        if number == 100:
            assert ask(field="data.bytes")["value"] is not None


def arm(nth: int, names: Sequence[str], positions: Sequence[float]) -> Msg:
    """As `joint_state`, in a type whose array has a length of its own."""
    kind = f"acme_msgs/msg/Arm{len(names)}"
    message = make(kind, names=[*names], positions=np.array(positions))
    return Msg("/joints", kind, T0 + nth * NS_PER_S, message)


@pytest.mark.parametrize(
    ("made", "count", "field"),
    [
        # By the name of its array in the message, too.
        (joint_state, 15, "position.elbow"),
        (joint_state, 15, "positions.elbow"),
        *((arm, n, "positions.elbow") for n in (3, MAX_NUMBERS, MAX_NUMBERS + 1)),
    ],
)
def test_a_joint_is_found_by_its_name_in_whatever_order_joints_are_named(
    remember: Remember,
    made: Callable[[int, Sequence[str], Sequence[float]], Msg],
    count: int,
    field: str,
) -> None:
    kind, random = f"acme_msgs/msg/Arm{count}", Random(count)
    bent, stated = list[float](), list[float]()
    typestore().register(get_types_from_msg(f"string[] names\nfloat64[{count}] positions\n", kind))
    joints, messages = ["elbow", "gripper.left", *map("joint_{}".format, range(count - 1))], []
    for nth in range(40):
        # Where one is missing, another node publishes it.
        names = random.sample(joints[1:] if nth % 4 == 3 or nth == 39 else joints, count)
        angles = {name: random.random() for name in names}
        messages.append(made(nth, names, [*angles.values()]))
        if "elbow" in angles:
            stated.append(angles["elbow"])
        if angles.get("elbow", 0.0) > 0.5:
            bent.append(T0 / NS_PER_S + nth)
    memory = remember(messages)
    states = [is_bent for is_bent, _ in groupby(angle > 0.5 for angle in stated)]
    window = {"start": T0 / NS_PER_S, "end": T0 / NS_PER_S + 40}
    elbow = {"condition_type": "above", "value": 0.5, "field": field}
    left = {**elbow, "field": "positions.gripper.left", "value": 2.0}
    ask = partial(asked, memory, topic="/joints")
    assert ask(name="find_last_match", **elbow)["timestamp"] == bent[-1]
    runs = ask(name="find_matches", **elbow, limit=100)["sightings"]
    assert sum(run["count"] for run in runs) == len(bent)
    assert len(runs) == states.count(True)
    of_elbow = partial(ask, name="get_topic_in_range", fields=[field], **window)
    shown = [angle for _, angle in of_elbow(max_samples=40)["rows"]]
    assert shown == pytest.approx(stated, abs=1e-6)
    of_hour = of_elbow(by="hour")
    ends = table(of_hour)["all"]
    assert ends[f"{field}.min"] == pytest.approx(min(stated), abs=1e-6)
    assert ends[f"{field}.max"] == pytest.approx(max(stated), abs=1e-6)
    assert ask(name="find_last_match", **left) is None
    refused = ask(name="find_last_match", **{**elbow, "field": "positions.knee"})
    assert refused["detail"].startswith("/joints: the values have no field 'positions.knee'")
    assert "their fields are: positions." in refused["detail"]


def test_long_arrays_beside_empty_ones_are_found_where_columns_were_dropped(
    tmp_path: Path,
) -> None:
    names, random, messages = [*map("joint_{}".format, range(12))], Random(1), list[Msg]()
    for nth in range(0, 40, 2):
        angles = [random.uniform(0.6, 1.0) for _ in names]
        messages += [joint_state(nth, names, angles), joint_state(nth + 1, ["gripper"], [])]
    plain = remembered(tmp_path, messages)
    asks = {"condition_type": "above", "value": 0.5, "field": "positions"}
    window = {"start": T0 / NS_PER_S, "end": T0 / NS_PER_S + 40, "fields": ["positions"]}
    for memory in (plain, with_store(plain, tmp_path, share=0.0)):
        ask = partial(asked, memory, topic="/joints")
        assert ask(name="find_last_match", **asks)["timestamp"] == T0 / NS_PER_S + 38
        extremes = ask(name="get_topic_in_range", **window)["extremes"]
        assert extremes["positions"]["max"] > 0.5


def test_joints_that_others_publish_between_end_no_sighting_where_columns_were_dropped(
    tmp_path: Path,
) -> None:
    random, messages = Random(1), list[Msg]()
    for nth in range(0, 80, 2):
        arm, gripper = [random.uniform(0.6, 1.0), random.random()], [random.random()]
        messages += [joint_state(nth, ["elbow", "wrist"], arm)]
        messages += [joint_state(nth + 1, ["gripper"], gripper)]
    plain = remembered(tmp_path, messages)
    bent = {"condition_type": "above", "value": 0.5, "field": "positions.elbow"}
    for memory in (plain, with_store(plain, tmp_path, share=0.0)):
        [bending] = asked(memory, "find_matches", topic="/joints", **bent)["sightings"]
        assert bending["count"] == 40


def test_a_joint_holds_its_value_while_another_publisher_names_others(remember: Remember) -> None:
    messages = list[Msg]()
    for nth in range(0, 12, 2):
        messages += [joint_state(nth, ["lift"], [0.5 * (nth >= 6)])]
        messages += [joint_state(nth + 1, ["elbow", "wrist"], [0.1 * nth, 0.0])]
    memory = remember(messages)
    window = {"topic": "/joints", "start": T0 / NS_PER_S, "end": T0 / NS_PER_S + 11}
    lift = partial(asked, memory, "get_topic_in_range", **window, fields=["positions.lift"])
    held = [(row["seconds"], row["value"]) for row in lift(changes=True)["changes"]]
    assert held == [(6.0, 0), (4.0, 0.5)]
    assert [row[:3] for row in lift(by="value")["rows"]] == [["0", 1, 6.0], ["0.5", 1, 4.0]]
    then = {"topic": "/joints", "timestamp": T0 / NS_PER_S + 7, "fields": ["positions.lift"]}
    for tolerance_s, lifted in ((2.0, 0.5), (0.5, None)):  # beyond it nothing says it
        at_time = asked(memory, "get_topic_at_time", **then, tolerance_s=tolerance_s)
        assert at_time["value"] == {"positions.lift": lifted}
        note = f"positions.lift: last at {T0 / NS_PER_S + 6:.6f}; a longer tolerance_s reaches it"
        assert at_time.get("notes", []) == ([] if lifted else [note])
    bent = {"condition_type": "above", "field": "positions.elbow", "value": 0.3}
    topics = {"condition_topic": "/joints", "value_topic": "/joints"}
    found = asked(memory, "get_value_when", **topics, **bent, fields=["positions.lift"])
    assert (found["value"], found["value_timestamp"]) == (
        {"positions.lift": 0.5},
        T0 / NS_PER_S + 10,
    )


def test_samples_of_a_joint_are_messages_that_name_it(remember: Remember) -> None:
    messages = list[Msg]()
    for nth in range(0, 40, 2):
        messages += [joint_state(nth, ["lift"], [nth / 10]), joint_state(nth + 1, ["elbow"], [0.0])]
    messages += [joint_state(40 + nth, ["elbow"], [0.0]) for nth in range(10)]
    memory = remember(messages)
    begin = T0 / NS_PER_S
    samples = partial(asked, memory, "get_topic_in_range", topic="/joints")
    lift = partial(samples, fields=["positions.lift"])
    few = lift(start=begin, end=begin + 39, max_samples=3)
    assert few["rows"] == [[begin, 0], [begin + 18, 1.8], [begin + 38, 3.8]]
    assert few["total"] == 40
    every = lift(start=begin + 10, end=begin + 15)
    assert [row[1] for row in every["rows"]] == [1, 1.2, 1.4]
    assert every["notes"] == ["3 samples left out, without any of the fields"]
    both = samples(fields=["positions.lift", "positions.elbow"], start=begin, end=begin + 1)
    assert [row[1:] for row in both["rows"]] == [[0, None], [None, 0]]
    none = lift(start=begin + 41, end=begin + 45)
    assert none["reason"] == "between_messages"
    assert none["detail"].endswith("in this time say nothing of positions.lift")


def test_joints_of_a_robot_with_many_are_compared_without_reading_each_message(
    tmp_path: Path,
) -> None:
    """The range of all its joints says nothing of one, and the store has no column of each."""
    names = ["elbow", *map("joint_{}".format, range(15))]
    angles = [0.9 if nth < 120 else 0.1 for nth in range(200)]
    messages = [joint_state(nth, names, [angle, *[2.0] * 15]) for nth, angle in enumerate(angles)]
    reader = NotingReader()
    memory = remembered(tmp_path, messages, reader=reader, recalls=True)
    reader.read.clear()
    bent = clause("/joints", "above", 0.5, field="positions.elbow")
    [sighting] = asked(memory, "find_matches", **bent)["sightings"]
    assert (sighting["count"], sighting["duration_s"]) == (120, 120.0)
    assert len(reader.read) < 20
