"""What is kept, over real files: by the keeper, through crashes, and past retention."""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory import queries
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.layout import MOMENT_FILE, REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import RequestQueue, stored_moments_in
from ros2_memory.core.model import Sample
from ros2_memory.history.context import Call
from ros2_memory.history.view import AtTime
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention import saved_moments
from ros2_memory.retention.saved_moments import LONGEST_WAIT_NS, Share
from tests.support.bags import McapLayout, odom, tf_of, write_mcap
from tests.support.clocks import SettableClock
from tests.support.examples import examples
from tests.support.fakes import broken, killed_at
from tests.support.housekeepers import (
    NOW,
    T0,
    A,
    B,
    S,
    asked,
    bag,
    files_in,
    house_of,
    in_moments,
    kept,
    lines,
    list_ended,
    recording,
    recording_now,
    size_of,
    told_of,
)
from tests.support.memories import memory_of
from tests.support.simulated_recorders import events

# A file has one size.
OPEN = McapLayout(chunk_size=400, finish=False)
"""Of a split that is being written."""
FILES = st.lists(st.integers(0, 8).map(lambda inode: (inode, 7 * inode)), max_size=12)


def test_the_bags_of_the_moment_are_linked_under_their_names(tmp_path: Path) -> None:
    made = recording(tmp_path, A, 0)
    # Both ends are part of it: each of these bags has one.
    outcome = kept(house_of(tmp_path), tmp_path, 19, 20, "Küche")
    assert (outcome.bags, outcome.pending, outcome.refused) == (2, False, None)
    folder = tmp_path / "moments" / str(outcome.moment) / A
    names = ["handover.json", f"{A}_1.mcap", f"{A}_2.mcap"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert (folder / names[1]).samefile(made[1])
    reported = told_of(tmp_path)
    told = [reported[key] for key in ("label", "complete", "missing", "start_ns", "end_ns")]
    assert told == ["Küche", True, [], T0 + 19 * S, T0 + 20 * S]
    assert not list((tmp_path / REQUESTS_FOLDER).iterdir())


@pytest.mark.parametrize("name", [A, os.fsdecode(b"caf\xe9")])
def test_a_bag_that_went_since_the_index_was_made_is_named_as_missing(
    tmp_path: Path, name: str
) -> None:
    # As `forget`, in another process, deletes beside the recorder.
    made = recording(tmp_path, name, 0)
    house = house_of(tmp_path)
    asked(tmp_path, 15, 25)
    with house._index.undisturbed() as snapshot:
        made[1].unlink()
        house.moments.keep(snapshot)
    reported = told_of(tmp_path)
    missing = [f"{name}/{name}_1.mcap is missing, or another file has its name"]
    assert (reported["complete"], reported["missing"]) == (False, missing)
    assert len(in_moments(tmp_path)) == 1


def test_what_cannot_be_kept_is_refused_with_the_reason_and_leaves_nothing(tmp_path: Path) -> None:
    made = recording(tmp_path, A, 0)
    house = house_of(tmp_path, moments_bytes=sum(path.stat().st_size for path in made[:3]))

    def refusal(start: int, end: int) -> str:
        return str(kept(house, tmp_path, start, end).refused)

    assert "nothing was recorded then" in refusal(500, 600)
    with broken(os, "link", errno.EPERM):
        assert "no hard link can be made: Operation not permitted" in refusal(15, 25)
    moments = tmp_path / "moments"
    with broken(saved_moments, "flush", errno.EIO, where=lambda path: path == moments):
        why = f"the bags cannot be saved in {moments}: Input/output error"
        assert refusal(15, 25) == why
    assert not [*moments.glob("*")]
    assert lines(tmp_path) == []
    # A bag that two moments share counts once in the share.
    assert [kept(house, tmp_path, *span).bags for span in ((0, 15), (5, 25))] == [2, 3]
    assert "retention.max_moments_gb" in refusal(25, 35)
    assert len(stored_moments_in(tmp_path).readable) == 2
    # Behind a link moments are neither made nor followed.
    (tmp_path / "moments").rename(tmp_path.parent / "else")
    (tmp_path / "moments").symlink_to(tmp_path.parent / "else")
    before = files_in(tmp_path.parent / "else")
    assert "symbolic link" in refusal(0, 5)
    assert files_in(tmp_path.parent / "else") == before


def test_a_moment_in_a_moment_is_kept_under_the_name_that_it_was_recorded_by(
    tmp_path: Path,
) -> None:
    made = recording(tmp_path, A, 0)
    house = house_of(tmp_path)
    kept(house, tmp_path, 0, 5, "one")
    made[0].unlink()
    assert kept(house, tmp_path, 2, 7, "two").bags == 1
    one, two = in_moments(tmp_path)
    assert one.partition("/")[2] == two.partition("/")[2] == f"{A}/{A}_0.mcap"


def waiting(bag_dir: Path, **limits: Any) -> tuple[Housekeeping, SettableClock]:
    """Two splits, and a moment that goes on for 6 s longer."""
    recording(bag_dir, A, 0, splits=2)
    clock = SettableClock(T0 + 19 * S)
    house = house_of(bag_dir, clock=clock, **limits)
    outcome = kept(house, bag_dir, 0, 25, at=clock.at)
    assert (outcome.bags, outcome.pending) == (2, True)
    return house, clock


def waiting_for_open(bag_dir: Path) -> tuple[Housekeeping, SettableClock]:
    """Two splits, a third that is being written, and a moment that waits for that one."""
    recording(bag_dir, A, 0, splits=2)
    open_one = bag(bag_dir / A / f"{A}_2.mcap", 20, OPEN)
    now = SettableClock(open_one.stat().st_mtime_ns)
    recording_now(bag_dir, A, clock=now)
    house = house_of(bag_dir, clock=now)
    outcome = kept(house, bag_dir, 15, 25, at=now.at)
    assert (outcome.bags, outcome.pending) == (1, True)
    assert told_of(bag_dir)["complete"] is False
    return house, now


def test_a_moment_waits_for_the_split_that_is_being_written(tmp_path: Path) -> None:
    _, now = waiting_for_open(tmp_path)
    bag(tmp_path / A / f"{A}_2.mcap", 20)
    bag(tmp_path / A / f"{A}_3.mcap", 30, OPEN)
    # Another recorder may be the one that goes on with it.
    house_of(tmp_path, clock=now).keep_moments()
    names = [name.rpartition("/")[2] for name in in_moments(tmp_path)]
    assert names == [f"{A}_1.mcap", f"{A}_2.mcap"]


def test_a_split_that_is_still_open_when_a_moment_waits_no_longer_is_named(tmp_path: Path) -> None:
    house, now = waiting_for_open(tmp_path)
    now.at += 3 * 3600 * S  # as a robot without a clock of its own, when it finds a time server
    recording_now(tmp_path, A, clock=now)
    house.keep_moments()
    reported = told_of(tmp_path)
    assert (reported["pending"], reported["complete"]) == (False, False)
    assert reported["missing"] == [f"{A}/{A}_2.mcap was still being written, or held back"]


def test_what_passes_the_share_when_it_closes_is_reported_and_not_kept(tmp_path: Path) -> None:
    size = bag(tmp_path / A / f"{A}_0.mcap", 0).stat().st_size
    house, clock = waiting(tmp_path, moments_bytes=5 * size // 2)
    bag(tmp_path / A / f"{A}_2.mcap", 20)
    clock.at = T0 + 26 * S
    house.keep_moments()
    reported = told_of(tmp_path)
    assert (reported["pending"], reported["complete"]) == (False, False)
    assert "retention.max_moments_gb" in reported["missing"][0]
    assert len(in_moments(tmp_path)) == 2


@pytest.mark.parametrize("stays_full", [False, True])
def test_a_disk_that_is_full_when_a_split_closes_costs_nothing_unless_it_stays_so(
    tmp_path: Path, *, stays_full: bool
) -> None:
    house, clock = waiting(tmp_path)
    bag(tmp_path / A / f"{A}_2.mcap", 20)

    with broken(os, "link"), capture_logs() as captured:
        for second in (26, 86):
            clock.at = T0 + second * S
            house.keep_moments()
            assert told_of(tmp_path)["pending"] is True
        if stays_full:
            clock.at += LONGEST_WAIT_NS
            house.keep_moments()
    told = events(captured, "moment_not_followed")
    reason = "no hard link can be made: No space left on device"
    assert [each["reason"] for each in told] == [reason]
    house.keep_moments()
    missing = [f"not all can be saved: {reason}"]
    assert told_of(tmp_path)["missing"] == (missing if stays_full else [])
    assert len(in_moments(tmp_path)) == (2 if stays_full else 3)


def test_before_anything_is_deleted_a_pending_moment_goes_on(tmp_path: Path) -> None:
    """As after a night: the recorder that begins anew repairs and deletes before it records."""
    _, clock = waiting(tmp_path)
    bag(tmp_path / A / f"{A}_2.mcap", 20, OPEN)
    # In a moment nothing is repaired: it would be another file than that it was linked to.
    left = bag(tmp_path / "moments/one" / A / f"{A}_7.mcap", 70, OPEN)
    before = left.read_bytes()
    recording(tmp_path, B, 100, splits=2)
    clock.at = NOW
    house_of(tmp_path, clock=clock, max_bytes=1).apply()
    assert left.read_bytes() == before
    assert len(in_moments(tmp_path)) == 4
    assert told_of(tmp_path)["complete"] is True


@pytest.mark.parametrize(
    ("owner", "step", "nth"),
    [(os, "link", 2), (saved_moments, "write_saved_moment", 2), (RequestQueue, "answer", 1)],
)
def test_a_recorder_that_is_killed_at_any_step_leaves_what_the_next_one_completes(
    tmp_path: Path, owner: Any, step: str, nth: int
) -> None:
    """It dies at its second link, as it writes what it made for the second time, or answers.

    No request is granted twice.
    """
    recording(tmp_path, A, 0)
    pending = asked(tmp_path, 15, 25)
    with killed_at(owner, step, nth):
        house_of(tmp_path).keep_moments()
    house_of(tmp_path).keep_moments()
    outcome = pending.outcome()
    assert outcome is not None
    reported = told_of(tmp_path)
    assert (reported["pending"], reported["missing"]) == (False, [])
    assert outcome.bags == len(in_moments(tmp_path)) >= 2
    assert len(stored_moments_in(tmp_path).readable) == 1


@pytest.mark.parametrize("is_damaged", [True, False])
def test_a_moment_that_cannot_be_read_is_reported_once_and_keeps_its_part_of_the_share(
    tmp_path: Path, is_damaged: bool
) -> None:
    made = recording(tmp_path, A, 0)
    house = house_of(tmp_path, moments_bytes=5 * made[0].stat().st_size // 2)
    assert kept(house, tmp_path, 19, 20).bags == 2
    [path] = (tmp_path / "moments").glob(f"*/{MOMENT_FILE}")
    if is_damaged:
        path.write_text("{")
    else:
        path.unlink()
        path.symlink_to(path)  # OSError: too many levels of symbolic links
    with capture_logs() as captured:
        refused = [str(kept(house, tmp_path, 1, 8).refused) for _ in range(2)]
    assert all("retention.max_moments_gb" in reason for reason in refused)
    assert [each["path"] for each in events(captured, "moment_not_followed")] == [str(path.parent)]


def test_a_moment_that_cannot_be_written_holds_up_no_other(tmp_path: Path) -> None:
    recording(tmp_path, A, 0)
    clock = SettableClock(T0 + 19 * S)
    house = house_of(tmp_path, clock=clock)
    stuck = kept(house, tmp_path, 0, 25, "stuck", at=clock.at)
    clock.at = NOW
    folder = tmp_path / "moments" / str(stuck.moment)
    (folder / f".{MOMENT_FILE}.tmp").mkdir()
    with capture_logs() as captured:
        assert kept(house, tmp_path, 30, 35).bags == 1
    assert events(captured, "moment_not_written")


@given(FILES, FILES, st.integers(0, 150))
def test_what_is_granted_or_fits_never_passes_it(
    files: list[tuple[int, int]], before: list[tuple[int, int]], share: int
) -> None:
    moments = Share(share)
    for file in before:
        assert (moments.refusal([file]) is None) == moments.take(*file)
    stored = {**moments.stored}
    if moments.refusal(files) is None:
        assert sum({**stored, **dict(files)}.values()) <= share
    for file in files:
        moments.take(*file)
    assert moments.stored.items() >= stored.items()
    assert sum(moments.stored.values()) <= share


@pytest.mark.parametrize("behind_h", [169, 300])
def test_a_clock_that_was_behind_deletes_nothing(tmp_path: Path, behind_h: int) -> None:
    made = []
    for name, hours in ((A, -150), (B, 0), ("rec_wrong", -behind_h), ("rec_right", 1)):
        made.append(bag(tmp_path / name / f"{name}_0.mcap", hours * 3600))
        list_ended(tmp_path, name)
    house_of(tmp_path, max_age_h=168, keeps_foreign=True).apply()
    assert all(path.exists() for path in made)
    house_of(tmp_path, max_bytes=size_of(tmp_path) * 6 // 10, keeps_foreign=True).apply()
    assert [path.exists() for path in made] == [False, False, True, True]


def test_a_transform_that_held_then_is_carried_for_as_long_as_the_moment_is_kept(
    tmp_path: Path,
) -> None:
    for at, x in ((T0 - 100 * S, 0.1), (T0 + 100 * S, 0.2)):
        mounted = tf_of(at, "base_link", "laser", (x, 0, 0), topic="/tf_static")
        path = tmp_path / A / f"{A}_{(at - T0) // S}.mcap"
        write_mcap(path, [odom(at, 0.0, 0.0), mounted])
    recording(tmp_path, A, 0)
    recording(tmp_path, B, 3 * 3600)
    house = house_of(tmp_path, max_age_h=1)
    kept(house, tmp_path, 15, 25)
    memory = memory_of(tmp_path, clock=SettableClock(NOW))

    def known() -> Sample:
        moment = AtTime(at_s=T0 / S + 17)
        return queries.topic_value(memory, Call(), "/tf_static", moment).sample

    before = known()
    assert "0.1" in str(before.value)
    for _ in range(2):
        house.apply()
        assert known() == before
    assert not (tmp_path / A).exists()


def test_the_sidecar_of_a_recording_that_goes_on_is_followed(tmp_path: Path) -> None:
    recording(tmp_path, A, 0)
    house = house_of(tmp_path)
    kept(house, tmp_path, 15, 25)
    write_handover(tmp_path / A, Handover(notes=("x",)))
    house.apply()
    [sidecar] = (tmp_path / "moments").rglob("handover.json")
    assert sidecar.samefile(tmp_path / A / "handover.json")


STEPS = st.lists(
    st.one_of(
        st.just(("split", 0, 0)),
        st.just(("apply", 0, 0)),
        st.tuples(st.just("keep"), st.integers(0, 80), st.integers(0, 30)),
        st.tuples(st.just("forget"), st.integers(0, 3), st.just(0)),
    ),
    max_size=14,
)


@settings(max_examples=examples(25), deadline=None)
@given(steps=STEPS, budget=st.integers(3, 9), share=st.integers(0, 5))
def test_no_moments_in_any_order_break_a_budget_or_lose_what_is_kept(
    tmp_path_factory: pytest.TempPathFactory,
    steps: list[tuple[str, int, int]],
    budget: int,
    share: int,
) -> None:
    """Splits are recorded, moments kept and deleted, limits applied. A size is one of a split."""
    root = tmp_path_factory.mktemp("bags")
    size = bag(root / A / f"{A}_0.mcap", 0).stat().st_size
    splits, rooms = 1, size * budget + 40_000
    house = house_of(root, max_bytes=rooms, moments_bytes=size * share + 10)
    promised: dict[Path, int] = {}
    for what, first, second in steps:
        if what == "split":
            bag(root / A / f"{A}_{splits}.mcap", splits * 10)
            splits += 1
        elif what == "keep":
            kept(house, root, first, first + second)
            links = [path for path in root.glob("moments/**/*.mcap") if path not in promised]
            promised.update((path, path.stat().st_ino) for path in links)
        elif what == "forget":
            for folder in sorted((root / "moments").glob("*"))[first : first + 1]:
                shutil.rmtree(folder)
            promised = {path: inode for path, inode in promised.items() if path.exists()}
        else:
            with capture_logs() as captured:
                house.apply()
            [reported] = [each for each in captured if each["event"] == "retention_applied"]
            assert reported["total_bytes"] == size_of(root) <= rooms
        assert {path: path.stat().st_ino for path in promised} == promised
        held = {path.stat().st_ino: path.stat().st_size for path in promised}
        assert sum(held.values()) <= size * share + 10
        files = {path.stat().st_ino for path in root.rglob("*.mcap")}
        assert len(memory_of(root).index.snapshot().bags) == len(files)
