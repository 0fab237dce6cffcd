"""Replies are those that were recorded before the store was rebuilt, but for what was wrong."""

from __future__ import annotations

from fnmatch import fnmatchcase
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import pytest

from tests.oracle.replies.asking import Call
from tests.oracle.replies.comparison import KNOWN_WRONG, Comparison, KnownWrong, differing
from tests.oracle.replies.fixture import Record, path_of
from tests.oracle.replies.recording import compare, sample
from tests.oracle.replies.robot_day import Rates, write_robot_day
from tests.oracle.replies.worlds import WORLDS
from tests.support.examples import LONG

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


pytestmark = pytest.mark.xdist_group("heavy")

ASKED: Final = [
    pytest.param(name, marks=[pytest.mark.shared(world.needs)] if world.needs else [])
    for name, world in WORLDS.items()
    if LONG or not world.long
]
FOR_EACH_WORLD: Final = 2
"""Calls of each world that a short run asks at least."""


@cache
def records() -> Mapping[str, Record]:
    return {name: Record.read(name) for name, world in WORLDS.items() if path_of(name).exists()}


@cache
def short_sample() -> Mapping[str, set[int]]:
    """Of worlds that short runs make: in each kind of them, each way and tool."""
    short = {name: record for name, record in records().items() if not WORLDS[name].long}
    return sample(short, FOR_EACH_WORLD)


def held(name: str, *, stored: bool) -> None:
    world, comparison = WORLDS[name], Comparison()
    if name not in records():
        pytest.skip(
            f"not recorded yet: python -m tests.oracle.replies record --world {name} --long"
        )
    chosen = None if LONG else short_sample()[name]
    asked = compare(world, records()[name], comparison, stored=stored, chosen=chosen)
    assert asked
    assert not comparison.differences, "\n".join(map(str, comparison.differences[:10]))


@pytest.mark.parametrize("name", ASKED)
def test_replies_from_bags_are_those_recorded(name: str) -> None:
    held(name, stored=False)


@pytest.mark.parametrize("name", ASKED if LONG else ["session_zstd", "damaged", "resets"])
def test_replies_with_a_store_are_those_recorded(name: str) -> None:
    held(name, stored=True)


def test_the_sample_asks_every_tool_and_way_in_every_kind_of_world() -> None:
    asked: dict[str, set[str]] = {}
    there: dict[str, set[str]] = {}
    for name, numbers in short_sample().items():
        if WORLDS[name].is_slow:
            continue
        kind, replies = WORLDS[name].kind, records()[name].replies
        asked.setdefault(kind, set()).update(replies[number].call.what for number in numbers)
        there.setdefault(kind, set()).update(replied.call.what for replied in replies)
    assert asked == there


def test_every_world_that_short_runs_ask_is_recorded() -> None:
    assert set(records()) >= {name for name, world in WORLDS.items() if not world.long}


def test_each_row_of_what_is_known_to_be_wrong_concerns_a_recorded_call() -> None:
    def concerns(row: KnownWrong) -> bool:
        return any(
            row.concerns(name, replied.call)
            for name, record in records().items()
            if fnmatchcase(name, row.world)
            for replied in record.replies
        )

    assert [row for row in KNOWN_WRONG if not concerns(row)] == []


def test_a_world_that_is_made_twice_has_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_robot_day(tmp_path / name, 5, Rates(0.01, 5))
    files = sorted(
        path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.mcap")
    )
    assert len(files) == 4
    for path in files:
        assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes()


@pytest.mark.parametrize(
    ("what", "recorded", "got", "paths"),
    [
        ("tool recap", {"start": 1.0}, {"start": 1.0000005}, []),
        ("tool recap", {"start": 1.0}, {"start": 1.000002}, ["/start"]),
        ("tool recap", {"total": 3}, {"total": 4}, ["/total"]),
        ("tool recap", {"total": 3}, {"total": True}, ["/total"]),
        ("tool recap", {"total": 3}, {}, ["/total"]),
        ("tool recap", {}, {"total": 3}, ["/total"]),
        ("tool recap", {"events": [1, 2]}, {"events": [1]}, ["/events"]),
        ("tool get_position_at", {"x": 1.0, "y": 2.0}, {"x": 1.0001, "y": 2.0003}, ["/y"]),
        ("tool get_position_at", {"yaw_deg": 1.0}, {"yaw_deg": 1.009}, []),
        ("tool get_topic_at_time", {"value": {"x": 1.0}}, {"value": {"x": 1.0001}}, ["/value/x"]),
        ("tool trajectory_summary", {"distance_m": 90.0}, {"distance_m": 90.08}, []),
        ("tool trajectory_summary", {"distance_m": 90.0}, {"distance_m": 90.2}, ["/distance_m"]),
        ("tool recap", {"notes": ["a", "b"]}, {"notes": ["b", "a"]}, []),
        ("tool recap", {"notes": ["a", "b"]}, {"notes": ["a"]}, ["/notes"]),
        ("tool recap", {"text": "stood 7.1 s"}, {"text": "stood 7.2 s"}, []),
        ("tool recap", {"text": "stood 7.1 s"}, {"text": "stood 7.3 s"}, ["/text"]),
        ("tool recap", {"text": "at 10:00:07.1"}, {"text": "at 10:00:07.2"}, ["/text"]),
        ("tool recap", {"text": "2 sightings"}, {"text": "3 sightings"}, ["/text"]),
    ],
)
def test_a_difference_is_one_beyond_the_tolerance_of_its_key(
    what: str, recorded: Any, got: Any, paths: list[str]
) -> None:
    assert [path for path, _, _ in differing(what, recorded, got)] == paths


def test_what_is_known_to_be_wrong_is_counted_and_is_no_difference() -> None:
    comparison = Comparison()
    counted = Call("tool", "find_matches", {"by": "day", "topic": "/bumper"})
    assert comparison.compare("wrong_clocks", counted, {"rows": [9]}, {"rows": [6]})
    assert not comparison.differences
    assert sum(comparison.left_out.values()) == 1
    assert not comparison.compare("resets", counted, {"rows": [9]}, {"rows": [6]})
    assert len(comparison.differences) == 1
