"""What counts, and how long it held; by label, as the messages say that the test wrote."""

import json
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import (
    boolean,
    detections,
    odom,
    text,
    write_mcap,
    write_splits,
)
from tests.support.examples import examples
from tests.support.memories import asked, each_way, memory_of
from tests.support.rooms import BEGIN, PLACES, ROOMS, SEEN, S, World, asked_of, bounds, draw, write
from tests.support.tables import table

ANY = {"topic": SEEN, "condition_type": "contains", "value": "", "by": "label"}


def expected(
    world: World, seconds: list[int], label: str, least: float = 0.0
) -> dict[str, Any] | None:
    """What is true of a label in some seconds (ascending), by the rules, one second at a time."""
    seen = {
        second: [score for name, score in world.seen[second] if name == label and score >= least]
        for second in seconds
    }
    at = [second for second in seconds if seen[second]]
    if not at:
        return None
    # A thing that is missed for up to 3 s did not leave.
    begins = [at[0], *(later for earlier, later in pairwise(at) if later - earlier > 3)]
    lasts = [*(earlier for earlier, later in pairwise(at) if later - earlier > 3), at[-1]]
    return {
        "count": len(begins),
        "seconds": sum(last - first for first, last in zip(begins, lasts, strict=True)),
        "first_unix": BEGIN + at[0],
        "last_unix": BEGIN + at[-1],
        "best_score": max(max(seen[second]) for second in at),
        "most_at_once": max(len(seen[second]) for second in at),
    }


def shown(row: dict[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in row if key not in {"first", "last"}}


@settings(max_examples=examples(10))
@given(
    seed=st.integers(0, 10_000),
    stored=st.booleans(),
    rooms=st.lists(st.sampled_from([*ROOMS]), max_size=2, unique=True),
    least=st.sampled_from([0.0, 0.6]),
)
def test_each_label_has_what_the_messages_say_of_it_while_the_robot_was_there(
    seed: int, stored: bool, rooms: list[str], least: float
) -> None:
    world = draw(seed, 120)
    with TemporaryDirectory() as name:
        bags = Path(name)
        write(world, bags)
        memory = asked_of(bags, stored=stored)
        where = {"where": bounds(*rooms)} if rooms else {}
        reply = asked(memory, "find_matches", min_score=least, **where, **ANY)
    seconds = [nth for nth in range(120) if not rooms or world.room(nth) in rooms]
    truth = {label: expected(world, seconds, label, least) for label in PLACES}
    rows = table(reply)
    whole = rows.pop("all")
    assert {label: shown(row) for label, row in rows.items()} == {
        label: pytest.approx(row) for label, row in truth.items() if row is not None
    }
    assert whole["count"] == sum(row["count"] for row in rows.values())
    counts = [row["count"] for row in rows.values()]
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize(
    "given",
    [
        {"condition_type": "above", "value": 0.5, "field": "detections.score"},
        {"value": "cup", "field": "detections.label"},
        {"condition_type": "near_position", "value": {"x": 1, "y": 1}},
    ],
)
def test_what_is_no_condition_on_labels_is_refused(tmp_path: Path, given: dict[str, Any]) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [detections(BEGIN * S, ["cup"])])
    reply = asked(memory_of(tmp_path), "find_matches", **{**ANY, **given})
    assert reply["error"] == "invalid_arguments"
    assert "by label takes labels of detections: give condition_type contains" in reply["detail"]


T: Final = 1_790_000_000


@each_way
def test_labels_in_json_are_compared_one_by_one(tmp_path: Path, *, recalls: bool) -> None:
    both, butter = ["Knife", "butter knife"], ["butter knife"]
    seen = [both if at < 20 else butter for at in range(40)]
    messages = [
        text((T + at) * NS_PER_S, json.dumps({"objects": [{"label": label} for label in labels]}))
        for at, labels in enumerate(seen)
    ]
    write_splits(tmp_path, messages, 10)
    memory = memory_of(tmp_path, recalls=recalls)
    for kind, value in (("equals", "knife"), ("contains_word", "knife -butter")):
        sought = {"topic": "/chatter", "condition_type": kind, "value": value}
        answer = asked(memory, "find_matches", **sought)
        assert [each["count"] for each in answer["sightings"]] == [20]
        newest = asked(memory, "find_last_match", **sought)
        assert newest["timestamp"] == T + 19


@each_way
def test_a_topic_that_changed_its_type_counts_what_it_said_as_either(
    tmp_path: Path, *, recalls: bool
) -> None:
    """A text for 100 s, then a boolean; true for 10 s of 20, and nothing or false in between."""
    said = [
        text((T + at) * NS_PER_S, "true" if at % 20 < 10 else "no", "/on")
        for at in range(0, 100, 2)
    ]
    said += [boolean((T + at) * NS_PER_S, at % 20 < 10, "/on") for at in range(100, 200, 2)]
    said += [odom((T + at) * NS_PER_S, 1.0, 0.0, topic="/on") for at in range(200, 220, 2)]
    write_splits(tmp_path, said, 40)
    memory = memory_of(tmp_path, recalls=recalls)
    window = {"topic": "/on", "start": T, "end": T + 198}
    on = {**window, "condition_type": "contains", "value": "true"}
    found = asked(memory, "find_matches", **on, limit=20)
    whole = table(asked(memory, "find_matches", **on, by="day"))["all"]
    assert found["total"] == 10
    assert (whole["count"], whole["seconds"]) == (10, 100)
    changes = asked(memory, "get_topic_in_range", **window, changes=True)
    assert [row["value"] for row in changes["changes"]] == ["true", "no"] * 5 + [True, False] * 5
    values = asked(memory, "get_topic_in_range", **window, by="value")
    assert values["all"][0] == 20
    notes = asked(memory, "get_topic_in_range", **window)["notes"]
    kinds = "std_msgs/msg/String, std_msgs/msg/Bool"
    assert f"the topic was recorded under several types: {kinds}" in notes
