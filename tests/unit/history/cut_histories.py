"""Histories as recordings that are cut into splits anywhere, and folders of bags that change."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from ros2_memory.serving.backfill import make_fragments
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    detections,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.random_histories import LATCHED, MS, WORDS, S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from random import Random

    from tests.support.column_worlds import World

    Recordings = dict[str, list[Msg]]
    Splits = dict[str, list[Msg]]

T0: Final = 1_700_006_330 * S
"""70 s later ten minutes are over; in most time zones an hour, and in UTC a day."""
_UNSET: Final = 5 * S
"""What a clock says that was never set."""


def draw_recordings(draw: Random) -> Recordings:
    """One recording takes over from another, and begins with what is latched; a third is later.

    Its clock may not have been set; that of the others may be set ahead. Messages are nearly in the
    order of their log times. One topic publishes no two messages at the same time.
    """
    seconds = draw.randint(60, 150)
    begin = draw.randrange(30, seconds)
    quiet = range(draw.randrange(begin), draw.randrange(begin, seconds))
    whole = _published(draw, T0, seconds, quiet)
    if draw.random() < 0.1:
        set_at = T0 + draw.randrange(10, 50) * S
        whole = [_later(message, 2500 * MS * (message.published >= set_at)) for message in whole]
    over = T0 + begin * S
    one = [message for message in whole if message.log_time < over + draw.randint(0, 9) * S]
    known = [message for message in one if message.topic in LATCHED and message.log_time < over]
    other = [
        *(replace(message, log_time=over) for message in known),
        *(_later(m, draw.randrange(10_000, 900_000)) for m in whole if m.log_time >= over),
    ]
    recordings = {"a": one, "b": other}
    third = draw.choice([None, T0 + (seconds + 90) * S, _UNSET])
    if third is not None:
        recordings["c"] = _published(draw, third, draw.randint(3, 40), range(0))
    return {
        name: sorted(found, key=lambda each: each.log_time + draw.choice([0, 0, draw.randrange(S)]))
        for name, found in recordings.items()
    }


def _published(draw: Random, start: int, seconds: int, quiet: range) -> list[Msg]:
    """Odometry each second, all else less often and some of it late; a detector that is quiet."""
    found, x, docked = [], 0.0, False
    for n in range(seconds):
        at = start + n * S
        x += draw.choice([0.0, draw.gauss(0, 0.4)])
        found.append(odom(at, x, draw.gauss(0, 1e-5), draw.uniform(-3, 3)))
        some = []
        if n % 2:
            some.append(text(at, draw.choice(WORDS), "/chatter"))
        if n % 2 and n not in quiet:
            labels = draw.sample(WORDS, draw.randint(0, 2))
            some.append(detections(at, labels, topic="/vision/a", score=n % 10 / 10))
        if n % 3 == 0:
            docked ^= draw.random() < 0.2
            some.append(boolean(at, docked))
        if n % 4 == 0:
            some.append(battery(at, draw.choice([math.nan, 0.9, draw.random(), 0.04])))
        if n % 40 == 1:
            some.append(text(at, draw.choice(["docked", "undocked"]), "/dock"))
        if n == 1:
            some.append(tf(at, transform(at, "base_link", "cam", (x, 0, 0)), topic="/tf_static"))
        for message in some:
            late = draw.choice([MS, MS, draw.randrange(4000) * MS]) + n
            found.append(replace(message, log_time=at + late, publish_time=at))
    return found


def _later(message: Msg, by: int) -> Msg:
    return replace(message, log_time=message.log_time + by, publish_time=message.published)


def cut(recordings: Recordings, cuts: Sequence[float]) -> Splits:
    """Returns the messages of each split by its path: recordings are cut at these parts of them.

    Not where the clock was set ahead: that would be a gap.
    """
    splits = {}
    for name, found in recordings.items():
        inside = {int(part * len(found)) for part in cuts} - {0, len(found)}
        inside = {n for n in inside if found[n].log_time - found[n - 1].log_time <= 2 * S}
        for number, (begin, end) in enumerate(pairwise([0, *sorted(inside), len(found)])):
            splits[f"{name}/{name}_{number}.mcap"] = found[begin:end]
    return splits


def span_of(messages: Sequence[Msg]) -> tuple[int, int]:
    times = [message.log_time for message in messages]
    return min(times), max(times)


def write(bag_dir: Path, splits: Mapping[str, list[Msg]], version: int = 0) -> None:
    for name, messages in splits.items():
        layout = McapLayout(chunk_size=4000, latched=LATCHED)
        os.utime(write_mcap(bag_dir / name, messages, layout), ns=(T0, T0 + version))


def fill_some(world: World, draw: Random) -> None:
    """Stores some of what waits in any order, and makes parts at any time."""
    timeline = world.memory.index.snapshot().timeline
    waiting = world.filling.waiting(timeline)
    draw.shuffle(waiting)
    for bag in waiting[: draw.randint(0, len(waiting))]:
        world.fill_alone([bag])
        if draw.random() < 0.3:
            for batch in world.filling.batches(timeline):
                if not {*batch.bags} & {*waiting} or draw.random() < 0.1:
                    world.filling.fill(batch, timeline)
            make_fragments(world.memory, world.filling.whole_since())
            if draw.random() < 0.5:
                world.filling.thin()
    if draw.random() < 0.3:
        world.prune()


def put_aside(bag_dir: Path, aside: Path, draw: Random) -> None:
    """Some bags are late."""
    for path in sorted(bag_dir.glob("rec_*/*.mcap")):
        if draw.random() < 0.3:
            (aside / path.parent.name).mkdir(parents=True, exist_ok=True)
            path.rename(aside / path.parent.name / path.name)


def change_something(bag_dir: Path, aside: Path, draw: Random) -> None:
    """A bag comes late, changes, is renamed, or goes."""
    bags = sorted(bag_dir.glob("rec_*/*.mcap"))
    late = sorted(aside.glob("*/*.mcap"))
    kind = draw.choice(["late", "late", "changed", "renamed", "deleted", "touched"])
    if kind == "late" and late:
        path = draw.choice(late)
        (bag_dir / path.parent.name).mkdir(exist_ok=True)
        path.rename(bag_dir / path.parent.name / path.name)
    elif kind == "changed" and bags:
        path = draw.choice(bags)
        start = draw.choice([1_700_000_000 * S, 3 * S])
        write_mcap(path, [odom(start + n * S, n / 7, 0.5) for n in range(draw.randint(1, 9))])
        os.utime(path, ns=(T0, T0 + draw.randrange(S)))
    elif kind == "renamed" and bags:
        path = draw.choice(bags)
        path.rename(path.with_name(f"{path.stem}9.mcap"))
    elif kind == "deleted" and bags:
        draw.choice(bags).unlink()
    elif kind == "touched" and bags:
        os.utime(draw.choice(bags), ns=(T0, T0 + draw.randrange(S)))
    date_folders(bag_dir, draw)


def date_folders(bag_dir: Path, draw: Random) -> None:
    """Two changes within one tick of the clock would look like one."""
    for folder in [bag_dir, *bag_dir.iterdir()]:
        os.utime(folder, ns=(T0, folder.stat().st_mtime_ns - draw.randrange(1, 9) * S))
