"""A detector that was blind for a while, as each tool reports it."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from ros2_memory.bag_dir.state_files import LOST, Loss, append_losses
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import Span
from ros2_memory.history import coverage
from ros2_memory.history.context import Memory
from tests.support.bags import boolean, detections, odom, write_mcap, write_splits
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, with_store

S = 10**9
BEGIN = 1_784_000_000
SEEN = "/vision/scene/scene_objects"
SPLITS, SPLIT = 30, 10
BLIND = range(10, 19)


@pytest.fixture(scope="module", params=[False, True], ids=["without catalogue", "with catalogue"])
def memory(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Memory:
    tmp_path = tmp_path_factory.mktemp("bags")
    messages = [odom(BEGIN * S + at * S // 2) for at in range(2 * SPLITS * SPLIT)]
    messages.append(boolean((BEGIN + 251) * S, data=True))
    for at in range(SPLITS * SPLIT):
        if at // SPLIT not in BLIND:
            seen = ["cup"] if at < 50 else []
            messages.append(detections((BEGIN + at) * S + 1, seen, topic=SEEN))
    write_splits(tmp_path, messages)
    clock = SettableClock((BEGIN + SPLITS * SPLIT + 5) * S)
    found = memory_of(tmp_path, clock=clock)
    return with_store(found, tmp_path) if request.param else found


def test_around_what_was_deleted_by_request_a_silence_stays_one(memory: Memory) -> None:
    """91 s of silence: 10 s of it deleted leave a part that is long enough, and one that is not."""
    deleted = Loss(SEEN, (BEGIN + 109) * S, (BEGIN + 119) * S, 9, "forgotten")
    append_losses(memory.index.bag_dir, [deleted])
    [left] = asked(memory, "memory_status")["silences"]
    LOST.replace(memory.index.bag_dir, [])
    assert (left["start"], left["end"]) == (BEGIN + 119, BEGIN + 190.000001)
    assert left["silent_s"] == pytest.approx(71.0)


def test_a_recap_has_it_as_an_event(memory: Memory) -> None:
    reply = asked(memory, "recap", start=BEGIN, end=BEGIN + 300)
    [event] = [each for each in reply["events"] if "silent" in each["text"]]
    assert event["text"] == f"{SEEN} was silent"
    assert (event["timestamp"], event["duration_s"]) == (BEGIN + 99.000001, pytest.approx(91.0))
    assert reply["counts"]["silences"] == 1
    within = asked(memory, "recap", start=BEGIN + 120, end=BEGIN + 150)
    assert [each["timestamp"] for each in within["events"] if "silent" in each["text"]] == [
        BEGIN + 120
    ]
    before = asked(memory, "recap", start=BEGIN, end=BEGIN + 90)
    assert "silences" not in before["counts"]


def test_compare_counts_how_long_a_topic_was_silent_while_the_robot_was_on(tmp_path: Path) -> None:
    morning = 8 * 3600 + 1200
    for begin in (0, 600, morning, morning + 600, morning + 1200, morning + 1800):
        names = ["/t0", "/t1", "/t2", "/t3", *["/camera"] * (begin not in {600, morning})]
        messages = [
            boolean((BEGIN + begin + at) * S + nth, data=True, topic=name)
            for at in range(0, 600, 5)
            for nth, name in enumerate(names)
        ]
        write_mcap(tmp_path / "run" / f"run_{begin}.mcap", messages)
    first = {"start": BEGIN, "end": BEGIN + morning + 1200}
    other = {"with_start": BEGIN + morning + 1200, "with_end": BEGIN + morning + 2399}
    reply = asked(memory_of(tmp_path), "compare", **first, **other)
    assert reply["silent_s"] == {"/camera": {"this": 1200.0, "with": 0.0}}


def test_silences_are_in_order_after_what_was_deleted_inside_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was deleted of a topic is read once, and for a window without its silences never."""
    silent = {"/early": [(60, 160), (320, 420)], "/late": [(80, 170), (330, 430)]}
    messages = [odom((BEGIN + at) * S) for at in range(600)]
    for nth, (topic, spans) in enumerate(silent.items()):
        heard = (at for at in range(600) if not any(start <= at < end for start, end in spans))
        messages += [boolean((BEGIN + at) * S + nth, data=True, topic=topic) for at in heard]
    write_splits(tmp_path, messages)
    append_losses(tmp_path, [Loss("/early", (BEGIN + 90) * S, (BEGIN + 95) * S, 9, "forgotten")])
    cut = Counter[str]()

    def cut_spans(bag_dir: Path, topic: str, window: TimeWindow) -> Sequence[Span]:
        cut[topic] += 1
        return coverage.cut_spans(bag_dir, topic, window)

    monkeypatch.setattr("ros2_memory.insights.silences.cut_spans", cut_spans)
    memory = memory_of(tmp_path)
    found = asked(memory, "memory_status")["silences"]
    assert [(each["topic"], each["start"] - BEGIN) for each in found] == [
        ("/late", pytest.approx(329)),
        ("/early", pytest.approx(319)),
        ("/early", pytest.approx(95)),
        ("/late", pytest.approx(79)),
        ("/early", pytest.approx(59)),
    ]
    assert cut == {"/early": 1, "/late": 1}
    asked(memory, "recap", start=BEGIN, end=BEGIN + 50)
    assert cut.total() == 2
    asked(memory, "recap", start=BEGIN + 100, end=BEGIN + 150)
    assert cut.total() > 2
