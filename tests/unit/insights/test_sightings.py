"""What a search finds: sightings, and texts and states that hold until the next."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate, count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from mcap.writer import Writer

from ros2_memory import queries
from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import Deadline
from ros2_memory.counts.matches import count_matches
from ros2_memory.history import held_values
from ros2_memory.history.conditions import Sought
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.held_values import HeldValues
from ros2_memory.insights import sightings
from ros2_memory.insights.sightings import find_matches
from ros2_memory.tools.replies import as_json
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    battery,
    boolean,
    detections,
    diagnostics,
    header,
    in_order,
    log_entry,
    make,
    octets,
    odom,
    point,
    quaternion,
    text,
    tf,
    tf_of,
    transform,
    write_mcap,
    write_splits,
)
from tests.support.mcap_surgery import raw_mcap
from tests.support.memories import Remember, asked, clause, memory_of, noted, remembered
from tests.support.tables import table
from tests.unit.columns.test_long_arrays import joint_state

S = 10**9
T0 = 1_784_000_000
BEGIN = T0 * S
OBJECTS = "/vision/scene/scene_objects"


@pytest.mark.parametrize(("missed_s", "close"), [(1, 4), (4, 0)])
def test_it_is_said_that_a_detector_missed_it_for_a_moment_only(
    remember: Remember, missed_s: int, close: int
) -> None:
    """Five sightings of 10 s."""
    seen = [
        detections(BEGIN + at * S, [] if at % 10 < missed_s else ["cup"]) for at in range(1, 50)
    ]
    memory = remember(seen)
    cup = clause(OBJECTS, "contains", "cup")
    found = asked(memory, "find_matches", **cup, limit=10)
    notes = noted(found, "missed it for less than 3 s")
    assert found["total"] == 5
    assert [note.split()[0] for note in notes] == ([str(close)] if close else [])
    counts = table(asked(memory, "find_matches", **cup, by="day"))["all"]
    assert counts["count"] == 5 - close


@pytest.mark.parametrize(("score", "lasts_s", "doubted"), [(0.5, 1, 3), (0.5, 2, 0), (0.9, 1, 0)])
def test_most_sightings_of_one_message_and_a_low_score_are_called_doubtful(
    tmp_path: Path, score: float, lasts_s: int, doubted: int
) -> None:
    """Else a person was seen every night."""
    seen = [
        detections(BEGIN + at * S, ["person"] * (at % 20 < lasts_s), score=score)
        for at in range(10, 80)
    ]
    person = {"topic": OBJECTS, "condition_type": "contains", "value": "person"}
    found = asked(remembered(tmp_path, seen), "find_matches", **person)
    assert found["total"] == 3
    note = "of one message alone may be an error of the detector: min_score 0.7 leaves such out"
    assert [one.split()[0] for one in found.get("notes", ()) if note in one] == (
        [str(doubted)] if doubted else []
    )


def test_a_detector_that_publishes_what_is_new_alone_makes_no_single_errors(tmp_path: Path) -> None:
    seen = [detections(BEGIN + at * S, ["person"], score=0.5) for at in (10, 100, 200)]
    found = asked(remembered(tmp_path, seen), "find_matches", **clause(OBJECTS, "equals", "person"))
    assert (found["total"], noted(found, "an error of the detector")) == (3, [])


def test_never_says_which_scores_do_not_count(tmp_path: Path) -> None:
    seen, limits = [detections(BEGIN, ["cup"], score=0.2)], QuerySettings(min_score=0.5)
    memory = remembered(tmp_path, seen, limits=limits)
    note = "detections with a score below 0.5 do not count here, unless min_score is given"
    cup = Sought(OBJECTS, "contains", "cup")
    assert find_matches(memory, Call(), cup).notes == (note,)
    assert find_matches(memory, Call(), cup._replace(min_score=0.5)).notes == ()
    assert note in queries.find_last_match(memory, Call(), cup).notes


@pytest.mark.parametrize(
    ("seen", "word"),
    [
        ("traffic_light", "traffic light"),
        ("traffic_light", "traffic-lights"),
        ("traffic_light", "the Traffic Light"),
        ("traffic light", "traffic_light"),
        ("scissors", "the scissors"),
    ],
)
@pytest.mark.parametrize("condition_type", ["equals", "contains", "contains_word"])
def test_never_names_the_spelling_of_a_label_that_was_found(
    tmp_path: Path, condition_type: str, seen: str, word: str
) -> None:
    memory = remembered(tmp_path, [detections(BEGIN, [seen])])
    note = f'"{word.lower()}" was not found, but "{seen}" was, last at {T0:.6f}'
    sought = Sought(OBJECTS, condition_type, word)
    found = find_matches(memory, Call(), sought)
    assert (found.total, found.notes) == (0, (note,))
    assert note in queries.find_last_match(memory, Call(), sought).notes


@pytest.mark.parametrize("topics", [("/wheel_odom", "/localization/odometry"), ()])
def test_why_no_robot_is_in_a_sighting_is_said_where_topics_have_poses(
    tmp_path: Path, topics: tuple[str, ...]
) -> None:
    poses = [replace(odom(BEGIN), topic=topic) for topic in topics]
    memory = remembered(tmp_path, [*poses, text(BEGIN + S, "lid open")])
    given = clause(text(BEGIN, "").topic, "contains", "lid")
    found = asked(memory, "find_matches", **given)
    assert found["sightings"][0]["robot"] is None
    said = noted(found, "where the robot was is not known")
    assert len(said) == bool(topics)
    assert all(topic in note for note in said for topic in topics)


def test_each_text_that_an_autopilot_reports_is_one_sighting(remember: Remember) -> None:
    """It is a line of a log: the next one, minutes later, does not end it."""
    type_name = "mavros_msgs/msg/StatusText"
    lines = {0: (6, "Takeoff"), 400: (4, "Wind"), 401: (4, "Wind"), 900: (6, "Landed")}
    said = [
        Msg("/texts", type_name, BEGIN + at * S, make(type_name, severity=level, text=words))
        for at, (level, words) in lines.items()
    ]
    memory = remember([*said, odom(BEGIN + 950 * S)])
    given = {"condition_type": "equals", "field": "severity", "value": "WARNING"}
    reply = asked(memory, "find_matches", topic="/texts", **given)
    assert [sighting["first_seen"] - T0 for sighting in reply["sightings"]] == [401, 400]
    assert [sighting["duration_s"] for sighting in reply["sightings"]] == [0.0, 0.0]


def test_fields_of_json_in_a_text_are_conditions_like_others(remember: Remember) -> None:
    """A state machine says its state, and a battery, in a std_msgs/String."""
    states = ['{"state": "docked"}', '{"state": "driving", "battery": {"pct": 40}}', "no JSON"]
    said = [text(BEGIN + at * S, states[at // 10], topic="/state") for at in range(30)]
    counted = [boolean(BEGIN + at * S, at % 5 == 0, topic="/bumper") for at in range(30)]
    memory = remember([*said, *counted, odom(BEGIN)])
    driving = {"topic": "/state", "condition_type": "equals", "field": "data.state"}
    driving["value"] = "driving"
    [found] = asked(memory, "find_matches", **driving)["sightings"]
    assert (found["first_seen"] - T0, found["duration_s"]) == (10, 10.0)
    low = {**driving, "condition_type": "below", "field": "data.battery.pct", "value": 50}
    assert asked(memory, "find_matches", **low)["sightings"][0]["count"] == 10
    bumps = {"topic": "/bumper", "condition_type": "equals", "value": True, "while": [driving]}
    assert asked(memory, "find_matches", **bumps)["total"] == 2
    rows = asked(memory, "find_matches", **low, by="hour")
    assert table(rows)["all"]["seconds"] == 10.0


@pytest.mark.parametrize("period_s", [10, 30])
def test_a_slow_battery_is_low_once_and_for_as_long_as_its_messages_say(
    remember: Remember, period_s: int
) -> None:
    """It says its charge every 10 s, give or take, and VDA 5050 a state at least every 30 s."""
    end = 60 * period_s
    jitter = [0, S // 50, S // 25]
    told = [
        message
        for nth in range(61)
        for at in [BEGIN + nth * period_s * S + jitter[nth % 3]]
        for message in (
            battery(at, 0.5 - nth / 100),
            text(at, f'{{"order": "{nth // 20}", "batteryCharge": {50 - nth}}}', "/state"),
        )
    ]
    bumps = [boolean(BEGIN + at * S, at % 60 == 59, topic="/bumper") for at in range(end)]
    memory = remember(in_order([*told, *bumps]))
    for topic, field, value in (
        ("/battery_state", "percentage", 0.195),
        ("/state", "data.batteryCharge", 19.5),
    ):
        low = clause(topic, "below", value, field=field)
        [found] = asked(memory, "find_matches", **low)["sightings"]
        assert (found["count"], round(found["duration_s"])) == (30, 29 * period_s), topic
        row = table(asked(memory, "find_matches", **low, by="day"))["all"]
        assert (row["count"], round(row["seconds"])) == (1, 29 * period_s), topic
    bumped = clause("/bumper", "equals", True)
    first = clause("/state", "equals", "0", field="data.order")
    found = asked(memory, "find_matches", **bumped, **{"while": first}, limit=50)
    assert found["total"] == 20 * period_s // 60


def test_events_that_come_at_any_time_stay_sightings_of_their_own(remember: Remember) -> None:
    gaps_s = [6 + 7 * nth * nth % 31 for nth in range(40)]
    read = [battery(BEGIN + at * S, 0.1) for at in accumulate(gaps_s)]
    memory = remember([*read, odom(BEGIN + 1000 * S)])
    low = {"topic": "/battery_state", "condition_type": "below", "field": "percentage"}
    apart = [gap for gap in gaps_s[1:] if gap > 10]
    found = asked(memory, "find_matches", **low, value=0.2, limit=50)
    assert found["total"] == 1 + len(apart)


def test_a_field_that_the_newest_json_lacks_is_searched_and_named(remember: Remember) -> None:
    said = [text(BEGIN + at * S, f'{{"state": "idle", "n": {at}}}', "/state") for at in range(9)]
    said.insert(4, text(BEGIN + 3 * S + 1, '{"fall": {"at": "stairs"}}', "/state"))
    memory = remember([*said, odom(BEGIN)])
    ask = partial(asked, memory, "find_matches", topic="/state", condition_type="contains")
    assert ask(field="data.fall.at", value="stairs")["total"] == 1
    never = ask(field="data.stat", value="idle")
    assert never["total"] == 0
    assert "/state: its newest JSON has no value.stat, but value.state, value.n" in never["notes"]


def test_a_frame_that_was_renamed_is_that_of_the_window(tmp_path: Path) -> None:
    """A place in the map of an older day was refused, and one in its later frame was found."""
    at_one = make("geometry_msgs/msg/Pose", position=point(1.0, 0.0), orientation=quaternion(0.0))
    for begin, frame in ((BEGIN, "map"), (BEGIN + 900 * S, "odom")):
        kind = "geometry_msgs/msg/PoseStamped"
        stamped = make(kind, header=header(begin, frame), pose=at_one)
        write_mcap(tmp_path / frame / f"{frame}_0.mcap", [Msg("/pose", kind, begin, stamped)])
    memory = memory_of(tmp_path)
    near = {"topic": "/pose", "condition_type": "near_position"}
    for after_s, frame, other in ((0, "map", "odom"), (900, "odom", "map")):
        begin_s = BEGIN / S + after_s
        ask = partial(asked, memory, "find_matches", **near, start=begin_s - 5, end=begin_s + 5)
        found = ask(value={"x": 1.0, "y": 0.0, "frame_id": frame})
        assert found["total"] == 1
        assert any(f"in {frame} (/pose)" in note for note in found["notes"])
        assert "invalid" in ask(value={"x": 1.0, "y": 0.0, "frame_id": other})["error"]


def test_a_position_of_a_reply_is_compared_in_its_frame_or_not_at_all(tmp_path: Path) -> None:
    moved = tf_of(BEGIN, "map", "odom", (5.0, 0.0, 0.0))
    memory = remembered(tmp_path, [moved, odom(BEGIN, 1.0, 2.0)])
    place: JsonValue = {"x": 1.0, "y": 2.0, "frame_id": "odom"}
    near = partial(Sought, "/odom", "near_position")
    assert len(find_matches(memory, Call(), near(place)).sightings) == 1
    found = queries.find_last_match(memory, Call(), near(place)).found
    assert found is not None
    assert found.frame_id == "odom"
    elsewhere = queries.find_last_match(memory, Call(), near({"x": 6.0, "y": 2.0}))
    assert "within 0.5 m in odom" in elsewhere.notes[-1]
    there: JsonValue = {"x": 6.0, "y": 2.0, "frame_id": "map"}
    for ask in (
        lambda: find_matches(memory, Call(), near(there)),
        lambda: queries.find_last_match(memory, Call(), near(there)),
        lambda: find_matches(
            memory, Call(), Sought("/odom", "contains", "x"), during=(near(there),)
        ),
    ):
        with pytest.raises(InvalidArgumentsError, match=r'is "map".* is odom on /odom.*visits'):
            ask()


def test_the_place_of_a_sighting_is_by_its_newest_message_that_can_be_placed(
    tmp_path: Path,
) -> None:
    late = BEGIN + 2 * S + 1_800_000
    placed = [
        tf(BEGIN + at * S, transform(BEGIN + at * S, *pair, (0.5 * at, 0.0, 0.0)))
        for at in range(3)
        for pair in [("map", "odom"), ("odom", "base_link")]
    ]
    seen = [detections(at, ["cup"]) for at in (BEGIN, BEGIN + S, BEGIN + 2 * S, late)]
    poses = along_x(BEGIN, 3, mps=0.5)
    memory = remembered(tmp_path, [*placed, *seen, *poses])
    for frame_id in (None, "odom"):
        answer = find_matches(memory, Call(), Sought(OBJECTS, "contains", "cup"), frame_id=frame_id)
        [sighting] = answer.sightings
        assert sighting.last == late
        assert sighting.thing is not None
        assert sighting.thing.frame_id == (frame_id or "map")
        assert "is in base_link" not in str(answer.notes)
    far = [detections(late + at * S, ["cup"]) for at in range(6, 8)]
    memory = remembered(tmp_path, [*placed, *poses, *far])
    answer = find_matches(memory, Call(), Sought(OBJECTS, "contains", "cup"))
    assert "no transform leads to map" in str(answer.notes)


@pytest.mark.parametrize(
    ("shown_s", "logged_s", "place"),
    [(10, [12], (1.0, 5.0)), (0, range(20), (4.0, 2.0))],
    ids=["takes two seconds", "hangs"],
)
def test_the_place_of_a_sighting_is_where_the_thing_was_at_the_stamp_of_its_message(
    tmp_path: Path, shown_s: int, logged_s: Sequence[int], place: tuple[float, float]
) -> None:
    """On a robot that turns 9 degrees in a second; one that hangs repeats its first message."""
    turning = []
    for tenth in range(200):
        at = BEGIN + tenth * S // 10
        turn = transform(at, "map", "base_link", (1.0, 2.0, 0.0), math.pi / 200 * tenth)
        turning.append(tf(at, turn))
    shown = detections(BEGIN + shown_s * S, ["cup"], at=(3.0, 0.0, 0.0))
    seen = [replace(shown, log_time=BEGIN + at * S) for at in logged_s]
    memory = remembered(tmp_path, [*turning, *seen])
    [sighting] = find_matches(memory, Call(), Sought(OBJECTS, "contains", "cup")).sightings
    assert sighting.thing is not None
    assert sighting.thing.position[:2] == pytest.approx(place, abs=0.01)
    assert sighting.thing.frame_id == "map"


def test_of_several_of_a_kind_the_best_has_the_place_and_the_score(tmp_path: Path) -> None:
    def seen(label: str, score: float, x: float) -> dict[str, JsonValue]:
        return {"label": label, "score": score, "position": {"x": x, "y": 1.0, "z": 0.0}}

    things = [seen("headphones", 0.4, 1.0), seen("phone", 0.8, 2.0), seen("mug", 0.9, 3.0)]
    memory = remembered(tmp_path, [text(BEGIN, json.dumps(things), topic="/seen")])
    [sighting] = find_matches(memory, Call(), Sought("/seen", "contains", "phone")).sightings
    assert sighting.thing is not None
    assert (sighting.thing.position[0], sighting.score) == (2.0, 0.8)


@pytest.mark.parametrize(("first_pose", "at", "x"), [(1, "last_seen", 2.9), (0, "first_seen", 0.0)])
def test_the_robot_is_where_it_was_last_if_the_first_match_is_before_its_first_pose(
    tmp_path: Path, first_pose: int, at: str, x: float
) -> None:
    """As at the begin of a recording, in which topics come one after the other."""
    poses = [odom(BEGIN + n * S // 10, n / 10) for n in range(first_pose, 30)]
    flags = [boolean(BEGIN + n * S // 10 + 1000, True) for n in range(30)]
    memory = remembered(tmp_path, in_order([*poses, *flags]))
    is_on = clause("/bumper", "equals", True)
    [sighting] = asked(memory, "find_matches", **is_on)["sightings"]
    assert (sighting["robot"]["at"], sighting["robot"]["x"]) == (at, x)


def test_a_frame_among_transforms_of_others_is_seen_until_it_is_not_for_long(
    remember: Remember,
) -> None:
    """Each broadcaster has messages of its own, and none says that the others' frames are gone."""
    messages = [
        tf(at := BEGIN + n * S // 10, transform(at, "odom", "base_link", (0.0, 0.0, 0.0)))
        for n in range(900)
    ]
    for second in (*range(20), *range(60, 80)):
        at = BEGIN + second * S + S // 20
        messages.append(tf_of(at, "odom", "tag_7", (1.0, 0.0, 0.0)))
    memory = remember(messages)
    seen = clause("/tf", "contains", "tag_7")
    newest, oldest = asked(memory, "find_matches", **seen)["sightings"]
    for sighting, first in ((newest, 60.05), (oldest, 0.05)):
        assert (sighting["first_seen"], sighting["count"]) == (T0 + first, 20)
        assert sighting["duration_s"] == pytest.approx(19.0, abs=0.1)
    whole = table(asked(memory, "find_matches", by="day", **seen))["all"]
    assert (whole["count"], whole["seconds"]) == (2, pytest.approx(38.0, abs=0.2))


def running_out(ask: Callable[[Call], Any]) -> Iterator[Any]:
    """What is answered where the clock may be looked at ever more often before the time is over."""
    for looks in range(1, 60):
        try:
            yield ask(Call(Deadline.after(looks, iter(range(10_000)).__next__)))
        except QueryTimeoutError:
            yield None


def test_spells_whose_ends_are_known_count_where_there_is_no_time_to_look_for_all(
    tmp_path: Path,
) -> None:
    times = [BEGIN + t * S for t in range(60)]
    driven = [odom(at, float(at // S % 10)) for at in times]
    memory = remembered(
        tmp_path, [*driven, *(text(at + 1, "calm", topic="/mood") for at in times)], split_s=10
    )
    calm = [Sought("/mood", "equals", "calm")]
    answered: list[bool] = []
    for answer in running_out(
        lambda call: count_matches(
            memory, call, Sought("/odom", "above", 5.5, field="position.x"), by="hour", during=calm
        )
    ):
        answered.append(answer is not None)
        if answer is not None:
            whole = table(as_json(answer, tmp_path))["all"]
            assert whole["seconds"] == whole["count"] * 4 - 1
            is_partial = "is counted: out of time" in str(answer.notes)
            assert (whole["count"] == 6) != is_partial
    # Once no time was left for the end of the newest one.
    assert answered[answered.index(True) :].count(False) <= 1


def test_a_damaged_bag_between_the_oldest_sightings_is_noted_where_time_is_over(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, [boolean(BEGIN + t * S, t % 10 < 5) for t in range(60)])
    bag = tmp_path / "rec" / "rec_3.mcap"
    data = bytearray(bag.read_bytes())
    data[200] ^= 0xFF
    bag.write_bytes(data)
    memory = memory_of(tmp_path)
    spanned = 0
    for answer in running_out(
        lambda call: find_matches(
            memory, call, Sought("/bumper", "equals", value=True), oldest_first=True, limit=2
        )
    ):
        if answer is not None and answer.sightings[0].first < BEGIN + 30 * S:
            assert "damaged" in str(answer.notes)
            spanned += "ran out of time" in str(answer.notes)
    assert spanned


def test_each_line_of_a_log_is_a_sighting_and_levels_have_names(tmp_path: Path) -> None:
    lines = [(20, "begins"), (30, "slow"), (40, "lost"), (30, "slow"), (20, "ends")]
    logged = [log_entry(BEGIN + n * S, level, "nav", said) for n, (level, said) in enumerate(lines)]
    state = diagnostics(BEGIN + 5 * S, motor=(1, "hot"))
    memory = remembered(tmp_path, [*logged, state])

    def texts(kind: str, value: JsonValue) -> list[object]:
        call = {"condition_type": kind, "value": value, "field": "level", "fields": ["msg"]}
        found = asked(memory, "find_matches", topic="/rosout", **call)
        return [each["value"]["msg"] for each in found["sightings"]]

    assert texts("above", 20) == texts("above", "info") == ["slow", "lost", "slow"]
    errors = clause("/rosout", "above", "WARN", field="level")
    found = asked(memory, "find_matches", **errors)
    assert found["quoted"] == ["sightings.matched"]
    assert [each["matched"] for each in found["sightings"]] == [["nav", "lost"]]
    assert texts("equals", "Warning") == texts("equals", 30) == ["slow", "slow"]
    slow = find_matches(
        memory, Call(), Sought("/rosout", "contains", "lo"), oldest_first=True, limit=2
    )
    assert [(each.first, each.messages) for each in slow.sightings] == [
        (BEGIN + S, 1),
        (BEGIN + 2 * S, 1),
    ]
    assert slow.total == 3

    def newest(topic: str, level: str, **more: object) -> Any:
        named = {"topic": topic, "condition_type": "equals", "value": level, **more}
        return asked(memory, "find_last_match", **named)

    assert newest("/rosout", "Error")["value"]["msg"] == "lost"
    for more in ({}, {"field": "status.level"}):
        assert newest("/diagnostics", "WARN", **more)["timestamp"] == T0 + 5
    assert newest("/rosout", "OK", field="status.level")["error"] == "invalid_arguments"


@pytest.mark.parametrize(("period_s", "is_old"), [(0.1, True), (2.0, False)])
def test_a_pose_of_seconds_before_is_said_to_be_old_unless_poses_are_rare(
    tmp_path: Path, *, period_s: float, is_old: bool
) -> None:
    """As of a robot that lost itself while it drove."""
    driven = [
        odom(BEGIN + round(n * period_s * S), x=n * period_s) for n in range(round(20 / period_s))
    ]
    bumps = [boolean(BEGIN + n * S, n in {10, 23}, "/bumper") for n in range(30)]
    memory = remembered(tmp_path, [*driven, *bumps])
    bumped = clause("/bumper", "equals", True)
    found = asked(memory, "find_matches", **bumped)
    assert [row["first_seen"] - T0 for row in found["sightings"]] == [23, 10]
    notes = noted(found, "newest pose was old")
    assert bool(notes) == is_old
    assert all(note.startswith(f"at {T0 + 23}.000000 the newest pose was old") for note in notes)


def test_what_several_nodes_reported_since_before_a_window_does_not_begin_in_it(
    remember: Remember,
) -> None:
    """The camera's error goes on, too, which the lidar's message parts from its own before."""
    messages = []
    for second in range(200):
        at = BEGIN + second * S
        messages.append(diagnostics(at, lidar=(2, "no data")))
        messages.append(diagnostics(at + 1000, camera=(2, "no data")))
        messages.append(diagnostics(at + 2000, motor=(2, "no data") if second > 150 else (0, "")))
    memory = remember(messages)
    counted = asked(
        memory,
        "find_matches",
        topic="/diagnostics",
        condition_type="contains",
        value="no data",
        start=BEGIN / S + 100,
        by="day",
    )
    assert table(counted)["all"]["count"] == 1


def test_no_message_of_another_node_ends_the_state_of_one_that_died(remember: Remember) -> None:
    messages = []
    for second in range(200):
        at = BEGIN + second * S
        messages += [diagnostics(at, lidar=(2, "no data"))] * (second <= 100)
        messages.append(diagnostics(at + 1000, camera=(0, "")))
    memory = remember(messages)
    condition = {"condition_type": "contains", "value": "no data"}
    [died] = asked(memory, "find_matches", topic="/diagnostics", **condition)["sightings"]
    assert (died["duration_s"], died["ended"]) == (100, False)


@pytest.mark.parametrize("split_s", [7.0, 1000.0])
def test_diagnostics_of_one_node_go_on_while_others_report(
    remember: Remember, split_s: float
) -> None:
    def report(second: float, **levels: tuple[int, str]) -> Msg:
        return diagnostics(BEGIN + round(second * S), **levels)

    reported: list[Msg] = []
    for second in range(60):
        door = (2, "blocked") if 20 <= second < 40 else (0, "ok")
        reported += [
            report(second, door=door, lamp=(0, "ok")),
            report(second + 0.5, lidar=(1, "dusty") if 30 <= second < 50 else (0, "ok")),
            report(second + 0.75, motor=(0, "ok")),
        ]
    memory = remember(reported, split_s=split_s)
    ask = partial(asked, memory, topic="/diagnostics")

    def sightings(kind: str, **how: object) -> list[tuple[float, float, int]]:
        found = ask("find_matches", condition_type=kind, **how)
        return [
            (each["first_seen"] - T0, each["duration_s"], each["count"])
            for each in found["sightings"]
        ]

    assert sightings("contains", value="blocked") == [(20.0, 20.0, 20)]
    worse = {"field": "status.level", "value": 0}
    assert sightings("above", **worse) == [(30.5, 20.0, 20), (20.0, 20.0, 20)]
    found = ask("find_matches", condition_type="above", **worse)["sightings"]
    assert [each["matched"] for each in found] == [["lidar", "dusty"], ["door", "blocked"]]
    [[_, _, _, times, seconds, *_]] = ask(
        "find_matches", condition_type="above", **worse, by="day"
    )["rows"]
    assert (times, seconds) == (2, 30.5)
    dusty = clause("/diagnostics", "contains", "dusty")
    motor = sightings("contains", value="motor", **{"while": dusty})
    assert motor == [(30.75, 19.75, 20)]


def test_levels_of_a_foxglove_log_have_names_and_a_recap_says_that_its_errors_are_left_out(
    tmp_path: Path,
) -> None:
    def fill(writer: Writer) -> None:
        schema = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
        channel = writer.register_channel("/rosout", "json", schema)
        for n, level in enumerate([2, 3, 4, 4]):
            line = {"level": level, "message": f"line {n}", "timestamp": {"sec": 1, "nsec": n}}
            writer.add_message(channel, BEGIN + n * S, json.dumps(line).encode(), BEGIN + n * S)

    raw_mcap(tmp_path / "rec" / "rec_0.mcap", fill)
    memory = memory_of(tmp_path)
    asks = {"topic": "/rosout", "condition_type": "above", "field": "level"}
    found = asked(memory, "find_matches", **asks, value="WARN", fields=["message"])
    assert [each["value"]["message"] for each in found["sightings"]] == ["line 3", "line 2"]
    # Under one name with a log of ROS, of another hour.
    write_mcap(
        tmp_path / "ros" / "ros_0.mcap",
        [log_entry(BEGIN + (3600 + n) * S, 10 + 10 * n, "node", f"entry {n}") for n in range(5)],
    )
    memory = memory_of(tmp_path)
    recap = asked(memory, "recap", start=T0, end=T0 + 4)
    [note] = noted(recap, "foxglove.Log")
    assert 'condition_type "equals", field "level", value 4 lists them' in note
    recap = asked(memory, "recap", start=T0 + 3600, end=T0 + 3604)
    assert "foxglove.Log" not in str(recap.get("notes"))


def test_a_topic_that_is_not_recorded_is_named_before_a_level_that_is_no_number(
    tmp_path: Path,
) -> None:
    memory = remembered(tmp_path, [odom(BEGIN), boolean(BEGIN, True)])
    asks = {"condition_type": "above", "field": "level", "value": "WARN"}
    for name, topic, more in (
        ("find_matches", "topic", {}),
        ("find_matches", "topic", {"by": "day"}),
        ("find_last_match", "topic", {}),
        ("get_value_when", "condition_topic", {"value_topic": "/odom"}),
    ):
        missing = asked(memory, name, **asks, **more, **{topic: "/rosout"})
        assert missing["reason"] == "topic_not_recorded"
        refused = asked(memory, name, **asks, **more, **{topic: "/bumper"})
        assert refused["error"] == "invalid_arguments"
        assert "names of levels are not known of std_msgs/msg/Bool" in refused["detail"]


@pytest.mark.parametrize("asked_for", ["ines", "Inês", "INE\u0302S"])
def test_a_name_is_found_with_and_without_its_accents(remember: Remember, asked_for: str) -> None:
    said = [text(BEGIN + n * S, name, topic="/operator") for n, name in enumerate(("Ana", "Inês"))]
    memory = remember(said)
    for kind in ("contains", "contains_word", "equals"):
        given = clause("/operator", kind, asked_for)
        assert asked(memory, "find_last_match", **given)["value"] == {"value": "Inês"}
    given = clause("/operator", "contains", "がか")
    assert asked(memory, "find_last_match", **given) is None


def test_letters_that_json_escapes_are_found(remember: Remember) -> None:
    seen = [json.dumps({"label": label}) for label in ("кружка", "cup", 'the "big" one')]
    said = [text(BEGIN + n * S, word, topic="/seen") for n, word in enumerate(seen)]
    memory = remember(said)
    for value, at in (("Кружка", 0), ('"big"', 2)):
        for condition_type in ("contains", "contains_word"):
            found = find_matches(memory, Call(), Sought("/seen", condition_type, value)).sightings
            assert [sighting.first for sighting in found] == [BEGIN + at * S]


TASKS = [
    (10, "wash the pot"), (40, "wash the pot"), (70, ""), (80, "wash the potato"),
    (120, "use a knife"), (200, "use a butter knife"), (260, ""), (300, "wash the pot"),
]  # fmt: skip
ACTIONS = [(12, "scrub"), (30, "rinse"), (60, ""), (85, "peel"), (110, ""), (130, "cut"), (210, "")]


def written(folder: Path, *, stored: bool = False) -> Memory:
    """Bags with a beat every two seconds, and nothing between 320 and 900 s."""
    said = [text(BEGIN + at * S, words, "/task") for at, words in TASKS]
    said += [text(BEGIN + at * S, words, "/action") for at, words in ACTIONS]
    beats = [odom(BEGIN + at * S, at / 100) for at in range(0, 321, 2)]
    beats += [boolean(BEGIN + at * S, data=at >= 100, topic="/docked") for at in range(0, 320, 2)]
    later = [odom(BEGIN + at * S) for at in range(900, 940, 2)]
    later.insert(5, text(BEGIN + 909 * S, "rest", "/task"))
    write_splits(folder, [*said, *beats], 100, "a")
    write_mcap(folder / "c" / "c_0.mcap", later)
    return memory_of(folder, recalls=stored)


@pytest.fixture(scope="module", params=[False, True], ids=["bags", "store"])
def memory(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Memory:
    return written(tmp_path_factory.mktemp("bags"), stored=request.param)


def test_changes_are_one_row_for_each_value_with_what_held_at_the_start(memory: Memory) -> None:
    window = {"start": T0 + 50, "end": T0 + 130}
    reply = asked(memory, "get_topic_in_range", topic="/task", changes=True, **window)
    assert [(row["start"] - T0, row["value"]) for row in reply["changes"]] == [
        (10, "wash the pot"),
        (80, "wash the potato"),
        (120, "use a knife"),
    ]
    assert "notes" not in reply
    few = asked(memory, "get_topic_in_range", topic="/task", changes=True, max_samples=2, **window)
    assert (few["total"], len(few["changes"])) == (3, 2)
    assert few["notes"][0].startswith("the first 2 of 3 changes: to continue")
    docked = asked(memory, "get_topic_in_range", topic="/docked", changes=True, **window)
    assert [row["value"] for row in docked["changes"]] == [False, True]


@pytest.mark.parametrize(
    ("kind", "number"),
    [("Float32", 0.1), ("Float32", float(2**128 - 2**104)), ("Float64", 1e300)],
)
def test_a_number_is_written_as_everywhere_else(
    remember: Remember, kind: str, number: float
) -> None:
    """A float32 holds 0.10000000149011612 where 0.1 was meant."""
    type_name = f"std_msgs/msg/{kind}"
    said = [make(type_name, data=value) for value in (number, 2.5, number)]
    messages = [Msg("/number", type_name, BEGIN + n * S, body) for n, body in enumerate(said)]
    memory = remember(messages)
    given = {"topic": "/number", "start": T0, "end": T0 + 9}
    samples = asked(memory, "get_topic_in_range", **given)["samples"]
    changes = asked(memory, "get_topic_in_range", **given, changes=True)["changes"]
    rows = asked(memory, "get_topic_in_range", **given, by="value")["rows"]
    shown = [str(row["value"]) for row in changes]
    assert shown == [str(number), "2.5", str(number)]
    assert shown == [str(each["value"]["value"]) for each in samples]
    assert {row[0] for row in rows} == {*shown}


def test_the_size_of_a_long_array_is_no_value_of_it(remember: Remember) -> None:
    said = [octets(BEGIN + n * S, [n] * 60) for n in range(10)]
    memory = remember(said)
    given = {"topic": "/octets", "start": T0, "end": T0 + 9}
    for how in ({"changes": True}, {"by": "value"}):
        reply = asked(memory, "get_topic_in_range", **given, **how, fields=["data"])
        assert "field data of /octets" in reply["detail"]
        reply = asked(memory, "get_topic_in_range", **given, **how, fields=["data.7"])
        assert len(reply["changes"] if "changes" in how else reply["rows"]) == 10


def test_a_search_that_runs_out_of_time_says_from_where_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After four tables of each question."""
    looks = count(1)

    def check(_: HeldValues, at: int) -> None:
        if next(looks) % 5 == 0:
            raise QueryTimeoutError(f"out of time at {at}")

    monkeypatch.setattr(sightings, "says_episodes", lambda *_: True)
    monkeypatch.setattr(HeldValues, "_check", check)
    given = {"topic": "/task", "condition_type": "equals"}
    some = asked(written(tmp_path), "find_matches", **given, value="rest")
    assert (some["at_least"], some["more"]) == (1, True)
    assert f"ran out of time at {T0 + 260}" in some["notes"][0]
    none = asked(written(tmp_path / "again"), "find_matches", **given, value="wash the potato")
    assert (none["error"], none["searched_back_to"]) == ("timeout", T0 + 260)


@patch.object(held_values, "_MOST_CHARS", 40)
def test_values_that_are_too_long_to_be_held_are_named(memory: Memory) -> None:
    window = {"start": T0, "end": T0 + 319}
    reply = asked(memory, "get_topic_in_range", topic="/task", by="value", **window)
    assert [row[0] for row in reply["rows"]] == ["use a butter knife", "wash the pot"]
    [note] = noted(reply, "more than 40 characters")
    assert f"only what is after {T0 + 200}.000000 is counted" in note


def test_the_last_text_of_all_is_found_from_its_own_time_on_and_follows_itself_nowhere(
    tmp_path: Path, remember: Remember
) -> None:
    said = {5: "fetch", 20: "", **dict.fromkeys(range(30, 61), "dock")}
    drive = along_x(T0 * S, 61)
    write_mcap(tmp_path / "run" / "run_0.mcap", drive)
    texts = [text((T0 + at) * S, word) for at, word in said.items()]
    write_mcap(tmp_path / "run" / "run_1.mcap", texts)
    wanted = clause("/chatter", "contains", "dock")
    memory = remember()
    [episode] = asked(memory, "find_matches", **wanted)["episodes"]
    assert (episode["start"], episode.get("next")) == (T0 + 30, None)
    write_mcap(tmp_path / "run" / "run_1.mcap", [*texts[:2], texts[-1]])
    memory = remember()
    for start in (T0 + 30, T0 + 60):
        window = {"start": start, "end": T0 + 70}
        [episode] = asked(memory, "find_matches", **wanted, **window)["episodes"]
        assert episode["start"] == T0 + 60
        changes = asked(memory, "get_topic_in_range", topic="/chatter", changes=True, **window)
        assert [row["value"] for row in changes["changes"]][-1] == "dock"


def test_an_episode_that_began_elsewhere_counts_for_its_time_in_the_place(
    remember: Remember,
) -> None:
    """The robot is beyond x = 5 m from 50 to 149 s and from 249 s on, at 0.1 m/s."""
    x = [*range(100), *range(99, 49, -1), *range(49, 0, -1), *range(1, 101)]
    drive = [odom(BEGIN + at * S, of / 10) for at, of in enumerate(x)]
    words = {10: "mow", 60: "rake", 80: "mow", 170: "", 230: "mow", 280: "", 290: "fetch"}
    said = [text(BEGIN + at * S, word, "/task") for at, word in words.items()]
    docked = [boolean(BEGIN + at * S, at < 20, "/docked") for at in range(0, 299, 2)]
    memory = remember([*drive, *said, *docked])
    place = {"x": [5.0, 20.0], "y": [-1.0, 1.0]}
    mown = clause("/task", "equals", "mow")

    def found(**bounds: object) -> list[tuple[int, int, int, bool]]:
        keys = ("start", "end", "seconds")
        return [
            (*(round(row[key] - T0 * (key != "seconds")) for key in keys), "began_earlier" in row)
            for row in asked(memory, "find_matches", **mown, **bounds)["episodes"]
        ]

    def counted(**bounds: object) -> tuple[int, int]:
        whole = table(asked(memory, "find_matches", **mown, by="hour", **bounds))["all"]
        return whole["count"], round(whole["seconds"])

    assert found() == [(230, 280, 50, False), (80, 170, 90, False), (10, 60, 50, False)]
    inside = [(248, 280, 32, True), (80, 149, 69, False), (50, 60, 10, True)]
    assert found(where=place) == inside
    assert counted(where=place) == (3, 111)
    undocked = clause("/docked", "equals", False)
    assert found(**{"while": undocked})[-1] == (20, 60, 40, True)
    assert counted(**{"while": undocked}) == (3, 180)
    window = {"start": T0 + 100, "end": T0 + 260}
    assert found(where=place, **window) == [(248, 260, 12, True), (100, 149, 49, True)]
    assert counted(where=place, **window) == (1, 61)
    [row, *_] = asked(memory, "find_matches", **mown, where=place)["episodes"]
    assert (row["robot"]["x"], row["previous"]["value"]) == (pytest.approx(5.0, abs=0.1), "mow")


@pytest.mark.parametrize(
    ("words", "are_states"),
    [
        (("IDLE", "DOCKING", "IDLE"), True),
        (("NAV TO GOAL", "E-STOP", "IDLE"), True),
        (("idle", "docking", "idle", "docking"), True),
        (("idle", "docking", "idle"), False),
        (("stop", "stop", "stop"), False),
        (("Bring me the cup", "thanks", "Bring me the cup", "thanks"), False),
        (("IDLE", "12"), False),
        (("PAL-004711", "PAL-004712", "PAL-004711"), False),
        (("ROOM 101", "ROOM 102") * 3, True),
    ],
)
def test_a_state_without_an_empty_text_holds_until_the_next_one(
    remember: Remember, words: Sequence[str], are_states: bool
) -> None:
    """A word every 60 s, and the robot's pose until 300 s."""
    said = [text(BEGIN + (60 * nth + 5) * S, word, "/mode") for nth, word in enumerate(words)]
    drive = along_x(BEGIN, 301, mps=0.1)
    memory = remember([*said, *drive])
    given = clause("/mode", "equals", words[0])
    reply = asked(memory, "find_matches", **given)
    counted = table(asked(memory, "find_matches", **given, by="hour"))["all"]
    starts = [60 * nth + 5 for nth, word in enumerate(words) if word == words[0]]
    assert counted["count"] == len(starts)
    if not are_states:
        assert [row["duration_s"] for row in reply["sightings"]] == [0.0] * len(starts)
        assert "a text on /mode counts for the moment" in reply["notes"][0]
        return
    last = 60 * len(words) - 55
    lengths = [(60.0, True) if at < last else (300.0 - last, False) for at in starts[::-1]]
    found = [(row["seconds"], row.get("ended", True)) for row in reply["episodes"]]
    assert found == lengths
    assert counted["seconds"] == sum(seconds for seconds, _ in lengths)


def test_a_word_that_only_a_key_of_json_has_is_said_to_be_a_key(remember: Remember) -> None:
    said = ['{"sky": "light rain", "rain_mm": 1.2}', '{"sky": "sunny", "rain_mm": 0.0}']
    weather = [text(BEGIN + 300 * nth * S, one, "/weather") for nth, one in enumerate(said)]
    memory = remember(weather)

    def is_noted(value: str, **given: object) -> bool:
        asks = {"topic": "/weather", "condition_type": "contains", "value": value, **given}
        note = "a key of its JSON, whatever its value is: a condition may be on data.rain_mm"
        return note in str(asked(memory, "find_matches", **asks))

    assert is_noted("rain")
    assert not is_noted("rain", end=BEGIN + 10)
    assert not is_noted("sunny")
    assert not is_noted("rain", field="data.sky")


def test_a_rare_number_is_said_to_count_for_its_moment_alone(remember: Remember) -> None:
    """A row of a field each 75 s; a level every second says how long it was below a limit."""
    type_name = "std_msgs/msg/Int32"
    rows = [
        Msg("/row", type_name, BEGIN + 75 * nth * S, make(type_name, data=nth)) for nth in range(4)
    ]
    levels = [
        Msg("/level", type_name, BEGIN + at * S, make(type_name, data=at)) for at in range(300)
    ]
    memory = remember(in_order([*rows, *levels]))
    for given in ({}, {"by": "hour"}):
        row = {"topic": "/row", "condition_type": "equals", "field": "data", "value": 2, **given}
        assert "a number on /row counts for the moment" in str(asked(memory, "find_matches", **row))
        level = {**row, "topic": "/level", "condition_type": "below", "value": 20}
        found = asked(memory, "find_matches", **level)
        assert "counts for the moment" not in str(found)
        # A message that is a number needs no field.
        del level["field"]
        assert asked(memory, "find_matches", **level) == found


def test_where_the_robot_was_is_known_long_after_a_topic_spoke(
    tmp_path: Path, remember: Remember
) -> None:
    """Mode and task are said in the first run, and hold when the robot leaves its dock again."""
    layout = McapLayout(latched=frozenset({"/mode"}))
    for name, begin in (("a", 0), ("b", 100)):
        run = [odom(BEGIN + at * S, at / 10) for at in range(begin, begin + 60)]
        run += [
            boolean(BEGIN + at * S, at < begin + 20, "/docked") for at in range(begin, begin + 60)
        ]
        if name == "a":
            run += [text(BEGIN + 5 * S, "AUTO", "/mode"), text(BEGIN + 6 * S, "", "/task")]
            run += [text(BEGIN + 7 * S, "mow", "/task")]
        write_splits(tmp_path, run, 1000, name, layout=layout)
    memory = remember()
    undocked = clause("/docked", "equals", False)
    given = {"condition_type": "contains", "while": undocked}
    modes = asked(memory, "find_matches", topic="/mode", value="AUTO", **given)["sightings"]
    tasks = asked(memory, "find_matches", topic="/task", value="mow", **given)["episodes"]
    assert [row["robot"] and row["robot"]["x"] for row in modes] == [12.0, 2.0]
    assert [row["robot"]["x"] for row in tasks] == [2.0]


@pytest.mark.parametrize(("since_s", "x"), [(10.05, 15.05), (3.05, 10.4)])
def test_the_robot_is_where_a_thinned_day_has_it_if_a_bag_between_was_deleted(
    tmp_path: Path, remember: Remember, since_s: float, x: float
) -> None:
    """Between two bags of one run there was another, of which poses stayed, or none."""
    first = along_x(BEGIN, 10.5, mps=1, hz=10)
    last = [odom(BEGIN + nth * S // 10, nth / 10) for nth in range(156, 300)]
    last.insert(0, text(BEGIN + 155 * S // 10, "hello"))
    write_mcap(tmp_path / "rec" / "rec_0.mcap", first)
    write_mcap(tmp_path / "rec" / "rec_2.mcap", last)
    day = [odom(BEGIN + round(at * S), at) for at in (since_s + nth for nth in range(6))]
    write_mcap(tmp_path / "memory" / "20260714.thinned.mcap", day)
    memory = remember()
    given = clause("/chatter", "equals", "hello")
    [row] = asked(memory, "find_matches", **given)["sightings"]
    assert row["robot"]["x"] == pytest.approx(x, abs=0.001)


@patch.object(sightings, "MOST_COUNTED", 2)
def test_of_more_episodes_than_are_counted_the_newest_are(memory: Memory) -> None:
    given = clause("/task", "contains", "wash", by="day")
    reply = asked(memory, "find_matches", **given)
    assert (reply["start"], table(reply)["all"]["count"]) == (T0 + 80, 2)
    [note] = noted(reply, "is counted")
    assert note.endswith("is counted: more than 2 episodes; ask about a shorter window")


def test_a_field_that_is_null_now_has_the_values_that_it_held(remember: Remember) -> None:
    """Nothing is in view at the end, as at the begin."""
    seen = [detections(BEGIN + n * S, ["cup"] * (3 <= n < 7)) for n in range(12)]
    memory = remember(seen)
    given = {"topic": "/vision/scene/scene_objects", "start": T0, "end": T0 + 11}
    ask = partial(asked, memory, "get_topic_in_range", **given)
    changes = ask(fields=["detections.0.label"], changes=True)["changes"]
    assert [(row["value"], row["seconds"]) for row in changes] == [
        (None, 3.0),
        ("cup", 4.0),
        (None, 4.0),
    ]
    assert "has no field 'labels'" in ask(fields=["labels"], changes=True)["detail"]


def test_a_latched_value_that_is_said_again_is_one_sighting(
    tmp_path: Path, remember: Remember
) -> None:
    """Each mode is said again after half a minute, and when the robot starts again."""
    said = {5: "AUTO", 35: "AUTO", 65: "MANUAL", 95: "AUTO", 125: "AUTO", 155: "MANUAL"}
    layout = McapLayout(latched=frozenset({"/mode"}))
    for name, begin, end in (("a", 0, 110), ("b", 120, 200)):
        run = [odom(BEGIN + at * S, at / 10) for at in range(begin, end)]
        run += [
            text(BEGIN + at * S, mode, "/mode") for at, mode in said.items() if begin <= at < end
        ]
        write_splits(tmp_path, run, 40, name, layout=layout)
    memory = remember()
    auto = clause("/mode", "equals", "AUTO")
    reply = asked(memory, "find_matches", **auto)
    found = [
        (row["first_seen"] - T0, row["duration_s"], row["count"]) for row in reply["sightings"]
    ]
    assert (found, reply["total"]) == ([(95.0, 60.0, 2), (5.0, 60.0, 2)], 2)

    def counted(since: int) -> tuple[int, float]:
        day = asked(memory, "find_matches", by="day", start=T0 + since, end=T0 + 199, **auto)
        row = table(day)["all"]
        return row["count"], row["seconds"]

    assert counted(0) == (2, 109.0), "for 11 s nothing was recorded"
    assert counted(20) == (1, 94.0), "the first began before"


@pytest.mark.parametrize("every_s", [1, 60])
def test_a_state_that_no_message_ended_is_marked_as_its_value_is_in_changes(
    remember: Remember, every_s: int
) -> None:
    """A crash, with the robot out of its dock since 180 s."""
    docked = [boolean(BEGIN + at * S, at in {60, 120}, "/docked") for at in range(0, 300, every_s)]
    memory = remember([*docked, odom(BEGIN + 300 * S)])
    undocked = clause("/docked", "equals", False)
    last, *_, first = asked(memory, "find_matches", **undocked, limit=9)["sightings"]
    assert (last["ended"], "ended" in first) == (False, False)
    changes = asked(
        memory, "get_topic_in_range", topic="/docked", changes=True, start=T0, end=T0 + 300
    )["changes"]
    assert (changes[-1]["ended"], "ended" in changes[0]) == (False, False)
    window = {"start": T0, "end": T0 + 30}
    [cut] = asked(memory, "find_matches", **undocked, **window)["sightings"]
    assert cut["ended"] is False, "it lasts longer than the window"


@pytest.mark.parametrize(("begun_s", "rooms"), [(19, ["Hall", "Study"]), (19.5, ["Hall"])])
def test_with_has_what_held_up_to_the_last_message_that_repeats_a_state(
    remember: Remember, begun_s: float, rooms: list[str]
) -> None:
    """The next one, a second later, says that it is over, and not since when."""
    bumps = [boolean(BEGIN + n * S, 10 <= n < 20) for n in range(40)]
    entered = {0: "Hall", begun_s: "Study", 30: "Hall"}
    said = [text(BEGIN + round(at * S), room, "/room") for at, room in entered.items()]
    memory = remember([*bumps, *said])
    bumped = clause("/bumper", "equals", True)
    [row] = asked(memory, "find_matches", **{"with": "/room"}, **bumped)["sightings"]
    assert (row["last_seen"], row["duration_s"]) == (T0 + 19, 10.0)
    assert [said["value"] for said in row["with"]] == rooms


def test_with_takes_a_field_of_a_topic_whose_messages_have_several(remember: Remember) -> None:
    messages = [boolean(BEGIN + at * S, 10 <= at < 20, "/bumper") for at in range(30)]
    messages += [battery(BEGIN + at * S, 0.5 if at < 12 else 0.4) for at in range(0, 30, 4)]
    memory = remember(in_order(messages))
    bumped = clause("/bumper", "equals", True)
    by_field = {"with": "/battery_state.percentage", **bumped}
    [row] = asked(memory, "find_matches", **by_field)["sightings"]
    held = [(said["start"] - T0, round(said["value"], 3)) for said in row["with"]]
    assert held == [(0.0, 0.5), (12.0, 0.4)]
    refused = asked(memory, "find_matches", **{"with": "/battery_state", **bumped})
    assert "name one of its fields, as /battery_state.FIELD" in refused["detail"]
    unknown = asked(memory, "find_matches", **{"with": "/battery_state.mood", **bumped})
    assert "mood" in unknown["detail"]


@pytest.mark.parametrize("name", ["/plc.state", "plc.state", "/plc.state.data"])
def test_a_topic_with_a_dot_in_its_name_is_read_beside_another(tmp_path: Path, name: str) -> None:
    said = [text(BEGIN + n * S, "drive" if n < 8 else "dock", "/plc.state") for n in range(20)]
    met = [boolean(BEGIN + n * S + 1, 5 <= n < 7) for n in range(20)]
    asked_for = {"topic": "/bumper", "condition_type": "equals", "value": True, "with": name}
    (row,) = asked(remembered(tmp_path, in_order([*said, *met])), "find_matches", **asked_for)[
        "sightings"
    ]
    assert "drive" in str(row["with"])


@pytest.mark.parametrize("split", [10, 20, 30, 40])
def test_a_message_that_cannot_be_decided_ends_no_sighting_in_another_bag(
    tmp_path: Path, remember: Remember, split: int
) -> None:
    """Between a = 2 and a = 0 a state names b alone: all is as if they were in one bag."""
    states = [*[("a", 0.0)] * 19, ("a", 2.0), ("b", 1.0), *[("a", 0.0)] * 9, *[("a", 2.0)] * 10]
    messages = [joint_state(30 * n, [name], [value]) for n, (name, value) in enumerate(states)]
    for nth, begin in enumerate(range(0, 40, split)):
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages[begin : begin + split])
    sought = clause("/joints", "equals", 2.0, field="position.a")
    rows = asked(remember(), "find_matches", **sought)["sightings"]
    assert [(row["duration_s"], row["ended"]) for row in rows] == [(270.0, False), (0.0, False)]


def test_each_call_of_a_tool_counts_however_soon_it_is_called_again(remember: Remember) -> None:
    """A planner calls a tool again where it failed: two calls are no single one."""
    calls = [(0, "drive"), (40, "grasp"), (48, "grasp"), (70, "grasp"), (90, "say")]
    said = [text(BEGIN + at * S, f'{{"tool": "{name}"}}', "/trace") for at, name in calls]
    beats = [boolean(BEGIN + at * S // 10, data=False, topic="/beat") for at in range(1000)]
    memory = remember(in_order([*said, *beats]))
    sought = {"condition_type": "equals", "field": "data.tool", "value": "grasp"}
    rows = asked(memory, "find_matches", topic="/trace", by="day", **sought)
    assert (table(rows)["all"]["count"], table(rows)["all"]["seconds"]) == (3, 0.0)
    found = asked(memory, "find_matches", topic="/trace", **sought)
    assert {row["duration_s"] for row in found["sightings"]} == {0.0}
    assert [row["last_seen"] - T0 for row in found["sightings"]] == [70.0, 48.0, 40.0]
