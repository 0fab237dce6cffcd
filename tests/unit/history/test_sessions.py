"""Whose transforms hold: those of the time, of both topics, and of the recording that is asked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import AtTime
from ros2_memory.insights.sightings import find_matches
from ros2_memory.places.visits import visits
from ros2_memory.queries import (
    frames,
    transform,
    value_when,
)
from tests.support.bags import Msg, boolean, detections, odom, tf, write_splits
from tests.support.bags import transform as stamped
from tests.support.memories import each_way, memory_of

if TYPE_CHECKING:
    from pathlib import Path


S = 10**9
BEGIN = 1_784_000_000 * S
DAY = 86_400 * S


def static(at: int, parent: str, child: str, x: float) -> Msg:
    return tf(at, stamped(at, parent, child, (x, 0.0, 0.0)), topic="/tf_static")


def moving(begin: int, seconds: int, parent: str, child: str, x: float, mps: float) -> list[Msg]:
    ticks = [begin + nth * S // 5 for nth in range(seconds * 5 + 1)]
    return [
        tf(at, stamped(at, parent, child, (x + mps * (at - begin) / S, 0.0, 0.0))) for at in ticks
    ]


def drive(begin: int, seconds: int, mps: float = 0.5) -> list[Msg]:
    """Odometry along x from 0."""
    ticks = [begin + nth * S // 5 for nth in range(seconds * 5 + 1)]
    return [odom(at, mps * (at - begin) / S, 0.0, 0.0) for at in ticks]


def record(folder: Path, messages: list[Msg], split_s: int = 10) -> None:
    write_splits(folder.parent, messages, split_s, folder.name)


def arrivals(memory: Memory, x: float, radius: float = 0.3) -> list[float]:
    """Arrivals in whole seconds after BEGIN, newest first."""
    found = visits(memory, Call(), x, 0.0, radius_m=radius)
    assert found.frame_id == "map"
    return [round(((each.arrived or 0) - BEGIN) / S, 1) for each in found.visits]


def two_robots(root: Path, static_at: int, moving_at: int) -> None:
    """One whose map is 100 m off its odometry for ever; and one that slips in its odometry."""
    first = drive(static_at + 1, 20, 0.4)  # else the first messages of both are one
    record(root / "nav2", [static(static_at, "map", "odom", 100.0), *first])
    record(root / "boat", [*moving(moving_at, 20, "map", "odom", 5.0, -0.5), *drive(moving_at, 20)])


@each_way
@pytest.mark.parametrize("nav2_days", [-3, 3, 0])
def test_a_place_in_the_map_is_one_by_the_transforms_of_the_own_recording(
    tmp_path: Path, nav2_days: int, recalls: bool
) -> None:
    """The boat stands at 5 m of its map throughout; the other robot drives from 100 m to 110."""
    apart = nav2_days * DAY
    two_robots(tmp_path, BEGIN + apart, BEGIN)
    memory = memory_of(tmp_path, recalls=recalls)
    assert arrivals(memory, 5.0) == [0.0]
    assert arrivals(memory, 103.0) == [round(apart / S + 6.8, 1)]
    assert visits(memory, Call(), 3.0, 0.0, radius_m=0.3).visits == ()
    assert visits(memory, Call(), 105.0, 0.0, radius_m=0.3).total == 1


def test_another_robots_static_transform_places_nothing(tmp_path: Path) -> None:
    """A boat without a map has no position in that of another robot."""
    record(tmp_path / "nav2", [static(BEGIN - DAY, "map", "odom", 100.0), *drive(BEGIN - DAY, 20)])
    record(
        tmp_path / "boat", [*moving(BEGIN, 20, "odom", "base_link", 0.0, 0.5), *drive(BEGIN, 20)]
    )
    memory = memory_of(tmp_path)
    assert arrivals(memory, 103.0) == [round(-DAY / S + 5.4, 1)]
    with pytest.raises(NoDataError):
        transform(memory, Call(), "map", "odom", AtTime(unix_from_ns(BEGIN + 5 * S)))


def asked(memory: Memory, at: int, parent: str = "map", child: str = "odom") -> float:
    found = transform(memory, Call(), parent, child, AtTime(unix_from_ns(at)))
    return round(found.transform.translation[0], 3)


def test_a_note_names_the_recording_that_answers_and_none_that_is_not_there(tmp_path: Path) -> None:
    first, second = "rec_20260714T000000Z", "rec_20260714T000001Z"
    for name, x in ((first, 100.0), (second, 500.0)):
        record(tmp_path / name, [static(BEGIN, "map", "odom", x), *drive(BEGIN, 20)])
    memory = memory_of(tmp_path)
    found = transform(memory, Call(), "map", "odom", AtTime(unix_from_ns(BEGIN + 4 * S)))
    named = {100.0: first, 500.0: second}[found.transform.translation[0]]
    [note] = [note for note in found.notes if "2 sessions" in note]
    assert note.endswith(f"this is that of {named}")


@each_way
def test_a_static_transform_that_changes_holds_from_then_on(tmp_path: Path, recalls: bool) -> None:
    """Also inside one bag: the robot is placed anew while it stands."""
    poses = [odom(BEGIN + nth * S // 5, 0.0, 0.0, 0.0) for nth in range(100)]
    changed = [static(BEGIN, "map", "odom", 0.0), static(BEGIN + 8 * S, "map", "odom", 50.0)]
    record(tmp_path / "one", [*changed, *poses], split_s=60)
    memory = memory_of(tmp_path, recalls=recalls)
    there, later = (visits(memory, Call(), x, 0.0, radius_m=1.0).visits for x in (0.0, 50.0))
    assert [((each.arrived or 0) - BEGIN, (each.departed or 0) - BEGIN) for each in there] == [
        (0, 39 * S // 5)
    ]
    assert [((each.arrived or 0) - BEGIN, (each.departed or 0) - BEGIN) for each in later] == [
        (8 * S, 99 * S // 5)
    ]


@each_way
def test_recordings_joined_by_a_handover_share_their_transforms(
    tmp_path: Path, recalls: bool
) -> None:
    """A publisher that has gone is not heard by the recording that took over."""
    first, second = tmp_path / "rec_20260714T000000Z", tmp_path / "rec_20260714T010000Z"
    record(first, [static(BEGIN, "map", "odom", 7.0), *drive(BEGIN, 20)])
    record(second, [static(BEGIN + 21 * S, "base_link", "laser", 1.0), *drive(BEGIN + 21 * S, 20)])
    memory = memory_of(tmp_path, recalls=recalls)
    with pytest.raises(NoDataError):
        asked(memory, BEGIN + 33 * S)
    write_handover(first, Handover(next=second.name))
    write_handover(second, Handover(previous=first.name))
    memory = memory_of(tmp_path, recalls=recalls)
    assert asked(memory, BEGIN + 33 * S) == 7.0
    assert arrivals(memory, 12.0) == [pytest.approx(30.6, abs=0.3), pytest.approx(9.6, abs=0.3)]


@each_way
def test_two_recorders_of_one_robot_complete_each_other(tmp_path: Path, recalls: bool) -> None:
    """One records what moves, one what is static, one neither."""
    record(tmp_path / "fixed", [static(BEGIN, "map", "odom", 7.0)])
    record(tmp_path / "moving", moving(BEGIN, 20, "odom", "base_link", 0.0, 0.5))
    record(tmp_path / "sensors", drive(BEGIN, 20))
    memory = memory_of(tmp_path, recalls=recalls)
    at = AtTime(unix_from_ns(BEGIN + 4 * S))
    joined = transform(memory, Call(), "map", "base_link", at)
    assert joined.transform.translation[0] == pytest.approx(9.0)
    assert [note for note in joined.notes if "fixed and moving are combined" in note]
    alone = transform(memory, Call(), "odom", "base_link", at)
    assert alone.notes == ()
    assert arrivals(memory, 9.0) == [pytest.approx(3.4, abs=0.21)]
    [note] = visits(memory, Call(), 9.0, 0.0, radius_m=0.3).notes[:1]
    assert note.startswith("sensors is placed by transforms of another recording")
    assert note.endswith("those of fixed and moving")


@pytest.mark.parametrize("later_s", [0, 30])
def test_a_loan_is_never_silent(tmp_path: Path, later_s: int) -> None:
    """Whether `nav2` is the same robot cannot be known; a day apart it is another."""
    base = moving(BEGIN, 60, "odom", "base_link", 0.0, 0.5)
    record(tmp_path / "nav2", [static(BEGIN, "map", "odom", 100.0), *base])
    record(tmp_path / "boat", drive(BEGIN + later_s * S, 60))
    answer = visits(memory_of(tmp_path), Call(), 105.0, 0.0)
    assert answer.total == 1
    assert [note for note in answer.notes if "boat" in note and "those of nav2" in note]


@each_way
@pytest.mark.parametrize("apart", [-DAY, 3600 * S, DAY])
def test_a_recording_of_another_time_lends_nothing(
    tmp_path: Path, apart: int, recalls: bool
) -> None:
    base = moving(BEGIN, 60, "odom", "base_link", 0.0, 0.5)
    record(tmp_path / "nav2", [static(BEGIN, "map", "odom", 100.0), *base])
    record(tmp_path / "boat", drive(BEGIN + apart, 60))
    memory = memory_of(tmp_path, recalls=recalls)
    assert visits(memory, Call(), 105.0, 0.0).total == 0
    assert visits(memory, Call(), 5.0, 0.0).frame_id == "odom"


@pytest.mark.parametrize("has_tf", [False, True])
def test_a_robot_beside_it_that_has_poses_of_its_own_lends_nothing(
    tmp_path: Path, has_tf: bool
) -> None:
    """A boat without a map was nowhere in that of the other robot, and a note says so."""
    record(tmp_path / "nav2", [static(BEGIN, "map", "odom", 100.0), *drive(BEGIN, 20, 0.0)])
    base = moving(BEGIN, 20, "odom", "base_link", 0.0, 0.5) if has_tf else []
    record(tmp_path / "boat", [*base, *drive(BEGIN, 20)])
    memory = memory_of(tmp_path)
    answer = visits(memory, Call(), 105.0, 0.0)
    assert (answer.frame_id, answer.total) == ("map", 0)
    assert visits(memory, Call(), 100.0, 0.0).total == 1
    if has_tf:
        with pytest.raises(NoDataError):
            asked(memory, BEGIN + 4 * S, "map", "base_link")
    else:
        assert [note for note in answer.notes if "boat has no transforms" in note]


@each_way
def test_a_thing_and_who_saw_it_are_placed_by_the_recording_of_the_sighting(
    tmp_path: Path, recalls: bool
) -> None:
    """Two robots of one time: the sighting is of the one that stands, though the other is newer."""
    record(
        tmp_path / "nav2",
        [
            static(BEGIN, "map", "odom", 100.0),
            *moving(BEGIN, 20, "odom", "base_link", 2.0, 0.0),
            *[odom(BEGIN + nth * S, 2.0, 0.0, 0.0) for nth in range(20)],
            detections(BEGIN + 4 * S + S // 2, ["scissors"]),
        ],
    )
    boat = moving(BEGIN, 20, "map", "odom", 5.0, -0.5)
    boat += moving(BEGIN, 20, "odom", "base_link", 0.0, 0.5)
    record(tmp_path / "boat", [*boat, *drive(BEGIN, 20)])
    memory = memory_of(tmp_path, recalls=recalls)
    topic = detections(BEGIN, []).topic
    [found] = find_matches(memory, Call(), topic, "contains", "scissors").sightings
    assert found.thing is not None
    assert found.thing.frame_id == "map"
    assert found.thing.position[0] == pytest.approx(103.0)
    assert found.robot is not None
    assert found.robot.frame_id == "map"
    assert found.robot.position[0] == pytest.approx(102.0)


def two_at_once(root: Path) -> None:
    """Two robots of one time on the same topics: r1 drives 20 m, r2 stands at 50 m and bumps."""
    ticks = [BEGIN + nth * S // 5 for nth in range(101)]
    bumps = [boolean(at + 1, False) for at in ticks]
    record(root / "r1", [*drive(BEGIN, 20, 1.0), *bumps])
    bumps = [boolean(at + 2, at == ticks[50]) for at in ticks]
    record(root / "r2", [*[odom(at + S // 10, 50.0, 0.0, 0.0) for at in ticks], *bumps])


def test_a_value_is_of_the_recording_of_the_match(tmp_path: Path) -> None:
    two_at_once(tmp_path)
    memory = memory_of(tmp_path)
    reply = value_when(
        memory, Call(), "/odom", "/bumper", condition_type="equals", value=True, fields=[]
    )
    assert reply.value is not None
    assert reply.value.sample.time == BEGIN + 49 * S // 5 + S // 10
    assert [note for note in reply.notes if "/bumper" in note and note.endswith(": r1, r2")]
    assert not [note for note in reply.notes if "the match is of" in note]


def test_a_value_of_another_recording_than_the_match_is_noted(tmp_path: Path) -> None:
    record(tmp_path / "r1", [boolean(BEGIN + 4 * S + 1, True)])
    record(tmp_path / "r2", drive(BEGIN, 20))
    memory = memory_of(tmp_path)
    reply = value_when(memory, Call(), "/odom", "/bumper", condition_type="equals", value=True)
    assert reply.value is not None
    assert [note for note in reply.notes if "of recording r1" in note and "of r2" in note]


def test_a_frame_without_a_name_is_none(tmp_path: Path) -> None:
    """Neither listed, nor a reason to advise another time."""
    nameless = moving(BEGIN, 20, "", "base_link", 0.0, 0.0)
    record(tmp_path / "one", [*nameless, *moving(BEGIN, 20, "odom", "wheel", 0.0, 0.0)])
    memory = memory_of(tmp_path)
    found = frames(memory, Call())
    assert [(edge.parent, edge.child) for edge in found.edges] == [("odom", "wheel")]
    assert [note for note in found.notes if "no name" in note and note.endswith("1")]
    with pytest.raises(NoDataError) as refused:
        asked(memory, BEGIN + 300 * S, "", "base_link")
    assert "ask about then" not in refused.value.detail
