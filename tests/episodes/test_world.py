"""The month and its questions are what their documents say, for any seed."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from tests.episodes.questions import EACH, KINDS, has_word, questions
from tests.episodes.world import ACTION, ACTIONS, DAYS, TASK, TASKS_A_DAY, month

_SEEDS = (1, 7)


@pytest.mark.parametrize("seed", _SEEDS)
def test_a_month_has_1500_tasks_and_20000_actions_in_order(seed: int) -> None:
    found = month(seed)
    assert (len(found.tasks), len(found.actions)) == (DAYS * TASKS_A_DAY, ACTIONS) == (1500, 20000)
    for spans in (found.tasks, found.actions):
        assert all(span.start < span.end for span in spans)
        assert all(a.end <= b.start for a, b in pairwise(spans))
        assert all(a.end < b.start for a, b in pairwise(spans) if a.text == b.text)
    assert len(str([said.text for said in found.messages if said.topic == TASK])) > 24_000


@pytest.mark.parametrize("seed", _SEEDS)
def test_the_messages_say_what_the_lists_have(seed: int) -> None:
    found = month(seed)
    for topic, spans in ((TASK, found.tasks), (ACTION, found.actions)):
        said = [(each.at, each.text) for each in found.messages if each.topic == topic]
        changes = [said[0], *(b for a, b in pairwise(said) if a[1] != b[1])]
        heard = [(start, text, until) for (start, text), (until, _) in pairwise(changes) if text]
        assert heard == [(each.start, each.text, each.end) for each in spans]
        assert len(said) > len(changes)


@pytest.mark.parametrize("seed", _SEEDS)
def test_there_are_a_hundred_questions_of_ten_kinds(seed: int) -> None:
    asked = questions(seed)
    assert Counter(each.kind for each in asked) == dict.fromkeys(KINDS, EACH)
    assert len(KINDS) * EACH == 100
    # One word is part of another, and one task past midnight is of two days.
    assert any(len(each.answer) > TASKS_A_DAY for each in asked if each.kind == KINDS[0])
    assert has_word("pot", "wash Pot")
    assert not has_word("knife", "pick up ButterKnife")


def test_questions_are_drawn_by_their_seed() -> None:
    assert questions.__wrapped__(1) == questions(1)
    assert questions(1) != questions(7)
