"""What was seen, by label: held to the messages that the test wrote."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.bags import detections, text, write_mcap
from tests.support.examples import examples
from tests.support.memories import asked, memory_of, with_store
from tests.support.rooms import BEGIN, PLACES, ROOMS, SEEN, S, World, asked_of, bounds, draw, write

ANY = {"topic": SEEN, "condition_type": "contains", "value": "", "by": "label"}


def rows_of(reply: Any) -> dict[str, dict[str, Any]]:
    names = reply["columns"][1:]
    rows = {row[0]: dict(zip(names, row[1:], strict=True)) for row in reply["rows"]}
    assert len(rows) == len(reply["rows"])
    return rows | {"all": dict(zip(names, reply["all"], strict=True))}


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


@settings(max_examples=examples(10), deadline=None, suppress_health_check=[HealthCheck.too_slow])
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
        reply = asked(memory, bags, "find_matches", min_score=least, **where, **ANY)
    seconds = [nth for nth in range(120) if not rooms or world.room(nth) in rooms]
    truth = {label: expected(world, seconds, label, least) for label in PLACES}
    rows = rows_of(reply)
    whole = rows.pop("all")
    assert {label: shown(row) for label, row in rows.items()} == {
        label: pytest.approx(row) for label, row in truth.items() if row is not None
    }
    assert whole["count"] == sum(row["count"] for row in rows.values())
    counts = [row["count"] for row in rows.values()]
    assert counts == sorted(counts, reverse=True)


def test_a_condition_takes_the_labels_that_meet_it_alone(tmp_path: Path) -> None:
    world = draw(5, 60)
    write(world, tmp_path)
    memory = asked_of(tmp_path, stored=True)
    some = asked(memory, tmp_path, "find_matches", **{**ANY, "value": "CAT"})
    assert {row[0] for row in some["rows"]} == {"cat", "cat bed"}
    one = asked(
        memory, tmp_path, "find_matches", **{**ANY, "condition_type": "equals", "value": "cat"}
    )
    assert {row[0] for row in one["rows"]} == {"cat"}
    none = asked(memory, tmp_path, "find_matches", **{**ANY, "value": "giraffe"})
    assert (none["rows"], none["all"][0]) == ([], 0)


def test_topics_of_a_glob_are_counted_as_one(tmp_path: Path) -> None:
    left = [detections((BEGIN + at) * S, ["cup"], topic="/left/seen") for at in range(5)]
    right = [
        detections((BEGIN + at) * S + 1, ["cup", "cup"], topic="/right/seen") for at in range(3, 9)
    ]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", sorted([*left, *right], key=lambda m: m.log_time))
    memory = with_store(memory_of(tmp_path), tmp_path)
    row = rows_of(asked(memory, tmp_path, "find_matches", **{**ANY, "topic": "/*/seen"}))["cup"]
    assert (row["count"], row["seconds"], row["most_at_once"]) == (1, 8.0, 2)


def test_labels_of_more_than_two_words_are_quoted(tmp_path: Path) -> None:
    named = "please open the door"
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [detections(BEGIN * S, ["cup", named])])
    reply = asked(memory_of(tmp_path), tmp_path, "find_matches", **ANY)
    assert reply["quoted"] == ["rows"]
    assert {row[0] for row in reply["rows"]} == {"cup", named}


def test_of_many_labels_those_seen_most_often_are_listed(tmp_path: Path) -> None:
    labels = [f"thing{nth}" for nth in range(80)]
    chance = Random(1)
    messages = [
        detections((BEGIN + 20 * at) * S, chance.sample(labels, 30)) for at in range(10)
    ] + [detections((BEGIN + 300) * S, labels)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    reply = asked(memory_of(tmp_path), tmp_path, "find_matches", **ANY)
    assert len(reply["rows"]) == 60
    assert "the 60 of 80 labels that were seen most often" in reply["notes"]


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
    reply = asked(memory_of(tmp_path), tmp_path, "find_matches", **{**ANY, **given})
    assert reply["error"] == "invalid_arguments"
    assert "by label takes labels of detections: give condition_type contains" in reply["detail"]


@pytest.mark.parametrize(
    ("said", "rows"),
    [
        ('[{"label": "cup"}]', 1),
        ('{"seen": [{"label": "cup"}]}', 1),
        ('{"seen": [{"in": {"label": "cup"}}]}', 1),
        ('{"seen": [{"in": {"in": {"in": {"label": "cup"}}}}]}', 0),
        ("a cup", 0),
    ],
)
def test_texts_that_show_nothing_are_named(tmp_path: Path, said: str, rows: int) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(BEGIN * S, said)])
    every = {"condition_type": "contains", "value": "", "by": "label"}
    reply = asked(memory_of(tmp_path), tmp_path, "find_matches", topic="/chatter", **every)
    assert len(reply["rows"]) == rows
    assert any("/chatter has texts" in note for note in reply["notes"]) == (not rows)
