"""Handovers that a crash cut short, brought to their end by reading both recordings."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import (
    Counting,
    Handover,
    Overlap,
    read_handover,
    write_handover,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.recorder.handover import intended, pending, void
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, tf, transform, write_mcap
from tests.support.handovers import recover_handovers
from tests.support.simulated_recorders import World

S = 10**9
T0 = 1_795_150_800 * S
READER = McapReader()
TRUNCATED = McapLayout(chunk_size=None, finish=False)


def message(published: int, delay: int) -> Msg:
    made = boolean(published, True)
    return Msg(made.topic, made.type, published + delay, made.body, published)


def recording(bag_dir: Path, name: str, start: float, stop: float, *, delay: int) -> Path:
    """A recording cut short that received ten messages a second from start to stop."""
    first, last = round(start * 10), round(stop * 10)
    messages = [message(T0 + n * S // 10, delay) for n in range(first, last)]
    directory = bag_dir / name
    write_mcap(directory / f"{name}_0.mcap", messages, TRUNCATED)
    return directory


def counted(bag_dir: Path) -> Counter[int]:
    found: Counter[int] = Counter()
    for path in bag_dir.glob("*/*.mcap"):
        if path.stat().st_size:
            records = BagDirReader(READER).records(path, ["/bumper"], TimeWindow.everything())
            found.update(record.publish_time for record in records)
    return found


@given(
    old_stop=st.floats(5, 20),
    new_start=st.floats(5, 20),
    new_lasts=st.floats(0, 20),
    delays=st.tuples(st.integers(0, S // 1000), st.integers(0, S // 1000)),
)
def test_whatever_either_holds_counts_exactly_once(
    tmp_path_factory: pytest.TempPathFactory,
    old_stop: float,
    new_start: float,
    new_lasts: float,
    delays: tuple[int, int],
) -> None:
    bag_dir = tmp_path_factory.mktemp("bags")
    old = recording(bag_dir, "a", 0, old_stop, delay=delays[0])
    new = recording(bag_dir, "b", new_start, new_start + new_lasts, delay=delays[1])
    write_handover(old, intended(Handover(), "b"))
    write_handover(new, pending("a"))
    recover_handovers(bag_dir, READER)
    expected = {round(n) for n in range(round(old_stop * 10))} | set(
        range(round(new_start * 10), round((new_start + new_lasts) * 10))
    )
    assert counted(bag_dir) == dict.fromkeys((T0 + n * S // 10 for n in expected), 1)
    assert read_handover(old).handover.counts_until is not None


def test_a_new_one_that_was_never_begun_is_forgotten(tmp_path: Path) -> None:
    old = recording(tmp_path, "a", 0, 10, delay=5)
    write_handover(old, intended(Handover(previous="z"), "b"))
    recover_handovers(tmp_path, READER)
    assert read_handover(old).handover == Handover(previous="z")


def test_a_handover_that_had_failed_stays_failed(tmp_path: Path) -> None:
    old = recording(tmp_path, "a", 0, 10, delay=5)
    new = recording(tmp_path, "b", 8, 9, delay=9)
    write_handover(old, intended(Handover(), "b"))
    write_handover(new, void("a"))
    recover_handovers(tmp_path, READER)
    assert read_handover(old).handover.next is None
    assert read_handover(new).handover.state is Counting.VOID
    assert counted(tmp_path) == dict.fromkeys((T0 + n * S // 10 for n in range(100)), 1)


def test_a_crash_between_the_two_sidecars_is_brought_to_its_end(tmp_path: Path) -> None:
    old = recording(tmp_path, "a", 0, 10, delay=5)
    new = recording(tmp_path, "b", 7, 15, delay=9)
    cut = T0 + 9 * S
    write_handover(old, intended(Handover(), "b"))
    begin = Overlap(T0 + 6 * S, T0 + 10 * S, ("b_0.mcap",))
    write_handover(new, Handover(previous="a", counts_from=cut, begin=begin))
    recover_handovers(tmp_path, READER)
    assert read_handover(old).handover.counts_until == cut
    assert counted(tmp_path) == dict.fromkeys((T0 + n * S // 10 for n in range(150)), 1)


def test_latched_messages_do_not_say_how_far_a_recording_reaches(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    static = tf(T0 + 99 * S, transform(T0, "a", "b", (0, 0, 0)), topic="/tf_static")
    write_mcap(directory / "a_0.mcap", [message(T0, 5), static], TRUNCATED)
    new = recording(tmp_path, "b", 0, 50, delay=9)
    write_handover(directory, intended(Handover(), "b"))
    write_handover(new, pending("a"))
    recover_handovers(tmp_path, READER)
    assert counted(tmp_path) == dict.fromkeys((T0 + n * S // 10 for n in range(500)), 1)


def test_after_a_clock_that_was_set_back_no_more_than_a_minute_is_in_doubt(tmp_path: Path) -> None:
    day = 86400
    old = recording(tmp_path, "a", day, day + 2, delay=0)
    new = recording(tmp_path, "b", 0, 300, delay=0)
    write_handover(old, intended(Handover(), "b"))
    write_handover(new, pending("a"))
    recover_handovers(tmp_path, READER)
    assert len(counted(tmp_path)) >= 20 + 2400


def test_what_cannot_be_completed_is_reported_and_the_rest_is_completed(tmp_path: Path) -> None:
    for name in ("a", "c"):
        old = recording(tmp_path, name, 0, 1, delay=0)
        write_handover(old, intended(Handover(), name + "2"))
    (tmp_path / "a" / ".handover.json.tmp").mkdir()
    with capture_logs() as logs:
        World(tmp_path).started(100)
    assert [each["recording"] for each in logs if each["log_level"] == "error"] == ["a"]
    assert read_handover(tmp_path / "c").handover.next is None


def test_a_new_one_that_has_handed_over_since_keeps_what_it_gave_away(tmp_path: Path) -> None:
    first = recording(tmp_path, "a", 0, 10, delay=5)
    second = recording(tmp_path, "b", 8, 20, delay=9)
    third = recording(tmp_path, "c", 18, 25, delay=2)
    write_handover(first, intended(Handover(), "b"))
    end = Overlap(T0 + 18 * S, None, ("b_0.mcap",))
    handed_over = replace(pending("a"), next="c", counts_until=T0 + 19 * S, end=end)
    write_handover(second, handed_over)
    begin = Overlap(T0 + 17 * S, T0 + 21 * S, ("c_0.mcap",))
    write_handover(third, Handover(previous="b", counts_from=T0 + 19 * S, begin=begin))
    recover_handovers(tmp_path, READER)
    assert counted(tmp_path) == dict.fromkeys((T0 + n * S // 10 for n in range(250)), 1)


def test_one_whose_predecessor_was_deleted_is_settled(tmp_path: Path) -> None:
    new = recording(tmp_path, "b", 7, 15, delay=9)
    begin = Overlap(T0 + 6 * S, T0 + 10 * S, ("b_0.mcap",))
    after = Handover(previous="a", counts_from=T0 + 9 * S, begin=begin, compared=False)
    write_handover(new, after)
    with capture_logs() as logs:
        recover_handovers(tmp_path, READER)
    assert not logs
    assert read_handover(new).handover == after
