"""Which frame places are told in, however much of the history is in the catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.transforms import connects_in_time
from ros2_memory.history.view import View
from ros2_memory.places.pose_frames import map_placement, recording_at
from tests.support.bags import odom, write_mcap
from tests.support.memories import asked, memory_of
from tests.support.moving_map import BEGIN, S, write_moving_map

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that moves, in fifty bags."""
    folder = tmp_path_factory.mktemp("moving")
    write_moving_map(folder, 1, seconds=100, split_s=2.0)
    return folder


class _Looks:
    """A clock that shows how often it was looked at."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> float:
        self.count += 1
        return self.count


def test_the_map_is_known_from_the_newest_bags_alone(moving: Path) -> None:
    looks, memory = _Looks(), memory_of(moving)
    view = View(memory, Call(Deadline.after(1e6, looks)))
    assert map_placement(view, "/odom", "map").frame_id == "map"
    nothing = _Looks()
    everything = View(memory, Call(Deadline.after(1e6, nothing)))
    assert not connects_in_time(everything, ("map", "elsewhere"))
    assert looks.count < nothing.count / 4


def test_a_map_of_which_it_is_not_known_whether_transforms_lead_there_is_not_denied(
    moving: Path,
) -> None:
    outcomes = set()
    for ticks in range(1, 40, 4):
        # A memory of its own each time: what one call found out, the next knows.
        view = View(memory_of(moving), Call(Deadline.after(ticks, _Looks())))
        try:
            outcomes.add(map_placement(view, "/odom", "map").frame_id)
        except QueryTimeoutError:
            outcomes.add("timeout")
    assert outcomes == {"map", "timeout"}


def test_a_map_that_no_transform_leads_to_is_denied(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [odom(BEGIN + at * S, 0.0, 0.0) for at in range(3)])
    view = View(memory_of(tmp_path), Call())
    with pytest.raises(InvalidArgumentsError, match="known in odom only"):
        map_placement(view, "/odom", "map")


_HERE: dict[str, object] = {"x": 0.0, "y": 0.0, "radius_m": 2.0}
_WINDOW: dict[str, object] = {"start": BEGIN // S, "end": BEGIN // S + 200}
_MOVING: dict[str, object] = {
    "topic": "/odom",
    "field": "position.x",
    "condition_type": "above",
    "value": -5.0,
}
_OVER_RUNS: list[tuple[str, dict[str, object]]] = [
    ("visits", {"x": 0.0, "y": 0.0}),
    ("visits", {"by": "day", "where": _HERE, **_WINDOW}),
    ("find_matches", {**_MOVING, "where": _HERE}),
    ("find_matches", {**_MOVING, "where": _HERE, "by": "day", **_WINDOW}),
    ("compare", {"with_start": BEGIN // S, "with_end": BEGIN // S + 200, **_WINDOW}),
    ("recap", {"where": _HERE, **_WINDOW}),
    ("trajectory_summary", _WINDOW),
    ("trajectory_summary", {"where": _HERE, **_WINDOW}),
    ("trajectory_summary", {"by": "place", "where": _HERE, **_WINDOW}),
]
"""Calls of tools that take a place, or return places."""


@pytest.mark.parametrize(("tool", "given"), _OVER_RUNS)
def test_places_over_several_runs_of_odometry_have_a_note(
    tmp_path: Path, tool: str, given: dict[str, object]
) -> None:
    """The same coordinates are not the same place, unless a map places both runs."""
    drive = [odom(BEGIN + n * S // 5, min(n / 50, 1.0), 0.0) for n in range(300)]
    write_mcap(tmp_path / "first" / "first_0.mcap", drive)
    write_mcap(tmp_path / "copy" / "copy_0.mcap", drive[50:250])
    alone = asked(memory_of(tmp_path), tmp_path, tool, **given)
    assert "error" not in alone
    assert not any("changes with every start" in note for note in alone.get("notes", ()))

    again = [odom(BEGIN + n * S // 5, min(n / 50 - 10, 1.0), 0.0) for n in range(500, 800)]
    write_mcap(tmp_path / "second" / "second_0.mcap", again)
    both = asked(memory_of(tmp_path), tmp_path, tool, **given)
    (note,) = [note for note in both["notes"] if "changes with every start" in note]
    assert "the origin of odom" in note
    on_map = memory_of(tmp_path, limits=QuerySettings(map_frame="odom"))
    placed = asked(on_map, tmp_path, tool, **given)
    assert not any("changes with every start" in note for note in placed.get("notes", ()))


T0 = 1_700_000_000 * S


def test_a_recording_that_began_with_an_unset_clock_is_not_that_of_each_time(
    tmp_path: Path,
) -> None:
    for name, start in (("a/a_0", S), ("a/a_1", T0 + 500 * S), ("b/b_0", T0)):
        messages = [odom(start + n * S, n, 0) for n in range(10)]
        write_mcap(tmp_path / f"{name}.mcap", messages)
    view = View(memory_of(tmp_path), Call())
    assert recording_at(view, "/odom", T0 + 5 * S) == tmp_path / "b"
    assert recording_at(view, "/odom", T0 + 505 * S) == tmp_path / "a"
    # What is asked of a recording of its own stays with it, as long as that lasts.
    assert recording_at(view, "/odom", T0 + 5 * S, tmp_path / "a") == tmp_path / "a"
    assert recording_at(view, "/odom", T0 + 505 * S, tmp_path / "b") == tmp_path / "a"
    assert recording_at(view, "/odom", T0 + 999 * S) is None
