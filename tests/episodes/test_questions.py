"""A hundred questions about a month that no reply holds are answered rightly, in one call each."""

import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.history.context import Memory
from tests.episodes.questions import (
    AFTER,
    AGO,
    BEFORE,
    DID,
    ENDS,
    EXACT,
    LISTED,
    LONG,
    OFTEN,
    USING,
    Question,
    date_of,
    questions,
    unix,
)
from tests.episodes.world import ACTION, DAYS, NOW, TASK, US_PER_S, day_start, month
from tests.support.bags import Msg, make, text, write_mcap
from tests.support.clocks import SettableClock, in_zone
from tests.support.memories import asked, memory_of, with_store

pytestmark = pytest.mark.xdist_group("episodes")

SEED = int(os.environ.get("EPISODIC_SEED", "1"))
BATTERY = "/battery"
_SPLIT_NS = 6 * 3600 * 10**9
_BATTERY_NS = 60 * 10**9


def write_month(seed: int, folder: Path) -> None:
    """Writes the bags of a seed's month into a folder."""
    rows = [text(said.at * 1000, said.text, said.topic) for said in month(seed).messages]
    # Where the robot works past midnight, that is of the recording of the day before.
    edges = [(day_start(day) + 3 * 3600 * US_PER_S) * 1000 for day in range(DAYS + 1)]
    for day, (begin, end) in enumerate(pairwise(edges)):
        of_day = [row for row in rows if begin <= row.log_time < end]
        _write_day(folder / f"day_{day:02}", of_day)


def _write_day(folder: Path, rows: Sequence[Msg]) -> None:
    both = sorted([*rows, *_battery(rows[0].log_time, rows[-1].log_time)], key=_at)
    splits = groupby(both, key=lambda row: (row.log_time - both[0].log_time) // _SPLIT_NS)
    for nth, (_, split) in enumerate(splits):
        write_mcap(folder / f"{folder.name}_{nth}.mcap", split)


def _battery(first: int, last: int) -> Iterator[Msg]:
    for at in range(first, last, _BATTERY_NS):
        body = make("std_msgs/msg/Float32", data=0.5)
        yield Msg(BATTERY, "std_msgs/msg/Float32", at, body)


def _at(row: Msg) -> int:
    return row.log_time


_MOST = 100


def call_for(question: Question) -> tuple[str, dict[str, Any]]:
    """Returns the tool, and its arguments."""
    window: dict[str, Any] = {}
    if question.day is not None:
        last = question.day + question.days - 1
        # A day alone is meant as a whole; of several the last one ends where the next begins.
        end = date_of(last) if question.days == 1 else f"{date_of(last)}T23:59:59.999"
        window = {"start": date_of(question.day), "end": end}
    if question.kind == LISTED:
        return "get_topic_in_range", {"topic": TASK, "changes": True, **window}
    if question.kind == EXACT and question.at:
        minute = {"start": question.at, "end": question.at}
        return "get_topic_in_range", {"topic": TASK, "changes": True, **minute}
    given: dict[str, Any] = {
        "topic": question.topic,
        "condition_type": "equals",
        "value": question.what,
        **window,
    }
    if question.kind == USING:
        given |= {"topic": ACTION, "condition_type": "contains_word", "with": TASK}
        return "find_matches", given | {"limit": 1 if question.day is None else _MOST}
    if question.kind == ENDS or (question.kind == LONG and question.day is not None):
        return "find_matches", given | {"by": "value"}
    if question.kind in {OFTEN, DID} or question.day is not None:
        # One more: the first may have begun in the evening before.
        return "find_matches", given | {"oldest_first": True, "limit": max(question.nth + 2, 1)}
    return "find_matches", given | {"limit": 1}


def answer_of(question: Question, reply: Any) -> Any:
    """Returns what a reply says, in the form of the question's true answer."""
    if "changes" in reply:
        values = [row["value"] for row in reply["changes"]]
        return values if question.kind == LISTED else set(values)
    if question.kind in {OFTEN, DID}:
        return reply["total"] if question.kind == OFTEN else reply["total"] > 0
    if question.kind == USING:
        return {row["value"] for each in reply["episodes"] for row in each["with"]}
    if "rows" in reply:
        [row] = reply["rows"]
        cells = dict(zip(reply["columns"], row, strict=True))
        return (
            cells["seconds"] if question.kind == LONG else (cells["first_unix"], cells["last_unix"])
        )
    rows = reply["episodes"]
    if question.kind == EXACT and question.day is not None:
        rows = [row for row in rows if row["start"] >= unix(day_start(question.day))]
    return _of_episode(question, rows[question.nth])


def _of_episode(question: Question, row: Any) -> Any:
    if question.kind in {AFTER, BEFORE}:
        beside = row.get("next" if question.kind == AFTER else "previous")
        return None if beside is None else (beside["value"], beside["start"])
    if question.kind == AGO:
        now = datetime.fromtimestamp(row["end"] + row["ago_s"], UTC)
        return (now.date() - datetime.fromtimestamp(row["start"], UTC).date()).days
    return row["start"] if question.kind == EXACT else (row["start"], row["seconds"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("month")
    write_month(SEED, folder)
    return folder


@pytest.fixture(autouse=True)
def in_utc() -> Iterator[None]:
    with in_zone("UTC"):
        yield


def over(folder: Path) -> Memory:
    return memory_of(folder, clock=SettableClock(int(NOW.timestamp()) * 10**9))


def wrong_among(memory: Memory, folder: Path) -> list[Any]:
    """The questions whose answers are not true, each with the answer."""
    wrong = []
    for question in questions(SEED):
        tool, given = call_for(question)
        reply = asked(memory, tool, **given)
        found = None if "error" in reply else answer_of(question, reply)
        if not is_true(found, question.answer):
            wrong.append((question, found, reply.get("detail"), reply.get("notes")))
    return wrong


def is_true(found: Any, truth: Any) -> bool:
    """Whether an answer is the truth: numbers to a tenth of a second, as tables round them."""
    if isinstance(truth, tuple) and isinstance(found, tuple):
        return all(map(is_true, found, truth)) and len(found) == len(truth)
    if isinstance(truth, float) and isinstance(found, float | int):
        return abs(found - truth) <= 0.06
    return bool(found == truth) and type(found) is type(truth)


def test_all_hundred_are_right_in_one_call_each_from_the_store(folder: Path) -> None:
    assert wrong_among(with_store(over(folder), folder), folder) == []


def test_all_hundred_are_right_in_one_call_each_from_the_bags_alone(folder: Path) -> None:
    assert wrong_among(over(folder), folder) == []
