"""Many bags read as one history, in which each message counts once, and in one order."""

import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.layout import utc_day
from ros2_memory.columns import decode
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import pick, scan
from ros2_memory.history.view import View
from ros2_memory.storage.base import Record
from ros2_memory.storage.mcap import bulk
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import (
    McapLayout,
    Msg,
    along_x,
    boolean,
    log_entry,
    make,
    odom,
    set_mtime,
    text,
    write_mcap,
)
from tests.support.column_worlds import EVERYTHING
from tests.support.examples import examples
from tests.support.memories import Remember, asked, memory_of, remembered, reply_over, with_store
from tests.support.noting_reader import NotingReader
from tests.support.random_histories import S

T0: Final = 1_700_006_400 * S


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


def test_a_message_that_three_recordings_received_late_counts_as_often_by_each_way(
    tmp_path: Path, remember: Remember
) -> None:
    """The third one is 2.1 s after the first, and 1.9 s after a copy, which counts for nothing."""
    for name, at_s in (("one", 1.9), ("two", 2.1), ("three", 4.0)):
        moved = text(T0 + S, "moved")
        received = replace(moved, log_time=T0 + round(at_s * S), publish_time=T0 + S)
        around = [text(T0 - 5 * S, f"{name} begins"), text(T0 + 20 * S, f"{name} ends")]
        write_mcap(tmp_path / name / f"{name}_0.mcap", [around[0], received, around[1]])
    memory = remember()
    window = {"topic": "/chatter", "start": T0 / S + 1, "end": T0 / S + 5}
    shown = asked(memory, "get_topic_in_range", **window)["samples"]
    assert [sample["timestamp"] for sample in shown] == [T0 / S + 1.9, T0 / S + 4]
    reply = asked(memory, "get_topic_at_time", topic="/chatter", timestamp=T0 / S + 4)
    assert reply["timestamp"] == T0 / S + 4


def test_of_a_message_that_two_recordings_have_twice_each_one_copy_is_of_the_second(
    tmp_path: Path, remember: Remember
) -> None:
    """The last one is 2.25 s after the first, whose copy was met, and 0.75 s after the second."""
    for name, received_s in (("one", (0.0, 1.5)), ("two", (0.125, 2.25))):
        sent = text(T0, "go")
        received = [
            replace(sent, log_time=T0 + round(at * S), publish_time=T0) for at in received_s
        ]
        begin, end = text(T0 - S, f"{name} begins"), text(T0 + 5 * S, f"{name} ends")
        write_mcap(tmp_path / name / f"{name}_0.mcap", [begin, *received, end])
    memory = remember()
    window = {"topic": "/chatter", "start": T0 / S, "end": T0 / S + 4}
    shown = asked(memory, "get_topic_in_range", **window)["samples"]
    assert [sample["timestamp"] for sample in shown] == [T0 / S, T0 / S + 1.5]


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
    set_mtime(path, changed)
    assert scanned(shorter) == [T0]
    path.unlink()
    assert scanned(deleted) == []
    assert "a/a_0.mcap was deleted before it could be read" in deleted.notes.sentences()[0]


@patch.object(decode, "GROUP_BYTES", 260_000)
@patch.object(bulk, "BATCH_BYTES", 20_000)
def test_a_message_is_told_from_others_of_its_time_wherever_a_large_bag_is_cut(
    tmp_path: Path, remember: Remember
) -> None:
    """A recorder of simulated time gives five messages each second of it."""
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    kind = "std_msgs/msg/Float32MultiArray"
    messages = [
        Msg("/numbers", kind, T0 + nth // 5 * S, make(kind, layout=layout, data=held))
        # Too long for columns, which have their least and greatest number alone.
        for nth, held in enumerate(np.arange(200_000, dtype=np.float32).reshape(50, 4_000))
    ]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages, McapLayout(chunk_size=20_000))
    assert len([*decode.undecoded(McapReader(), path)]) > 2
    memory = remember()
    wanted = {"topic": "/numbers", "condition_type": "equals", "field": "data.700"}
    for nth in range(0, 50, 6):
        found = asked(memory, "find_matches", **wanted, value=4_000 * nth + 700)
        assert [row["first_seen"] for row in found["sightings"]] == [T0 / S + nth // 5]


def test_the_time_after_the_last_message_of_a_bag_is_time_of_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reader takes a second to find that there are no more."""
    now = [0]

    class Slow(NotingReader):
        def records(self, *args: Any, **given: Any) -> Iterator[Record]:
            yield from super().records(*args, **given)
            now[0] += S

    view = View(remembered(tmp_path, [odom(T0)], reader=Slow()), Call())
    monkeypatch.setattr(time, "perf_counter_ns", lambda: now[0])
    assert len([*view.stream.messages(["/odom"], TimeWindow.everything())]) == 1
    assert view.call.stages.spent["read"] == S


def test_the_newest_message_of_a_silent_topic_is_read_without_the_time_after_it(
    tmp_path: Path,
) -> None:
    """A .db3 has no index by topic: its reader goes through all messages of a window."""
    bumps = [boolean(T0, True), boolean(T0 + 1, False)]
    write_mcap(
        tmp_path / "rec" / "rec_0.mcap", [*bumps, *(odom(T0 + at * S, at) for at in range(100))]
    )
    write_mcap(tmp_path / "later" / "later_0.mcap", [odom(T0 + 200 * S, 200.0)])
    reader = NotingReader()
    view = View(memory_of(tmp_path, reader=reader), Call())
    newest = view.stream.last("/bumper", T0 + 90 * S)
    assert newest is not None
    assert newest.time == T0 + 1
    assert max(window.stop for window in reader.windows) == T0 + 2


def test_what_a_saved_moment_has_whole_is_not_said_to_be_of_a_thinned_day(tmp_path: Path) -> None:
    day = along_x(T0, 600, mps=1.0)
    write_mcap(tmp_path / "memory" / f"{utc_day(T0)}.thinned.mcap", day)
    whole = [odom(T0 + 100 * S + n * S // 10, 100 + n / 10) for n in range(300)]
    write_mcap(tmp_path / "moments" / "fall" / "rec" / "rec_0.mcap", whole)
    for after_s, is_thinned in ((110, False), (300, True)):
        reply = reply_over(tmp_path, "get_position_at", timestamp=T0 / S + after_s)
        assert (reply["x"], "from" in reply) == (after_s, is_thinned)
