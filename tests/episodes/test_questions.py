"""A hundred questions about a month that no reply holds are answered rightly, in one call each."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest

from tests.episodes.asking import answer_of, call_for
from tests.episodes.questions import questions
from tests.episodes.recording import write_month
from tests.episodes.world import NOW
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory

pytestmark = pytest.mark.xdist_group("episodes")

SEED = 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("month")
    write_month(SEED, folder)
    return folder


@pytest.fixture(autouse=True)
def in_utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patched:
        patched.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()


def over(folder: Path) -> Memory:
    return memory_of(folder, clock=SettableClock(int(NOW.timestamp()) * 10**9))


def wrong_among(memory: Memory, folder: Path) -> list[Any]:
    """The questions whose answers are not true, each with the answer."""
    wrong = []
    for question in questions(SEED):
        tool, given = call_for(question)
        reply = asked(memory, folder, tool, **given)
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
