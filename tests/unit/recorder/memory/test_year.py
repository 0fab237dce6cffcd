"""What a year of a home robot takes, by a part of one of its hours."""

from __future__ import annotations

import struct
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.memory.days import MONTH_NS
from tests.support.bags import Msg, battery, boolean, detections, odom, write_mcap
from tests.unit.recorder.memory.test_days import days_of, keep_all

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


FIRST_S: Final = 1_790_038_800
PART_S: Final = 1200
THINGS: Final = 40
NUMBERS: Final = 30
YEAR_BYTES: Final = 10**9
SEED: Final = 20_261_125


def path_of(chance: np.random.Generator) -> NDArray[np.float64]:
    """Twenty poses a second (x, y): half a minute of driving, and more of standing."""
    ends = chance.uniform(-5, 5, (121, 2))
    legs = []
    for begin, end in pairwise(ends):
        stands = np.repeat(end[None], int(chance.integers(600, 6000)), axis=0)
        legs += [np.linspace(begin, end, 600), stands]
    path = np.concatenate(legs)[: 20 * PART_S]
    noisy: NDArray[np.float64] = path + chance.normal(0, 0.005, path.shape)
    return noisy


def published(chance: np.random.Generator, begin: int) -> Iterator[Msg]:
    """What the robot publishes from a log time (ns) on, topic by topic."""
    template = bytearray(odom(0, 12345.5, 54321.5).payload)
    at_x, at_y = (template.index(struct.pack("<d", number)) for number in (12345.5, 54321.5))
    for nth, (x, y) in enumerate(path_of(chance)):
        at = begin + nth * NS_PER_S // 20
        struct.pack_into("<II", template, 4, *divmod(at, NS_PER_S))
        struct.pack_into("<d", template, at_x, x)
        struct.pack_into("<d", template, at_y, y)
        yield Msg("/odom", "nav_msgs/msg/Odometry", at, bytes(template))
    walks = np.cumsum(chance.normal(0, 0.01, (NUMBERS, PART_S)), axis=1)
    for number, walk in enumerate(walks):
        for nth, value in enumerate(walk):
            body = struct.pack("<4sd", b"\0\1\0\0", value)
            at = begin + nth * NS_PER_S
            yield Msg(f"/number_{number}", "std_msgs/msg/Float64", at, body)
    for nth in range(PART_S):
        at = begin + nth * NS_PER_S
        # In each room it sees others.
        room = nth // 300 * 5
        yield detections(at, [f"thing {(room + one) % THINGS}" for one in range(nth % 6)])
        if nth % 10 == 0:
            yield battery(at, 1 - nth / 1e4)
            yield boolean(at, nth // 600 % 2 == 0)


def test_a_year_of_a_home_robot_fits_a_gigabyte(tmp_path: Path) -> None:
    """Of each day it is on for twelve hours, and this is a third of one."""
    begin = FIRST_S * NS_PER_S
    chance, path = np.random.default_rng(SEED), tmp_path / "rec_A" / "rec_A_0.mcap"
    write_mcap(path, sorted(published(chance, begin), key=attrgetter("log_time")))
    days = days_of(tmp_path)
    keep_all(tmp_path, days=days)
    [day] = tmp_path.glob("memory/*.thinned.mcap")
    young = day.stat().st_size
    assert young < path.stat().st_size / 20
    days.limit(begin + 2 * MONTH_NS)
    old = day.stat().st_size
    assert old < young
    assert 36 * (31 * young + (365 - 31) * old) < YEAR_BYTES
