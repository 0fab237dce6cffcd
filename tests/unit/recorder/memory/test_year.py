"""What a year of a home robot takes: ten of its days go through bags, and their days again."""

from __future__ import annotations

import resource
import shutil
import struct
import sys
import time
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.memory.days import MONTH_NS
from ros2_memory.storage.mcap.writer import McapWriter
from tests.support.bags import Msg, battery, boolean, detections, odom, write_mcap
from tests.support.examples import LONG
from tests.unit.recorder.memory.test_days import days_of, keep_all, messages_in

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from ros2_memory.storage.base import Record

FIRST_S: Final = 1_790_038_800
"""Of each day the robot is on for twelve hours."""
DAYS: Final = 10 if LONG else 1
WHOLE: Final = 365 if LONG else 3
HOURS: Final = 12 if LONG else 1
HOUR_S: Final = 3600
THINGS: Final = 40
NUMBERS: Final = 30
YEAR_BYTES: Final = 10**9
SEED: Final = 20_261_125


def path_of(chance: np.random.Generator) -> NDArray[np.float64]:
    """Twenty poses a second (x, y) of an hour: half a minute of driving, and more of standing."""
    ends = chance.uniform(-5, 5, (121, 2))
    legs = []
    for begin, end in pairwise(ends):
        stands = np.repeat(end[None], int(chance.integers(600, 6000)), axis=0)
        legs += [np.linspace(begin, end, 600), stands]
    path = np.concatenate(legs)[: 20 * HOUR_S]
    noisy: NDArray[np.float64] = path + chance.normal(0, 0.005, path.shape)
    return noisy


def hour(chance: np.random.Generator, begin: int) -> Iterator[Msg]:
    """What the robot publishes in an hour from a log time (ns) on, topic by topic."""
    template = bytearray(odom(0, 12345.5, 54321.5).payload)
    at_x, at_y = (template.index(struct.pack("<d", number)) for number in (12345.5, 54321.5))
    for nth, (x, y) in enumerate(path_of(chance)):
        at = begin + nth * NS_PER_S // 20
        struct.pack_into("<II", template, 4, *divmod(at, NS_PER_S))
        struct.pack_into("<d", template, at_x, x)
        struct.pack_into("<d", template, at_y, y)
        yield Msg("/odom", "nav_msgs/msg/Odometry", at, bytes(template))
    walks = np.cumsum(chance.normal(0, 0.01, (NUMBERS, HOUR_S)), axis=1)
    for number, walk in enumerate(walks):
        for nth, value in enumerate(walk):
            body = struct.pack("<4sd", b"\0\1\0\0", value)
            at = begin + nth * NS_PER_S
            yield Msg(f"/number_{number}", "std_msgs/msg/Float64", at, body)
    for nth in range(HOUR_S):
        at = begin + nth * NS_PER_S
        # In each room it sees others.
        room = nth // 300 * 5
        yield detections(at, [f"thing {(room + one) % THINGS}" for one in range(nth % 6)])
        if nth % 10 == 0:
            yield battery(at, 1 - nth / 1e4)
            yield boolean(at, nth // 600 % 2 == 0)


def later(day: Path, seconds: int) -> Iterator[Record]:
    """The messages of a day with later times, also in their headers."""
    for record in messages_in(day):
        payload = bytearray(record.payload)
        words = np.frombuffer(payload, np.uint32, len(payload) // 4 - 1, 4)
        is_stamp = abs(words.astype(np.int64) - record.log_time // NS_PER_S) <= 1
        words[is_stamp] += np.uint32(seconds)
        ns = seconds * NS_PER_S
        yield record._replace(
            log_time=record.log_time + ns,
            publish_time=record.publish_time + ns,
            payload=bytes(payload),
        )


def test_a_year_of_a_home_robot_fits_a_gigabyte(tmp_path: Path) -> None:
    """Its other days are those again: what stays of them is a bag, of which all stays once more."""
    days, chance, bags = days_of(tmp_path), np.random.default_rng(SEED), 0
    begun = time.process_time()
    for nth in range(DAYS * HOURS):
        day, of_day = divmod(nth, HOURS)
        begin = (FIRST_S + day * 86_400 + of_day * HOUR_S) * NS_PER_S
        messages = sorted(hour(chance, begin), key=attrgetter("log_time"))
        path = write_mcap(tmp_path / "rec_A" / f"rec_A_{nth}.mcap", messages)
        bags += path.stat().st_size
        keep_all(days, tmp_path)
        path.unlink()
    written = [*sorted(tmp_path.glob("memory/*.thinned.mcap"))]
    first = [Path(shutil.copy(path, tmp_path / f"first_{path.name}.day")) for path in written]
    size = sum(path.stat().st_size for path in first) / DAYS
    spent = [time.process_time() - begun]
    for day in range(DAYS, WHOLE):
        bag = tmp_path / "rec_A" / f"rec_A_{day}.mcap"
        McapWriter().write(bag, later(first[day % DAYS], (day - day % DAYS) * 86_400))
        keep_all(days, tmp_path)
        bag.unlink()
        days.limit((FIRST_S + day * 86_400) * NS_PER_S)
    spent.append(time.process_time() - begun)
    for _ in range(WHOLE):
        days.limit((FIRST_S + WHOLE * 86_400) * NS_PER_S + 2 * MONTH_NS)
    spent.append(time.process_time() - begun)
    files = [*tmp_path.glob("memory/*.thinned.mcap")]
    assert len(files) == WHOLE
    thinned = sum(path.stat().st_size for path in files) / WHOLE
    # Those of the last month are not thinned yet.
    year = ((365 - 31) * thinned + 31 * size) / HOURS * 12
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    sys.stdout.write(
        f"{bags / DAYS / HOURS * 12} bytes of bags a day, {size / HOURS * 12} of it stay; "
        f"{year} bytes a year, by {WHOLE} days; {spent} s of the processor, {peak_mb} MB\n"
    )
    assert year < YEAR_BYTES
