"""Transforms of a memory: what is read of its bags for them, and what of that is kept."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory import queries
from ros2_memory.analysis.frames import static_at
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS
from ros2_memory.history.context import Call
from ros2_memory.history.view import AtTime, TimeRange, View
from ros2_memory.insights.recap import recap
from ros2_memory.insights.sightings import find_matches
from tests.support.bags import Msg, detections, odom, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.memories import each_way, memory_of
from tests.support.noting_reader import NotingReader

if TYPE_CHECKING:
    from collections.abc import Sequence

S = 10**9
T0 = 1_784_000_000 * S


def asked(reader: NotingReader, topic: str) -> set[str]:
    return {path.name for path, topics in reader.asked if topic in topics}


def static(second: int, child: str, x: float) -> Msg:
    at = T0 + second * S
    return tf(at, transform(at, "base_link", child, (x, 0.0, 0.0)), topic="/tf_static")


def bag(folder: Path, number: int, messages: Sequence[Msg]) -> None:
    write_mcap(folder / "rec" / f"rec_{number}.mcap", messages)


@settings(max_examples=examples(30))
@given(
    received=st.lists(
        st.tuples(st.sampled_from(["arm", "/arm", "eye"]), st.integers(0, 2)),
        min_size=1,
        max_size=12,
    ),
    at=st.integers(-1, 13),
)
def test_a_static_transform_is_the_newest_of_its_child_however_often_it_was_repeated(
    received: list[tuple[str, int]], at: int
) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        for second, (child, x) in enumerate(received):
            bag(folder, second, [static(second, child, float(x))])
        view = View(memory_of(folder), Call())
        [session] = view.sessions.recorded_at(T0) or []
        found = static_at(view.sessions.static(session), T0 + at * S - AT_OR_BEFORE_SLACK_NS)
    expected: dict[str, float] = {}
    for second, (child, x) in enumerate(received):
        if second <= at or child.lstrip("/") not in expected:
            expected[child.lstrip("/")] = float(x)
    assert {each.child.lstrip("/"): each.transform.translation[0] for each in found} == expected


def test_a_view_is_freed_with_its_call_without_the_garbage_collector(tmp_path: Path) -> None:
    bag(tmp_path, 0, [static(0, "eye", 1.0)])
    gc.disable()
    try:
        view = View(memory_of(tmp_path), Call())
        assert view.sessions.recorded_at(T0)
        known = weakref.ref(view)
        del view
        assert known() is None
    finally:
        gc.enable()


def test_static_transforms_are_read_once_until_a_bag_is_added(tmp_path: Path) -> None:
    for second in range(3):
        bag(tmp_path, second, [static(second, "eye", 1.0)])
    reader = NotingReader()
    memory = memory_of(tmp_path, reader=reader)
    moment = AtTime(T0 / 1e9 + 2.5)

    def place() -> float:
        return queries.transform(memory, Call(), "base_link", "eye", moment).transform.translation[
            0
        ]

    assert place() == 1.0
    assert asked(reader, "/tf_static") == {"rec_0.mcap", "rec_1.mcap", "rec_2.mcap"}
    reader.asked.clear()
    assert place() == 1.0
    assert asked(reader, "/tf_static") == set()
    bag(tmp_path, 3, [static(2, "eye", 2.0)])
    assert place() == 2.0


@each_way
def test_transforms_that_cannot_be_decoded_are_named_each_time(
    tmp_path: Path, recalls: bool
) -> None:
    moved = [
        tf(T0 + n * S // 10, transform(T0 + n * S // 10, "odom", "base_link", (0.1 * n, 0.0, 0.0)))
        for n in range(100)
    ]
    moved[50] = replace(moved[50], body=b"\0\1\0\0\1")
    bag(tmp_path, 0, [*moved, *(odom(T0 + n * S // 10, 0.1 * n, 0.0) for n in range(100))])
    memory = memory_of(tmp_path, recalls=recalls)
    for _ in range(2):
        notes = recap(memory, Call(), TimeRange(start_s=T0 / 1e9, end_s=T0 / 1e9 + 9)).notes
        assert any("messages of /tf could not be decoded" in note for note in notes)


def test_where_no_transform_leads_to_the_map_a_sighting_reads_those_around_it_alone(
    tmp_path: Path,
) -> None:
    for minute in range(20):
        at = T0 + minute * 60 * S
        messages = [tf(at, transform(at, "odom", "other", (1.0, 0.0, 0.0)))]
        messages += [detections(at, ["cup"])] if minute == 10 else []
        bag(tmp_path, minute, messages)
    reader = NotingReader()
    answer = find_matches(
        memory_of(tmp_path, reader=reader), Call(), "/vision/scene/scene_objects", "contains", "cup"
    )
    [sighting] = answer.sightings
    assert sighting.thing is not None
    assert sighting.thing.frame_id == "base_link"
    assert asked(reader, "/tf") == {"rec_10.mcap"}
