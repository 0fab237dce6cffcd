"""What a year of a home robot takes, by ten of its days, which go through bags."""

from __future__ import annotations

import struct
import sys
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.memory.days import MONTH_NS
from tests.support.bags import Msg, battery, boolean, detections, odom, write_mcap
from tests.support.examples import LONG
from tests.unit.recorder.memory.test_days import days_of, keep_all

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

FIRST_S: Final = 1_790_038_800
"""Of each day the robot is on for twelve hours."""
DAYS: Final = 10 if LONG else 1
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
        time = begin + nth * NS_PER_S // 20
        struct.pack_into("<II", template, 4, *divmod(time, NS_PER_S))
        struct.pack_into("<d", template, at_x, x)
        struct.pack_into("<d", template, at_y, y)
        yield Msg("/odom", "nav_msgs/msg/Odometry", time, bytes(template))
    walks = np.cumsum(chance.normal(0, 0.01, (NUMBERS, HOUR_S)), axis=1)
    for number, walk in enumerate(walks):
        for nth, value in enumerate(walk):
            body = struct.pack("<4sd", b"\0\1\0\0", value)
            time = begin + nth * NS_PER_S
            yield Msg(f"/number_{number}", "std_msgs/msg/Float64", time, body)
    for nth in range(HOUR_S):
        time = begin + nth * NS_PER_S
        # In each room it sees others.
        room = nth // 300 * 5
        yield detections(time, [f"thing {(room + one) % THINGS}" for one in range(nth % 6)])
        if nth % 10 == 0:
            yield battery(time, 1 - nth / 1e4)
            yield boolean(time, nth // 600 % 2 == 0)


def test_a_year_of_a_home_robot_fits_a_gigabyte(tmp_path: Path) -> None:
    days, chance, bags = days_of(tmp_path), np.random.default_rng(SEED), 0
    for nth in range(DAYS * HOURS):
        day, of_day = divmod(nth, HOURS)
        begin = (FIRST_S + day * 86_400 + of_day * HOUR_S) * NS_PER_S
        messages = sorted(hour(chance, begin), key=attrgetter("log_time"))
        path = write_mcap(tmp_path / "rec_A" / f"rec_A_{nth}.mcap", messages)
        bags += path.stat().st_size
        keep_all(days, tmp_path)
        path.unlink()
    sizes = []
    for later in (0, 2 * MONTH_NS):
        for _ in range(DAYS):
            days.limit((FIRST_S + DAYS * 86_400) * NS_PER_S + later)
        files = [*tmp_path.glob("memory/*.thinned.mcap")]
        assert len(files) == DAYS
        sizes.append(sum(file.stat().st_size for file in files))
    a_day = [size / DAYS / HOURS * 12 for size in sizes]
    sys.stdout.write(f"{bags / DAYS / HOURS * 12} bytes of bags a day; days {a_day}\n")
    assert 30 * a_day[0] + 335 * a_day[1] < YEAR_BYTES
