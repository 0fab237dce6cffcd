"""Searching the history backwards for the last time that a condition held."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from ros2_memory.absence import damaged_note, matching_topics, undecodable
from ros2_memory.errors import UndecodableError
from ros2_memory.model import TimeWindow

if TYPE_CHECKING:
    from ros2_memory.conditions import Condition
    from ros2_memory.copies import Found
    from ros2_memory.history import View


def last_match(view: View, pattern: str, condition: Condition) -> Found | None:
    """The newest match; what could not be tested is noted and leaves the search incomplete."""
    topics = matching_topics(view, pattern)
    failures: dict[tuple[str, str], UndecodableError] = {}
    tested = False
    for found in view.stream(topics, TimeWindow.everything(), newest_first=True):
        begin = time.perf_counter_ns()
        channel = found.record.channel
        try:
            message = view.memory.reader.decode(found.record)
            value = view.memory.extractor.exact(message, channel.type)
            tested = True
            matched = condition.matches(value)
        except UndecodableError as error:
            failures.setdefault((channel.topic, channel.type), error)
            matched = False
        finally:
            view.call.stages.add("extract", time.perf_counter_ns() - begin)
        if matched:
            _note_undecodable(view, failures)
            return found
    if failures and not tested:
        (topic, type_name), error = next(iter(failures.items()))
        raise undecodable(topic, type_name, error)
    _note_undecodable(view, failures)
    return None


def _note_undecodable(view: View, failures: dict[tuple[str, str], UndecodableError]) -> None:
    for (topic, type_name), error in failures.items():
        view.complete = False
        view.note(f"messages of {topic} ({type_name}) could not be decoded: {error.reason}")


def unsearched(view: View) -> tuple[str, ...]:
    """Why a search without a match was not complete; empty where it was."""
    damaged = damaged_note(view)
    if damaged:
        view.note(damaged)
    return view.notes if damaged or not view.complete else ()
