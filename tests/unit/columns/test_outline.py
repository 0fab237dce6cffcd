"""What is known of the columns of a part without them: nothing that the bags do not say."""

import json
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.stored import Letters
from ros2_memory.columns.table import Texts
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, odom, text, write_mcap
from tests.support.column_worlds import World
from tests.support.examples import examples
from tests.support.memories import asked, assert_same_counts

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


def write_world(folder: Path, draw: Random) -> None:
    """A robot that drives, stands still, and tells in JSON what it sees; some bags are missing."""
    every = draw.choice([4, 10])
    for number in range(40):
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


def questions(draw: Random) -> Iterator[tuple[str, dict[str, Any]]]:
    start = T0 / S + draw.choice([0, 600, 1234.5])
    window = {"start": start, "end": start + draw.choice([1800, 5000])}
    for fields in (["position.x"], ["position.y", "orientation.yaw_deg"]):
        asking = {"topic": "/odom", "fields": fields, **window}
        yield "get_topic_in_range", {**asking, "by": "hour"}
        yield "get_topic_in_range", asking
    sought = "mug", "MUG", "big mug", "tasse", "straße", "éclair", "x7", "see", "none", "7"
    for value, kind in product(sought, ("contains", "contains_word")):
        condition = {"topic": "/seen", "condition_type": kind, "value": value}
        yield "find_matches", {**condition, "by": "hour", **window}


@pytest.mark.parametrize("seed", range(examples(2)))
def test_what_is_known_of_parts_changes_no_answer(seed: int) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_world(folder, Random(seed))
        world = World.of(folder, limits=StoreLimits(max_share=[10.0, 0.001][seed % 2]))
        world.fill()
        plain = world.unstored().memory
        started = World.of(folder).memory  # what it knows it has from the store
        for tool, given_ in questions(Random(seed)):
            expected = asked(plain, folder, tool, **given_)
            assert_same_counts(asked(started, folder, tool, **given_), expected, of_means=0.02)
