"""What is known of the columns of a part without them: nothing that the bags do not say."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.stored import Letters
from ros2_memory.columns.table import Texts
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.counts.matches import count_matches
from ros2_memory.counts.numbers import count_range
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import TimeRange, View
from ros2_memory.insights.fields import extremes_of
from tests.support.bags import Msg, odom, text, write_mcap
from tests.support.column_worlds import World
from tests.support.examples import examples

if TYPE_CHECKING:
    from collections.abc import Iterator


S = NS_PER_S
T0 = 1_700_000_400 * S
LABELS = ("mug", "big mug", "Tasse", "Straße", "ÉCLAIR", "x7", "éclair_2")


@given(
    st.lists(st.text("aAbé ß7_-\"\\'{[:\n\0", max_size=12), max_size=8),
    st.text("abés7_ -", min_size=1, max_size=4),
)
def test_letters_rule_out_no_text_that_has_them(texts: list[str], needle: str) -> None:
    column, folded = Texts.of(texts), needle.casefold()
    letters = Letters.of(column)
    assert letters is not None
    may = letters.may_have(folded)
    has = np.array([folded in word.casefold() for word in column.values()], np.bool_)
    assert may.size == len(texts)
    assert not (has & ~may).any()
    if folded.isalpha():
        assert (may == has).all()


def write_world(folder: Path, draw: Random, hours: float = 1.5) -> None:
    """A robot that drives, stands still, and tells in JSON what it sees; some bags are missing."""
    every = draw.choice([4, 10])
    for number in range(round(hours * 60)):
        start = T0 + number * 60 * S
        if draw.random() < 0.05:
            continue
        messages: list[Msg] = []
        for at in range(start, start + 60 * S, every * S):
            x = draw.choice([0.0, 1.25, draw.gauss(0.0, 1.0), float("nan")])
            messages.append(odom(at + draw.randrange(S), x, draw.gauss(0, 1e-5), 0.3))
            seen = [{"label": draw.choice(LABELS), "at": draw.random()}] * draw.randrange(3)
            data = json.dumps({"stamp": at / S, "seen": seen}, ensure_ascii=draw.random() < 0.5)
            messages.append(text(at + draw.randrange(S), data, "/seen"))
        messages.sort(key=lambda message: message.log_time)
        write_mcap(folder / "rec" / f"rec_{number}.mcap", messages)


def numbers_by(
    memory: Memory, span: TimeRange, by: Literal["hour", "weekday"], *fields: str
) -> object:
    """The answer without its means, which are as exact as columns are."""
    found = count_range(memory, Call(), "/odom", span, by, fields=fields)
    rows = [*found.rows, ("", found.all)]
    cells = [
        (name, column, value)
        for name, values in rows
        for (column, _), value in zip(found.columns, values, strict=True)
        if not column.endswith(".mean")
    ]
    return cells, found.notes


def answers(memory: Memory, draw: Random) -> Iterator[object]:
    first = T0 / S + draw.choice([0, 600, 1234.5])
    span = TimeRange(first, first + draw.choice([1800, 5000, 9000]))
    window = TimeWindow(round(first) * S, round(first + 6000) * S)
    for fields in (["position.x"], ["position.y", "orientation.yaw_deg"], ["position.x", "stamp"]):
        yield numbers_by(memory, span, "hour", *fields)
        yield extremes_of(View(memory, Call()), "/odom", window, fields)
    sought = (
        "mug",
        "MUG",
        "big mug",
        "tasse",
        "straße",
        "éclair",
        "x7",
        "seen",
        "see",
        "none",
        "7",
    )
    for value in sought:
        for kind in ("contains", "contains_word"):
            start, end = span.start_s, span.end_s
            yield count_matches(
                memory, Call(), "/seen", kind, value, by="hour", start_s=start, end_s=end
            )


@pytest.mark.parametrize("seed", range(examples(2)))
def test_what_is_known_of_parts_changes_no_answer(seed: int) -> None:
    with TemporaryDirectory() as folder:
        write_world(Path(folder), Random(seed), hours=1.0)
        share = Random(seed).choice([10.0, 0.001])
        world = World.of(Path(folder), limits=StoreLimits(max_share=share))
        world.fill()
        plain = answers(world.unstored().memory, Random(seed))
        started = World.of(Path(folder))  # what it knows it has from the store
        for found, expected in zip(answers(started.memory, Random(seed)), plain, strict=True):
            assert found == expected
