"""Counts by times of the clock, and by labels as the messages say that the test wrote."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.counts.bins import MOST_BINS, MOST_DAYS, ClockBin, TimeBins, time_bins
from ros2_memory.history.context import QuerySettings
from tests.support.bags import (
    Msg,
    along_x,
    boolean,
    detected,
    detections,
    header,
    in_order,
    log_entry,
    make,
    odom,
    text,
    write_mcap,
)
from tests.support.clocks import in_zone
from tests.support.examples import examples
from tests.support.memories import Remember, asked, clause, memory_of, remembered
from tests.support.moving_map import BEGIN as MAP_BEGIN
from tests.support.moving_map import write_moving_map
from tests.support.rooms import BEGIN, PLACES, ROOMS, SEEN, S, World, asked_of, bounds, draw, write
from tests.support.tables import table

H = 3600
EPOCH = 719163
BERLIN = "CET-1CEST,M3.5.0,M10.5.0/3"
LORD_HOWE = "<+1030>-10:30<+11>-11,M10.1.0,M4.1.0"
HAVANA = "CST5CDT,M3.2.0/0,M11.1.0/1"
TROLL = "<+00>0<+02>-2,M3.5.0/1,M10.5.0/3"
BACK_BEHIND_MIDNIGHT = "NST3:30NDT,M3.2.0/0:01,M11.1.0/0:01"  # St. John's until 2011
ZONES = ("UTC", BERLIN, LORD_HOWE, HAVANA, "<+0545>-5:45", TROLL, BACK_BEHIND_MIDNIGHT)
"""Written out, so that they do not depend on the machine's time zone files."""


def hours(by: ClockBin, *days: str) -> dict[str, float]:
    """How long each bin is from the beginning of one day to that of another, in Berlin."""
    with in_zone(BERLIN):
        start, stop = (int(datetime.fromisoformat(f"2026-{day}").timestamp()) * S for day in days)
        bins = time_bins(TimeWindow(start, stop), by)
    found = bins.lengths([start], [stop]) @ bins.member
    return {name: int(length) / S / H for name, length in zip(bins.names, found, strict=True)}


windows = st.builds(
    lambda start, length: TimeWindow(start, start + length),
    st.integers(1_700_000_000 * S, 1_800_000_000 * S),
    st.integers(1, 50 * 86_400 * S),
)


def bin_of(bins: TimeBins, at: int) -> str:
    return bins.names[int(bins.member[bins.pieces([at])[0]].argmax())]


in_zones = given(
    windows, st.sampled_from(["day", "hour", "weekday"]), st.sampled_from(ZONES), st.data()
)


@in_zones
def test_every_time_is_in_the_bin_of_its_local_time(
    window: TimeWindow, by: ClockBin, name: str, data: st.DataObject
) -> None:
    when = data.draw(st.integers(window.start, window.stop - 1))
    with in_zone(name):
        bins = time_bins(window, by)
        local = datetime.fromtimestamp(when // S, UTC).astimezone()
    expected = {
        "day": local.date().isoformat(),
        "weekday": local.strftime("%A"),
        "hour": f"{local.hour:02d}:00",
    }[by]
    assert bin_of(bins, when) == expected
    assert bins.day_of is not None
    assert bins.day_of[bins.pieces([when])[0]] == local.date().toordinal() - EPOCH


@pytest.mark.parametrize(
    ("name", "by", "begin"),
    [(TROLL, "hour", "2025-10-26T01:30Z"), (BACK_BEHIND_MIDNIGHT, "day", "2025-11-02T03:00Z")],
)
def test_what_clocks_repeat_is_in_order(name: str, by: ClockBin, begin: str) -> None:
    start = int(datetime.fromisoformat(begin).timestamp()) * S
    window = TimeWindow(start, start + 6 * H * S)
    with in_zone(name):
        bins = time_bins(window, by)
        for at in range(window.start, window.stop, 60 * S):
            local = datetime.fromtimestamp(at // S, UTC).astimezone()
            expected = local.date().isoformat() if by == "day" else f"{local.hour:02d}:00"
            assert bin_of(bins, at) == expected


@in_zones
def test_spans_are_shared_out_without_loss(
    window: TimeWindow, by: ClockBin, name: str, data: st.DataObject
) -> None:
    with in_zone(name):
        bins = time_bins(window, by)
    moments = st.integers(window.start - 10**15, window.stop + 10**15)
    spans = [sorted(each) for each in data.draw(st.lists(st.tuples(moments, moments)))]
    starts, stops = [each[0] for each in spans], [each[1] for each in spans]
    inside = sum(
        max(min(stop, window.stop) - max(start, window.start), 0)
        for start, stop in zip(starts, stops, strict=True)
    )
    assert bins.lengths(starts, stops).sum() == inside


def test_a_day_has_23_or_25_hours_where_clocks_are_changed() -> None:
    spring = hours("day", "03-28", "03-31")
    assert spring == {"2026-03-28": 24, "2026-03-29": 23, "2026-03-30": 24}
    assert hours("day", "10-25", "10-26") == {"2026-10-25": 25}
    by_hour = hours("hour", "10-25", "10-26")
    assert (by_hour["02:00"], sum(by_hour.values())) == (2, 25)
    assert "02:00" not in hours("hour", "03-29", "03-30")


@in_zone("UTC")
def test_more_bins_than_a_reply_has_room_for_are_refused() -> None:
    def bins(by: ClockBin, days: int) -> TimeBins:
        return time_bins(TimeWindow(1, days * 86_400 * S), by)

    assert len(bins("day", MOST_BINS).names) == MOST_BINS
    with pytest.raises(InvalidArgumentsError, match=r"by day takes at most 62 days.*by weekday"):
        bins("day", MOST_BINS + 2)
    with pytest.raises(InvalidArgumentsError, match="by hour takes at most 1000 days"):
        bins("hour", MOST_DAYS + 2)


def test_times_in_which_nothing_was_recorded_have_no_rows(tmp_path: Path) -> None:
    noon = round(datetime(2026, 3, 2, 12, 30).astimezone().timestamp())
    for begin in (noon, noon + 5 * 3600, noon + 3 * 86_400):
        at = begin * S
        write_mcap(tmp_path / f"{begin}.mcap", along_x(at, 20, mps=1.0))
    memory = memory_of(tmp_path)

    def rows(by: str) -> tuple[list[str], list[str]]:
        span = {"start": noon, "end": noon + 3 * 86_400 + 60}
        reply = asked(memory, "trajectory_summary", by=by, **span)
        notes = [each for each in reply.get("notes", ()) if each.startswith("no rows")]
        return [each[0] for each in reply["rows"]], notes

    start = "no rows for times in which nothing was recorded: "
    hours, notes = rows("hour")
    assert hours == ["12:00", "17:00"]
    assert notes == [f"{start}00:00 to 11:00, 13:00 to 16:00, 18:00 to 23:00"]
    days, notes = rows("day")
    assert days == ["2026-03-02", "2026-03-05"]
    assert notes == [f"{start}2026-03-03 to 2026-03-04"]
    weekdays, notes = rows("weekday")
    assert weekdays == ["Monday", "Thursday"]
    assert notes == [f"{start}Tuesday to Wednesday"]


NESTED = (
    Place("west", "map", Rectangle(-3.0, 2.0, -3.0, 6.0)),
    Place("east", "map", Rectangle(2.0, 8.0, -3.0, 6.0)),
    Place("start", "map", Circle(0.0, 0.0, 0.6)),
)


def test_an_hour_without_poses_has_no_metres_one_in_which_the_robot_stands_has_zero(
    remember: Remember,
) -> None:
    """It drives for an hour, has no odometry for an hour, and stands for an hour."""
    begin = 1_784_001_600
    messages = [boolean((begin + t) * S, True) for t in range(0, 3 * H, 5)]
    messages += [odom((begin + t) * S, t * 0.01) for t in range(0, H, 5)]
    messages += [odom((begin + t) * S, 36.0) for t in range(2 * H, 3 * H, 5)]
    memory = remember(messages, split_s=600)
    with in_zone("UTC"):
        window = {"start": begin, "end": begin + 3 * H - 1, "by": "hour"}
        rows = asked(memory, "trajectory_summary", **window)["rows"]
    assert [row[-1] for row in rows] == [pytest.approx(36, abs=0.1), None, 0.0]


def test_where_the_robot_was_in_a_short_gap_is_no_recorded_time(tmp_path: Path) -> None:
    """Two runs of the recorder, 4 s apart, of a robot that stands."""
    for run, begin in enumerate((0, 64)):
        poses = [odom(BEGIN + (begin + at) * S, 1.0, 1.0) for at in range(61)]
        write_mcap(tmp_path / f"run_{run}" / f"run_{run}_0.mcap", poses)
    counted = asked(memory_of(tmp_path), "visits", x=1, y=1, radius_m=0.5, by="day")
    whole = table(counted)["all"]
    assert (whole["recorded_s"], whole["placed_s"], whole["minutes"]) == (120.0, 120.0, 2.07)


def test_a_place_in_another_one_counts_to_both_and_a_note_says_so(tmp_path: Path) -> None:
    write_moving_map(tmp_path, 1, seconds=300)
    memory = memory_of(tmp_path, limits=QuerySettings(places=NESTED), recalls=True)
    span = {"start": MAP_BEGIN / S, "end": MAP_BEGIN / S + 300}
    reply = asked(memory, "get_topic_in_range", topic="/odom", by="place", **span)
    rows = table(reply)
    assert sum(row["count"] for name, row in rows.items() if name != "all") > 1500
    assert rows["all"]["count"] == 1500
    assert "places overlap: what is in two of them counts to both" in reply["notes"]


def departs(bag_dir: Path, begin: int) -> None:
    """It is driving from ten seconds after a time on."""
    messages = [boolean((begin + at) * S, at >= 10, topic="/is_driving") for at in range(20)]
    write_mcap(bag_dir / f"{begin}.mcap", messages)


DEPARTED = clause("/is_driving", "equals", True, by="day")


def test_the_first_of_a_day_is_not_known_where_the_window_begins_after_others(
    tmp_path: Path,
) -> None:
    midnight = round(datetime(2026, 3, 2).astimezone().timestamp())
    for day, hour in ((0, 8), (0, 17), (1, 9), (2, 8)):
        departs(tmp_path, midnight + day * 86_400 + hour * 3600)
    memory = memory_of(tmp_path)

    def usual_first(start_h: float) -> tuple[str, str, int]:
        span = {"start": midnight + start_h * 3600, "end": midnight + 3 * 86_400}
        usual = asked(memory, "find_matches", **DEPARTED, **span)["usual_first"]
        return usual["earliest"], usual["latest"], usual["days"]

    assert usual_first(0) == usual_first(7) == usual_first(8) == ("08:00:10", "09:00:10", 3)
    assert usual_first(15) == ("08:00:10", "09:00:10", 2)


def test_an_episode_of_the_evening_before_is_not_the_first_of_a_day(tmp_path: Path) -> None:
    midnight = round(datetime(2026, 3, 2).astimezone().timestamp())
    said = ((22, "charge"), (30, ""), (33, "mow"), (35, ""), (46, "charge"), (54, ""))
    messages = [text((midnight + hour * H) * S, word, "/task") for hour, word in said]
    messages += [odom((midnight + at) * S) for at in range(20 * H, 55 * H, 60)]
    memory = remembered(tmp_path, messages)
    asks = clause("/task", "equals", "charge", by="day")
    span = {"start": midnight + 24 * H, "end": midnight + 48 * H}
    reply = asked(memory, "find_matches", **asks, **span)
    day = table(reply)["2026-03-03"]
    assert (day["count"], day["seconds"]) == (1, 8 * H)
    assert day["first_unix"] == midnight + 46 * H
    assert reply["usual_first"]["earliest"] == reply["usual_first"]["latest"] == "22:00:00"


def test_a_text_that_holds_through_a_gap_has_no_row_for_hours_without_recording(
    tmp_path: Path,
) -> None:
    begin = round(datetime(2026, 3, 2, 8).astimezone().timestamp())
    said = {0: "", 600: "nap"}
    for number, recorded in enumerate((range(H), range(3 * H, 4 * H + 1))):
        messages = [odom((begin + at) * S) for at in recorded]
        texts = [text((begin + at) * S, said[at], "/task") for at in recorded if at in said]
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", [*texts, *messages])
    asks = clause("/task", "equals", "nap", by="hour")
    reply = asked(memory_of(tmp_path), "find_matches", start=begin, end=begin + 4 * H, **asks)
    rows = table(reply)
    assert [*rows] == ["08:00", "11:00", "all"]
    assert rows["08:00"]["last"] == "2026-03-02 08:59:59"
    assert rows["08:00"]["last_unix"] == begin + H - 1
    assert rows["11:00"]["last"] == rows["all"]["last"] == "2026-03-02 12:00:00"
    assert "no rows for times in which nothing was recorded: 09:00 to 10:00" in reply["notes"]


@pytest.mark.parametrize("topic", [SEEN, "/state"])
def test_what_goes_on_from_before_a_window_counts_where_it_began(
    remember: Remember, topic: str
) -> None:
    """A person is in view from 60 to 130 s and from 150 to 160 s, missed for 2 s now and then."""
    messages = []
    for second in range(200):
        at = (BEGIN + second) * S
        is_there = 60 <= second < 130 or 150 <= second < 160
        is_seen = is_there and (topic != SEEN or second not in {100, 101})
        words = ["person"] if is_seen else []
        messages += [odom(at), detections(at, words), text(at, str(words), "/state")]
    memory = remember(messages)
    asks = clause(topic, "contains", "person", by="day")

    def counted(first: float, last: float) -> tuple[int, float | None]:
        span = {"start": BEGIN + first, "end": BEGIN + last}
        whole = table(asked(memory, "find_matches", **asks, **span))["all"]
        return whole["count"], whole["first_unix"] and whole["first_unix"] - BEGIN

    assert counted(0, 199) == (2, 60)
    assert counted(0, 100.5) == (1, 60)
    assert counted(100.5, 199) == (1, 150)
    assert counted(90.5, 120) == (0, None)


def test_the_evening_before_clocks_go_forward_is_no_part_of_the_next_day(tmp_path: Path) -> None:
    with in_zone(BERLIN):
        noon = round(datetime(2026, 3, 29, 10, tzinfo=UTC).timestamp())
        for begin in (noon - 12 * H, noon):  # 23:00 in winter time, and 12:00 in summer time
            departs(tmp_path, begin)
        reply = asked(memory_of(tmp_path), "find_matches", start=noon, end=noon + H, **DEPARTED)
    assert reply["usual_first"]["earliest"] == "12:00:10"


ANY = clause(SEEN, "contains", "", by="label")


def expected(
    world: World, seconds: list[int], label: str, least: float = 0.0
) -> dict[str, Any] | None:
    """What is true of a label in some seconds (ascending), by the rules, one second at a time."""
    seen = {
        second: [score for name, score in world.seen[second] if name == label and score >= least]
        for second in seconds
    }
    at = [second for second in seconds if seen[second]]
    if not at:
        return None
    # A thing that is missed for up to 3 s did not leave.
    begins = [at[0], *(later for earlier, later in pairwise(at) if later - earlier > 3)]
    lasts = [*(earlier for earlier, later in pairwise(at) if later - earlier > 3), at[-1]]
    return {
        "count": len(begins),
        "seconds": sum(last - first for first, last in zip(begins, lasts, strict=True)),
        "first_unix": BEGIN + at[0],
        "last_unix": BEGIN + at[-1],
        "best_score": max(max(seen[second]) for second in at),
        "most_at_once": max(len(seen[second]) for second in at),
    }


def shown(row: dict[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in row if key not in {"first", "last"}}


@settings(max_examples=examples(10))
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    rooms=st.lists(st.sampled_from([*ROOMS]), max_size=2, unique=True),
    least=st.sampled_from([0.0, 0.6]),
)
def test_each_label_has_what_the_messages_say_of_it_while_the_robot_was_there(
    seed: int, stored: bool, rooms: list[str], least: float
) -> None:
    world = draw(seed, 120)
    with TemporaryDirectory() as name:
        bags = Path(name)
        write(world, bags)
        memory = asked_of(bags, stored=stored)
        where = {"where": bounds(*rooms)} if rooms else {}
        reply = asked(memory, "find_matches", min_score=least, **where, **ANY)
    seconds = [nth for nth in range(120) if not rooms or world.room(nth) in rooms]
    truth = {label: expected(world, seconds, label, least) for label in PLACES}
    rows = table(reply)
    whole = rows.pop("all")
    assert {label: shown(row) for label, row in rows.items()} == {
        label: pytest.approx(row) for label, row in truth.items() if row is not None
    }
    assert whole["count"] == sum(row["count"] for row in rows.values())
    counts = [row["count"] for row in rows.values()]
    assert counts == sorted(counts, reverse=True)


def test_a_label_that_two_fields_may_name_is_one_label(remember: Remember) -> None:
    """Once a blank label made a label of the other field, 0 cups were in view at once."""
    kind, named = "own_msgs/msg/NamedTwice", [[("cup", "cup")] * 3, [("", "box"), ("", "cup")]]
    messages = []
    for nth, names in enumerate(named):
        seen = [make(kind, label=label, class_name=name, score=0.9) for label, name in names]
        body = make(f"{kind}Array", detections=seen)
        messages.append(Msg(SEEN, f"{kind}Array", (BEGIN + nth) * S, body))
    rows = table(asked(remember(messages), "find_matches", **ANY))
    assert (rows["cup"]["most_at_once"], rows["box"]["most_at_once"]) == (3, 1)


def test_spellings_of_a_label_are_one_row(remember: Remember) -> None:
    """A detector that writes "Mug" in some messages had 4 rows of mugs, and thousands of sights."""
    labels = ["mug", "Mug", "mug", "mugs", "mug", "coffee mug"]
    messages = [detections((BEGIN + 4 * nth) * S, [label]) for nth, label in enumerate(labels)]
    messages.append(detections((BEGIN + 24) * S, ["mug", "Mug"]))
    memory = remember(messages, limits=QuerySettings(labels={"mug": ["coffee mug"]}))
    rows = table(asked(memory, "find_matches", **ANY))
    assert [*rows] == ["mug", "all"]
    row = rows["mug"]
    assert (row["count"], row["seconds"], row["most_at_once"]) == (1, 24.0, 2)


@pytest.mark.parametrize(
    "given",
    [
        {"condition_type": "above", "value": 0.5, "field": "detections.score"},
        {"value": "cup", "field": "detections.label"},
        {"condition_type": "near_position", "value": {"x": 1, "y": 1}},
    ],
)
def test_what_is_no_condition_on_labels_is_refused(tmp_path: Path, given: dict[str, Any]) -> None:
    memory = remembered(tmp_path, [detections(BEGIN * S, ["cup"])])
    reply = asked(memory, "find_matches", **{**ANY, **given})
    assert reply["error"] == "invalid_arguments"
    assert "by label takes labels of detections: give condition_type contains" in reply["detail"]


def test_counts_of_labels_say_that_they_are_of_detections_alone(tmp_path: Path) -> None:
    """Else "never" is read of what is said, as of the ids of people who are tracked."""
    said = [log_entry(BEGIN * S, 20, "tracker", "maria"), odom((BEGIN + 1) * S)]
    memory = remembered(tmp_path, said)
    reply = asked(memory, "find_matches", **{**ANY, "topic": "/rosout", "value": "maria"})
    assert "leave by out to search all that /rosout said" in str(reply["notes"])


T = 1_790_000_000


def test_labels_in_json_are_compared_one_by_one(remember: Remember) -> None:
    both, butter = ["Knife", "butter knife"], ["butter knife"]
    seen = [both if at < 20 else butter for at in range(40)]
    messages = [
        text((T + at) * NS_PER_S, json.dumps({"objects": [{"label": label} for label in labels]}))
        for at, labels in enumerate(seen)
    ]
    memory = remember(messages, split_s=10)
    for kind, value in (("equals", "knife"), ("contains_word", "knife -butter")):
        sought = clause("/chatter", kind, value)
        answer = asked(memory, "find_matches", **sought)
        assert [each["count"] for each in answer["sightings"]] == [20]
        newest = asked(memory, "find_last_match", **sought)
        assert newest["timestamp"] == T + 19


def tags(at: int, *numbers: int) -> Msg:
    kind = "apriltag_msgs/msg/AprilTagDetection"
    seen = [make(kind, family="tag36h11", id=each, decision_margin=60.0) for each in numbers]
    name = "apriltag_msgs/msg/AprilTagDetectionArray"
    found = make(name, header=header(at, "camera"), detections=seen)
    return Msg("/detections", name, at, found)


def cups(at: int, *numbers: int) -> Msg:
    things = [("cup" if each == 7 else "pot", 0.9, (1.0, 0.0, 0.0)) for each in numbers]
    return detected(at, things, topic="/detections")


def test_how_long_a_key_of_a_text_of_json_held_is_counted(remember: Remember) -> None:
    """As of deliveries, each of which has some states; the newest text is an empty one."""
    states = [("D1", "loading"), ("D1", "done"), (), ("D2", "loading"), ("D2", "failed"), ()]
    why = [{}, {"why": "lost"}, {}, {}, {}, {}]
    reports = [
        json.dumps({"id": state[0], "is": {"state": state[1]}} | why[at]) if state else ""
        for at, state in enumerate(states)
    ]
    said = [text((T + 10 * at) * S, report) for at, report in enumerate(reports)]
    bumped = [boolean((T + at) * S, at == 33) for at in range(60)]
    window = {"start": T, "end": T + 59}
    memory = remember([*said, *bumped])
    ask = partial(asked, memory, "get_topic_in_range", topic="/chatter", **window)
    for field in ("data.id", "value.id"):
        rows = ask(by="value", fields=[field])["rows"]
        assert [row[:3] for row in rows] == [["D1", 1, 20.0], ["D2", 1, 20.0]]
    changes = ask(changes=True, fields=["data.is.state"])["changes"]
    assert [change["value"] for change in changes] == ["loading", "done", "loading", "failed"]
    bump = clause("/bumper", "equals", True)
    reply = asked(memory, "find_matches", **bump, **{"with": "/chatter.data.id"})
    assert reply["sightings"][0]["with"][0]["value"] == "D2"
    assert "has no field" in ask(by="value", fields=["data.name"])["detail"]
    changes = ask(changes=True, fields=["data.why"])["changes"]
    assert [change["value"] for change in changes] == [None, "lost", None]


@pytest.mark.parametrize(
    ("said", "path", "values"),
    [
        ([{"in": '{"is": "on"}'}, {"in": '{"is": "off"}'}], "data.in.is", ["on", "off"]),
        (
            [{"tasks": [{"is": "new"}]}, {"tasks": [1, {"is": "end"}]}],
            "data.tasks.-1.is",
            ["new", "end"],
        ),
        ([{"tasks": [{"is": "new"}]}, {"tasks": [{"is": "end"}]}], "data.tasks.is", ["new", "end"]),
        ([{"at": {"x": 1, "y": 2, "z": 0}}, {"at": {"x": 3, "y": 2, "z": 0}}], "data.at.0", [1, 3]),
        ([{"error": None}, {"id": "D1"}], "data.error", [None]),
    ],
    ids=["text of JSON in it", "last element", "only element", "axis", "null"],
)
def test_what_a_condition_finds_in_a_text_of_json_has_a_length(
    tmp_path: Path, said: list[object], path: str, values: list[object]
) -> None:
    reports = [text((T + 10 * at) * S, json.dumps(report)) for at, report in enumerate(said)]
    memory = remembered(tmp_path, reports)
    window = {"topic": "/chatter", "start": T, "end": T + 59}
    reply = asked(memory, "get_topic_in_range", changes=True, fields=[path], **window)
    assert [change["value"] for change in reply["changes"]] == values


def test_what_could_not_be_decoded_ends_what_was_known(remember: Remember) -> None:
    """b held for 20 s, though what was said meanwhile is not known, and nothing told so."""
    torn = Msg("/chatter", "std_msgs/msg/String", (T + 20) * S, b"")
    said = [text((T + at) * S, word) for at, word in ((0, "a"), (10, "b"), (30, "a"), (60, "c"))]
    memory = remember(in_order([*said, torn]))
    ask = partial(asked, memory, "get_topic_in_range", topic="/chatter")
    reply = ask(start=T, end=T + 59, by="value")
    assert [row[:3] for row in reply["rows"]] == [["a", 2, 39.0], ["b", 1, 10.0]]
    assert reply["notes"][0].startswith("messages of /chatter could not be decoded")
    changes = ask(start=T, end=T + 40, changes=True)["changes"]
    assert [change.get("ended", True) for change in changes] == [True, False, True]
    assert "notes" not in ask(start=T + 40, end=T + 59, by="value")
    assert ask(start=T + 18, end=T + 25, changes=True)["total"] == 1
    assert ask(start=T + 20, end=T + 25, changes=True)["reason"] == "undecodable"


def test_numbers_that_replies_show_alike_are_one_value(tmp_path: Path) -> None:
    """0.1 + 0.2 is another float than 0.3: 0.3 had two rows, and changed to 0.3."""
    kind, shown = "std_msgs/msg/Float64", [0.3, 0.1 + 0.2, 0.3, 0.5]
    said = [Msg("/limit", kind, (T + at) * S, make(kind, data=shown[at % 4])) for at in range(9)]
    ask = partial(asked, remembered(tmp_path, said), "get_topic_in_range", topic="/limit")
    window = {"start": T, "end": T + 8}
    rows = ask(by="value", **window)["rows"]
    assert [row[:3] for row in rows] == [["0.3", 3, 6.0], ["0.5", 2, 2.0]]
    changes = ask(changes=True, **window)["changes"]
    assert [(change["value"], change["seconds"]) for change in changes] == [
        (0.3, 3.0),
        (0.5, 1.0),
        (0.3, 3.0),
        (0.5, 1.0),
        (0.3, 0.0),
    ]


def test_a_thing_in_view_as_a_window_begins_or_ends_is_so_whatever_else_is_asked(
    remember: Remember,
) -> None:
    """With a score or a place that it had all the time it counted as come into view."""
    seen = [detections((T + at) * S, ["cup"] if at < 40 else []) for at in range(60)]
    poses = [odom((T + at) * S, 0.0, 0.0) for at in range(60)]
    memory = remember([*seen, *poses], split_s=20)
    sought = clause("/vision/*/*", "contains", "cup", by="hour")
    here: dict[str, Any] = {"where": {"x": [-1, 1], "y": [-1, 1]}}
    for scope in ({}, {"min_score": 0.5}, here):
        for start, end, *expected in (
            (20.5, 59, 0, 18.5),
            (20.5, 30.5, 0, 10.0),
            (-5, 59, 1, 39.0),
            (40.5, 59, 0, 0.0),
        ):
            window = {"start": T + start, "end": T + end}
            whole = table(asked(memory, "find_matches", **sought, **window, **scope))["all"]
            assert [whole["count"], whole["seconds"]] == expected


@pytest.mark.parametrize(
    ("write_seen", "field", "value"),
    [(tags, "detections.id", 7), (cups, "detections.label", "cup")],
    ids=["tag", "label"],
)
def test_a_thing_that_a_detector_misses_for_a_moment_counts_once(
    remember: Remember, write_seen: Callable[..., Msg], field: str, value: str | int
) -> None:
    """Two visits of 30 s, in which every fifth message misses it: the field names what is seen."""
    seen = [
        write_seen((T + at) * NS_PER_S, *([4] if at % 5 == 2 else [4, 7] if at % 60 < 30 else []))
        for at in range(120)
    ]
    memory = remember(seen, split_s=40)
    sought = clause("/detections", "equals", value, field=field)
    whole = table(asked(memory, "find_matches", **sought, by="day"))["all"]
    assert (whole["count"], whole["seconds"]) == (2, pytest.approx(58, abs=4))


def test_a_topic_that_changed_its_type_counts_what_it_said_as_either(remember: Remember) -> None:
    """A text for 100 s, then a boolean; true for 10 s of 20, and nothing or false in between."""
    said = [
        text((T + at) * NS_PER_S, "true" if at % 20 < 10 else "no", "/on")
        for at in range(0, 100, 2)
    ]
    said += [boolean((T + at) * NS_PER_S, at % 20 < 10, "/on") for at in range(100, 200, 2)]
    said += [odom((T + at) * NS_PER_S, 1.0, 0.0, topic="/on") for at in range(200, 220, 2)]
    memory = remember(said, split_s=40)
    window = {"topic": "/on", "start": T, "end": T + 198}
    on = {**window, "condition_type": "contains", "value": "true"}
    found = asked(memory, "find_matches", **on, limit=20)
    whole = table(asked(memory, "find_matches", **on, by="day"))["all"]
    assert found["total"] == 10
    assert (whole["count"], whole["seconds"]) == (10, 100)
    changes = asked(memory, "get_topic_in_range", **window, changes=True)
    assert [row["value"] for row in changes["changes"]] == ["true", "no"] * 5 + [True, False] * 5
    values = asked(memory, "get_topic_in_range", **window, by="value")
    assert values["all"][0] == 20
    notes = asked(memory, "get_topic_in_range", **window)["notes"]
    kinds = "std_msgs/msg/String, std_msgs/msg/Bool"
    assert f"the topic was recorded under several types: {kinds}" in notes
