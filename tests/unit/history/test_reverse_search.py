"""A search skips what is ruled out, stops at the newest match, and can be gone on with.

Replies of a call that was out of time have what is known, and claim no more than that.
"""

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from mcap.writer import Writer

from ros2_memory import queries
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S, Deadline
from ros2_memory.history.conditions import Sought
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.reverse_search import ReverseSearch
from ros2_memory.insights.fields import describe_type
from ros2_memory.insights.sightings import find_matches
from ros2_memory.results import Match
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    Msg,
    battery,
    boolean,
    detections,
    fix,
    goals,
    header,
    make,
    odom,
    stamp,
    text,
    write_mcap,
)
from tests.support.mcap_surgery import raw_mcap
from tests.support.memories import Remember, asked, clause, memory_of, remembered, with_store
from tests.support.noting_reader import NotingReader

T0_S = 1_700_000_000
T0 = T0_S * NS_PER_S
SCENE = "/vision/scene/scene_objects"


@pytest.fixture
def filled(tmp_path: Path) -> tuple[Memory, NotingReader]:
    """A memory with a store, and what has been read since that was filled."""
    for number, label in enumerate(["scissors", "cup", "cup", "chair", "cup"]):
        at = T0 + number * 10 * NS_PER_S
        found = detections(at + NS_PER_S, [label], at=(number, 0.0, 0.0))
        messages = [odom(at, number), found, boolean(at + 2 * NS_PER_S, data=False)]
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", messages)
    reader = NotingReader()
    memory = memory_of(tmp_path, reader=reader, recalls=True)
    reader.asked.clear()
    return memory, reader


def winch(second: int = 0, state: int = 2) -> Msg:
    kind = "winch_msgs/msg/Winch"
    body = make(kind, state=state, cable=1.0, note="")
    return Msg("/winch", kind, T0 + second * NS_PER_S, body)


@pytest.mark.parametrize(
    ("message", "word", "field", "refusal"),
    [
        (battery(T0, 0.5), "POWER_SUPPLY_STATUS_EMPTY", "power_supply_status", "must be a number"),
        # It is no whole number.
        (winch(), "CABLE_LONGEST", "cable", "must be a number"),
        # Its number may also be a byte of an id.
        (
            goals(T0, {6: 4}),
            *("STATUS_ABORTED", None),
            r"such as STATUS_ABORTED = 6: ask equals on the field of that number$",
        ),
    ],
)
def test_a_constant_that_names_no_number_of_the_field_is_refused(
    tmp_path: Path, message: Msg, word: str, field: str | None, refusal: str
) -> None:
    memory = remembered(tmp_path, [message])
    with pytest.raises(InvalidArgumentsError, match=refusal):
        last(memory, "equals", word, message.topic, field)


def test_a_constant_of_the_message_may_be_named_for_its_number(tmp_path: Path) -> None:
    memory = remembered(tmp_path, [battery(T0, 0.5), text(T0, "POWER_SUPPLY_STATUS_FULL")])

    def newest(
        word: str, topic: str = "/battery_state", field: str = "power_supply_status"
    ) -> Match:
        return last(memory, "equals", f"POWER_SUPPLY_STATUS_{word}", topic, field=field)

    assert at(newest("DISCHARGING")) == 0
    assert newest("CHARGING").found is None
    assert at(newest("FULL", "/chatter", "value")) == 0  # a text stays one


@pytest.mark.parametrize("field", ["fix_status", "status.status"])
def test_a_constant_names_the_number_of_a_field_that_replies_call_otherwise(
    tmp_path: Path, field: str
) -> None:
    statuses = enumerate((2, -1, 0))
    fixes = [fix(T0 + second * NS_PER_S, status=status) for second, status in statuses]
    memory = remembered(tmp_path, fixes)

    assert at(last(memory, "equals", "STATUS_NO_FIX", "/fix", field=field)) == 1
    assert at(last(memory, "equals", "STATUS_GBAS_FIX", "/fix", field=field)) == 0


@pytest.mark.parametrize("newest_first", [False, True])
def test_a_constant_may_be_of_the_first_or_of_the_last_definition_of_a_type(
    tmp_path: Path, *, newest_first: bool
) -> None:
    plain, named = "uint8 fix\n", "uint8 FIX_NONE = 1\nuint8 FIX_RTK = 6\nuint8 fix\n"
    definitions = [named, plain] if newest_first else [plain, named]
    for day, definition in enumerate(definitions):

        def fill(writer: Writer, day: int = day, definition: str = definition) -> None:
            schema = writer.register_schema("gps_msgs/msg/Fix", "ros2msg", definition.encode())
            channel = writer.register_channel("/fix", "cdr", schema)
            for second, each in enumerate([6, 1, 6]):
                at = T0 + (1000 * day + second) * NS_PER_S
                writer.add_message(channel, at, b"\0\1\0\0" + bytes([each]), at)

        raw_mcap(tmp_path / f"day_{day}" / f"day_{day}_0.mcap", fill, profile="ros2")
    memory = memory_of(tmp_path)

    assert at(last(memory, "equals", "FIX_NONE", "/fix", field="fix")) == 1001
    with pytest.raises(InvalidArgumentsError, match=r"must be a number"):
        last(memory, "equals", "FIX_GONE", "/fix", field="fix")


def test_a_field_of_either_type_of_a_topic_is_searched(tmp_path: Path, remember: Remember) -> None:
    level = make("std_msgs/msg/Float32", data=45.5)
    before = [Msg("/level", "std_msgs/msg/Float32", T0, level), text(T0, "45", topic="/said")]
    later = replace(battery(T0 + 10 * NS_PER_S, 0.5), topic="/level")
    write_mcap(tmp_path / "rec" / "rec_0.mcap", before)
    write_mcap(tmp_path / "rec" / "rec_1.mcap", [later])
    memory = remember()

    def reply(tool: str, field: str, limit: float, topic: str = "/level") -> Any:
        given = clause(topic, "above", limit, field=field)
        return asked(memory, tool, **given)

    for field in ("data", "value"):
        assert reply("find_last_match", field, 45)["timestamp"] == T0_S
        assert reply("find_last_match", field, 45, "/*")["timestamp"] == T0_S
        assert reply("find_matches", field, 45)["total"] == 1
        assert reply("find_last_match", field, 46) is None
    assert reply("find_last_match", "percentage", 0.4)["timestamp"] == T0_S + 10
    refused = reply("find_last_match", "percent", 0.4)
    assert refused["error"] == "invalid_arguments"
    assert "std_msgs/msg/Float32 the values have no field 'percent'" in refused["detail"]
    assert "BatteryState the values have no field 'percent'" in refused["detail"]


def test_a_battery_that_stated_fractions_before_percent_is_noted(
    tmp_path: Path, remember: Remember
) -> None:
    days = {"fri": [0.9, 0.7], "sat": [0.6, 0.1], "sun": [83.0, 0.8], "mon": [97.0, 90.0]}
    for nth, (day, charges) in enumerate(days.items()):
        times = (T0 + (1000 * nth + second) * NS_PER_S for second in range(2))
        write_mcap(tmp_path / day / f"{day}_0.mcap", map(battery, times, charges))
    memory = remember()

    def notes(topic: str) -> list[str]:
        given = clause(topic, "below", 20, field="percentage")
        reply = asked(memory, "find_matches", **given)
        return [note for note in reply["notes"] if "fraction" in note]

    said = (
        "percentage of /battery_state is a fraction, from 0 to 1, until 1700001001.000000 and "
        "percent from 1700002000.000000 on: ask about each time with a limit of its own"
    )
    assert notes("/battery_state") == notes("/battery*") == [said]


def test_a_field_of_json_is_refused_with_what_to_ask_instead(tmp_path: Path) -> None:
    found = '{"detections": [{"class": "thistle", "confidence": 0.9, "bbox": [1, 2, 3, 4]}]}'
    memory = remembered(tmp_path, [text(T0, found, "/plants"), text(T0, "up", "/said")])
    given = {"condition_type": "above", "field": "detections.confidence", "value": 0.8}
    refused = asked(memory, "find_matches", topic="/plants", **given)["detail"]
    assert refused.endswith(
        "their fields are: value, a text of JSON, with value.detections, value.detections.class, "
        "value.detections.confidence, value.detections.bbox: contains and contains_word look for "
        "words in it, and min_score leaves out detections"
    )
    assert asked(memory, "find_matches", topic="/said", **given)["detail"].endswith("are: value")


def statistics(second: int, *data: float) -> Msg:
    """A message of a list that is mostly empty, as of faults."""
    kind, at = "statistics_msgs/msg/MetricsMessage", T0 + second * NS_PER_S
    points = [
        make("statistics_msgs/msg/StatisticDataPoint", data_type=1, data=value) for value in data
    ]
    body = make(
        kind,
        measurement_source_name="node",
        metrics_source="age",
        unit="ms",
        window_start=stamp(at),
        window_stop=stamp(at),
        statistics=points,
    )
    return Msg("/statistics", kind, at, body)


def test_a_refusal_names_the_fields_of_what_a_list_has_that_is_empty_now(tmp_path: Path) -> None:
    memory = remembered(tmp_path, [statistics(second) for second in range(9)])
    given = clause("/statistics", "above", 0)
    for field in ("data", "statistics.size"):
        refused = asked(memory, "find_matches", field=field, **given)
        assert refused["detail"].endswith(
            f"the values have no field '{field}'; their fields are: measurement_source_name, "
            "metrics_source, unit, window_start, window_stop, statistics, statistics.data_type, "
            "statistics.data"
        )
    assert asked(memory, "find_matches", field="statistics.data", **given)["total"] == 0
    described = describe_type(memory, Call(), "statistics_msgs/msg/MetricsMessage").fields
    assert ("statistics.data", "number") in described


def test_a_detector_that_sees_nothing_for_long_has_the_fields_of_a_detection(
    tmp_path: Path,
) -> None:
    """Also of a type in the schema map."""
    seen = [detections(T0 + second * NS_PER_S, []) for second in range(9)]
    memory = remembered(tmp_path, seen)
    given = clause(SCENE, "above", 0.5, field="confidence")
    refused = asked(memory, "find_matches", **given)["detail"]
    assert refused.endswith(
        "their fields are: skill, detections, detections.label, detections.score, "
        "detections.point, detections.bbox, detections.point.x, detections.point.y, "
        "detections.point.z"
    )


@pytest.mark.parametrize("points", [(), (7.0,), (7.0, 8.0)])
def test_a_value_in_a_list_is_refused_with_one_of_its_elements(
    tmp_path: Path, points: tuple[float, ...]
) -> None:
    memory = remembered(tmp_path, [statistics(0, *points)])
    window = {"topic": "/statistics", "start": T0_S, "end": T0_S + 9, "changes": True}
    refused = asked(memory, "get_topic_in_range", fields=["statistics.data"], **window)["detail"]
    assert refused.endswith("ask about one element of the list, such as statistics.0.data")


def humidity(ns: int, fraction: float) -> Msg:
    kind = "sensor_msgs/msg/RelativeHumidity"
    stated = make(kind, header=header(ns, ""), relative_humidity=fraction, variance=0.0)
    return Msg("/humidity", kind, ns, stated)


@pytest.mark.parametrize(
    ("stated", "topic", "field"),
    [(battery, "/battery_state", "percentage"), (humidity, "/humidity", "relative_humidity")],
)
def test_percent_of_what_is_stated_as_a_fraction_is_refused(
    tmp_path: Path, stated: Callable[[int, float], Msg], topic: str, field: str
) -> None:
    question = partial(asked, topic=topic, field=field)
    of_fractions = [stated(T0, 0.91), stated(T0 + NS_PER_S, 0.6)]
    memory = remembered(tmp_path / "fraction", of_fractions)
    for tool, kind in itertools.product(("find_last_match", "find_matches"), ("below", "above")):
        refused = question(memory, tool, condition_type=kind, value=80)
        assert refused["detail"].endswith("is a fraction here, from 0 to 1: 80 % is 0.8")
    above = partial(question, condition_type="above")
    assert above(memory, "find_last_match", value=0.8)["timestamp"] == T0_S
    memory = remembered(tmp_path / "percent", [stated(T0, 91.0), stated(T0 + NS_PER_S, 60.0)])
    assert above(memory, "find_last_match", value=80)["timestamp"] == T0_S
    note = f"{field} is percent here: 0.8 is 0.8 %"
    assert note in above(memory, "find_matches", value=0.8)["notes"]
    never = question(memory, "find_last_match", condition_type="below", value=0.8)
    assert (never["timestamp"], never["notes"]) == (None, [note])


@pytest.mark.parametrize("unknown", [math.nan, -1.0])
def test_a_battery_that_states_no_charge_states_it_neither_in_percent_nor_as_a_fraction(
    tmp_path: Path, unknown: float
) -> None:
    memory = remembered(tmp_path, [battery(T0, unknown)])
    assert last(memory, "above", 20, "/battery_state", field="percentage").found is None


@pytest.mark.parametrize("kind", ["contains", "contains_word", "equals"])
@pytest.mark.parametrize("word", ["STATE_HAULING", "hauling"])
def test_never_of_a_word_names_the_constant_that_has_it(
    tmp_path: Path, kind: str, word: str
) -> None:
    memory = remembered(tmp_path, [winch(), text(T0, "up", "/winch_log")])
    note = (
        f'"{word.lower()}" names STATE_HAULING = 2 (winch_msgs/msg/Winch): '
        "ask equals on the field of that number, such as state"
    )
    for topic in ("/winch", "/winch*"):
        sought = Sought(topic, kind, word)
        assert queries.find_last_match(memory, Call(), sought).notes == (note,)
        assert find_matches(memory, Call(), sought).notes == (note,)
        other = Sought(topic, kind, "paying")
        assert queries.find_last_match(memory, Call(), other).notes == ()
    if word == "hauling":
        with pytest.raises(InvalidArgumentsError, match=r"such as STATE_HAULING = 2$"):
            last(memory, kind, word, "/winch", field="state")


def test_a_constant_stands_for_the_number_that_each_type_of_a_topic_gives_it(
    tmp_path: Path,
) -> None:
    """As after an update of the robot; the older type is defined in IDL."""
    idl = (
        f"{'=' * 80}\nIDL: old_msgs/msg/Winch\n"
        "module old_msgs { module msg {\n  module Winch_Constants {\n"
        "    const uint8 STATE_IDLE = 1;\n    const uint8 STATE_HAULING = 4;\n"
        "    const uint8 STATE_BROKEN = 5;\n  };\n"
        "  struct Winch {\n    @default (value=0)\n    uint8 state;\n  };\n}; };\n"
    )

    def fill(writer: Writer) -> None:
        schema = writer.register_schema("old_msgs/msg/Winch", "ros2idl", idl.encode())
        channel = writer.register_channel("/winch", "cdr", schema)
        for nth, state in enumerate([1, 4, 4, 2, 5]):
            at = T0 + nth * NS_PER_S
            writer.add_message(channel, at, bytes([0, 1, 0, 0, state]), at)

    raw_mcap(tmp_path / "old" / "old_0.mcap", fill)
    states = [winch(100 + nth, state) for nth, state in enumerate([0, 2, 2, 4])]
    write_mcap(tmp_path / "new" / "new_0.mcap", states)
    memory = memory_of(tmp_path)

    def times(value: str) -> list[float]:
        given = {"topic": "/winch", "condition_type": "equals", "field": "state"}
        found = asked(memory, "find_matches", **given, value=value)
        return [row["first_seen"] - T0_S for row in found["sightings"]]

    assert times("STATE_HAULING") == times("state_hauling") == [101, 1]
    assert times("STATE_BROKEN") == [4]
    window = {"topic": "/winch", "start": T0_S, "end": T0_S + 200, "fields": ["state"]}
    for how in ({"changes": True}, {"by": "value"}):
        notes = asked(memory, "get_topic_in_range", **window, **how)["notes"]
        assert [note for note in notes if note.startswith("numbers of ")] == [
            "numbers of old_msgs/msg/Winch: STATE_IDLE = 1, STATE_HAULING = 4, STATE_BROKEN = 5",
            "numbers of winch_msgs/msg/Winch: STATE_IDLE = 0, STATE_HAULING = 2",
        ]
    notes = asked(memory, "get_topic_in_range", **{**window, "fields": ["cable"]}, changes=True)
    assert "numbers of" not in str(notes)
    named = r"must be a number, or one of STATE_IDLE = 0, STATE_HAULING = 2$"
    with pytest.raises(InvalidArgumentsError, match=named):
        last(memory, "equals", "STATE_PAYING", "/winch", field="state")


def test_a_field_that_replies_do_not_show_is_refused_with_what_shows_it(tmp_path: Path) -> None:
    memory = remembered(tmp_path, [odom(T0, 1.0)])
    limit = clause("/odom", "above", 0.3)
    for tool in ("find_matches", "find_last_match"):
        refused = asked(memory, tool, **limit, field="pose.covariance.0")
        assert refused["detail"] == (
            "/odom: 'pose.covariance.0' is in the messages of nav_msgs/msg/Odometry, but not among "
            "the fields that are searched; get_topic_in_range shows it with fields, "
            "and its extremes"
        )
        refused = asked(memory, tool, **limit, field="pose.covariances")
        assert "the values have no field 'pose.covariances'" in refused["detail"]
    window = {"topic": "/odom", "start": T0_S, "end": T0_S + 1}
    shown = asked(memory, "get_topic_in_range", **window, fields=["pose.covariance.0"])
    assert shown["rows"] == [[T0_S, 0]]


@pytest.mark.parametrize("value", [5, True])
def test_a_number_is_refused_where_all_are_texts_but_not_of_json_that_may_have_one(
    tmp_path: Path, value: JsonValue
) -> None:
    def fill(writer: Writer) -> None:
        channel = writer.register_channel("/json", "json", 0)
        writer.add_message(channel, T0, b'{"state": "up"}', T0)

    raw_mcap(tmp_path / "rec" / "rec_0.mcap", fill)
    write_mcap(tmp_path / "bag.mcap", [text(T0, "5")])
    memory = memory_of(tmp_path)
    assert last(memory, "equals", value, topic="/json").found is None
    with pytest.raises(InvalidArgumentsError, match="the values are texts"):
        last(memory, "equals", value, topic="/chatter")


def last(
    memory: Memory,
    condition_type: str,
    value: JsonValue,
    topic: str = SCENE,
    field: str | None = None,
) -> Match:
    return queries.find_last_match(
        memory, Call(), Sought(topic, condition_type, value, field=field)
    )


def at(match: Match) -> int:
    assert match.found is not None
    return (match.found.sample.time - T0) // NS_PER_S


def test_a_bag_beyond_its_share_is_searched_by_its_columns(tmp_path: Path) -> None:
    draw = random.Random(7)
    xs = [draw.choice([-1, 1]) * draw.uniform(1, 9) for _ in range(1000)]
    drive = [odom(T0 + n * NS_PER_S // 100, x, draw.uniform(-9, 9)) for n, x in enumerate(xs)]
    plain = remembered(tmp_path, drive)
    memory = with_store(plain, tmp_path, share=0.0)
    whole = McapReader.decode
    with patch.object(McapReader, "decode", autospec=True, side_effect=whole) as decode:
        for each in (memory, plain):
            search = partial(last, each, "near_position", topic="/odom")
            assert search({"x": 0.0, "y": 0.0}).found is None
            assert search({"x": 5.0, "y": 5.0}).found is not None
            runs = find_matches(
                each, Call(), Sought("/odom", "above", 8.9, field="position.x"), limit=99
            )
            assert runs.total == sum(met for met, _ in itertools.groupby(x > 8.9 for x in xs))
    assert decode.call_count < 60


@pytest.mark.parametrize(
    ("topic", "condition_type", "value"),
    [
        (SCENE, "contains", "elephant"),
        ("/*", "contains", "elephant"),
        ("/bumper", "equals", True),
    ],
)
def test_what_never_was_is_answered_without_reading_a_message(
    filled: tuple[Memory, NotingReader], topic: str, condition_type: str, value: JsonValue
) -> None:
    memory, reader = filled
    assert last(memory, condition_type, value, topic=topic).found is None
    assert not any(topics for _, topics in reader.asked)  # but the definitions of types


def test_texts_of_which_it_is_not_known_whether_they_end_are_said_to_be_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for nth in range(4):
        said = [(2, "wash"), (9, "")] if nth % 2 else [(2, "dry"), (9, "wash")]
        messages = [text(T0 + (nth * 3600 + at) * NS_PER_S, word) for at, word in said]
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages)
    over = Deadline.after(0, itertools.count().__next__)
    monkeypatch.setattr(Call, "partial_after", lambda *_: over)
    wash = clause("/chatter", "contains", "wash")
    reply = asked(memory_of(tmp_path), "find_matches", **wash)
    assert len(reply["sightings"]) == 4
    assert "may have held for longer" in str(reply["notes"])


def test_of_recordings_that_overlap_each_message_is_tested_once(tmp_path: Path) -> None:
    """A message that cannot be decoded leaves both without columns: all messages are read."""
    for nth, name in enumerate(("one", "two")):
        said = [text(T0 + n * NS_PER_S // 10 + nth, f"{n} of {name}") for n in range(300)]
        said[7] = replace(said[7], body=bytes([nth]))
        write_mcap(tmp_path / name / f"{name}_0.mcap", said)
    memory, matches = memory_of(tmp_path), ReverseSearch.matches
    never = clause("/chatter", "contains", "nobody")
    with patch.object(ReverseSearch, "matches", autospec=True, side_effect=matches) as tested:
        assert asked(memory, "find_matches", **never)["sightings"] == []
    assert tested.call_count == 600


def test_only_the_bag_of_the_match_is_read(filled: tuple[Memory, NotingReader]) -> None:
    memory, reader = filled
    assert at(last(memory, "contains", "scissors")) == 1
    assert reader.names == ["rec_0.mcap"]
