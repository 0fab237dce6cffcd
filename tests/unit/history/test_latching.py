"""Latched is what holds until the next message, unless messages of it may have been deleted."""

from collections.abc import Collection
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Latching, Memory, QuerySettings
from ros2_memory.index.segment import Segment, TopicTotals
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    in_order,
    log_entry,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.clocks import SettableClock
from tests.support.housekeepers import NOW, T0, A, B, S, house_of, keeper_of, kept
from tests.support.memories import Remember, asked, clause, each_way, memory_of

MAP, TELEMETRY, ROSOUT = "/map_name", "/fmu/out/vehicle_status", "/rosout"

DOCKED = "/docked"
LAYOUT = McapLayout(latched=frozenset({MAP, TELEMETRY, ROSOUT, DOCKED, "/map_ready"}))


def drive(start: int, stop: int) -> list[Msg]:
    return [odom(at) for at in range(start, stop, S)]


def every(period_s: float, seconds: float, topic: str) -> list[Msg]:
    count = int(seconds / period_s)
    return [text(T0 + round(n * period_s * S), str(n), topic) for n in range(count)]


def record(bag_dir: Path, messages: list[Msg]) -> None:
    write_splits(bag_dir, messages, layout=LAYOUT)


def remembered(root: Path, *, recalls: bool = False, **limits: Any) -> Memory:
    return memory_of(root, limits=QuerySettings(**limits), recalls=recalls)


def at(memory: Memory, topic: str, when: int) -> Any:
    """The reply to a question for a moment."""
    asks = {"topic": topic, "timestamp": when / S}
    return asked(memory, "get_topic_at_time", **asks)


def test_a_boot_with_a_wrong_clock_makes_no_topic_of_its_session_rare(tmp_path: Path) -> None:
    """A recorder that boots in 1970 has a topic of ten messages a second once a month or so."""

    def ticks(begin: int, many: int) -> list[Msg]:
        return [boolean(begin + n * S // 10, n < many - 1) for n in range(many)]

    again = ticks(T0 + 300 * S, 100)
    write_mcap(tmp_path / "r0" / "r0_0.mcap", [*ticks(100 * S, 100), *ticks(T0, 500)])
    write_mcap(tmp_path / "r1" / "r1_0.mcap", [*ticks(T0 + 60 * S, 500), *again])
    cut = T0 + 58 * S
    end, begin = (Overlap(cut - S, cut + S, (f"{name}_0.mcap",)) for name in ("r0", "r1"))
    joined = Handover(next="r1", counts_until=cut, end=end, compared=True)
    write_handover(tmp_path / "r0", joined)
    joined = Handover(previous="r0", counts_from=cut, begin=begin, compared=True)
    write_handover(tmp_path / "r1", joined)
    window = {"start": T0 / S + 60, "end": T0 / S + 400}
    asks = {"topic": "/bumper", "by": "value", **window}
    reply = asked(memory_of(tmp_path), "get_topic_in_range", **asks)
    assert [row[:3] for row in reply["rows"]] == [["true", 2, 59.8], ["false", 2, 0.0]]


def test_a_flag_that_came_every_twenty_seconds_holds_until_it_fell_silent(
    tmp_path: Path, remember: Remember
) -> None:
    """It was true for hours in which data_time_range has its silence, and while knew nothing."""
    ticks = [boolean(T0 + at * S, True) for at in range(0, 600, 20)]
    write_splits(tmp_path, [*ticks, *drive(T0, T0 + 5400 * S)[::10]], 1800)
    memory = remember()
    window = {"start": T0 / S, "end": T0 / S + 5390}
    true = clause("/bumper", "equals", True)
    ask = partial(asked, memory, "find_matches", **window)
    held = asked(memory, "get_topic_in_range", topic="/bumper", by="value", **window)
    assert [row[:3] for row in held["rows"]] == [["true", 1, 580.0]]
    by_hour = ask(**true, by="hour")
    assert by_hour["all"][by_hour["columns"].index("seconds") - 1] == 580
    assert [row["duration_s"] for row in ask(**true)["sightings"]] == [580]
    driven = clause("/odom", "above", -1, field="position.x")
    [driven_so] = ask(**driven, **{"while": true})["sightings"]
    assert driven_so["duration_s"] == 580


def test_a_flag_that_holds_since_before_a_window_is_noted_as_a_latched_value_is(
    tmp_path: Path, remember: Remember
) -> None:
    """A door that stood open all the time was never open by find_matches, though by hour it was."""
    door = [boolean(T0 + at * S, at != 1500, "/door") for at in (100, 1500)]
    write_mcap(tmp_path / "r" / "r_0.mcap", in_order([*door, *drive(T0, T0 + 1800 * S)[::10]]))
    memory = remember()

    def found(wanted: bool, begin: int) -> Any:
        asks = clause("/door", "equals", wanted)
        window = {"start": T0 / S + begin, "end": T0 / S + begin + 200}
        return asked(memory, "find_matches", **asks, **window)

    [note] = found(True, 300)["notes"]
    since = f"{T0 / S + 100:.6f} holds until its next message"
    assert note == f"/door met this already when the window began: what it said at {since}"
    assert "notes" not in found(False, 300)
    assert "notes" not in found(True, 1550)


def test_the_pace_of_a_topic_is_measured_in_all_recordings_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 1,500 recordings, which are ten days, each sighting measured all of them anew: 9 s."""
    measured: list[str] = []
    real = Segment.recordings

    def recordings(segment: Segment, topic: str) -> dict[Path, TopicTotals]:
        measured.append(topic)
        return real(segment, topic)

    monkeypatch.setattr(Segment, "recordings", recordings)
    found = []
    for many in (6, 30):
        for number in range(many):
            bumps = [boolean(T0 + (600 * number + at) * S, at == 60) for at in (0, 60, 120)]
            write_mcap(tmp_path / f"{many}" / f"r{number}" / "r_0.mcap", bumps)
        bumped = clause("/bumper", "equals", True)
        measured.clear()
        window = {"start": T0 / S, "end": T0 / S + 600 * many}
        reply = asked(memory_of(tmp_path / f"{many}"), "find_matches", **bumped, **window)
        assert len(reply["sightings"]) == 5
        found.append(len(measured))
    assert found[0] == found[1]


def test_how_long_what_a_topic_says_holds_is_of_its_own_session(
    tmp_path: Path, remember: Remember
) -> None:
    """A bumper whose driver once repeated its state: values of all later days held for 0 s, until
    that day was deleted."""
    day = 86_400

    def bumps(day_number: int, period_s: float, hits: Collection[int]) -> list[Msg]:
        begin = T0 + day_number * day * S
        ticks = [boolean(begin + round(n * period_s * S), n in hits) for n in range(10)]
        return in_order([*ticks, *drive(begin, begin + 600 * S)[::10]])

    for number, (period_s, hits) in enumerate([(0.1, [4, 5]), (60, [2, 3, 7])]):
        write_mcap(tmp_path / f"r{number}" / "r_0.mcap", bumps(number, period_s, hits))
    start = T0 / S + day
    bumped = clause("/bumper", "equals", True)
    driven = clause("/odom", "above", -1, field="position.x")
    asks: list[tuple[str, dict[str, object]]] = [
        ("get_topic_in_range", {"topic": "/bumper", "changes": True}),
        ("get_topic_in_range", {"topic": "/bumper", "by": "value"}),
        ("find_matches", bumped),
        ("find_matches", bumped | {"by": "hour"}),
        ("find_matches", driven | {"while": bumped}),
    ]

    def replies() -> list[Any]:
        memory = remember()
        return [asked(memory, name, **given, start=start, end=start + 599) for name, given in asks]

    changes, *rest = replies()
    assert [change["seconds"] for change in changes["changes"]] == [120, 120, 180, 60, 110]
    (tmp_path / "r0" / "r_0.mcap").unlink()
    assert replies() == [changes, *rest]


@pytest.mark.parametrize(
    ("latched_s", "drive_s", "holds"),
    [
        ([0], 3, True),  # a map, published once, in a recording however short
        ([n * 4.9 for n in range(24)], 130, False),
        ([n * 5.1 for n in range(23)], 130, True),
        ([0, 60], 130, True),
        ([0, 4.9, 9.8], 14, False),
        ([0, 0.4], 130, True),  # twice when its node started
        ([0, 0.4], 3, False),
    ],
    ids=count(),
)
def test_what_is_published_every_five_seconds_or_less_often_holds(
    tmp_path: Path, latched_s: list[float], drive_s: int, holds: bool
) -> None:
    latched = [text(T0 + round(at * S), "office", MAP) for at in latched_s]
    record(tmp_path, [*latched, *drive(T0, T0 + drive_s * S)])
    for recalls in (False, True):
        found = at(remembered(tmp_path, recalls=recalls), MAP, latched[-1].log_time + 3 * S)
        assert ("error" not in found) is holds
        if holds:
            assert (found["latched"], found["age_s"]) == (True, 3.0)


def test_the_configuration_says_what_is_latched_and_what_is_not(tmp_path: Path) -> None:
    telemetry = every(0.1, 7, TELEMETRY)
    record(tmp_path, [text(T0, "x", MAP), *telemetry, *drive(T0, T0 + 60 * S)])
    latching = Latching(include=("/fmu/*",), exclude=(MAP,))
    memory = remembered(tmp_path, latching=latching)
    assert at(memory, TELEMETRY, T0 + 59 * S)["latched"] is True
    assert "error" in at(memory, MAP, T0 + 59 * S)
    both = remembered(tmp_path, latching=Latching(include=("/odom",), exclude=("/odom",)))
    assert "error" in at(both, "/odom", T0 + 99 * S)


def test_a_value_of_another_time_and_a_pose_say_that_they_are_latched(tmp_path: Path) -> None:
    bump = boolean(T0 + 20 * S, True)
    record(tmp_path, [text(T0, "office", MAP), bump, *drive(T0, T0 + S), text(T0 + 60 * S, "")])
    memory = remembered(tmp_path, latching=Latching(include=("/odom",)))
    bumped = {"condition_topic": "/bumper", "condition_type": "equals", "value": True}
    shown = asked(memory, "get_value_when", value_topic=MAP, **bumped)
    assert (shown["value_latched"], shown["value_age_s"]) == (True, 20.0)
    window = {"topic": MAP, "start": T0 / S + 30, "end": T0 / S + 40}
    refused = asked(memory, "get_topic_in_range", **window)["detail"]
    assert f"the last one before is at {T0 // S}.000000, and holds: ask about a moment" in refused
    pose = asked(memory, "get_position_at", timestamp=T0 / S + 30)
    assert [note for note in pose["notes"] if "/odom is latched" in note and "30" in note]


def test_retention_carries_the_newest_of_what_is_transient_local_and_no_log(
    tmp_path: Path,
) -> None:
    """However often it is published; and then it is no more latched than before."""
    telemetry = every(0.01, 7, TELEMETRY)
    messages = [
        text(T0, "office", MAP),
        log_entry(T0 + S, 20, "nav", "hello"),
        *telemetry,
        *drive(T0, T0 + 30 * S),
    ]
    record(tmp_path, messages)
    keeper_of(tmp_path, max_bytes=1).apply()
    carried = tmp_path / "latched/carried.mcap"
    topics = [TELEMETRY, MAP, ROSOUT]
    found = {
        each.channel.topic: each.log_time
        for each in McapReader().records(carried, topics, TimeWindow.everything())
    }
    assert found == {TELEMETRY: telemetry[-1].log_time, MAP: T0}
    memory = remembered(tmp_path)
    assert "error" in at(memory, TELEMETRY, T0 + 29 * S)
    assert at(memory, TELEMETRY, telemetry[-1].log_time)["value"] == {"value": "699"}
    assert at(memory, MAP, T0 + 29 * S)["age_s"] == 29.0


T0_S = T0 // S


def docked(second: float, value: bool, topic: str = DOCKED) -> Msg:
    return boolean(T0 + round(second * S), value, topic)


def record_splits(
    bag_dir: Path, name: str, start: int, splits: int, latched: Collection[Msg]
) -> None:
    """Splits of ten seconds, in which the robot moves."""
    for number in range(splits):
        first = T0 + (start + 10 * number) * S
        own = [message for message in latched if first <= message.log_time < first + 10 * S]
        driven = [odom(first + n * S, 1.0, 2.0) for n in range(10)]
        write_mcap(bag_dir / name / f"{name}_{number}.mcap", in_order([*driven, *own]), LAYOUT)
    (bag_dir / name / "handover.json").write_text('{"format": 1}')


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """Of two minutes 10 to 30 s are a moment that was saved, 30 to 110 s were deleted."""
    said = [docked(5.5, True), docked(15.5, False), docked(40.5, True), docked(60.5, False)]
    said += [docked(80.5, True), docked(115.5, False), docked(2.5, True, "/map_ready")]
    record_splits(tmp_path, A, 0, 6, said)
    record_splits(tmp_path, B, 60, 6, said)
    kept(house_of(tmp_path), tmp_path, 12, 28)
    house_of(tmp_path, max_bytes=1).apply()
    left = sorted(path.stem for path in tmp_path.glob("rec*/*.mcap"))
    assert left == [f"{A}_1", f"{A}_2", f"{B}_5"]
    return tmp_path


def memory(bag_dir: Path, *, recalls: bool = False) -> Memory:
    return memory_of(bag_dir, clock=SettableClock(NOW), recalls=recalls)


def value_at(memory: Memory, second: float, topic: str = DOCKED) -> Any:
    reply = at(memory, topic, T0 + round(second * S))
    return reply["value"]["value"] if "value" in reply else reply["reason"]


@each_way
def test_a_latched_value_is_not_held_into_a_time_that_was_deleted(
    bag_dir: Path, recalls: bool
) -> None:
    asking = memory(bag_dir, recalls=recalls)
    seconds = (12, 25, 45, 65, 75, 90, 112, 119)
    known = [value_at(asking, second) for second in seconds]
    # What it said newest before something is kept again was carried on.
    assert known == [True, False, "deleted", "deleted", "deleted", True, True, False]
    # A topic that said nothing there holds.
    assert {value_at(asking, second, "/map_ready") for second in seconds} == {True}
    refused = at(asking, DOCKED, T0 + 65 * S)
    assert "recorded, and deleted since" in str(refused["notes"])
    assert "to accept the older one, ask with tolerance_s of at least" in refused["detail"]


@each_way
def test_how_long_a_value_held_ends_where_a_time_was_deleted(bag_dir: Path, recalls: bool) -> None:
    asking = memory(bag_dir, recalls=recalls)
    window = {"topic": DOCKED, "start": T0_S + 10, "end": T0_S + 130}
    changes = asked(asking, "get_topic_in_range", changes=True, **window)["changes"]
    assert [spell_of(spell) for spell in changes] == [
        (True, 5.5, 10, True),
        (False, 15.5, 13.5, False),
        (True, 80.5, 35, True),
        (False, 115.5, 3.5, False),
    ]
    undocked = {"condition_type": "equals", "value": False}
    found = asked(asking, "find_matches", **window, **undocked)["sightings"]
    spans = [(row["first_seen"] - T0_S, row["duration_s"]) for row in found]
    assert spans == [(115.5, 3.5), (15.5, 13.5)]
    events = asked(asking, "recap", start=T0_S, end=T0_S + 130)["events"]
    flips = [event for event in events if event["text"] == "/docked became false"]
    assert [flip.get("duration_s") for flip in flips] == [13.5, None]


def spell_of(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["value"], row["start"] - T0_S, row["seconds"], row.get("ended", True)


def test_a_value_is_not_held_on_across_messages_that_were_deleted_by_request(
    tmp_path: Path,
) -> None:
    record_splits(tmp_path, A, 0, 6, [docked(5.5, True), docked(55.5, False)])
    append_losses(tmp_path, [Loss(DOCKED, T0 + 20 * S, T0 + 30 * S, 2, "forgotten")])
    asking = memory(tmp_path)
    assert [value_at(asking, second) for second in (15, 25, 50, 57)] == [
        True,
        "deleted",
        "deleted",
        False,
    ]
    odometry = clause("/odom", "above", 0, field="position.x")
    docked_then = clause(DOCKED, "equals", True)
    for end, last in ((12, 12), (50, 20)):
        span = {"start": T0_S, "end": T0_S + end, "while": docked_then}
        answer = asked(asking, "find_matches", **odometry, **span)
        [found] = answer["sightings"]
        assert (found["first_seen"] - T0_S, found["last_seen"] - T0_S) == (6, last)
    assert answer["unknown_s"] == 30


def test_a_refusal_says_how_to_ask_what_a_rare_text_said_last(
    tmp_path: Path, remember: Remember
) -> None:
    """A mission manager says what it does when that changes, minutes before."""
    said = {0: "CHARGING", 400: "SCOUTING", 1000: "CHARGING"}
    for begin in (0, 2000):
        states = [text(T0 + (begin + at) * S, word, "/mission") for at, word in said.items()]
        moving = [odom(T0 + (begin + at) * S, at) for at in range(1200)]
        write_mcap(tmp_path / f"run{begin}" / "run_0.mcap", in_order([*states, *moving]))
    asking = remember()

    refused = at(asking, "/mission", T0 + 900 * S)
    advice = "to accept the older one, ask with tolerance_s of at least 500.000"
    assert refused["detail"].endswith(advice)
    given = {"topic": "/mission", "timestamp": T0 / S + 900, "tolerance_s": 500}
    assert asked(asking, "get_topic_at_time", **given)["value"] == {"value": "SCOUTING"}
    # Between two runs nobody knows.
    assert "to accept" not in at(asking, "/mission", T0 + 1300 * S)["detail"]


def test_refusals_of_any_text_and_of_a_message_without_one_value_say_what_to_ask(
    tmp_path: Path,
) -> None:
    words = [text(T0 + at * S, word) for at, word in enumerate(("hello", "hello", "bye"))]
    logs = [log_entry(T0 + at * S, 20, "nav", f"goal {at}") for at in range(3)]
    moving = along_x(T0, 3, mps=1.0)
    write_mcap(tmp_path / "run" / "run_0.mcap", in_order([*words, *logs, *moving]))
    memory = memory_of(tmp_path)
    span = {"start": T0 / S, "end": T0 / S + 2}

    blank = clause("/chatter", "contains", "")
    for by in ({}, {"by": "value"}):
        refused = asked(memory, "find_matches", **blank, **by)["detail"]
        assert "not blank; for example" in refused
        assert refused.endswith(
            "for any text, get_topic_in_range with changes lists each that a topic, or one of its "
            "fields, held"
        )
    for topic, fields, total in (("/chatter", [], 2), ("/rosout", ["msg"], 3)):
        listed = asked(
            memory, "get_topic_in_range", topic=topic, fields=fields, changes=True, **span
        )
        assert listed["total"] == total

    refused = asked(memory, "get_topic_in_range", topic="/odom", changes=True, **span)["detail"]
    assert "name one of its fields, where the tool takes fields: position.x, position.y" in refused
    assert refused.endswith("linear_velocity.x, linear_velocity.y and 4 more")
