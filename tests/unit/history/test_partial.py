"""What a call has no time for: replies have what is known, and claim no more than that."""

from __future__ import annotations

import math
from functools import partial
from itertools import chain, repeat
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from tests.support.bags import boolean, detections, odom, text, write_mcap
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

S = 10**9
BEGIN = 1_784_030_400  # 12:00 UTC
HOUR = 3600
NEWEST = BEGIN + 3 * HOUR
SPAN = {"start": BEGIN, "end": BEGIN + 4 * HOUR}
BUMPS = {"topic": "/bumper", "condition_type": "equals", "value": True}
CUPS = {"topic": "/vision/scene/scene_objects", "condition_type": "contains", "value": "cup"}


@pytest.fixture
def memory(tmp_path: Path) -> Memory:
    """Four bags, an hour apart, in each a bump, a cup and a task."""
    for nth in range(4):
        messages = [
            message
            for second in range(20)
            for at in [(BEGIN + nth * HOUR + second) * S]
            for message in (
                odom(at, second / 10, 0.0),
                boolean(at + 1, 5 <= second < 8),
                detections(at + 2, ["cup"] if 5 <= second < 8 else []),
            )
        ]
        said = [(2, "wash"), (9, "")] if nth % 2 else [(2, "dry"), (9, "wash")]
        messages += [text((BEGIN + nth * HOUR + at) * S + 3, word, "/task") for at, word in said]
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages)
    return memory_of(tmp_path, limits=QuerySettings(now="latest", map_frame=""))


@pytest.fixture
def ask(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Asks a tool, which has time for reading until it has looked at the clock so often."""

    def ask_in_part(tool: str, looks: int, **given: object) -> Any:
        clock = chain([0.0] * (looks + 1), repeat(math.inf))
        monkeypatch.setattr(
            Call, "partial_after", lambda *_: Deadline.after(1.0, partial(next, clock))
        )
        return asked(memory, memory.index.bag_dir, tool, **given)

    return ask_in_part


def test_of_a_day_that_is_counted_in_part_the_first_time_is_not_known(
    ask: Callable[..., Any],
) -> None:
    reply = ask("find_matches", 0, **BUMPS, by="day", **SPAN)
    assert reply["all"][2] == 1
    assert "usual_first" not in reply
    assert reply["start"] == pytest.approx(NEWEST, abs=1e-6)
    assert "out of time" in reply["notes"][0]


def test_what_is_counted_by_label_begins_where_it_is_counted_from(ask: Callable[..., Any]) -> None:
    reply = ask("find_matches", 0, **CUPS, by="label", **SPAN)
    assert (reply["start"], reply["end"]) == pytest.approx((NEWEST, NEWEST + 19), abs=1e-6)


def test_where_places_are_known_in_part_matches_there_have_no_total(
    ask: Callable[..., Any],
) -> None:
    where = {"x": 0.5, "y": 0.0, "radius_m": 2.0}
    reply = ask("find_matches", 2, **BUMPS, where=where, limit=100, **SPAN)
    assert reply["at_least"] == len(reply["sightings"]) == 2
    assert reply["unknown_s"] > 0
    assert "total" not in reply


def test_changes_that_were_not_all_read_have_no_total(ask: Callable[..., Any]) -> None:
    reply = ask("get_topic_in_range", 2, topic="/bumper", changes=True, **SPAN)
    assert reply["at_least"] == len(reply["changes"]) == 2
    assert "only what is after" in reply["notes"][0]


def test_texts_of_which_it_is_not_known_whether_they_end_are_said_to_be_such(
    ask: Callable[..., Any],
) -> None:
    found = {"topic": "/task", "condition_type": "contains", "value": "wash"}
    reply = ask("find_matches", 0, **found, **SPAN)
    assert len(reply["sightings"]) == 4
    assert any("may have held for longer" in note for note in reply["notes"])


def test_a_question_without_time_for_any_of_it_says_what_to_ask(ask: Callable[..., Any]) -> None:
    reply = ask("get_topic_in_range", 0, topic="/task", by="value", **SPAN)
    assert reply["error"] == "timeout"
    assert "ask about a shorter window" in reply["detail"]
