"""Bags that the recorder did not make are neither deleted, repaired nor counted in a limit."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory import cli
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.history.context import Call, Memory
from ros2_memory.insights.status import memory_status
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention.clear import clear_bags
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.serving.health import Health
from tests.support.bags import McapLayout, mcap_content, odom, set_mtime, write_mcap
from tests.support.clocks import SettableClock
from tests.support.examples import examples
from tests.support.housekeepers import (
    NOW,
    PLENTY,
    T0,
    A,
    B,
    S,
    files_in,
    house_of,
    in_moments,
    keeper_of,
    kept,
    own_all,
    recording,
    size_of,
)
from tests.support.memories import memory_of
from tests.support.program import Program, exits
from tests.support.simulated_recorders import events

__all__ = ["exits"]


def bytes_of(paths: Iterable[Path]) -> int:
    return sum(path.stat().st_size for path in paths)


def careful(bag_dir: Path, **limits: Any) -> Housekeeping:
    """A house that leaves foreign bags alone."""
    return house_of(bag_dir, keeps_foreign=True, **limits)


def foreign(bag_dir: Path, *names: str) -> list[Path]:
    """Bags of another program, older than any of the recorder's."""
    return [
        write_mcap(bag_dir / name, [odom(T0 + (n - 86_400) * S, 1.0, 2.0) for n in range(20)])
        for name in names
    ]


Mixed: TypeAlias = "tuple[Path, list[Path], list[Path]]"


@pytest.fixture
def mixed(tmp_path: Path) -> Mixed:
    """The bag directory, the recorder's bags, and those of others wherever they may lie."""
    mine = [*recording(tmp_path, A, 0), *recording(tmp_path, B, 3 * 3600)]
    own_all(tmp_path)
    others = foreign(
        tmp_path,
        "session_mcap/session_0.mcap",
        "loose.mcap",
        "deep/er/run/run_0.mcap",
        f"deep/{A}/{A}_0.mcap",
        f"{A}/inside/x_0.mcap",
        f"{A}/theirs_0.mcap",
        "latched/latched_0.mcap",
        "rec_20260101T000000Z/rec_20260101T000000Z_0.mcap",
    )
    (tmp_path / "session_mcap" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    return tmp_path, mine, others


def test_the_budget_counts_the_recorders_own_and_moments_alone(mixed: Mixed) -> None:
    bag_dir, mine, others = mixed
    (bag_dir / "session_mcap" / "broken.mcap").write_bytes(b"no bag")
    kept(careful(bag_dir), bag_dir, 0, 15)
    besides = bytes_of(others)

    counted = size_of(bag_dir) - besides - len(b"no bag")
    counted -= (bag_dir / "session_mcap" / "metadata.yaml").stat().st_size
    with capture_logs() as logs:
        careful(bag_dir, max_bytes=counted).apply()
    [reported] = events(logs, "retention_applied")
    found = [reported[key] for key in ("log_level", "bags", "total_bytes", "foreign_bytes")]
    assert found == ["debug", 0, counted, besides + len(b"no bag")]
    [warned] = events(logs, "foreign_bags_kept")
    assert "adopt" in warned["reason"]
    careful(bag_dir, max_bytes=counted - 1).apply()
    # The first two are kept in a moment, and would free nothing.
    assert [path.exists() for path in mine[:4]] == [True, True, False, True]


@settings(max_examples=examples(25), deadline=None)
@given(
    ours=st.lists(st.booleans(), min_size=1, max_size=6),
    budget=st.integers(1, 60_000),
    free=st.booleans(),
)
def test_whatever_the_limits_only_listed_recordings_lose_a_bag(
    tmp_path_factory: pytest.TempPathFactory,
    ours: list[bool],
    budget: int,
    free: bool,
) -> None:
    bag_dir = tmp_path_factory.mktemp("bags")
    names = {f"rec_20260921T10{nth:02}00Z": own for nth, own in enumerate(ours)}
    for are_own in (True, False):
        for nth, (name, own) in enumerate(names.items()):
            if own is are_own:
                recording(bag_dir, name, nth * 600, splits=2)
        if are_own:
            own_all(bag_dir)
    before = files_in(bag_dir)
    house = careful(bag_dir, max_bytes=budget, measure_free=lambda _: PLENTY * free)
    house.apply()
    house.make_room(PLENTY)
    lost = {path.partition("/")[0] for path in {*before} - {*files_in(bag_dir)}}
    assert all(names[name] for name in lost)


def test_what_a_killed_recorder_began_goes_where_it_holds_no_byte(tmp_path: Path) -> None:
    own_all(tmp_path)
    own = OwnRecordings(tmp_path)
    own.begin(A)
    for name in (A, B):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}_0.mcap").touch()
    keeper_of(tmp_path, keeps_foreign=True).prepare()
    assert not (tmp_path / A).exists()
    assert (tmp_path / B / f"{B}_0.mcap").exists()


def test_a_repair_neither_rewrites_nor_removes_another_programs_bag(tmp_path: Path) -> None:
    own_all(tmp_path)
    folder = tmp_path / A
    layout = McapLayout(chunk_size=400, finish=False)
    cut = write_mcap(folder / "x_0.mcap", [odom(T0 + n, 1.0, 2.0) for n in range(30)], layout)
    empty = folder / "x_1.mcap"
    empty.touch()
    before = cut.read_bytes()
    house = keeper_of(tmp_path, keeps_foreign=True)
    for _ in range(2):
        house.apply()
        assert cut.read_bytes() == before
        assert empty.exists()
        # Nor where it lies in a recording of ours.
        own = OwnRecordings(tmp_path)
        own.begin(A)
        own.complete(A)
    own_all(tmp_path)
    house.apply()
    assert cut.read_bytes() != before
    assert not empty.exists()


def test_of_moments_those_bags_go_that_were_saved(tmp_path: Path) -> None:
    own_all(tmp_path)
    recording(tmp_path, A, 0)
    house = careful(tmp_path)
    moments = [
        tmp_path / "moments" / str(kept(house, tmp_path, 5, 25, label).moment)
        for label in ("ours", "mixed")
    ]
    others = foreign(
        moments[1], "theirs_0.mcap", f"{A}/theirs_0.mcap", f"{A}/{A}_5.mcap", "run/run_0.mcap"
    )
    others += foreign(tmp_path, "moments/theirs/x_0.mcap")
    # What retention deleted long ago is in no list.
    (tmp_path / A).rename(tmp_path.parent / "gone")
    own = OwnRecordings(tmp_path)
    own.claim()
    clear_bags(tmp_path, own)
    assert all(path.exists() for path in others)
    assert len(in_moments(tmp_path)) == len(others)
    assert not moments[0].exists()


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exits: Program) -> Program:
    """The program on the robot whose bags these are."""
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    return exits


def memory_in(bag_dir: Path, *, keeps_foreign: bool = True) -> Memory:
    memory = memory_of(bag_dir, clock=SettableClock(NOW))
    limits = RetentionLimits(PLENTY, 10**6 * 3600 * S, keeps_foreign=keeps_foreign)
    return replace(memory, limits=replace(memory.limits, kept=limits))


def test_status_and_health_say_how_much_foreign_bags_take(mixed: Mixed) -> None:
    bag_dir, mine, others = mixed
    broken, loose = bag_dir / "session_mcap" / "broken.mcap", bag_dir / "loose.mcap"
    broken.write_bytes(b"no bag")
    memory = memory_in(bag_dir)
    budget = memory_status(memory, Call()).budget
    assert budget.used - budget.state == bytes_of(mine)
    assert budget.foreign == bytes_of([*others, broken])
    assert anyio.run(Health(memory))["foreign_bytes"] == budget.foreign
    # They follow the list and the bags.
    own_all(bag_dir)
    assert memory_status(memory, Call()).budget.foreign == bytes_of([loose])
    loose.unlink()
    memory.index.refresh()
    assert memory_status(memory, Call()).budget.foreign == 0


def test_a_foreign_bag_that_grows_is_measured_anew(tmp_path: Path) -> None:
    recording(tmp_path, A, 0)
    own_all(tmp_path)
    messages = [odom(T0 + n * S // 10, 1.0, 2.0) for n in range(500)]
    content = mcap_content(messages, McapLayout(finish=False, chunk_size=4096))
    session = tmp_path / "session_mcap" / "session_0.mcap"
    session.parent.mkdir()
    memory = memory_in(tmp_path)
    sizes = [len(content) * fifths // 5 for fifths in range(1, 6)]
    reported = list[int | None]()
    for size in sizes:
        session.write_bytes(content[:size])
        set_mtime(session, NOW)
        memory.index.refresh()
        reported.append(memory_status(memory, Call()).budget.foreign)
    assert reported == sizes


def test_nothing_is_reported_where_it_is_not_known_or_does_not_matter(tmp_path: Path) -> None:
    foreign(tmp_path, "session_mcap/session_0.mcap")
    assert memory_status(memory_in(tmp_path), Call()).budget.foreign is None
    own_all(tmp_path)
    every = memory_in(tmp_path, keeps_foreign=False)
    assert memory_status(every, Call()).budget.foreign is None
    assert memory_status(memory_of(tmp_path), Call()).budget.foreign is None
    assert "foreign_bytes" not in anyio.run(Health(every))


def test_doctor_and_info_say_how_much_foreign_bags_take(
    tmp_path: Path, robot: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    own_all(tmp_path)
    foreign(tmp_path, "session_mcap/session_0.mcap")
    cli.main(["doctor", "--json"])  # its exit code is of other findings, too
    found = json.loads(capsys.readouterr().out)["findings"]
    [disk] = [each["seen"] for each in found if each["about"] == "disk"]
    assert "bags that the recorder did not make take" in disk
    assert "ros2-memory adopt DIR" in disk
    reported = robot(0, "info --json").json["memory_status"]["budget"]
    assert reported["used_gb"] < 0.001 < 10**9 * reported["foreign_gb"]


def test_adopt_takes_a_directory_and_all_below_it(tmp_path: Path, robot: Program) -> None:
    foreign(tmp_path, "old/a/a_0.mcap", "old/a/a_1.mcap", "old/b/c/d_0.mcap", "other/x.mcap")
    reported = robot(0, "adopt", tmp_path / "old").out
    own = OwnRecordings(tmp_path)
    assert [*own.names()] == ["old/a", "old/b/c"]
    assert own.owns(tmp_path / "old" / "a")
    assert "adopted: old/a (2 bag files, " in reported
    assert "retention deletes them from now on" in reported
    # What lies loose in the bag directory is in none.
    foreign(tmp_path, "latched/carried.mcap", "moments/m/r/r.mcap")
    (tmp_path / "other" / "x.mcap").rename(tmp_path / "loose.mcap")
    robot(0, "adopt", tmp_path)
    assert [*own.names()] == ["old/a", "old/b/c"]


@pytest.mark.parametrize("name", ["nowhere", "/", "..", "link"])
def test_what_is_no_directory_of_bags_here_is_refused(
    tmp_path: Path, robot: Program, name: str
) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert "ros2-memory adopt: " in robot(2, "adopt", name).err


def test_links_are_neither_adopted_nor_counted(tmp_path: Path, robot: Program) -> None:
    [target] = foreign(tmp_path, "old/x_0.mcap")
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    (tmp_path / "a" / "x_0.mcap").symlink_to(target)
    (tmp_path / "a" / "y_0.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "b" / "old").symlink_to(target.parent)
    output = robot(1, "adopt a b").out
    told = ("there are no bag files", "links are not followed", "adopted")
    assert [each in output for each in told] == [True, True, False]
    (tmp_path / "old" / "y_0.mcap").symlink_to(tmp_path / "nowhere")
    assert "adopted: old (1 bag file, " in robot(0, "adopt old a").out
    assert [*OwnRecordings(tmp_path).names()] == ["old"]
