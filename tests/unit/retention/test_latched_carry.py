from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.errors import BagError, BagUnreachableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Memory
from ros2_memory.retention.latched_carry import (
    RECEIVED_AGAIN_NS,
    Latched,
    MessageIdentity,
    worth_carrying,
)
from ros2_memory.storage.base import REPEATED_NS, Record
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, odom, text, tf_of, write_mcap
from tests.support.clocks import SettableClock
from tests.support.fakes import broken, killed_at
from tests.support.housekeepers import files_in, keeper_of, made_moment, size_of
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of
from tests.support.noting_reader import fail_reading

S = 10**9
T0 = 1_790_000_000 * S
DOCK = "/docked"
LAYOUT = McapLayout(latched=frozenset({"/tf_static", DOCK}))


def frame(at: int, child: str, x: float, *, received: int | None = None) -> Msg:
    return tf_of(at, "base_link", child, (x, 0.0, 0.0), topic="/tf_static", log_time=received or at)


def docked(at: int, where: str, *, received: int | None = None) -> Msg:
    return replace(text(received or at, where, DOCK), publish_time=at)


def drive(start: int, stop: int) -> list[Msg]:
    return [odom(at, (at - T0) / S, 0.0) for at in range(start, stop, S)]


def drive_in(split: int) -> list[Msg]:
    """Ten seconds of driving."""
    return drive(T0 + split * 10 * S, T0 + (split + 1) * 10 * S)


def recording(bag_dir: Path, name: str, *splits: Iterable[Msg]) -> None:
    for number, messages in enumerate(splits):
        write_mcap(bag_dir / name / f"{name}_{number}.mcap", messages, LAYOUT)


def at_home(bag_dir: Path, splits: int = 2) -> None:
    """A recording whose first split has a latched message."""
    odometry = [drive_in(n) for n in range(splits)]
    recording(bag_dir, "rec", [docked(T0, "home"), *odometry[0][:-1]], *odometry[1:])


def keep_only(bag_dir: Path, *kept: str) -> None:
    """Has all bags deleted but these, which are the newest."""
    sidecars = {(bag_dir / name).with_name("handover.json") for name in kept}
    files = [*(bag_dir / name for name in kept), *(each for each in sidecars if each.exists())]
    size = sum(each.stat().st_size for each in files)
    of_list = 500
    keeper_of(bag_dir, max_bytes=size + of_list).apply()
    left = [path for path in bag_dir.rglob("*.mcap") if not is_carried(path)]
    assert sorted(path.relative_to(bag_dir).as_posix() for path in left) == sorted(kept)


def held(memory: Memory, topic: str, moment: int) -> tuple[float, object] | str:
    """What a topic held, and since when; or why that is not known."""
    reply = asked(memory, "get_topic_at_time", topic=topic, timestamp=moment / S)
    return reply["reason"] if "error" in reply else (reply["timestamp"], reply["value"])


def places(memory: Memory, moment: int, children: Iterable[str]) -> list[object]:
    frames = {"parent": "base_link", "timestamp": moment / S}
    replies = [asked(memory, "get_transform_at", child=child, **frames) for child in children]
    return [reply.get("translation", reply.get("reason")) for reply in replies]


def test_a_carried_message_keeps_its_bytes_times_definition_and_qos(tmp_path: Path) -> None:
    message = docked(T0, "home", received=T0 + 77)
    recording(tmp_path, "rec", [message, *drive(T0, T0 + 5 * S)], drive_in(1))
    (before,) = McapReader().records(tmp_path / "rec/rec_0.mcap", [DOCK], TimeWindow.everything())
    keep_only(tmp_path, "rec/rec_1.mcap")
    (after,) = records(tmp_path)
    channel, metadata = before.channel, after.channel.metadata[:1]
    assert after.channel.latched
    assert replace(after.channel, metadata=metadata) == channel
    assert after._replace(channel=channel) == before


def test_a_link_in_place_of_the_carried_bag_is_not_followed_and_nothing_is_lost(
    tmp_path: Path,
) -> None:
    bags, elsewhere = tmp_path / "bags", tmp_path / "elsewhere"
    elsewhere.mkdir()
    at_home(bags)
    (bags / "latched").symlink_to(elsewhere, target_is_directory=True)
    keeper_of(bags, max_bytes=1).apply()
    assert not list(elsewhere.iterdir())
    assert "rec/rec_0.mcap" in files_in(bags)


def test_where_latched_messages_cannot_be_carried_bags_without_them_go_instead(
    tmp_path: Path,
) -> None:
    at_home(tmp_path, splits=3)
    with broken(McapWriter, "write"):
        keeper_of(tmp_path, max_bytes=1).apply()
    assert files_in(tmp_path) == ["rec", "rec/rec_0.mcap", "rec/rec_2.mcap"]
    keeper_of(tmp_path, max_bytes=1).apply()
    assert held(memory_of(tmp_path), DOCK, T0 + 25 * S) == (T0 / S, {"value": "home"})


def test_a_bag_stays_until_nobody_looks_for_latched_messages_in_it(tmp_path: Path) -> None:
    at_home(tmp_path, splits=4)
    budget = 3 * (tmp_path / "rec/rec_0.mcap").stat().st_size + 1
    keeper_of(tmp_path, max_bytes=budget, grace_s=10**6).apply()
    left = ["latched", "latched/carried.mcap", "rec", *(f"rec/rec_{n}.mcap" for n in (0, 2, 3))]
    assert files_in(tmp_path) == left
    keeper_of(tmp_path, max_bytes=budget, grace_s=0).apply()
    assert "rec/rec_0.mcap" not in files_in(tmp_path)


def test_a_bag_that_stays_for_a_while_and_is_saved_in_a_moment_counts_once(tmp_path: Path) -> None:
    at_home(tmp_path, splits=4)
    saved = made_moment(tmp_path / "moments" / "m") / "rec" / "rec_0.mcap"
    saved.parent.mkdir()
    saved.hardlink_to(tmp_path / "rec/rec_0.mcap")
    budget = size_of(tmp_path) + saved.stat().st_size - 1
    keeper = keeper_of(tmp_path, max_bytes=budget, max_age_h=25 / 3600, grace_s=10**6)
    for _ in range(2):
        keeper.apply()
        assert len([*(tmp_path / "rec").iterdir()]) == 4
    assert keeper.status().counted_bytes == size_of(tmp_path) <= budget


def test_after_a_kill_the_carried_bag_is_the_recorder_s_own(tmp_path: Path) -> None:
    at_home(tmp_path)
    with killed_at(OwnRecordings, "add_bags"):
        keeper_of(tmp_path, max_bytes=1).apply()
    keeper_of(tmp_path, max_bytes=1).apply()
    assert OwnRecordings(tmp_path).owns_bag(tmp_path / "latched/carried.mcap")


@pytest.mark.parametrize("is_full", [False, True])
def test_a_bag_of_latched_messages_goes_at_once_where_no_other_can_go_in_its_place(
    tmp_path: Path, is_full: bool
) -> None:
    at_home(tmp_path)
    if is_full:
        keeper_of(tmp_path, grace_s=10**6, measure_free=lambda _: 0).make_room(1)
    else:
        keeper_of(tmp_path, max_bytes=1, grace_s=10**6).apply()
    assert "rec/rec_0.mcap" not in files_in(tmp_path)
    assert held(memory_of(tmp_path), DOCK, T0 + 15 * S) == (T0 / S, {"value": "home"})


def test_a_bag_stays_while_the_disk_fails_to_give_its_latched_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    too_many = BagUnreachableError("rec_0.mcap", "it cannot be opened: Too many open files")
    fail_reading(
        monkeypatch, "records", lambda path: too_many if path.name == "rec_0.mcap" else None
    )
    at_home(tmp_path, splits=4)
    now = SettableClock(0)
    keeper = keeper_of(tmp_path, max_bytes=1, monotonic=lambda: now.now() / S)
    for hour in range(24):
        now.at = hour * 3600 * S
        keeper.apply()
        assert (tmp_path / "rec" / "rec_0.mcap").exists()
    now.at = 86_400 * S
    keeper.apply()
    assert not (tmp_path / "rec" / "rec_0.mcap").exists()


def test_what_lies_behind_a_damaged_part_of_a_bag_is_carried(tmp_path: Path) -> None:
    recording(tmp_path, "rec", (), drive_in(1))
    lost, left = frame(T0, "laser", 0.1), frame(T0 + 8 * S, "camera", 0.2)
    damaged = write_mcap(
        tmp_path / "rec" / "rec_0.mcap",
        [lost, *drive(T0 + S, T0 + 8 * S), left],
        replace(LAYOUT, chunk_size=400),
    )
    spoil_chunk(damaged, 0)
    keep_only(tmp_path, "rec/rec_1.mcap")
    assert carried_at(tmp_path) == [T0 + 8 * S]


@pytest.mark.parametrize("kind", [BagError, BagUnreachableError])
def test_what_is_carried_is_not_replaced_while_it_cannot_be_read(
    tmp_path: Path, kind: type[BagError]
) -> None:
    laser, camera = frame(T0, "laser", 0.1), frame(T0 + 10 * S, "camera", 0.2)
    first, second, *others = map(drive_in, range(4))
    recording(tmp_path, "rec", [laser, *first], [camera, *second], *others)
    keep_only(tmp_path, *(f"rec/rec_{number}.mcap" for number in (1, 2, 3)))
    with pytest.MonkeyPatch.context() as patched:
        fault = kind("carried.mcap", "it cannot be opened: Input/output error")
        fail_reading(patched, "records", lambda path: fault if is_carried(path) else None)
        keeper_of(tmp_path, max_bytes=1).apply()
    assert carried_at(tmp_path) == [T0]
    assert not (tmp_path / "rec/rec_2.mcap").exists()
    assert (tmp_path / "rec/rec_1.mcap").exists()
    keep_only(tmp_path, "rec/rec_3.mcap")
    assert carried_at(tmp_path) == [T0, T0 + 10 * S]


def records(bag_dir: Path) -> list[Record]:
    """What is carried."""
    path = bag_dir / "latched/carried.mcap"
    return list(McapReader().records(path, ["/tf_static", DOCK], TimeWindow.everything()))


def carried_at(bag_dir: Path) -> list[int]:
    return [each.log_time for each in records(bag_dir)]


# Every recording receives latched messages again; the answer tells when they came first.


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    for n, name in enumerate(["one", "two", "six"]):
        start = T0 + n * 100 * S
        again = [
            docked(T0 - 50 * S, "far", received=start + 1),
            docked(T0 + 5 * S, "home", received=start + 2 if n else T0 + 5 * S),
            frame(T0 - 60 * S, "laser", 0.1, received=start + 3),
            frame(T0 - 70 * S, "camera", 0.2, received=start + 4),
        ]
        recording(
            tmp_path,
            name,
            [*again, *drive(start + 10, start + 50 * S)],
            drive(start + 50 * S, start + 99 * S),
        )
    late = [docked(T0 + 260 * S, "yard"), frame(T0 + 261 * S, "arm", 0.5)]
    recording(tmp_path, "six_more", [*late, *drive(T0 + 255 * S, T0 + 300 * S)])
    write_handover(tmp_path / "six", Handover(next="six_more"))
    write_handover(tmp_path / "six_more", Handover(previous="six"))
    return tmp_path


@pytest.mark.parametrize(("gone", "since"), [(1, 51), (3, 151), (5, 256)])
def test_answers_about_latched_topics_are_the_same_after_as_before_a_deletion(
    bag_dir: Path, gone: int, since: int
) -> None:
    memory = memory_of(bag_dir)
    moments = [T0 + second * S for second in range(since, 300, 11)]
    frames = ["laser", "camera", "arm"]

    def answers() -> list[object]:
        return [(held(memory, DOCK, moment), places(memory, moment, frames)) for moment in moments]

    before = answers()
    names = [f"{name}/{name}_{n}.mcap" for name in ("one", "two", "six") for n in range(2)]
    keep_only(bag_dir, *names[gone:], "six_more/six_more_0.mcap")
    assert answers() == before


@pytest.mark.parametrize("is_split", [False, True])
@pytest.mark.parametrize("others_s", [100, 120])
def test_what_is_received_again_after_a_live_message_keeps_its_first_time(
    tmp_path: Path, others_s: int, is_split: bool
) -> None:
    recording(tmp_path, "rec", [docked(T0, "home"), docked(T0 + 5 * S, "shelf"), *drive_in(0)])
    live = docked(T0 + 100 * S, "door")
    again = docked(T0, "home", received=T0 + (others_s + 1) * S)
    driven = drive(T0 + 102 * S, T0 + 140 * S)
    splits = [[live], [again, *driven]] if is_split else [[live, again, *driven]]
    recording(tmp_path, "rez", *splits)
    memory = memory_of(tmp_path)
    moments = [T0 + second * S for second in (105, 130)]
    before = [held(memory, DOCK, moment) for moment in moments]
    keep_only(tmp_path, *(f"rez/rez_{number}.mcap" for number in range(len(splits))))
    assert [held(memory, DOCK, moment) for moment in moments] == before


def test_carried_messages_say_nothing_of_when_there_was_a_recording(bag_dir: Path) -> None:
    keep_only(bag_dir, "six_more/six_more_0.mcap", "six/six_1.mcap")
    reported = asked(memory_of(bag_dir), "data_time_range")
    assert reported["earliest"] == T0 / S + 250
    assert (reported["bags"], reported["gaps"]) == (2, [])


@given(st.data())
def test_what_is_carried_is_carried_on_whatever_the_order(data: st.DataObject) -> None:
    drawn = data.draw(st.lists(st.tuples(st.integers(0, 20), st.sampled_from("ab"))))
    messages = [
        Latched(at, MessageIdentity("/tf", at, child.encode()), (("/tf", ""), ("/tf", child)))
        for at, child in drawn
    ]
    once = worth_carrying(messages, [(7, 8)], {})
    shuffled = data.draw(st.permutations(messages))
    assert worth_carrying(shuffled, [(7, 8)], {}) == once
    assert worth_carrying(once, [(7, 8)], {}) == once


def test_what_may_have_been_received_before_is_what_questions_take_for_it() -> None:
    assert RECEIVED_AGAIN_NS <= REPEATED_NS
