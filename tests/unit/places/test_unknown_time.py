"""For how long it is not known where the robot was, or what another topic said (`unknown_s`)."""

import random
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from tests.support.bags import Msg, boolean, odom, text, write_splits
from tests.support.examples import examples
from tests.support.memories import asked, memory_of
from tests.support.tables import table

S = 10**9
T0 = 1_784_000_000
HERE = {"x": 0.0, "y": 0.0, "radius_m": 1.0}
PRESSED = {"topic": "/bumper", "condition_type": "equals", "value": True}
CALM = {"topic": "/mood", "condition_type": "equals", "value": "calm"}


def life(seconds: int, silent: Mapping[str, Sequence[tuple[float, float]]] | None = None) -> Any:
    """A robot that stands at the origin: poses 5 times, a bumper and a mood once in a second.

    `silent`: between which seconds (inclusive, exclusive) a topic has no message.
    """
    quiet = silent or {}
    messages: list[Msg] = []
    for step in range(seconds * 5):
        at = T0 * S + step * S // 5
        messages.append(odom(at, 0.0, 0.0))
        if step % 5 == 0:
            messages += [boolean(at, True), text(at, "calm", topic="/mood")]
    return [
        one
        for one in messages
        if not any(a <= one.log_time / S - T0 < b for a, b in quiet.get(one.topic, ()))
    ]


def brute(times: Sequence[int], first: int, last: int, start: int, end: int) -> int:
    """How much (ns) of a window a topic leaves open, given all its times and what was recorded."""
    ends = sorted({first, last, *times})
    apart = [(a, b) for a, b in pairwise(ends) if b - a > SILENCE_NS]
    return sum(max(0, min(b, end) - max(a, start)) for a, b in apart)


@settings(max_examples=examples(25))
@given(seed=st.integers(0, 2**32), split_s=st.sampled_from([5, 10, 60]), stored=st.booleans())
def test_unknown_time_is_what_brute_force_says(seed: int, split_s: int, stored: bool) -> None:
    draw = random.Random(seed)
    silent: dict[str, list[tuple[float, float]]] = {"/odom": [], "/mood": []}
    for spans in silent.values():
        for _ in range(draw.randrange(4)):
            begin = draw.randrange(100)
            spans.append((begin, begin + draw.randrange(30)))
    messages = life(120, silent)
    times = {name: [one.log_time for one in messages if one.topic == name] for name in silent}
    first, last = T0 * S, (T0 + 119) * S
    last = max(last, *times["/odom"][-1:])
    start, end = sorted(T0 + draw.randrange(120) for _ in range(2))
    bounds = first, last, start * S, min(end * S, last)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        write_splits(bag_dir, messages, split_s)
        memory = memory_of(bag_dir, recalls=stored)
        window = {"start": start, "end": end}
        for given, name in (({"where": HERE}, "/odom"), ({"while": CALM}, "/mood")):
            if len(times[name]) < 20:
                continue
            found = asked(memory, "find_matches", **PRESSED, **given, **window)
            expected = brute(times[name], *bounds) / S
            assert found.get("unknown_s", 0) == pytest.approx(expected, abs=1e-3)
            assert ("unknown_s" in found) is (expected > 0)
            by_hour = asked(memory, "find_matches", **PRESSED, **given, **window, by="hour")
            assert table(by_hour)["all"].get("unknown_s", 0) == pytest.approx(expected, abs=0.06)
            if name == "/odom":
                visited = asked(memory, "visits", **HERE, **window)
                assert visited.get("unknown_s", 0) == found.get("unknown_s", 0)
