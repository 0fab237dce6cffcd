"""What a topic says lasts as long as its next message, its session and its kind allow."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.support.bags import along_x, battery, boolean, in_order, write_mcap
from tests.support.housekeepers import T0, S
from tests.support.memories import asked, clause, memory_of

DAY_S = 86_400


def paced(pace: str, draw: Random) -> list[int]:
    """The seconds of a session's messages."""
    steps = {
        "often": [draw.choice([1, 1, 1, 1, 12]) for _ in range(40)],
        "seldom": [7] * 25 + [15] + [7] * 5,
        "regular": [20] * 30,
        "slower": [45] * 25 + [100] + [45] * 5,
        "on change": [draw.choice([7, 30, 200, 900]) for _ in range(8)],
    }[pace]
    return [sum(steps[:nth]) for nth in range(len(steps) + 1)]


LASTING_S = {"often": 10.0, "seldom": 10.5, "regular": 30.0, "slower": 67.5, "on change": 10.0}
"""For how long at most a message of a measurement lasts."""


def expected(sessions: list[tuple[str, list[int]]], is_state: bool) -> Iterator[tuple[int, int]]:
    """When what messages of one value said held, by a loop over them."""
    for pace, times in sessions:
        lasts_on = is_state and pace != "often"
        begin = times[0]
        for before, after in pairwise(times):
            if after - before > LASTING_S[pace] and not lasts_on:
                yield begin, before
                begin = after
        yield begin, times[-1]


@pytest.mark.parametrize("seed", range(6))
def test_each_session_says_for_how_long_its_messages_last(tmp_path: Path, seed: int) -> None:
    draw = Random(seed)
    sessions: list[tuple[str, list[int]]] = []
    for nth, pace in enumerate(draw.sample([*LASTING_S], len(LASTING_S))):
        times = [nth * DAY_S + at for at in paced(pace, draw)]
        sessions.append((pace, times))
        logged = [T0 + at * S for at in times]
        said = [message for at in logged for message in (battery(at, 0.1), boolean(at, True))]
        driven = along_x(T0 + times[0] * S, times[-1] - times[0] + 1)
        messages = in_order([*driven, *said])
        write_mcap(tmp_path / f"r{nth}" / "r_0.mcap", messages)
    memory = memory_of(tmp_path)

    def held(**asks: Any) -> list[tuple[int, int]]:
        rows = asked(memory, "find_matches", limit=100, **asks)["sightings"][::-1]
        begun = [row["first_seen"] - T0 / S for row in rows]
        pairs = zip(begun, rows, strict=True)
        return [(round(start), round(start + row["duration_s"])) for start, row in pairs]

    low = {"condition_type": "below", "field": "percentage", "value": 0.5}
    assert held(topic="/battery_state", **low) == [*expected(sessions, is_state=False)]
    flags = [*expected(sessions, is_state=True)]
    true = clause("/bumper", "equals", True)
    assert held(**true) == flags
    lengths = sum(last - first for first, last in flags)
    window = {"start": T0 / S, "end": T0 / S + 5 * DAY_S}
    by_value = asked(memory, "get_topic_in_range", topic="/bumper", by="value", **window)
    assert [row[:3] for row in by_value["rows"]] == [["true", len(flags), lengths]]
    driven_so = clause("/odom", "above", -1, field="position.x")
    parts = asked(memory, "find_matches", **driven_so, **{"while": true}, limit=100)["sightings"]
    assert sum(row["duration_s"] for row in parts) == pytest.approx(lengths, abs=len(parts))
