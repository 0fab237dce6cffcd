"""What is kept outlives retention, and counts once."""

import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory import queries
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.core.model import Sample
from ros2_memory.history.context import Call
from ros2_memory.history.view import AtTime
from tests.support.bags import odom, tf, transform, write_mcap
from tests.support.clocks import SettableClock
from tests.support.examples import examples
from tests.support.housekeepers import (
    NOW,
    T0,
    A,
    B,
    S,
    bag,
    house_of,
    kept,
    list_ended,
    recording,
    size_of,
)
from tests.support.memories import memory_of


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
        mounted = tf(at, transform(at, "base_link", "laser", (x, 0, 0)), topic="/tf_static")
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
