"""Many bags read as one history, in which each message counts once, and in one order."""

import os
import random
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.columns import decode
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import pick, scan
from ros2_memory.history.view import View
from ros2_memory.storage.mcap import bulk
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    detections,
    log_entry,
    make,
    odom,
    text,
    write_mcap,
)
from tests.support.column_worlds import EVERYTHING
from tests.support.examples import LONG, examples
from tests.support.memories import asked, assert_same_counts, memory_of, with_store
from tests.support.noting_reader import fail_reading
from tests.support.random_histories import MS, S

T0: Final = 1_700_006_400 * S


def test_a_bag_that_fails_is_named_and_the_others_still_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, at in (("a", T0), ("b", T0 + 60 * S)):
        write_mcap(tmp_path / name / f"{name}_0.mcap", [odom(at)])
    failure = BagError("a_0.mcap", "the disk returned an error")
    fail_reading(
        monkeypatch, "records", lambda path: failure if path.name == failure.path else None
    )
    view = View(memory_of(tmp_path), Call())
    found = view.stream.messages(["/odom"], EVERYTHING)
    assert [message.time for message in found] == [T0 + 60 * S]
    assert view.notes.sentences() == (
        "a/a_0.mcap could not be read to its end: the disk returned an error",
    )
    assert not view.notes.complete


TOPIC = "/rosout"

LAYOUT = McapLayout(latched=frozenset({TOPIC}))

SPLIT = 10 * S

Stored = tuple[int, int, str, int]

"""Log time, publish time, text, and the number of the recording."""


def write_recordings(root: Path, draw: random.Random, *, stamped: bool = True) -> list[Stored]:
    """Recordings one after the other, each of which begins with messages received again.

    Where they are not stamped, all were published at 0, as some bridges have it: when is unknown.
    """
    stored: list[Stored] = []
    published: list[tuple[int, str]] = []
    at = 1_000 * S
    for number in range(draw.randint(2, 4)):
        messages: list[tuple[int, int, str]] = []
        start = at
        again = draw.sample(published, min(len(published), draw.choice([0, 1, 5, 12])))
        for nth, (was, said) in enumerate(sorted(again)):
            messages.append((start + S + nth * 10**6, was, said))
        for _ in range(draw.randint(3, 25)):
            at += draw.choice([S // 5, S, 4 * S])
            said = draw.choice(["ready", "blocked", "lost"])
            messages.append((at, at if stamped else 0, said))
            published.append((at if stamped else 0, said))
        if draw.random() < 0.3 and again:  # a publisher that was lost for a while
            was, said = draw.choice(again)
            messages.append((at + S, was, said))
        at = max(at, *(each[0] for each in messages))
        for log_time, was, said in sorted(messages):
            stored.append((log_time, was or log_time, said, number))
        write_splits(root / f"rec{number}", sorted(messages), start, at)
        at += draw.choice([5, 60, 400]) * S
    return stored


def write_splits(
    folder: Path, messages: Sequence[tuple[int, int, str]], start: int, stop: int
) -> None:
    for nth, begin in enumerate(range(start, stop + 1, SPLIT)):
        inside = [
            replace(said(text, was), log_time=log_time, publish_time=was)
            for log_time, was, text in messages
            if begin <= log_time < begin + SPLIT
        ]
        poses = [odom(begin), odom(min(begin + SPLIT - 1, stop), 1.0)]
        write_mcap(folder / f"{folder.name}_{nth}.mcap", [*inside, *poses], LAYOUT)


def said(text: str, was: int) -> Msg:
    return log_entry(was, 40 if text == "lost" else 20, "nav", text)


def once(stored: Sequence[Stored]) -> list[Stored]:
    """The messages that count, by a look at each pair: not where another recording was first."""
    return [
        each
        for each in stored
        if each[0] - each[1] <= S
        or min(other for other in stored if other[1:3] == each[1:3])[3] == each[3]
    ]


def texts(memory: Memory, window: TimeWindow, *, newest_first: bool = False) -> list[Any]:
    found = View(memory, Call()).stream.messages([TOPIC], window, newest_first=newest_first)
    return [(each.time, each.record.publish_time) for each in found]


def picked(memory: Memory, window: TimeWindow) -> list[int]:
    total, chosen = pick(View(memory, Call()), TOPIC, window, 10_000)
    times = [each.time for each in chosen]
    assert len(times) == total
    return times


@settings(
    max_examples=examples(12),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 10**6), part=st.sampled_from([0.0, 0.5, 1.0]), stamped=st.booleans())
@example(seed=3, part=1.0, stamped=True)
def test_each_message_counts_once_whatever_the_catalogue_knows(
    seed: int, part: float, *, stamped: bool
) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        root = Path(folder)
        stored = write_recordings(root, draw, stamped=stamped)
        counted = once(stored)
        memory = with_store(memory_of(root, reader=McapReader()), root, part=part)
        edges = sorted(draw.choice(stored)[0] + draw.choice([0, 1]) for _ in range(2))
        for window in (EVERYTHING, TimeWindow(edges[0], edges[1] + 1)):
            inside = [each for each in counted if window.contains(each[0])]
            said = texts(memory, window)
            assert said == [each[:2] for each in inside]
            assert texts(memory, window, newest_first=True) == said[::-1]
            assert picked(memory, window) == [each[0] for each in inside]
        [census] = View(memory, Call()).census(TOPIC).values()
        ends = counted[0][0], counted[-1][0]
        assert (census.first, census.last, census.messages) == (*ends, len(counted))
        last = View(memory, Call()).stream.newest(TOPIC, EVERYTHING)
        assert last is not None
        assert last.time == counted[-1][0]


def test_a_bag_that_changes_after_it_was_looked_up_is_not_taken_from_memory(
    tmp_path: Path,
) -> None:
    messages = [boolean(T0 + n * S, n == 5) for n in range(60)]
    path = write_mcap(tmp_path / "a" / "a_0.mcap", messages)
    memory = memory_of(tmp_path)

    def scanned(view: View) -> list[int]:
        return [int(at) for rows in scan(view, "/bumper", EVERYTHING) for at in rows.times]

    assert len(scanned(View(memory, Call()))) == 60
    shorter, deleted = View(memory, Call()), View(memory, Call())
    changed = path.stat().st_mtime_ns + S
    write_mcap(path, [boolean(T0, True)])
    os.utime(path, ns=(changed, changed))
    assert scanned(shorter) == [T0]
    path.unlink()
    assert scanned(deleted) == []
    assert "a/a_0.mcap was deleted before it could be read" in deleted.notes.sentences()[0]


SPAN: Final = {"start": T0 / S - 5, "end": T0 / S + 200}

CUP: Final = {"topic": "/chatter", "condition_type": "contains", "value": "cup"}


def said_in(recordings: Mapping[str, list[Msg]], topic: str) -> Iterator[tuple[int, str]]:
    """Log time (ns) and text of each message: by log time, then by recording; copies count once."""
    every = [
        (each.log_time, name, nth, each)
        for name, messages in recordings.items()
        for nth, each in enumerate(messages)
        if each.topic == topic
    ]
    known: defaultdict[tuple[int, str], Counter[str]] = defaultdict(Counter)
    for at, name, _, message in sorted(every, key=lambda row: row[:3]):
        body: Any = message.body
        copies = known[message.published, body.data]
        most = max(copies.values(), default=0)
        copies[name] += 1
        if copies[name] > most:
            yield at, body.data


def sightings(recordings: Mapping[str, list[Msg]]) -> tuple[int, float]:
    """How many runs of cups there are, and how long they last until another text, in seconds."""
    found = [*said_in(recordings, "/chatter")]
    count, total, goes_on = 0, 0, False
    for (at, word), (following, _) in pairwise([*found, (MAX_NS, "")]):
        count += word == "cup" and not goes_on
        goes_on = word == "cup" and following - at <= SILENCE_NS
        total += (following - at) * goes_on
    return count, total / S


def counted(memory: Memory) -> tuple[int, float]:
    """The same as `find_matches` counts it; both are 0 where there is no such topic."""
    reply = asked(memory, "find_matches", **CUP, by="day", **SPAN)
    values = dict(zip(reply.get("columns", ())[1:], reply.get("all", ()), strict=True))
    return values.get("count", 0), values.get("seconds", 0.0)


@pytest.mark.parametrize("recalls", [False, True], ids=["bags", "store"])
def test_a_message_is_told_from_others_of_its_time_wherever_a_large_bag_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recalls: bool
) -> None:
    """A recorder of simulated time gives five messages each second of it."""
    monkeypatch.setattr(decode, "GROUP_BYTES", 260_000)
    monkeypatch.setattr(bulk, "BATCH_BYTES", 20_000)
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    kind = "std_msgs/msg/Float32MultiArray"
    messages = [
        Msg("/numbers", kind, T0 + nth // 5 * S, make(kind, layout=layout, data=held))
        # Too long for columns, which have their least and greatest number alone.
        for nth, held in enumerate(np.arange(200_000, dtype=np.float32).reshape(50, 4_000))
    ]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages, McapLayout(chunk_size=20_000))
    assert len([*decode.undecoded(McapReader(), path)]) > 2
    memory = memory_of(tmp_path, recalls=recalls)
    wanted = {"topic": "/numbers", "condition_type": "equals", "field": "data.700"}
    for nth in range(0, 50, 6):
        found = asked(memory, "find_matches", **wanted, value=4_000 * nth + 700)
        assert [row["first_seen"] for row in found["sightings"]] == [T0 / S + nth // 5]


def _message(draw: Random, kind: int, at: int) -> Msg:
    if kind == 0:
        return text(at, draw.choice(["cup", "cup", "cat", "dog"]), "/chatter")
    if kind == 1:
        return boolean(at, draw.random() < 0.6)
    if kind == 2:
        labels = draw.choice([["cup"], ["cup", "dog"], [], ["dog"]])
        return detections(at, labels, topic="/vision", score=draw.choice([0.1, 0.5]))
    if kind == 3:
        label, score = draw.choice(["cup", "dog"]), draw.choice([0.1, 0.5])
        return text(at, f'[{{"label": "{label}", "score": {score}}}]', "/json")
    return odom(at, draw.choice([-1.0, 1.0, 1.0]))


def _published(draw: Random, start: int, stop: int) -> list[Msg]:
    """Text, booleans, detections and poses at whole tenths of seconds, now and then none."""
    found: list[Msg] = []
    for kind in range(5):
        at = T0 + start * S
        while (at := at + draw.choice([1, 2, 5, 5, 10, 30, 110]) * 100 * MS) < T0 + stop * S:
            found.append(replace(_message(draw, kind, at), publish_time=at))
    return found or [odom(T0 + start * S)]


def draw_recordings(draw: Random) -> dict[str, list[Msg]]:
    """Two or three recordings that overlap, of which messages often have one log time."""
    seconds = draw.choice([5, 20, 40])
    begin = draw.randrange(seconds)
    names = draw.sample(["a", "ab", "b", "c"], draw.randint(2, 3))
    first, second, *others = names
    found = {first: _published(draw, 0, seconds)}
    found[second] = _published(draw, begin, begin + draw.choice([3, 20, 40]))
    if draw.random() < 0.5:
        late = [each for each in found[first] if each.log_time >= T0 + begin * S]
        found[second] += [
            replace(each, log_time=each.log_time + draw.choice([0, 1, 500]) * MS) for each in late
        ]
    for name in others:
        found[name] = _published(draw, 2, 12)
    return {name: sorted(some, key=lambda each: each.log_time) for name, some in found.items()}


def _on_chatter(message: Msg) -> Msg:
    return replace(message, topic="/chatter") if message.topic == "/bumper" else message


def write_cut(bag_dir: Path, recordings: Mapping[str, list[Msg]], draw: Random) -> None:
    """Writes recordings, each cut into splits anywhere."""
    for name, messages in recordings.items():
        inside = {draw.randrange(len(messages)) for _ in range(draw.choice([0, 1, 3, 6]))} - {0}
        for nth, (begin, end) in enumerate(pairwise([0, *sorted(inside), len(messages)])):
            write_mcap(bag_dir / name / f"{name}_{nth}.mcap", messages[begin:end])


TRUE: Final = {"topic": "/bumper", "condition_type": "equals", "value": True}


QUESTIONS: Final[Sequence[tuple[str, dict[str, Any]]]] = [
    ("find_matches", {**CUP, "by": "day"}),
    ("find_matches", {**CUP, "by": "hour"}),
    ("find_matches", CUP),
    ("find_matches", {**CUP, "where": {"x": 1, "y": 0, "radius_m": 0.5}, "by": "day"}),
    ("find_matches", {**CUP, "while": TRUE}),
    ("find_matches", {**CUP, "value": "c", "by": "value"}),
    ("find_matches", {**TRUE, "by": "day"}),
    ("find_matches", {**CUP, "topic": "/vision", "by": "hour"}),
    ("find_matches", {**CUP, "topic": "/vision", "min_score": 0.3, "by": "day"}),
    ("find_matches", {**CUP, "topic": "/vision", "by": "label"}),
    ("find_matches", {**CUP, "topic": "/json", "min_score": 0.3, "by": "day"}),
    ("get_topic_in_range", {"topic": "/chatter", "changes": True}),
    ("get_topic_in_range", {"topic": "/chatter", "max_samples": 9}),
    ("get_topic_in_range", {"topic": "/odom", "fields": ["position.x"], "by": "hour"}),
    ("trajectory_summary", {}),
    ("visits", {"x": 1.0, "y": 0.0, "radius_m": 0.5}),
    ("recap", {}),
]


@settings(max_examples=10 if LONG else 1)
@given(seed=st.integers(0, 2**32), part=st.sampled_from([1.0, 0.5]), has_types=st.booleans())
@example(seed=12, part=1.0, has_types=False)
@example(seed=35, part=0.5, has_types=False)
@example(seed=6, part=0.5, has_types=True)
@example(seed=321, part=1.0, has_types=True)
def test_what_is_stored_of_messages_of_one_time_changes_no_answer(
    seed: int, part: float, has_types: bool
) -> None:
    """Also of a topic of two types."""
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        recordings = draw_recordings(draw)
        if has_types:
            recordings = {name: [*map(_on_chatter, some)] for name, some in recordings.items()}
        write_cut(bag_dir, recordings, draw)
        plain = memory_of(bag_dir)
        every = [with_store(plain, bag_dir, part=part, share=share) for share in (1.0, 0.0)]
        recorded = asked(plain, "data_time_range")
        # Durations are without gaps, and pauses that look as where the clock was set ahead.
        if not has_types and not recorded["clock_steps"] and not recorded["gaps"]:
            assert counted(plain) == pytest.approx(sightings(recordings), abs=0.051)
        for name, given_ in QUESTIONS:
            expected = asked(plain, name, **given_, **SPAN)
            stored = draw.choice(every)
            assert_same_counts(asked(stored, name, **given_, **SPAN), expected)
