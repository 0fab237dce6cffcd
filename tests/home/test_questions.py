"""The home robot's sixty questions, asked by a script and judged by the truth of its world."""

from __future__ import annotations

import asyncio
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from tests.home import asking, flat, instances
from tests.home.days import Scale
from tests.home.questions import KINDS, questions
from tests.home.truth import truth_of
from tests.home.world import world_of

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.serving.mcp_server import EpisodicServer

pytestmark = [pytest.mark.xdist_group("home"), pytest.mark.usefixtures("in_utc")]

SCALE = Scale()
MOST_CHARS = 6_000
"""Of a reply: what a planner can take in beside much else."""


@pytest.fixture(scope="module")
def server(home: Path) -> EpisodicServer:
    return asking.server_over(asking.settings_for(home, SCALE.split_s))


def test_there_are_sixty_questions_of_every_kind() -> None:
    asked = questions(SCALE)
    assert len({each.id for each in asked}) == len({each.text for each in asked}) == 60
    assert {each.kind for each in asked} == set(KINDS)


def test_every_question_is_answered_rightly_in_few_calls_and_short_replies(
    server: EpisodicServer,
) -> None:
    outcomes = asking.ask_all(server, questions(SCALE))
    missed = [(each.question.id, each.why) for each in outcomes if each.result != asking.RIGHT]
    assert missed == []
    assert len(outcomes) == 60
    assert sum(each.calls for each in outcomes) <= 75
    assert sum(each.characters for each in outcomes) <= 66_000
    assert max(each.longest_reply for each in outcomes) <= MOST_CHARS


def test_things_are_counted_placed_and_followed_as_they_were(server: EpisodicServer) -> None:
    found = instances.measured(server, truth_of(SCALE), SCALE.split_s)
    assert (found.right_labels, found.wrong_numbers) == (found.labels, [])
    assert found.labels == 22
    assert found.moves_in_time == found.moves > 0
    assert sorted(found.away_m)[len(found.away_m) // 2] < 1.0
    assert found.switches == []
    assert found.denied == []


def test_a_thing_is_denied_only_where_somebody_looked_and_it_was_gone(
    server: EpisodicServer,
) -> None:
    found = instances.denials(server, world_of(SCALE), truth_of(SCALE))
    assert found.count > 0
    assert found.unseen == []
    assert found.false == []


def test_no_reply_about_things_or_differences_is_longer_than_6_kb(server: EpisodicServer) -> None:
    runs = truth_of(SCALE).recorded
    known = runs[0][0], runs[-1][1]
    asked: list[tuple[str, dict[str, object]]] = [("find_things", {})]
    asked += [("find_things", {"where": name}) for name in flat.ROOMS]
    asked += [
        ("compare", {"start": b, "end": d, "with_start": a, "with_end": c})
        for (a, c), (b, d) in [*pairwise(runs), (runs[0], runs[-1]), (runs[0], known)]
    ]
    longest: Counter[str] = Counter()
    for tool, given in asked:
        reply = asyncio.run(server.dispatcher.answer(tool, given))
        assert not reply.is_error, (tool, given, reply.text)
        longest[tool] = max(longest[tool], len(reply.text))
    assert all(2_000 < each <= MOST_CHARS for each in longest.values()), longest
