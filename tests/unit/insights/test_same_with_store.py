"""Every tool answers as without a store, in whatever history, and however much of it is stored."""

from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal
from unittest.mock import patch

from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.core.regions import Circle, Place, Rectangle
from ros2_memory.history.context import QuerySettings
from tests.support.bags import write_splits
from tests.support.clocks import FixedClock
from tests.support.examples import LONG
from tests.support.memories import asked, assert_same_counts, memory_of, with_store
from tests.support.moving_map import BEGIN, S, write_moving_map
from tests.support.random_histories import write_history
from tests.unit.things.test_find import KITCHEN, random_messages

LIMITS: Final = QuerySettings(
    places=(
        KITCHEN,
        Place("room", "map", Rectangle(-1.0, 5.0, -1.0, 4.0)),
        Place("start", "map", Circle(0.0, 0.0, 0.6)),
        Place("yard", "elsewhere", Rectangle(-9.0, 9.0, -9.0, 9.0)),
    ),
    labels={"mug": ["coffee mug"]},
)
OBJECTS: Final = "/vision/scene/scene_objects"
BOX: Final[dict[str, Any]] = {"where": {"x": [-1, 1], "y": [-2, 2]}}
CUPS: Final[dict[str, Any]] = {"topic": OBJECTS, "condition_type": "contains", "value": "cup"}
PRESSED: Final[dict[str, Any]] = {"topic": "/bumper", "condition_type": "equals", "value": True}
SAID: Final[dict[str, Any]] = {"topic": "/chatter", "condition_type": "contains", "value": "cup"}
UNDOCKED: Final[dict[str, Any]] = {"topic": "/dock", "condition_type": "contains", "value": "un"}
NUMBERS: Final = (
    {"topic": "/odom", "fields": ["position.x", "position.z"]},
    {"topic": OBJECTS, "fields": ["objects.score"]},
    {"topic": "/battery_state", "fields": ["percentage", "voltage"]},
)
BINS: Final = ("day", "hour", "weekday", "place")
THINGS: Final[list[tuple[str, dict[str, Any]]]] = [
    *(("find_things", more) for more in ({}, {"label": "mug"}, {"where": "kitchen"})),
    ("find_things", {"label": "cup", "min_score": 0.5}),
    *(("compare", more) for more in ({}, {"where": "kitchen"})),
]
QUESTIONS: Final[list[tuple[str, dict[str, Any]]]] = [
    *THINGS,
    *(("recap", more) for more in ({}, {"where": "room"}, BOX)),
    *(("trajectory_summary", more) for more in ({}, BOX, {**BOX, "frame_id": "map"})),
    *(("find_matches", {**CUPS, **more}) for more in ({}, {"where": "room"}, BOX)),
    *(("find_matches", {**SAID, "while": other}) for other in (PRESSED, UNDOCKED)),
    ("visits", {}),
    *(("visits", more) for more in ({"where": "start"}, BOX, {**BOX, "frame_id": "odom"})),
    ("visits", {"x": 0.5, "y": 0.0, "radius_m": 1.0}),
    *(("visits", {"where": "start", "by": by}) for by in BINS),
    *(("trajectory_summary", {"by": by}) for by in BINS),
    *(("find_matches", {**each, "by": by}) for each in (CUPS, PRESSED) for by in BINS),
    *(("get_topic_in_range", {**each, "by": by}) for each in NUMBERS for by in BINS),
]


@settings(max_examples=60 if LONG else 1)
@given(
    kind=st.sampled_from(["odd", "moving map", "things"]),
    seed=st.integers(0, 2**32),
    part=st.sampled_from([0.3, 0.6, 1.0, 1.0]),
    split_s=st.sampled_from([3.0, 10.0, 1000.0]),
    questions=st.lists(st.sampled_from(QUESTIONS), min_size=6, max_size=6),
)
# Of three poses within 0.2 s the middle one alone is a place.
@example(kind="odd", seed=598, part=1.0, split_s=10.0, questions=[("trajectory_summary", BOX)])
# What one of two windows leaves out for want of transforms is found by reading, or remembered.
@example(kind="odd", seed=236, part=0.6, split_s=10.0, questions=[THINGS[-1], THINGS[-2]] * 8)
@example(kind="things", seed=1, part=1.0, split_s=10.0, questions=THINGS)
@example(kind="things", seed=2, part=0.5, split_s=3.0, questions=THINGS)
# A score of 0.73605, which a column has to some digits.
@example(kind="things", seed=255582709, part=0.3, split_s=3.0, questions=[("recap", {})] * 6)
# Of one recording's poses 2 s apart, the transforms of another place the later alone.
@example(kind="odd", seed=101, part=0.3, split_s=3.0, questions=[THINGS[-1], THINGS[-2]] * 3)
def test_every_question_is_answered_as_without_a_store(
    kind: Literal["odd", "moving map", "things"],
    seed: int,
    part: float,
    split_s: float,
    questions: list[tuple[str, dict[str, Any]]],
) -> None:
    draw = Random(seed)
    with TemporaryDirectory() as folder:
        bags = Path(folder)
        moments = [BEGIN, BEGIN + 20 * S, BEGIN + 50 * S, BEGIN + 130 * S]
        if kind == "odd":
            moments = write_history(bags, draw).moments
        elif kind == "moving map":
            write_moving_map(bags, seed, seconds=60, split_s=split_s)
        else:
            write_splits(bags, random_messages(draw), split_s)
        plain = memory_of(bags, limits=LIMITS, clock=FixedClock(max(moments) + S))
        known = with_store(plain, bags, part=part)

        # Parts are few here: what is known of columns is still read in several pieces.
        with patch("ros2_memory.columns.scanner._NEIGHBOURS", 1 + seed % 9):
            for tool, question in questions:
                first, last = draw.choice([sorted(draw.choices(moments, k=2)), [0, 4 * 10**18]])
                given_ = {**question, "start": first / S, "end": last / S}
                if tool == "compare":
                    given_ |= {"with_start": moments[0] / S - 1, "with_end": moments[1] / S}
                answer = asked(plain, tool, **given_)
                # What was joined of all that is stored serves when it is asked for again.
                for _ in range(2):
                    assert_same_counts(asked(known, tool, **given_), answer)
