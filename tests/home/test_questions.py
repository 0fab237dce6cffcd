"""The home robot's sixty questions, asked by a script and judged by the truth of its world."""

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ros2_memory.serving.mcp_server import EpisodicServer
from tests.home import asking, flat
from tests.home.asking import Row, since, stays
from tests.home.camera import in_view
from tests.home.days import Scale
from tests.home.paths import Pose
from tests.home.questions import questions
from tests.home.things import Place
from tests.home.truth import truth_of
from tests.home.world import VISION, world_of

pytestmark = [pytest.mark.xdist_group("home"), pytest.mark.usefixtures("in_utc")]

SCALE = Scale()
MOST_CHARS = 6_000
"""Of a reply: what a planner can take in beside much else."""
_SAME_M = 0.7
"""A place that is reported so near to a true one is that one: half of the way to another."""
_DENIED = "not_seen_where_expected"


@pytest.fixture(scope="module")
def server(home: Path) -> EpisodicServer:
    return asking.server_over(asking.settings_for(home, SCALE.split_s))


def test_every_question_is_answered_rightly_and_in_few_words(server: EpisodicServer) -> None:
    asked = questions(SCALE)
    assert len({question.text for question in asked}) == 60
    texts = asking.replies_to(server, asked)
    assert asking.missed(asked, texts) == {}
    assert sum(map(len, texts)) <= 58_000
    assert max(map(len, texts)) <= MOST_CHARS


def things_in(server: EpisodicServer, **question: object) -> list[Row]:
    found: list[Row] = json.loads(asking.text_of(server, "find_things", question))["things"]
    return found


def away(thing: Row, place: Place | None) -> float:
    """Returns how far a reply has a thing, or a stay of it, from a true place."""
    if place is None:
        return math.inf
    return math.dist((thing["place"]["x"], thing["place"]["y"]), (place.x, place.y))


def test_things_are_counted_placed_and_followed_as_they_were(server: EpisodicServer) -> None:
    """A thing that was never detected is not expected, nor a move that nobody saw."""
    truth = truth_of(SCALE)
    labels = sorted({thing.label for thing in truth.things if thing.known()})
    assert len(labels) == 22
    offs, moves = [], 0
    for label in labels:
        things = [thing for thing in truth.of(label) if thing.known()]
        reported = things_in(server, label=label)
        assert len(reported) == len(things), label
        offs += [min(away(each, thing.known()[-1].place) for each in reported) for thing in things]
        listed = [stay for each in reported for stay in stays(each)]
        known = [stay for thing in things for stay in thing.known()]
        for stay in (stay for thing in things for stay in thing.known()[1:]):
            moves += 1
            first = stay.sight.first_detected or math.inf
            assert any(
                away(each, stay.place) <= _SAME_M and abs(since(each) - first) <= SCALE.split_s
                for each in listed
            ), (label, stay)
        for each in listed:  # it never stood elsewhere
            assert min(away(each, stay.place) for stay in known) <= _SAME_M, (label, each)
        for each in reported:
            if _DENIED in each.get("still_there", {}):
                ends = [thing.stays[-1].place for thing in things]
                assert min(away(each, place) for place in ends) > _SAME_M, (label, each)
    assert moves > 0
    assert np.median(offs) <= _SAME_M


def test_a_thing_is_denied_only_where_somebody_looked_and_it_was_gone(
    server: EpisodicServer,
) -> None:
    """As of the end of each recorded time: in two messages or more its place was in view."""
    world, truth = world_of(SCALE), truth_of(SCALE)
    beats = [world.beats(VISION, recording).stamp for recording in world.recordings]
    stamps = np.unique(np.concatenate(beats))
    clock, robot = world.clock(stamps), world.robot(stamps)
    denied = [
        thing
        for _, stop in truth.recorded
        for thing in things_in(server, end=stop, limit=100)
        if _DENIED in thing.get("still_there", {})
    ]
    assert denied
    for thing in denied:
        last, until = thing["last_seen"], thing["still_there"][_DENIED]
        looked = (clock > last + 0.5) & (clock <= until + 0.5)
        poses = Pose(*(part[looked] for part in robot))
        x, y = (np.full((len(poses.x), 1), thing["place"][axis]) for axis in "xy")
        assert np.count_nonzero(in_view(poses, x, y)) >= 2, thing
        assert not any(
            stay.start <= last and until <= stay.stop and away(thing, stay.place) <= _SAME_M
            for stood in truth.of(thing["label"])
            for stay in stood.stays
        ), thing


def test_no_reply_about_things_or_differences_is_longer_than_6_kb(server: EpisodicServer) -> None:
    runs = truth_of(SCALE).recorded
    known = runs[0][0], runs[-1][1]
    asked: dict[str, list[Row]] = {
        "find_things": [{}, *({"where": name} for name in flat.ROOMS)],
        "compare": [
            {"start": b, "end": d, "with_start": a, "with_end": c}
            for (a, c), (b, d) in [*pairwise(runs), (runs[0], runs[-1]), (runs[0], known)]
        ],
    }
    for tool, given in asked.items():
        longest = max(len(asking.text_of(server, tool, arguments)) for arguments in given)
        assert 2_000 < longest <= MOST_CHARS, tool
