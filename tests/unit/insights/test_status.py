"""What a memory says of itself: losses, faults, and detectors that were blind for a while."""

import json
import re
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
from mcap.opcode import Opcode

from ros2_memory.analysis.silences import LONGEST_OFF_NS
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.state_files import Loss, append_losses
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import Span
from ros2_memory.history import coverage
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.insights.status import memory_status, usual_rate
from ros2_memory.retention.policy import RetentionLimits
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    detections,
    goals,
    in_order,
    log_entry,
    make,
    odom,
    stamp,
    write_mcap,
    write_splits,
)
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat
from tests.support.log_lines import with_checks
from tests.support.mcap_surgery import edit_summary, spoil_chunk
from tests.support.memories import Remember, asked, clause, each_way, memory_of, noted, remembered

S = 10**9
T0 = 1_784_000_000
BEGIN = T0 * S
DAY = 86_400 * S


SOUND = "no loss or fault was found"
DRIVEN = along_x(BEGIN, 50)


def remembering(
    folder: Path,
    messages: Sequence[Msg] = DRIVEN,
    *,
    seconds: float = 60,
) -> Memory:
    clock = SettableClock(BEGIN + round(seconds * S))
    return remembered(folder, in_order(messages), clock=clock)


def shown(memory: Memory) -> dict[str, Any]:
    reply: dict[str, Any] = asked(memory, "memory_status")
    return reply


def test_the_recorders_own_topics_do_not_make_old_data_new(tmp_path: Path) -> None:
    """The robot died at 10 s, and the recorder logs each split that it opens."""
    driven = along_x(BEGIN, 11)
    splits = [log_entry(BEGIN + t * S, 20, "rosbag2_recorder", "opened") for t in range(0, 60, 10)]
    memory = remembering(tmp_path, [*driven, *splits])
    assert shown(memory)["newest_age_s"] == 10.0  # of whoever recorded this
    beat(tmp_path, BEGIN + 59 * S)
    told = shown(memory)
    assert (told["recorder_alive"], told["newest_age_s"]) == (True, 50.0)
    assert f"no message since {T0 + 10}.000000 but on topics that the" in told["doubts"]
    ahead = BEGIN + 365 * 86_400 * S
    write_mcap(tmp_path / "rec" / "ahead.mcap", [odom(ahead)])
    assert shown(memory)["newest_age_s"] == 50.0


def lost(kind: Any, begin_s: float, stop_s: float, count: int = 0, topic: str = "/odom") -> Loss:
    return Loss(topic, BEGIN + round(begin_s * S), BEGIN + round(stop_s * S), count, kind)


@pytest.mark.parametrize(
    ("now", "losses", "doubts"),
    [
        (
            "wall",
            [lost("stamps", 10, 11, 4), lost("counter", 20, 21, 3)],
            (
                "3 messages lost before they were recorded: /odom (3); 4 messages missing by the "
                "cadence of header stamps (never published, or lost): /odom (4)"
            ),
        ),
        (
            "wall",
            [lost("refused", 10, 11.5), lost("refused", 13, 14.5), lost("refused", 50, 51)],
            (
                f"messages of /odom are missing from {T0 + 10}.000000 to {T0 + 11}.500000 (1.5 s),"
                f" and 2 more times, at last from {T0 + 50}.000000 to {T0 + 51}.000000 (1 s),"
                " as the QoS or type of a publisher did not fit the subscription: how many is not "
                "known"
            ),
        ),
        (
            "wall",
            [lost("refused", 10, 11), lost("refused", 50, 51, topic="/tf")],
            "; ".join(
                f"messages of {topic} are missing from {T0 + at}.000000 to {T0 + at + 1}.000000 "
                "(1 s), as the QoS or type of a publisher did not fit the subscription: how many "
                "is not known"
                for topic, at in (("/odom", 10), ("/tf", 50))
            ),
        ),
        # A simulation has another clock than the recorder that ended unexpectedly.
        ("latest", [lost("died", 51, 52, topic="*")], SOUND),
    ],
)
def test_what_was_lost_is_a_doubt(
    tmp_path: Path, now: Literal["wall", "latest"], losses: list[Loss], doubts: str
) -> None:
    memory = remembering(tmp_path)
    memory = replace(memory, limits=replace(memory.limits, now=now))
    beat(tmp_path, BEGIN + 59 * S, lost={"/odom": 7})
    append_losses(tmp_path, losses)
    told = shown(memory)
    assert (told["doubts"], told["lost_last_hour"]) == (doubts, {"/odom": 7})


def test_each_topic_with_a_refused_publisher_is_named_or_counted(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    topics = [f"/sensor_{nth}" for nth in range(8)]
    append_losses(tmp_path, [lost("refused", 10, 20, topic=topic) for topic in topics])
    samples = asked(memory, "get_topic_in_range", topic="/odom", start=T0, end=T0 + 30)
    for said in (shown(memory)["doubts"], str(samples["notes"])):
        assert said.count("did not fit") == 1
        assert "messages of /sensor_0, /sensor_1, /sensor_2 and 5 more are missing" in said


def test_an_unexpected_end_after_the_newest_data_is_a_doubt_until_more_is_there(
    tmp_path: Path,
) -> None:
    memory = remembering(tmp_path)  # up to 49 s; asked at 60 s
    beat(tmp_path, BEGIN + 59 * S)
    append_losses(
        tmp_path,
        [
            lost("died", 51, 52, topic="*"),
            lost("unclean", 53, 54, topic="*"),
            lost("hung", 7 * 86_400, 8 * 86_400, topic="*"),  # the clock was ahead then
        ],
    )
    after = f"after {T0 + 49}.000000 messages may be missing, because "
    sentence = f"{after}ros2 bag record died, and the recorder ended without a shutdown"
    assert shown(memory)["doubts"] == sentence
    for until, notes in ((45, []), (60, [sentence])):
        window = {"start": T0 + 40, "end": T0 + until}
        recap = asked(memory, "recap", **window)
        assert noted(recap, after) == notes
    messages = along_x(BEGIN + 55 * S, 5)
    write_mcap(tmp_path / "later" / "later_0.mcap", messages)
    memory.index.refresh()
    assert after not in shown(memory)["doubts"]


def test_a_window_has_what_is_missing_in_it_and_a_comparison_says_in_which(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    append_losses(tmp_path, [lost("counter", 10, 11, 1), lost("counter", 30, 31, 6)])
    for start, count in ((0, 1), (12, 0), (25, 6)):
        window = {"start": T0 + start, "end": T0 + start + 15}
        found = asked(memory, "get_topic_in_range", topic="/odom", **window)
        notes = noted(found, "lost")
        assert [int(note[0]) for note in notes] == [count] * bool(count)
    asks = {"start": T0, "end": T0 + 20, "with_start": T0 + 21, "with_end": T0 + 45}
    notes = asked(memory, "compare", **asks)["notes"]
    assert "from start to end: 1 message lost before it was recorded: /odom (1)" in notes
    assert (
        "from with_start to with_end: 6 messages lost before they were recorded: /odom (6)" in notes
    )


@pytest.mark.parametrize(("now", "told"), [("wall", ("died", False)), ("latest", (None, None))])
def test_a_heartbeat_that_was_copied_with_bags_to_replay_is_no_recorder_of_them(
    now: Literal["wall", "latest"], told: tuple[str | None, bool | None], tmp_path: Path
) -> None:
    memory = remembering(tmp_path, seconds=1e6)
    memory = replace(memory, limits=replace(memory.limits, now=now))
    beat(tmp_path, BEGIN + 1 * S)
    reply = shown(memory)
    assert (reply["recorder"], reply["recorder_alive"]) == told
    assert ("the recorder died" in reply["doubts"]) == (now == "wall")


def test_an_action_that_nobody_calls_is_not_silent(tmp_path: Path) -> None:
    """Its topics have messages while a goal is active, as a log while there is something to log."""
    messages = along_x(BEGIN, 600)
    called = [t for t in range(600) if t < 200 or 300 <= t < 350]
    messages += [goals(BEGIN + t * S + 1, {1: 2}) for t in called]
    messages += [boolean(BEGIN + t * S + 2, True, topic="/drive/_action/feedback") for t in called]
    messages += [boolean(BEGIN + t * S + 3, True, topic="/bumper") for t in called]
    messages += [boolean(BEGIN + t * S + 4, True, topic="/arm/_service_event") for t in called]
    tree = "nav2_msgs/msg/BehaviorTreeLog"
    ticked = make(tree, timestamp=stamp(BEGIN), event_log=[])
    messages += [Msg("/behavior_tree_log", tree, BEGIN + t * S + 5, ticked) for t in called]
    memory = remembered(tmp_path, in_order(messages))
    status = asked(memory, "memory_status")
    assert [row["topic"] for row in status["fell_silent"]] == ["/bumper"]
    assert {row["topic"] for row in status["silences"]} == {"/bumper"}
    assert len(status["silences"]) == 2


@pytest.mark.parametrize(("later", "fell"), [(0, ["/bumper"]), (S, [])])
def test_what_was_recorded_before_a_long_gap_did_not_fall_silent(
    tmp_path: Path, later: int, fell: list[str]
) -> None:
    """That may be the recording of another robot."""
    bumps = [boolean(BEGIN + t * S, True) for t in range(80)]
    write_mcap(tmp_path / "a" / "a_0.mcap", bumps)
    again = bumps[-1].log_time + LONGEST_OFF_NS + later
    poses = along_x(again, 80)
    write_mcap(tmp_path / "b" / "b_0.mcap", poses)
    answer = memory_status(memory_of(tmp_path), Call())
    assert [each.topic for each in answer.fell_silent] == fell


def test_the_time_that_a_robot_was_off_is_no_silence_of_its_slow_topics(tmp_path: Path) -> None:
    charges = [boolean(BEGIN + t * S, True, topic="/charging") for t in range(0, 3600, 300)]
    write_mcap(tmp_path / "a" / "a_0.mcap", in_order([*along_x(BEGIN, 3600), *charges]))
    morning = BEGIN + 9 * 3600 * S
    write_mcap(tmp_path / "b" / "b_0.mcap", along_x(morning, 100))
    assert memory_status(memory_of(tmp_path), Call()).fell_silent == ()
    write_mcap(tmp_path / "b" / "b_1.mcap", along_x(morning + 100 * S, 3600))
    answer = memory_status(memory_of(tmp_path), Call())
    assert [each.topic for each in answer.fell_silent] == ["/charging"]


@pytest.mark.parametrize("is_listed", [False, True])
def test_a_topic_that_was_taken_from_the_list_is_not_silent(
    tmp_path: Path, is_listed: bool
) -> None:
    bumps = [boolean(BEGIN + t * S, True) for t in range(80)]
    drive = along_x(BEGIN, 400)
    write_splits(tmp_path, [*bumps, *drive], 100)
    listed = ("/odom", "/bumper") if is_listed else ("/odom",)
    beat(tmp_path, BEGIN + 400 * S, listed=listed, recordings=("rec",))
    reply = asked(memory_of(tmp_path, clock=SettableClock(BEGIN + 401 * S)), "memory_status")
    silent = ["/bumper"] * is_listed
    assert [row["topic"] for row in reply["fell_silent"]] == silent
    assert [row["topic"] for row in reply.get("silences", ())] == silent


def test_what_a_live_recorder_counts_is_what_the_budget_has(tmp_path: Path) -> None:
    limits = QuerySettings(kept=RetentionLimits(10**6, 7 * 86_400 * S))
    memory = replace(remembering(tmp_path), limits=limits)
    for counted, derived in ((4_900_000, 4_700_000), (200_000, 50_000)):
        beat(tmp_path, BEGIN + 59 * S, counted_bytes=counted, state_bytes=derived)
        budget = shown(memory)["budget"]
        assert (budget["used_gb"], budget["state_gb"]) == (counted / 1e9, derived / 1e9)


def test_a_topic_that_is_recorded_was_heard_though_its_recorder_hears_it_no_more(
    tmp_path: Path,
) -> None:
    """Each rotation begins a recording, and an event may come once a day."""
    memory = remembering(tmp_path)
    beat(tmp_path, BEGIN + 59 * S, subscribed=("/odom", "/scan"), silent=("/odom", "/scan"))
    assert shown(memory)["never_heard"] == ["/scan"]


def test_what_stays_of_deleted_bags_has_no_rate_and_does_not_slow_the_growth_of_the_others(
    tmp_path: Path,
) -> None:
    write_splits(tmp_path, along_x(BEGIN, 60))
    beat(tmp_path, BEGIN + 60 * S)
    limits = QuerySettings(kept=RetentionLimits(10**6, 7 * 86_400 * S))

    def growth() -> float:
        memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 60 * S), limits=limits)
        return float(shown(memory)["budget"]["growth_gb_per_day"])

    without_memory = growth()
    day = [boolean(BEGIN - hour * 3600 * S, True) for hour in range(26, 2, -1)]
    write_mcap(tmp_path / "memory" / "20260713.thinned.mcap", day)
    assert growth() == without_memory
    memory = memory_of(tmp_path)
    snapshot, latching = memory.index.snapshot(), memory.limits.latching
    rates = {topic: usual_rate(snapshot, topic, latching) for topic in ("/odom", "/bumper")}
    assert rates == {"/odom": 1.0, "/bumper": None}


def test_bags_that_a_wrong_clock_dated_ahead_are_no_growth_of_the_newest_day(
    tmp_path: Path,
) -> None:
    limits = QuerySettings(kept=RetentionLimits(10**6, 7 * 86_400 * S))
    grown = []
    for name, more in (("rec", along_x(BEGIN, 60)), ("ahead", along_x(BEGIN + 400 * DAY, 600))):
        write_splits(tmp_path / name, more)
        beat(tmp_path, BEGIN + 60 * S)
        memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 60 * S), limits=limits)
        grown.append(shown(memory)["budget"]["growth_gb_per_day"])
    assert grown[0] == grown[1] > 0


@each_way
def test_a_part_of_a_bag_that_cannot_be_read_is_named_once_something_met_it(
    tmp_path: Path, recalls: bool
) -> None:
    driven = along_x(BEGIN, 10, mps=0.5, hz=10)
    bag = write_mcap(tmp_path / "rec" / "rec_0.mcap", driven, McapLayout(chunk_size=3000))
    spoil_chunk(bag, 3)
    memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 60 * S), recalls=recalls)
    if not recalls:
        assert shown(memory)["doubts"] == SOUND
        asked(memory, "trajectory_summary", start=T0, end=T0 + 10)
    assert shown(memory)["doubts"].startswith("1 bag could not be read whole; data_time")
    [note] = asked(memory, "data_time_range")["notes"]
    assert note.startswith("rec/rec_0.mcap: damaged: ")
    write_mcap(bag, driven)
    memory.index.refresh()
    assert shown(memory)["doubts"] == SOUND


def state_messages(bag: Path, count: int) -> None:
    edit_summary(bag, Opcode.STATISTICS, lambda body: struct.pack_into("<Q", body, 0, count))


def test_of_many_odd_bags_those_of_the_newest_are_named_whatever_is_odd(tmp_path: Path) -> None:
    for number in range(7):
        driven = along_x(BEGIN + 10 * number * S, 10, hz=10)
        bag = write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", driven, McapLayout(3000))
        if number < 2:
            spoil_chunk(bag, 3)
            continue
        state_messages(bag, 1000 + number)
    memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 100 * S))
    asked(memory, "trajectory_summary", start=T0, end=T0 + 20)
    *notes, more = asked(memory, "data_time_range")["notes"]
    assert [note[:14] for note in notes] == [f"rec/rec_{number}.mcap" for number in range(2, 7)]
    assert more == "2 older bags are odd too"


def recording(folder: Path, *listed: tuple[str, int]) -> None:
    """Two splits of five messages each, and a metadata.yaml that lists those given."""
    for split in range(2):
        messages = along_x(BEGIN + 10 * split * S, 5)
        write_mcap(folder / f"rec_{split}.mcap", messages)
    names = "".join(f"  - {name}\n" for name, _ in listed)
    files = "".join(f"  - path: {name}\n    message_count: {n}\n" for name, n in listed)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 9\n"
        f"  message_count: {sum(n for _, n in listed)}\n"
        f"  relative_file_paths:\n{names}  files:\n{files}"
    )


def test_a_file_without_an_end_may_be_being_written_or_left_by_a_crash(tmp_path: Path) -> None:
    messages = along_x(BEGIN, 9)
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    content = path.read_bytes()[:-100]
    path.write_bytes(content)
    clock = SettableClock(path.stat().st_mtime_ns + S)

    def doubts(memory: Memory) -> str:
        return str(shown(memory)["doubts"])

    memory, young = memory_of(tmp_path, clock=clock), "1 file has no end yet"
    assert young in doubts(memory)
    # Seen to grow, it is being written.
    path.write_bytes(content + b"x")
    assert young not in doubts(memory)
    # So is one that a live recorder names.
    assert young in doubts(memory_of(tmp_path, clock=clock))
    beat(tmp_path, clock.now(), recordings=("rec",))
    assert young not in doubts(memory_of(tmp_path, clock=clock))


@pytest.mark.parametrize(
    ("listed", "beside", "doubts"),
    [
        (
            [("rec_0.mcap", 5), *((f"rec_{n}.mcap", 20) for n in range(1, 14))],
            "other.json",
            "lists 12 missing files and 255 messages that no file here contains",
        ),
        (
            [("rec_0.mcap", 5), ("rec_1.mcap", 255)],
            "other.json",
            "metadata.yaml of rec lists 250 messages that no file here contains",
        ),
        (
            [("rec_0.mcap", 5), ("rec_1.mcap", 5), ("empty.mcap", 7)],  # without its journal, say
            "other.json",
            "metadata.yaml of rec lists 7 messages that no file here contains",
        ),
        ([("rec_0.mcap.zstd", 5), ("rec/rec_1.mcap", 5)], "other.json", SOUND),  # compressed
        ([("rec_0.mcap", 9), ("rec_1.mcap", 9)], "handover.json", SOUND),  # cut by a handover
    ],
)
def test_splits_and_messages_that_metadata_lists_and_no_file_has_are_counted(
    tmp_path: Path, listed: list[tuple[str, int]], beside: str, doubts: str
) -> None:
    recording(tmp_path / "rec", *listed)
    write_mcap(tmp_path / "rec" / "empty.mcap", [])
    (tmp_path / "rec" / beside).write_text("{}")
    assert shown(memory_of(tmp_path))["doubts"].endswith(doubts)


def test_of_a_recording_that_is_not_its_own_retention_deletes_nothing(tmp_path: Path) -> None:
    recording(tmp_path / "rec", *((f"rec_{n}.mcap", 5) for n in range(-3, 3)))
    beat(tmp_path, BEGIN + 59 * S, RecorderState.STOPPED)
    own = tmp_path / ".episodic" / "recordings.jsonl"
    own.parent.mkdir()
    inode = (tmp_path / "rec").stat().st_ino
    own.write_text(with_checks('{"bag_dir_id": "5f0c"}'))
    assert "lists 4 missing files" in shown(memory_of(tmp_path))["doubts"]
    with own.open("a") as stream:
        stream.write(with_checks(json.dumps({"recording": "rec", "inode": inode})))
    assert "lists 1 missing file" in shown(memory_of(tmp_path))["doubts"]


def test_nothing_behind_a_link_is_looked_at(tmp_path: Path) -> None:
    recording(tmp_path / "bags" / "rec", ("rec_0.mcap", 5), ("gone.mcap", 5))
    memory = memory_of(tmp_path / "bags")
    snapshot = memory.index.snapshot()
    (tmp_path / "bags" / "rec").rename(tmp_path / "outside")
    (tmp_path / "bags" / "rec").symlink_to(tmp_path / "outside")
    (absent,) = memory.absent_splits(snapshot)
    assert (absent.files, absent.unreadable) == ((), True)


def test_a_recap_has_a_silence_as_an_event(remember: Remember) -> None:
    messages = along_x(BEGIN, 300, hz=2)
    messages.append(boolean((T0 + 251) * S, data=True))
    seen = (at for at in range(300) if not 100 <= at < 190)
    messages += [detections((T0 + at) * S + 1, ["cup"] if at < 50 else []) for at in seen]
    memory = remember(messages, split_s=10, clock=SettableClock((T0 + 305) * S))
    reply = asked(memory, "recap", start=T0, end=T0 + 300)
    [event] = [each for each in reply["events"] if "silent" in each["text"]]
    assert event["text"] == "/vision/scene/scene_objects was silent"
    assert (event["timestamp"], event["duration_s"]) == (T0 + 99.000001, pytest.approx(91.0))
    assert reply["counts"]["silences"] == 1
    within = asked(memory, "recap", start=T0 + 120, end=T0 + 150)
    assert [each["timestamp"] for each in within["events"] if "silent" in each["text"]] == [
        T0 + 120
    ]
    before = asked(memory, "recap", start=T0, end=T0 + 90)
    assert "silences" not in before["counts"]


def test_compare_counts_how_long_a_topic_was_silent_while_the_robot_was_on(tmp_path: Path) -> None:
    morning = 8 * 3600 + 1200
    for begin in (0, 600, morning, morning + 600, morning + 1200, morning + 1800):
        names = ["/t0", "/t1", "/t2", "/t3", *["/camera"] * (begin not in {600, morning})]
        messages = [
            boolean((T0 + begin + at) * S + nth, data=True, topic=name)
            for at in range(0, 600, 5)
            for nth, name in enumerate(names)
        ]
        write_mcap(tmp_path / "run" / f"run_{begin}.mcap", messages)
    first = {"start": T0, "end": T0 + morning + 1200}
    other = {"with_start": T0 + morning + 1200, "with_end": T0 + morning + 2399}
    reply = asked(memory_of(tmp_path), "compare", **first, **other)
    assert reply["silent_s"] == {"/camera": {"this": 1200.0, "with": 0.0}}


def test_never_names_the_longest_silences_by_how_long_the_robot_was_on(tmp_path: Path) -> None:
    """The last of four goes on over a night: the robot was on for 400 s of it."""
    morning = 45_000
    silent = [(1200, 1800), (3000, 3900), (5400, 6600), (10_000, morning + 200)]
    for begin in (*range(0, 10_200, 600), *range(morning, morning + 20_400, 600)):
        messages = [
            boolean((T0 + at) * S + nth, data=True, topic=name)
            for at in range(begin, begin + 600, 5)
            for nth, name in enumerate(["/t0", "/t1", "/t2", "/t3", "/bumper"])
            if name != "/bumper" or not any(first <= at < last for first, last in silent)
        ]
        name = "day" if begin < morning else "morning"
        write_mcap(tmp_path / name / f"{name}_{begin}.mcap", messages)
    memory = memory_of(tmp_path)
    lengths = []
    for after in (T0, T0 + 2000):
        reply = asked(memory, "find_matches", **clause("/bumper", "equals", False), start=after)
        [note] = noted(reply, "silent while the robot was on")
        lengths.append(re.findall(r"\((.+?) s\)", note))
    assert lengths == [["605", "905", "1205"], ["905", "1205", "400"]]


def test_silences_are_in_order_after_what_was_deleted_inside_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was deleted of a topic is read once, and for a window without its silences never.

    What is left of a silence beside it may be too short to be one.
    """
    silent = {"/early": [(60, 160), (320, 420)], "/late": [(80, 170), (330, 430)]}
    messages = along_x(T0 * S, 600)
    for nth, (topic, spans) in enumerate(silent.items()):
        heard = (at for at in range(600) if not any(start <= at < end for start, end in spans))
        messages += [boolean((T0 + at) * S + nth, data=True, topic=topic) for at in heard]
    write_splits(tmp_path, messages)
    for at in (T0 + 90, T0 + 325):
        append_losses(tmp_path, [Loss("/early", at * S, (at + 5) * S, 9, "forgotten")])
    cut = Counter[str]()

    def cut_spans(bag_dir: Path, topic: str, window: TimeWindow) -> Sequence[Span]:
        cut[topic] += 1
        return coverage.cut_spans(bag_dir, topic, window)

    monkeypatch.setattr("ros2_memory.insights.silences.cut_spans", cut_spans)
    memory = memory_of(tmp_path)
    found = asked(memory, "memory_status")["silences"]
    assert [(each["topic"], each["start"] - T0) for each in found] == [
        ("/early", pytest.approx(330)),
        ("/late", pytest.approx(329)),
        ("/early", pytest.approx(95)),
        ("/late", pytest.approx(79)),
        ("/early", pytest.approx(59)),
    ]
    assert cut == {"/early": 1, "/late": 1}
    asked(memory, "recap", start=T0, end=T0 + 50)
    assert cut.total() == 2
    asked(memory, "recap", start=T0 + 100, end=T0 + 150)
    assert cut.total() > 2
