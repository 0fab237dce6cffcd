"""Conditions over columns: the same as on each decoded message."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.columns.truth import truth
from tests.support.drawn_tables import MAPPED, OTHERS, condition_on, drawn_tables
from tests.support.examples import examples
from tests.support.memories import shipped_extractor

if TYPE_CHECKING:
    from random import Random

    from tests.support.drawn_tables import Drawn

EXTRACTOR = shipped_extractor()


@settings(max_examples=examples(3000), deadline=None)
@given(drawn_tables(), st.randoms(use_true_random=False))
def test_truth_of_drawn_messages_is_that_of_each_message(drawn: Drawn, random: Random) -> None:
    values = [EXTRACTOR.exact(message, drawn.type) for message in drawn.messages]
    for _ in range(4):
        condition = condition_on(values, random)
        expected = np.array([condition.matches(value) for value in values])
        found = truth(condition, drawn.table, EXTRACTOR)
        assert not (found.met & found.unsure).any()
        assert found.is_none == (not (found.met | found.unsure).any())
        settled = ~found.unsure
        assert found.met[settled].tolist() == expected[settled].tolist(), (condition, values)
