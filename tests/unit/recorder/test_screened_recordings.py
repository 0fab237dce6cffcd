"""A recorder that screens what it records before it is served: sessions, handovers, the house."""

from pathlib import Path

import pytest

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.layout import SCREENED_FILE
from ros2_memory.bag_dir.state_files import SCREENED, read_withheld
from ros2_memory.recorder.background import Background
from ros2_memory.storage.mcap.writer import McapWriter
from tests.support.bags import McapLayout
from tests.support.fakes import broken, failing
from tests.support.housekeepers import keeper_of, recording_now
from tests.support.screened_bags import ScreenedBags, off, on, privacy, words
from tests.support.simulated_recorders import assert_each_counts_once, rotating

pytestmark = pytest.mark.usefixtures("no_flushing")

OPEN = McapLayout(latched=frozenset({"/privacy_mode"}), finish=False, chunk_size=400)


@pytest.mark.parametrize("unknown", [False, True])
def test_over_rotations_what_is_not_excluded_counts_once(tmp_path: Path, unknown: bool) -> None:
    bags = ScreenedBags(tmp_path, privacy(excludes_unknown=unknown))
    house = keeper_of(tmp_path, screening=bags.screening)
    world = rotating(tmp_path, housekeeper=house)
    for _ in range(12):
        world.run(5)
        withheld = read_withheld(tmp_path)
        newest = world.heartbeat()["recordings"][-1]
        assert withheld.holds(newest, f"{newest}_0.mcap") or (tmp_path / newest).exists()
    world.supervisor.stop()
    if unknown:
        assert not world.published(counting=False)
    else:
        assert_each_counts_once(world)
    names = [each.name for each in tmp_path.glob("rec_*")]
    assert len(names) > 2
    assert not any(read_withheld(tmp_path).holds_some(each) for each in names)
    # Compared when they were released, and not before.
    assert all(read_handover(tmp_path / each).handover.compared for each in sorted(names)[1:])


def test_a_recording_that_cannot_be_held_back_does_not_begin(tmp_path: Path) -> None:
    house = keeper_of(tmp_path, screening=ScreenedBags(tmp_path).screening)
    world = rotating(tmp_path, 15, housekeeper=house)
    with broken(SCREENED, "write"):
        world.run(15)
        assert len(world.recorders) == 1
        assert "screened.json: No space left" in world.heartbeat()["last_error"]
    world.run(80)
    assert len(world.recorders) > 1
    world.supervisor.stop()


def test_what_a_crash_left_open_is_repaired_and_then_screened(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    house = keeper_of(bags.bag_dir, screening=bags.screening)
    name = bags.begin(0)
    bags.split(name, [off(-2), *words(0, 10)])
    bags.split(name, words(10, 20), OPEN)
    bags.end()
    assert len(bags.served()) == 1
    assert bags.screening.problem() is None
    house.apply()
    bags.step()
    assert [path.name for path in bags.served()] == [f"{name}_{n}.mcap" for n in range(2)]


def test_the_budget_may_delete_what_is_held_back_in_a_recording_that_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(McapWriter, "cut", failing())
    bags = ScreenedBags(tmp_path / "bags")
    name = bags.begin(0)
    held = bags.split(name, [on(0), *words(0, 10)])
    bags.split(name, [off(13), *words(10, 30)])
    bags.end()
    recording_now(bags.bag_dir, name)
    keeper_of(bags.bag_dir, max_bytes=1).apply()
    assert held.exists()
    recording_now(bags.bag_dir)
    keeper_of(bags.bag_dir, max_bytes=1).apply()
    assert not held.exists()


def test_a_step_runs_in_the_background_and_its_fault_is_reported(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    house = keeper_of(bags.bag_dir, background=Background(), screening=bags.screening)
    name = bags.begin(0)
    bags.split(name, [off(-2), *words(0, 10)])
    house.screen(())
    house.wait()
    assert len(bags.served()) == 1
    (bags.bag_dir / SCREENED_FILE).write_text("{")
    background = Background()
    house = keeper_of(bags.bag_dir, screening=bags.new(), background=background)
    house.screen(())
    assert "screened.json" in background.faults()["screen"]
    house.finish()
    assert "screened.json" in background.faults()["screen"]
