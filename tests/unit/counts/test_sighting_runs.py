from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.counts import sighting_runs
from ros2_memory.counts.sighting_runs import (
    known_sightings,
    store_shared_texts,
    topics_with_texts,
)
from ros2_memory.history.bag_fold import shares_of
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.reverse_search import ReverseSearch
from ros2_memory.history.view import View
from ros2_memory.insights.sightings import find_matches
from tests.support.bags import detections, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of, recalling

if TYPE_CHECKING:
    from ros2_memory.history.bag_fold import Share
    from ros2_memory.history.context import Memory
    from ros2_memory.results import Sightings
    from tests.support.bags import Msg

S = 10**9
BEGIN = 1_784_000_000 * S
TOPIC = "/vision/scene/scene_objects"
LATEST = QuerySettings(now="latest")
LABELS = ("cup", "teacup", "fork")


def seen(draw: Random) -> list[tuple[Msg, bool]]:
    """What a detector sees that misses things, and is silent at times; and whether it is a cup."""
    at, labels = BEGIN, [*LABELS]
    messages = []
    for _ in range(draw.randint(1, 60)):
        at += draw.choice([S // 3, S // 3, 2 * S, SILENCE_NS, SILENCE_NS + 1, 40 * S])
        if draw.random() < 0.3:
            labels = draw.sample(LABELS, draw.randint(0, 3))
        messages.append((detections(at, labels), any("cup" in each for each in labels)))
    return messages


def write(folder: Path, messages: list[Msg], draw: Random) -> None:
    """Writes messages as splits of any length, of recordings of which some overlap."""
    number, recording = 0, 0
    again: list[Msg] = []
    while messages:
        size = draw.randint(1, 12)
        some, messages = messages[:size], messages[size:]
        # A recording that took over logged later what the one before has, too.
        copies = [
            replace(each, log_time=each.log_time + 1000, publish_time=each.published)
            for each in again
        ]
        path = folder / f"rec_{recording}" / f"rec_{recording}_{number}.mcap"
        write_mcap(path, [*copies, *some])
        number, again = number + 1, []
        if draw.random() < 0.4:
            recording, number = recording + 1, 0
            again = [each for each in some[-3:] if some[-1].log_time - each.log_time < S]


def count_of(messages: list[tuple[Msg, bool]]) -> int:
    """How many sightings of a cup there are."""
    count, before = 0, None
    for each, is_cup in messages:
        if is_cup and (before is None or each.log_time - before > SILENCE_NS):
            count += 1
        before = each.log_time if is_cup else None
    return count


def asked(
    memory: Memory, limit: int, span: tuple[float | None, float | None], *, oldest_first: bool
) -> Sightings:
    start_s, end_s = span
    return find_matches(
        memory,
        Call(),
        TOPIC,
        "contains",
        "cup",
        start_s=start_s,
        end_s=end_s,
        limit=limit,
        oldest_first=oldest_first,
    )


@settings(deadline=None, max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), part=st.sampled_from([0.5, 1.0]), limit=st.integers(1, 6))
def test_sightings_are_the_same_by_texts_as_by_messages(seed: int, part: float, limit: int) -> None:
    draw = Random(seed)
    messages = seen(draw)
    with TemporaryDirectory() as folder:
        bags = Path(folder)
        write(bags, [each for each, _ in messages], draw)
        plain = memory_of(bags, limits=LATEST)
        known = recalling(plain, bags, part=part)
        if seed % 3:
            store_shared_texts(View(known, Call()), TOPIC, TimeWindow.everything())
        start, end = sorted(draw.choice(messages)[0].log_time / S for _ in range(2))
        for oldest_first in (False, True):
            for span in ((None, None), (start, end)):
                answer = asked(plain, limit, span, oldest_first=oldest_first)
                for _ in range(2):
                    assert asked(known, limit, span, oldest_first=oldest_first) == answer
                if oldest_first and span == (None, None):
                    assert answer.total == count_of(messages)


def test_whole_bags_are_counted_without_reading_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = Random(0)
    messages = seen(draw)
    write(tmp_path, [each for each, _ in messages], draw)
    known = recalling(memory_of(tmp_path, limits=LATEST), tmp_path)
    view = View(known, Call())
    assert topics_with_texts(view) == [TOPIC]
    assert store_shared_texts(view, TOPIC, TimeWindow.everything()) > 0
    monkeypatch.setattr(sighting_runs, "_MOST_READ", 0)
    for value, total in (("cup", count_of(messages)), ("spoon", None)):
        condition = parse_condition("contains", value, 0.5)
        found = known_sightings(
            view,
            ReverseSearch(view, TOPIC, condition),
            condition,
            TimeWindow.everything(),
            1,
            oldest_first=True,
        )
        assert (None if found is None else found.total) == total


@pytest.mark.parametrize("part", [0.5, 1.0])
def test_bags_of_which_none_can_hold_a_text_are_not_looked_at_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: float
) -> None:
    draw = Random(0)
    write(tmp_path, [each for each, _ in seen(draw)], draw)
    known = recalling(memory_of(tmp_path, limits=LATEST), tmp_path, part=part)
    view = View(known, Call())
    condition = parse_condition("contains", "spoon", 0.5)
    asked_for = []

    def counting(view: View, topic: str, window: TimeWindow) -> list[Share]:
        asked_for.append(topic)
        return shares_of(view, topic, window)

    monkeypatch.setattr(sighting_runs, "shares_of", counting)
    search = ReverseSearch(view, TOPIC, condition)
    everything = TimeWindow.everything()
    assert known_sightings(view, search, condition, everything, 1, oldest_first=False) is None
    assert asked_for == ([] if part == 1.0 else [TOPIC])


@pytest.mark.parametrize(
    ("kind", "value", "more"),
    [
        ("contains", "true", {}),
        ("equals", "1", {}),
        ("contains", "cup", {"field": "detections.label"}),
        ("contains", "cup", {"min_score": 0.5}),
        ("above", 1, {"field": "detections.score"}),
    ],
)
def test_what_more_than_texts_decides_is_left_to_the_search(
    kind: str, value: JsonValue, more: dict[str, Any]
) -> None:
    assert parse_condition("contains", "cup", 0.5).is_on_texts_alone
    assert not parse_condition(kind, value, 0.5, **more).is_on_texts_alone
