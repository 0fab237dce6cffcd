"""Rules over recordings as a recorder leaves them, with real files."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.bag_dir.handover_file import Counting, Handover, message_id, write_handover
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import TRIGGERS_FILE
from ros2_memory.bag_dir.state_files import TRIGGERS, TriggerState
from ros2_memory.core.directories import identity_of
from ros2_memory.core.errors import BagUnreachableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.triggers.rules import Rule
from tests.support.bags import McapLayout, Msg, text, write_mcap
from tests.support.fakes import broken
from tests.support.noting_reader import fail_reading
from tests.support.watched_bags import RESTART, SILENT, T0, S, WatchedBags, flag, rule, seconds

LATCHED = McapLayout(latched=frozenset({"/bumper"}))


def watched(tmp_path: Path, *rules: Rule, **limits: object) -> WatchedBags:
    return WatchedBags(tmp_path / "bags", rules or [rule()], **limits)


@pytest.fixture
def robot(tmp_path: Path) -> WatchedBags:
    return watched(tmp_path)


def fail_to_summarize(monkeypatch: pytest.MonkeyPatch, *bags: Path) -> None:
    reason = "it cannot be opened or read: Input/output error"
    faults = {bag: BagUnreachableError(str(bag), reason) for bag in bags}
    fail_reading(monkeypatch, "summarize", faults.get)


def test_what_was_never_recorded_of_it_is_said(robot: WatchedBags) -> None:
    robot.split(seconds(0, 8, {1, 7}))
    robot.close_all(60)
    [moment] = robot.moments()
    assert (robot.spans(), moment.moment.matches) == ([(-4, 10)], 2)
    missing = [each.partition(" from ")[0] for each in moment.moment.missing]
    assert missing == ["nothing is recorded"] * 2


def test_a_later_match_extends_a_moment_that_is_stored(robot: WatchedBags) -> None:
    robot.drive(10, {6})
    robot.split(seconds(10, 20, {11}))
    robot.split(seconds(20, 30))
    robot.look(30)
    assert robot.spans() == [(1, 14)]
    [moment] = robot.moments()
    assert (moment.moment.matches, len(moment.files), moment.moment.pending) == (2, 2, False)
    assert robot.record().moments == 1


def test_a_rule_begins_with_what_is_recorded_from_now_on(robot: WatchedBags) -> None:
    robot.split(seconds(0, 10, {6}))
    robot.beat(state=RecorderState.STOPPED)
    (robot.bag_dir / TRIGGERS_FILE).unlink()
    robot.house = robot.new_house()
    robot.look()
    robot.begin(T0 + 20 * S)
    robot.split(seconds(20, 30, {26}))
    robot.close_all()
    assert robot.spans() == [(21, 29)]


def test_adopted_bags_fire_nothing_and_the_recording_beside_them_does(robot: WatchedBags) -> None:
    live = robot.begin(T0)
    robot.split(seconds(0, 10))
    write_mcap(robot.bag_dir / live / "copy.mcap", [])
    write_mcap(robot.bag_dir / "old" / "old_0.mcap", seconds(-90_000, -89_990, {-89_995}))
    for name in (live, "old"):
        identity = identity_of(robot.bag_dir / name)
        assert identity
        robot.own.adopt({name: identity})
    robot.look()
    robot.split(seconds(10, 20, {15}))
    robot.close_all()
    assert robot.fired_at() == [15]


def test_what_each_recording_receives_again_fires_once(robot: WatchedBags) -> None:
    said = replace(flag(5, True), publish_time=T0 + 5 * S - 1)
    # Nor does what was published long before.
    old = replace(flag(1, True), publish_time=T0 - 60 * S)
    robot.split([text(T0, "a"), old, flag(3, False), said, text(T0 + 9 * S, "b")], layout=LATCHED)
    for at in (10, 20, 30):
        before, new = robot.names[-1], robot.begin(T0 + at * S)
        robot.hand_over(before, new, T0 + at * S, f"{before}_0.mcap")
        again = replace(said, log_time=T0 + at * S + 1)
        robot.split([again, text(T0 + (at + 5) * S, "c")], layout=LATCHED)
        robot.look()
    robot.close_all()
    assert robot.record().fired == 1


def test_a_handover_that_was_given_up_ends_no_match(tmp_path: Path) -> None:
    """The recording that did not take over has a message that the other one missed."""
    robot = watched(tmp_path, rule(hold=30 * S))
    old = robot.begin(T0)
    robot.split([flag(n, value=True) for n in range(50) if n != 45])
    robot.look()
    robot.begin(T0 + 44 * S)
    path = robot.split([flag(45, value=True)])
    [missed] = McapReader().records(path, ["/bumper"], TimeWindow.everything())
    also: dict[str, dict[str, tuple[str, ...]]] = {
        path.name: {"/bumper": (message_id(missed.publish_time, missed.payload),)}
    }
    given_up = Handover(Counting.VOID, previous=old, compared=True, also_counts=also)
    write_handover(path.parent, given_up)
    robot.beat(old)
    robot.look()
    for nth in (1, 2, 3, 4):
        at = 20 + 30 * nth
        robot.split(seconds(at, at + 30, range(at, at + 30)), old)
        robot.look()
    robot.close_all()
    assert robot.fired_at() == [30]


def test_a_topic_that_falls_silent_fires_and_a_recorder_that_was_off_is_no_silence(
    tmp_path: Path,
) -> None:
    robot = watched(tmp_path, rule("quiet", hold=5 * S, **SILENT))
    robot.split(seconds(0, 10))
    robot.beat(state=RecorderState.STOPPED)
    robot.look()
    robot.begin(T0 + 60 * S)
    robot.split(seconds(60, 70))
    robot.split([text(T0 + n * S, "x") for n in range(70, 80)])
    robot.look()
    robot.split([text(T0 + n * S, "x") for n in range(80, 90)])
    robot.close_all()
    assert robot.fired_at() == [74]
    assert robot.spans() == [(64, 77)]


def test_a_rule_on_a_topic_that_is_not_recorded_has_a_problem(tmp_path: Path) -> None:
    robot = WatchedBags(tmp_path / "bags", [rule(hold=S)], unrecorded={"/bumper"})
    assert [each["rule"] for each in robot.log if each["event"] == "rule_not_recorded"]
    assert "/bumper is not recorded" in (robot.problem() or "")
    robot.unrecorded.clear()  # the list was changed, without a restart
    robot.look()
    assert robot.problem() is None
    robot.unrecorded.add("/bumper")
    robot.look()
    assert "/bumper is not recorded" in (robot.problem() or "")


def test_that_a_topic_is_not_recorded_hides_no_other_problem_of_its_rule(tmp_path: Path) -> None:
    robot = watched(tmp_path)
    triggers = robot.house.triggers
    assert triggers is not None
    triggers.note_deleted(2)
    for unrecorded in ({"/bumper"}, set()):
        robot.unrecorded = unrecorded
        robot.look()
        problem = robot.problem() or ""
        assert "2 bags that rules may have needed were deleted" in problem
        assert ("/bumper is not recorded" in problem) == bool(unrecorded)


def test_a_recording_that_ended_unasked_and_a_recorder_that_was_killed(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule("restart", **RESTART))
    robot.split(seconds(0, 10))
    robot.clock.at = T0 + 9 * S
    robot.house.note_restart(T0 + 8 * S, "died")
    robot.house.keep_moments()
    assert robot.spans() == [(3, 12)]
    robot.clock.at = T0 + 39 * S
    robot.beat(robot.names[-1])
    robot.clock.at = T0 + 60 * S
    robot.house = robot.new_house()
    robot.house.prepare()
    robot.look()
    assert robot.spans() == [(3, 12), (34, 63)]
    # One that was stopped ended as it should.
    robot.beat(state=RecorderState.STOPPED)
    robot.house = robot.new_house()
    robot.house.prepare()
    robot.look()
    assert robot.record("restart").fired == 2


def test_of_a_long_restart_its_two_ends_are_saved_whatever_other_clocks_date_between(
    tmp_path: Path,
) -> None:
    robot = watched(tmp_path, rule("restart", **RESTART))
    for begin in range(0, 60, 10):
        robot.split(seconds(begin, begin + 10))
    robot.beat(state=RecorderState.STOPPED)
    robot.look()
    # It boots with an empty clock, and is killed before that is set.
    robot.clock.at = T0 - 3000 * S
    robot.beat(robot.names[-1])
    robot.clock.at = T0 + 60 * S
    robot.house = robot.new_house()
    robot.house.prepare()
    robot.look()
    assert robot.spans() == [(55, 63)]
    robot.beat(robot.names[-1])
    robot.clock.at = T0 + 9000 * S
    robot.house = robot.new_house()
    robot.house.prepare()
    robot.split([*seconds(60, 65), *seconds(8999, 9003)])
    robot.look()
    assert robot.spans() == [(55, 63), (8995, 9003)]
    record = robot.record("restart")
    assert (record.fired, record.moments, record.refused, record.problem) == (2, 2, 0, None)


def test_a_noisy_rule_leaves_the_other_its_share(tmp_path: Path) -> None:
    noisy = rule("noisy", before=0, after=0, max_bytes=6_000)
    quiet = rule("quiet", topic="/door", max_bytes=6_000)
    robot = watched(tmp_path, noisy, quiet, moments_bytes=12_000)
    for begin in range(0, 100, 10):
        doors = [flag(begin + n + 0.5, begin + n == 95, "/door") for n in range(10)]
        robot.split([*seconds(begin, begin + 10, range(5, 100, 10)), *doors])
        robot.look()
    robot.close_all(200)
    one, other = robot.record("noisy"), robot.record("quiet")
    assert (one.fired, other.fired) == (10, 1)
    assert 0 < one.moments < 10
    assert one.moments + one.refused == 10
    assert "max_gb of the rule noisy" in (one.problem or "")
    assert len(robot.logged("trigger_not_kept")) == 1
    assert (other.moments, other.refused, other.problem) == (1, 0, None)
    kept = [sum(each.files.values()) for each in robot.moments() if each.moment.rule == "noisy"]
    assert sum(kept) <= 6_000


def test_a_rule_that_fires_too_often_says_so_once(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule(before=0, after=0, max_per_hour=3))
    robot.drive(60, range(0, 60, 2))
    robot.close_all()
    record = robot.record()
    assert (record.fired, record.moments, record.refused) == (30, 3, 27)
    [said] = robot.logged("trigger_not_kept")
    assert "max_per_hour: 3" in said["reason"]


def test_moments_that_are_refused_for_their_size_do_not_count_in_the_hour(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule(max_bytes=1, max_per_hour=2))
    robot.drive(100, {5, 35, 65, 95})
    robot.close_all()
    record = robot.record()
    assert (record.fired, record.moments, record.refused) == (4, 0, 4)
    assert "raise max_gb of the rule" in (record.problem or "")


def test_a_rule_that_matches_all_the_time_says_so_once(robot: WatchedBags) -> None:
    for begin in range(0, 4000, 1000):
        robot.split([flag(n, True) for n in range(begin, begin + 1000, 8)])
        robot.look()
    robot.close_all()
    assert (robot.record().fired, robot.record().always_since) == (1, T0)
    assert len(robot.logged("trigger_matches_always")) == 1


def test_age_deletes_nothing_that_a_rule_may_need(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule(before=50 * S), max_age_h=20 / 3600)
    splits = robot.drive(100)
    robot.look(100)
    robot.look()
    # Until 98 s everything was searched, and 50 s before that may be needed.
    assert [each.exists() for each in splits] == [False] * 4 + [True] * 6


def test_a_match_that_takes_long_keeps_the_bags_in_which_it_began(tmp_path: Path) -> None:
    lasting = rule(before=2 * S, hold=60 * S)
    robot = watched(tmp_path, lasting, max_age_h=5 / 3600)
    for begin in range(0, 100, 10):
        robot.split(seconds(begin, begin + 10, range(20, 100)))
        robot.look(begin + 10)
    robot.close_all()
    assert robot.spans() == [(18, 83)]
    assert [len(moment.files) for moment in robot.moments()] == [8]


def test_the_budget_deletes_it_and_that_is_said(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule(before=3600 * S), max_bytes=10_000)
    robot.drive(100)
    robot.look()
    assert robot.logged("needed_bags_deleted")
    assert "were deleted to make room" in (robot.record().problem or "")


def test_a_name_that_is_no_utf8_stops_neither_rules_nor_deletion(tmp_path: Path) -> None:
    robot = watched(tmp_path, max_bytes=1)
    for begin in range(0, 100, 10):
        robot.split(seconds(begin, begin + 10, {92}), os.fsdecode(b"caf\xe9"))
    robot.close_all(110)
    assert robot.spans() == [(87, 95)]
    assert len([*robot.bag_dir.glob("caf*/*")]) == 2  # those of the moment


@pytest.mark.parametrize("back", [5, 60, 110])
def test_what_happens_after_the_clock_was_set_back_fires_once(
    robot: WatchedBags, back: int
) -> None:
    robot.drive(100, {98})
    begin = 100 - back
    robot.drive(begin + 10, first=begin)
    robot.house = robot.new_house()
    # A match across two splits, and one when the clock has caught up.
    held = [*range(begin + 15, begin + 25), 131]
    robot.drive(140, held, first=begin + 10)
    robot.close_all()
    assert robot.fired_at() == sorted([98, begin + 15, 131])


def test_what_version_0_1_0_searched_after_the_clock_was_set_back_is_not_searched_again(
    robot: WatchedBags,
) -> None:
    """It had searched a recording as a whole up to one log time."""
    name = robot.begin(T0)
    for begin in (0, 10, 5, 15):
        robot.split(seconds(begin, begin + 10, {22}))
    searched = TriggerState(searched={name: T0 + 25 * S})
    TRIGGERS.write(robot.bag_dir, searched)
    robot.house = robot.new_house()
    robot.split(seconds(25, 35, {28}))
    robot.close_all()
    assert robot.fired_at() == [28]


def test_a_split_that_cannot_be_read_is_named_and_searched_when_it_can(
    robot: WatchedBags, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.drive(10)
    bad = robot.split(seconds(10, 20, {15}))
    with monkeypatch.context() as failing:
        fail_to_summarize(failing, bad)
        for begin in (20, 30, 40):
            robot.split(seconds(begin, begin + 10, {begin + 2}))
            robot.look(begin + 10)
        assert bad.name in (robot.problem() or "")
    robot.close_all(300)
    assert robot.fired_at() == [15, 22, 32, 42]


@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_split_that_cannot_be_read_is_a_problem_only_until_it_can_be(
    robot: WatchedBags, monkeypatch: pytest.MonkeyPatch, is_restarted: bool
) -> None:
    robot.drive(10)
    with monkeypatch.context() as failing:
        first = robot.split(seconds(10, 20))
        second = robot.split([])  # it has no message, which shows only once it can be read
        fail_to_summarize(failing, first, second)
        robot.split(seconds(30, 40))
        robot.look(40)
        assert first.name in (robot.problem() or "")
    with monkeypatch.context() as failing:
        fail_to_summarize(failing, second)
        robot.look(300)
        assert second.name in (robot.problem() or "")
    if is_restarted:
        robot.house = robot.new_house()
    robot.look(600)
    assert robot.problem() is None


def test_a_split_that_was_deleted_before_it_could_be_read_stays_a_problem(
    robot: WatchedBags, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.drive(10)
    lost = robot.split(seconds(10, 20, {15}))
    fail_to_summarize(monkeypatch, lost)
    robot.split(seconds(20, 30))
    robot.look(30)
    lost.unlink()
    other = robot.split(seconds(30, 40))
    fail_to_summarize(monkeypatch, other)
    robot.split(seconds(40, 50))
    robot.look(60)
    said = robot.problem() or ""
    assert (lost.name in said, other.name in said) == (True, True)


def test_a_first_split_that_is_readable_late_is_searched_then(
    robot: WatchedBags, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as failing:
        first = robot.split(seconds(0, 10, {5}))
        fail_to_summarize(failing, first)
        robot.split(seconds(10, 20, {12}))
        robot.split(seconds(20, 30))
        robot.look(30)
        assert robot.fired_at() == [12]
        assert first.name in (robot.problem() or "")
    robot.close_all(300)
    assert robot.fired_at() == [5, 12]
    assert robot.problem() is None


def test_deleting_what_was_searched_fires_nothing_again(robot: WatchedBags) -> None:
    paths = robot.drive(50, {25})
    paths[1].unlink()
    robot.split(seconds(50, 60))
    robot.close_all()
    assert robot.fired_at() == [25]


def test_a_split_that_the_disk_never_gives_stops_the_rules_for_a_day(
    robot: WatchedBags, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = robot.split(seconds(0, 10, {2}))
    robot.split(seconds(10, 20, {16}))
    robot.clock.at = T0 + 40 * S
    fault = BagUnreachableError(str(bad), "it cannot be opened or read: Input/output error")
    fail_reading(monkeypatch, "records", lambda path: fault if path == bad else None)
    robot.close_all()
    assert robot.logged("moments_not_minded")
    for hour in range(1, 25):
        assert robot.spans() == []
        robot.now_s = hour * 3600.0
        robot.look()
    assert robot.spans() == [(11, 19)]


def test_where_its_state_cannot_be_read_the_budget_deletes_and_age_does_not(tmp_path: Path) -> None:
    robot = watched(tmp_path, max_bytes=10_000, max_age_h=0.02)
    with broken(TRIGGERS, "read", errno.EIO):
        robot.house = robot.new_house()
        robot.begin(T0)
        for begin in (*range(0, 50, 10), 500):
            robot.split(seconds(begin, begin + 10))
        robot.look()
    assert [told["reason"] for told in robot.logged("moments_not_minded")]
    assert len([*robot.bag_dir.glob("rec_*/*.mcap")]) == 4  # of 6; by age there would be one


def test_a_state_that_is_damaged_is_said_to_be_lost(tmp_path: Path) -> None:
    robot = watched(tmp_path, rule(condition=parse_condition("equals", True, 0.5, "data")))
    (robot.bag_dir / TRIGGERS_FILE).write_text('{"format": 1, "rules": 7}')
    robot.house = robot.new_house()
    robot.look()
    [said] = robot.logged("trigger_state_lost")
    assert "rules" in said["reason"]
    # Messages that are searched since do not bring back what was lost.
    robot.begin(T0 + 3600 * S)
    robot.split([flag(3600, value=False)])
    robot.close_all()
    assert robot.record().problem == said["reason"]


def test_moments_that_cannot_be_stored_are_a_problem_until_they_are(robot: WatchedBags) -> None:
    robot.split(seconds(0, 10, {5}))
    moments = robot.bag_dir / "moments"
    moments.symlink_to(robot.bag_dir.parent)
    robot.close_all()
    assert "cannot be stored" in (robot.problem() or "")
    moments.unlink()
    robot.look()
    assert (robot.spans(), robot.problem()) == ([(0, 8)], None)


@pytest.mark.parametrize("field", ["missing", "x"])
def test_a_condition_that_nothing_can_meet_is_named(tmp_path: Path, field: str) -> None:
    robot = watched(tmp_path, rule(condition=parse_condition("equals", True, 0.5, field)))
    robot.split(seconds(0, 10))
    robot.close_all()
    assert f"'{field}'" in (robot.record().problem or "")


def test_messages_that_cannot_be_decoded_are_named(robot: WatchedBags) -> None:
    robot.split(seconds(0, 3), layout=McapLayout(definitions=False))
    robot.split([Msg("/bumper", "std_msgs/msg/Bool", T0 + 5 * S, b"")])
    robot.close_all()
    assert "/bumper" in (robot.record().problem or "")


def test_what_was_published_by_a_clock_that_was_ahead_makes_nothing_a_repeat(
    robot: WatchedBags,
) -> None:
    year = 365 * 86_400
    for begun in (year, 100, 4000):
        robot.begin(T0 + begun * S)
        states = [flag(begun + at, at == 30) for at in (20, 30, 40)]
        said = [replace(each, publish_time=each.log_time - 10**6) for each in states]
        robot.split(said, layout=LATCHED)
        robot.close_all()
    assert len(robot.fired_at()) == 3
