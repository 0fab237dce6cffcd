from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.insights.sightings import find_matches
from tests.support.bags import Msg, make, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of, with_store

S = 10**9
BEGIN = 1_784_000_000 * S
FLOAT = "std_msgs/msg/Float64"
LATEST = QuerySettings(now="latest")


def write(folder: Path, messages: list[Msg], draw: Random) -> None:
    """Writes messages as splits of any length, of recordings of which some overlap."""
    number, recording = 0, 0
    again: list[Msg] = []
    while messages:
        size = draw.randint(1, 12)
        some, messages = messages[:size], messages[size:]
        # A recording that took over logged later what the one before has, too.
        copies = [
            replace(each, log_time=each.log_time + 1000, publish_time=each.published)
            for each in again
        ]
        path = folder / f"rec_{recording}" / f"rec_{recording}_{number}.mcap"
        write_mcap(path, [*copies, *some])
        number, again = number + 1, []
        if draw.random() < 0.4:
            recording, number = recording + 1, 0
            again = [each for each in some[-3:] if some[-1].log_time - each.log_time < S]


@settings(deadline=None, max_examples=examples(20), suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), part=st.sampled_from([0.5, 1.0]))
# One split, all of which is stored.
@example(seed=4, part=1.0)
def test_messages_of_one_log_time_are_told_apart(seed: int, part: float) -> None:
    """With simulated time many share one; stored numbers are rounded, which bags have to settle.

    Publish times differ: equal messages of one of these are copies where recordings overlap.
    """
    draw = Random(seed)
    thirds = [draw.randint(0, 8) / 3 for _ in range(draw.randint(2, 40))]
    messages = [
        Msg("/load", FLOAT, BEGIN + nth // 3 * S, make(FLOAT, data=third), BEGIN + nth)
        for nth, third in enumerate(thirds)
    ]
    with TemporaryDirectory() as folder:
        bags = Path(folder)
        write(bags, messages, draw)
        plain = memory_of(bags, limits=LATEST)
        for memory in (plain, with_store(plain, bags, part=part)):
            for asked_for in {*thirds[:3]}:
                found = find_matches(memory, Call(), "/load", "equals", asked_for, limit=50)
                assert sum(each.messages for each in found.sightings) == thirds.count(asked_for)
