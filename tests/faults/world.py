"""A memory with everything in it that a server has, and questions that every answer shows in."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import zstandard

from ros2_memory import queries
from ros2_memory.bootstrap import build_backfill, build_memory
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.columns.store import ColumnStore
from ros2_memory.config import load_settings
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.history.conditions import Sought
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import AtTime, TimeRange
from ros2_memory.insights.recap import recap
from ros2_memory.insights.sightings import find_matches
from ros2_memory.places.visits import visits
from ros2_memory.serving.backfill import Backfill
from tests.support.bags import McapLayout, detections, odom, set_mtime, tf, transform, write_mcap
from tests.support.clocks import FixedClock
from tests.support.housekeepers import recorded_before
from tests.support.memories import memory_of

T0_S = 1_700_000_000
T0 = T0_S * NS_PER_S
NOW = FixedClock(T0 + 1_000_000 * NS_PER_S)


def write_bags(bag_dir: Path, count: int = 12, *, first: int = 0) -> list[Path]:
    """Bags of ten seconds, each with odometry, transforms and a thing of its own."""
    recorded_before(bag_dir)
    return [write_bag(bag_dir, number) for number in range(first, first + count)]


def write_bag(bag_dir: Path, number: int) -> Path:
    start = T0 + number * 10 * NS_PER_S
    messages = [odom(start + n * NS_PER_S // 2, number + n / 20, 0.0) for n in range(20)]
    fixed = transform(start, "base_link", f"laser_{number % 3}", (0.1, 0.0, 0.0))
    messages.append(tf(start, fixed, topic="/tf_static"))
    messages.append(detections(start + NS_PER_S, ["cup", f"thing{number}"]))
    layout = McapLayout(chunk_size=500)
    path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages, layout)
    set_mtime(path, start)
    return path


def compress(path: Path) -> None:
    """Leaves a bag compressed alone."""
    path.with_name(f"{path.name}.zstd").write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()


def told(
    memory: Memory, *, count: int = 12, after_each: Callable[[], None] = lambda: None
) -> list[str]:
    """What is answered: topics, frames, searches that find and find nothing, ways and happenings.

    An error of the tree is an answer too.
    """
    span = TimeRange(start_s=T0_S, end_s=T0_S + 10 * count)
    place = '{"x": 4.0, "y": 0.0}'

    def last(wanted: str) -> Callable[[], object]:
        sought = Sought("/vision/*", "contains", wanted)
        return partial(queries.find_last_match, memory, Call(), sought)

    asked: list[Callable[[], object]] = [
        lambda: queries.list_recorded_topics(memory, Call()),
        lambda: queries.frames(memory, Call()),
        *(last(wanted) for wanted in ("thing3", "never", "cup", f"thing{count - 1}")),
        lambda: queries.find_last_match(memory, Call(), Sought("/odom", "near_position", place)),
        lambda: queries.trajectory_summary(memory, Call(), span),
        lambda: queries.topic_value(memory, Call(), "/odom", AtTime(at_s=T0_S + 42.0)),
        lambda: recap(memory, Call(), span),
        lambda: visits(memory, Call(), 4.0, 0.0),
        lambda: find_matches(memory, Call(), Sought("/vision/*", "contains", "cup")),
    ]
    answers = []
    for ask in asked:
        try:
            # What is now, and how long ago that was, moves on while a test waits.
            answers.append(re.sub(r"(age|now)=\d+", r"\1", repr(ask())))
        except EpisodicError as error:
            answers.append(repr(error))
        after_each()
    return answers


def served(bag_dir: Path, clock: Clock = NOW) -> tuple[Memory, Backfill]:
    """A memory as the server builds it, and what fills its store of columns."""
    settings = load_settings((), {"MEMORY_BAG_DIR": str(bag_dir)})
    memory = build_memory(settings)
    # Every question looks, and the clock stands long after the bags.
    plain = memory_of(bag_dir, clock=clock)
    memory = replace(memory, clock=clock, index=plain.index, reader=plain.reader)
    return memory, build_backfill(settings, memory)


def store_of(filler: Backfill) -> ColumnStore:
    """The store that is filled."""
    assert filler.filling is not None
    return filler.filling.store


def fill_up(filler: Backfill) -> None:
    """Stores all that waits."""
    fill_store(filler)


def plainly(bag_dir: Path, *, count: int = 12) -> list[str]:
    """What is answered without a store, by a memory that has seen nothing before."""
    return told(memory_of(bag_dir, clock=NOW), count=count)
