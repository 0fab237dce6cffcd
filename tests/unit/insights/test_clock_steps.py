"""A clock that was set, a recorder that stalled, and what only looks like it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.history import clock_steps
from ros2_memory.history.context import Memory
from tests.support.bags import (
    McapLayout,
    Msg,
    battery,
    boolean,
    in_order,
    odom,
    text,
    tf,
    transform,
    write_db3,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of, remembered, with_store

S = 10**9
BEGIN = 1_784_000_000
SPLITS, SPLIT, HZ = 16, 10, 10
SPEED = 0.5


def recorded(
    folder: Path,
    *,
    shown: Callable[[float], float] = lambda t: t,
    driven: Callable[[float], float] = lambda t: t,
    is_on: Callable[[float], bool] = lambda t: True,
) -> Memory:
    """A robot whose clock shows `shown` seconds, that has driven for `driven` at a time."""

    def at_beat(t: float) -> Iterator[Msg]:
        at = BEGIN * S + round(shown(t) * S)
        if is_on(t):
            yield odom(at, SPEED * driven(t))
            yield from [boolean(at + 1, data=False)] * (t % 1 == 0)

    return written(folder, at_beat)


def written(folder: Path, at_beat: Callable[[float], Iterable[Msg]]) -> Memory:
    """A recording in splits, of what a robot publishes at each beat of its own time (s)."""
    for number in range(SPLITS):
        beats = range(number * SPLIT * HZ, (number + 1) * SPLIT * HZ)
        messages = [message for beat in beats for message in at_beat(beat / HZ)]
        write_mcap(folder / "rec" / f"rec_{number}.mcap", in_order(messages))
    return memory_of(folder, clock=SettableClock((BEGIN + 1000) * S))


def each_known(memory: Memory) -> Iterator[Memory]:
    """The memory without a store, with one of all columns, and with one of few."""
    yield memory
    for share in (1.0, 0.0):
        yield with_store(memory, memory.index.bag_dir, share=share)


@pytest.mark.parametrize(
    ("stands", "when", "by"),
    [(False, 54.95, 8.0), (False, 59.95, 2.95), (True, 54.95, 2.0), (True, 59.95, 0.8)],
    ids=["in a split", "between two", "in a split, it stands", "between two, it stands"],
)
def test_a_clock_that_was_set_forward_is_reported_wherever_it_is_asked(
    tmp_path: Path, stands: bool, when: float, by: float
) -> None:
    """Where the robot stands, stamps of another clock show it."""
    if stands:
        plain = stamped(tmp_path, delay=lambda t: by * (t > when))
    else:
        plain = recorded(tmp_path, shown=lambda t: t + by * (t > when))
    for memory in each_known(plain):
        at = BEGIN + round(when - 0.05, 1)
        expected = [{"at": pytest.approx(at, abs=1e-5), "step_s": pytest.approx(by, abs=0.01)}]
        assert asked(memory, "data_time_range")["clock_steps"] == expected
        status = asked(memory, "memory_status")
        assert status["clock_steps"] == expected
        assert status["doubts"].endswith(f"the clock was set {by:g} s ahead")
        reply = asked(memory, "recap", start=BEGIN, end=BEGIN + 100)
        [event] = [each for each in reply["events"] if "clock" in each["text"]]
        assert event["text"] == f"the clock was set forward by {by:g} s"
        assert reply["counts"]["clock steps"] == 1
        assert reply["duration_s"] == pytest.approx(100 - by, abs=0.05)
        later = asked(memory, "recap", start=BEGIN + 100, end=BEGIN + 150)
        assert "clock steps" not in later["counts"]
        skipped = asked(memory, "get_position_at", timestamp=at + by / 2)
        assert "the clock skipped this time, as it was set ahead" in skipped["detail"]


def test_what_the_clock_skipped_is_neither_recorded_nor_missing_nor_unknown(tmp_path: Path) -> None:
    """A window from 100 s before the memory to its end, one that ends in the step; and in it."""
    plain = recorded(tmp_path, shown=lambda t: t + 500.0 * (t > 54.95))
    note = f"the clock was set 500 s ahead at {BEGIN + 54}.900000: durations are without that"
    cut = {"start": BEGIN + 5, "end": BEGIN + 300}
    later = {"with_start": BEGIN + 400, "with_end": BEGIN + 600}
    for memory in each_known(plain):
        reply = asked(memory, "recap", start=BEGIN - 100, end=BEGIN + 659.9)
        assert note in reply["notes"]
        assert "recorded only 160 of 260 s" in reply["notes"]
        inside: dict[str, Any] = {"topic": "/odom", "start": BEGIN + 300, "end": BEGIN + 400}
        for missing in (
            asked(memory, "get_position_at", timestamp=BEGIN + 300),
            asked(memory, "get_topic_in_range", **inside),
        ):
            assert (missing["error"], missing["notes"]) == ("no_data", [note])
        assert asked(memory, "recap", **cut)["notes"] == [note]
        assert asked(memory, "visits", x=0.0, y=0.0, **cut)["notes"] == [note]
        told = asked(memory, "compare", **cut, **later)["notes"]
        assert [each for each in told if "known" in each or "poses" in each] == []
        within = asked(memory, "data_time_range", start=BEGIN + 200, end=BEGIN + 300)
        assert [step["step_s"] for step in within["clock_steps"]] == [pytest.approx(500, abs=0.1)]


@pytest.mark.parametrize(("silent_s", "by"), [(5.0, 0.8), (120.0, 1.5)])
def test_a_gap_in_the_poses_is_one_also_where_the_clock_was_set(
    tmp_path: Path, silent_s: float, by: float
) -> None:
    """By less than makes a gap, or beside a pause that makes poses rare on average."""

    def at_beat(t: float) -> Iterator[Msg]:
        at, logged = (BEGIN * S + round((t + extra) * S) for extra in (0.0, by * (t > 139.95)))
        if not 10 <= t < 10 + silent_s:
            yield odom(at, SPEED * t, log_time=logged)
        yield battery(at + 1000, 0.5, log_time=logged + 1)

    memory = written(tmp_path, at_beat)
    assert len(steps(memory)) == 1
    driven = asked(memory, "trajectory_summary", start=BEGIN, end=BEGIN + 200)
    assert driven["gap_m"] == pytest.approx(SPEED * silent_s, abs=0.11)
    assert [note for note in driven["notes"] if note.startswith("1 gap without a pose")]


def test_the_age_of_a_latched_value_is_without_what_the_clock_skipped(tmp_path: Path) -> None:
    messages = [text(BEGIN * S + 50 * S, "on", topic="/mode")]
    for beat in range(160 * HZ):
        at = BEGIN * S + beat * S // HZ + 500 * S * (beat > 549)
        messages += [odom(at, SPEED * beat / HZ), boolean(at + 1, data=False)]
    layout = McapLayout(latched=frozenset({"/mode"}))
    write_mcap(tmp_path / "rec" / "rec_0.mcap", in_order(messages), layout)
    plain = memory_of(tmp_path, clock=SettableClock((BEGIN + 1000) * S))
    for memory in each_known(plain):
        found = asked(memory, "get_topic_at_time", topic="/mode", timestamp=BEGIN + 600)
        assert (found["latched"], found["age_s"]) == (True, pytest.approx(50, abs=0.01))
        assert "the clock was set 500 s ahead" in str(found["notes"])
        when = {"condition_topic": "/odom", "condition_type": "above", "field": "position.x"}
        matched = asked(memory, "get_value_when", value_topic="/mode", value=79, **when)
        assert matched["value_age_s"] == pytest.approx(109.9, abs=0.01)


def driven_topics(at: int, x: float) -> list[Msg]:
    """What two filters and a localiser publish: no topic is called `/odom`."""
    moved = transform(at, "odom", "base_link", (x, 0.0, 0.0))
    placed = transform(at, "map", "odom", (0.0, 0.0, 0.0))
    return [
        odom(at, x, topic="/odometry/local"),
        odom(at, x, topic="/odometry/global"),
        tf(at, moved, placed),
    ]


@pytest.mark.parametrize(
    ("pose_topic", "published"),
    [
        ("/odom", ("/odometry/local", "/odometry/global", "/tf")),
        ("/tf", ("/odometry/local", "/odometry/global", "/tf")),
        ("/tf", ("/tf",)),
        ("/odom", ("/tf",)),
    ],
)
def test_a_clock_that_was_set_forward_is_reported_whatever_places_the_robot(
    tmp_path: Path, pose_topic: str, published: Sequence[str]
) -> None:
    def at_beat(t: float) -> Iterator[Msg]:
        at = BEGIN * S + round((t + 8.0 * (t > 54.95)) * S)
        yield from (each for each in driven_topics(at, SPEED * t) if each.topic in published)
        yield from [boolean(at + 1, data=False)] * (t % 1 == 0)

    memory = written(tmp_path, at_beat)
    placed = replace(memory, limits=replace(memory.limits, pose_topic=pose_topic))
    for each in each_known(placed):
        assert steps(each) == [
            {
                "at": pytest.approx(BEGIN + 54.9, abs=1e-5),
                "step_s": pytest.approx(8.0, abs=0.01),
            }
        ]
        assert asked(each, "data_time_range")["gaps"] == []


def steps(memory: Memory) -> list[Any]:
    found: list[Any] = asked(memory, "data_time_range")["clock_steps"]
    return found


def late(t: float) -> float:
    """Messages wait for the recorder, ever shorter."""
    return max(0.0, 2.0 - 0.8 * (t - 55)) if t > 54.95 else 0.0


@pytest.mark.parametrize(
    ("memory_in", "suspects"),
    [
        # The recorder stalled while the robot drove on.
        (lambda folder: recorded(folder, is_on=lambda t: not 52 < t < 57), 1),
        # Where the robot stood, a step and a pause are alike.
        (
            lambda at: recorded(
                at, shown=lambda t: t + 8.0 * (t > 55), driven=lambda t: min(t, 50)
            ),
            1,
        ),
        (lambda folder: recorded(folder, shown=lambda t: t + 1.0 * (t > 55)), 0),
        (lambda folder: stamped(folder, delay=late), 1),
        (lambda folder: stamped(folder, is_lost=lambda t: 54.95 < t < 57), 1),
        # One topic pauses, or all publish little.
        (lambda folder: recorded(folder, is_on=lambda t: not 53 < t < 57 or t % 1 == 0), 0),
        (lambda folder: recorded(folder, is_on=lambda t: t % 10 == 0), 0),
    ],
    ids=["stall", "standing", "a second", "waiting", "lost", "one topic", "rare"],
)
def test_what_only_looks_like_a_step_is_none(
    tmp_path: Path, memory_in: Callable[[Path], Memory], suspects: int
) -> None:
    memory = memory_in(tmp_path)
    assert len(memory.index.snapshot().suspects) == suspects
    assert steps(memory) == []


@pytest.mark.parametrize(("when", "queued"), [(54.95, 3), (59.95, 100)])
def test_what_queued_up_while_the_recorder_stalled_is_no_step(
    tmp_path: Path, when: float, queued: int
) -> None:
    """Each topic has a queue of so many messages; what is received late was sent in its cadence."""

    def is_kept(t: float) -> bool:
        return not when < t < when + 3.5 or t < when + queued / HZ

    messages: list[Msg] = []
    for beat in range(SPLITS * SPLIT * HZ):
        t = beat / HZ
        if is_kept(t):
            at = BEGIN * S + round(t * S)
            logged = max(at, BEGIN * S + round((when + 3.5) * S)) if t > when else at
            messages.append(odom(at, SPEED * t, log_time=logged))
            messages.append(replace(boolean(logged, data=False), publish_time=at))
    memory = remembered(tmp_path, messages, split_s=10, clock=SettableClock((BEGIN + 1000) * S))
    for each in each_known(memory):
        assert steps(each) == []


def stamped(
    folder: Path,
    *,
    delay: Callable[[float], float] = lambda t: 0.0,
    is_lost: Callable[[float], bool] = lambda t: False,
) -> Memory:
    """A robot that stands, whose sensors stamp by a clock of their own, logged after a delay."""

    def at_beat(t: float) -> Iterator[Msg]:
        at, logged = (BEGIN * S + round((t + extra) * S) for extra in (0.0, delay(t)))
        if not is_lost(t):
            yield odom(at, 1.0, log_time=logged)
            yield battery(at + 1000, 0.5, log_time=logged + 1)

    return written(folder, at_beat)


def test_pauses_that_are_not_looked_at_are_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock was set before two pauses in which messages were lost."""
    monkeypatch.setattr(clock_steps, "_MOST_SUSPECTS", 2)
    lost = [(100, 103), (150, 153)]

    def is_lost(t: float) -> bool:
        return any(begin < t < end for begin, end in lost)

    memory = stamped(tmp_path, delay=lambda t: 2.0 * (t > 54.95), is_lost=is_lost)
    for tool in ("data_time_range", "memory_status"):
        reply = asked(memory, tool)
        assert not reply.get("clock_steps")
        assert "only the newest 2 of 3 pauses" in str(reply["notes"]), tool
    monkeypatch.setattr(clock_steps, "_MOST_SUSPECTS", 3)
    assert len(steps(memory)) == 1


def set_back_in_a_split(folder: Path, since: int, *, driven: bool = True) -> None:
    """A recording since a tick, in files of 10 s: the clock is set back by 20 s in the second."""
    files: list[list[Msg]] = [[] for _ in range(4)]
    for tick in range(since, 400):
        at = BEGIN * S + tick * S // 10 - (20 * S if tick >= 150 else 0)
        if driven:
            files[tick // 100].append(odom(at, tick / 20, vx=0.5))
        files[tick // 100].append(battery(at + S // 50, 0.5))
    for nth, some in enumerate(filter(None, files)):
        layout = McapLayout(chunk_size=1 << 14)
        write_mcap(folder / f"{folder.name}_{nth}.mcap", some, layout)


@pytest.mark.parametrize("recordings", [1, 2])
def test_a_step_back_that_several_bags_show_is_listed_once(tmp_path: Path, recordings: int) -> None:
    set_back_in_a_split(tmp_path / "rec", 0)
    if recordings > 1:  # a rotation: the next one has begun already
        set_back_in_a_split(tmp_path / "next", 120, driven=False)
    memory = memory_of(tmp_path)
    reply = asked(memory, "data_time_range")
    [step] = reply["clock_steps"]
    assert -20 <= step["step_s"] <= -19
    assert step["at"] == pytest.approx(BEGIN - 5, abs=0.1)
    reasons = [fault["reason"] for fault in reply["clock_faults"]]
    within = "the clock was set back by 20 s or more while it was being written"
    assert reasons == [within] * recordings
    recap = asked(memory, "recap", start=BEGIN - 10, end=BEGIN + 20)
    assert recap["counts"]["clock steps"] == 1


def test_a_duration_across_a_clock_that_was_set_back_and_put_right_may_be_too_long(
    tmp_path: Path,
) -> None:
    """It is 20 s behind from 15 to 25 s; the robot is docked from 20 to 35 s, for 15 s."""
    files: list[list[Msg]] = [[] for _ in range(5)]
    for tick in range(500):
        behind = 20 * S if 150 <= tick < 250 else 0
        at = BEGIN * S + tick * S // 10 - behind
        files[tick // 100].append(battery(at, 0.5))
        if tick in (200, 350):
            files[tick // 100].append(boolean(at + 1, tick == 200, "/docked"))
    for nth, messages in enumerate(files):
        layout = McapLayout(chunk_size=1 << 14)
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages, layout)
    docked = {"topic": "/docked", "condition_type": "equals", "value": True}
    reply = asked(memory_of(tmp_path), "find_matches", **docked)
    assert [row["duration_s"] for row in reply["sightings"]] == [35.0]
    [note] = [note for note in reply["notes"] if "durations across" in note]
    assert note.endswith(": durations across that may be wrong by as much")


LENGTH = 30
STALLS = ((8.0, 11.0), (16.0, 16.7))


def at_rates(slow: Sequence[tuple[float, float]] = ()) -> list[Msg]:
    """Odometry at 200 Hz, a flag at 50 Hz, both off in `STALLS` and `slow`; a text at 10 Hz."""

    def is_on(t: float, off: Sequence[tuple[float, float]]) -> bool:
        return not any(start <= t < stop for start, stop in off)

    def at(t: float) -> int:
        return BEGIN * S + round(t * S)

    fast = [*STALLS, *slow]
    messages = [odom(at(n / 200), n / 200) for n in range(200 * LENGTH) if is_on(n / 200, fast)]
    flags = [n / 50 + 0.001 for n in range(50 * LENGTH)]
    messages += [boolean(at(t), data=True) for t in flags if is_on(t, fast)]
    texts = [n / 10 + 0.001 for n in range(10 * LENGTH)]
    messages += [text(at(t), "here") for t in texts if is_on(t, STALLS)]
    return in_order(messages)


def memory_with(
    folder: Path, messages: Sequence[Msg], splits: int = 1, kind: str = "mcap"
) -> Memory:
    length = -(-len(messages) // splits)
    for number in range(splits):
        some = messages[number * length : (number + 1) * length]
        if kind == "db3":
            write_db3(folder / "rec" / f"rec_{number}.db3", some)
        else:
            write_mcap(folder / "rec" / f"rec_{number}.mcap", some, McapLayout(chunk_size=1 << 14))
    clock = SettableClock((BEGIN + LENGTH + 60) * S)
    return memory_of(folder, clock=clock, storage="sqlite3" if kind == "db3" else "mcap")


def gaps(memory: Memory) -> list[tuple[float, float]]:
    found = asked(memory, "data_time_range")["gaps"]
    return [(round(gap["start"] - BEGIN, 3), round(gap["end"] - BEGIN, 3)) for gap in found]


@pytest.mark.parametrize("kind", ["mcap", "db3", "stored", "cut into splits"])
def test_gaps_within_bags_are_listed_wherever_gaps_are(tmp_path: Path, kind: str) -> None:
    splits = 7 if kind == "cut into splits" else 1
    stalled = memory_with(tmp_path, at_rates(slow=((22, 24),)), splits, kind)
    if kind == "stored":
        stalled = with_store(stalled, tmp_path)
    assert gaps(stalled) == [(7.995, 11.0), (15.995, 16.7)]
    status = asked(stalled, "memory_status")
    assert [gap["duration_s"] for gap in status["gaps"]] == pytest.approx([0.705, 3.005], abs=0.001)
    assert status["doubts"] == "while the recorder ran, nothing was recorded 2 times (3.71 s)"
    window = {"start": BEGIN + 8.5, "end": BEGIN + 10.5}
    reply = asked(stalled, "get_topic_in_range", topic="/chatter", **window)
    assert reply["reason"] == "gap"


def test_a_recorder_did_not_stall_where_another_recording_lies_within_its_pause(
    tmp_path: Path,
) -> None:
    bag, moved = at_rates(), 1000 * S
    ahead = [replace(message, log_time=message.log_time + moved) for message in bag]
    between = [replace(message, log_time=message.log_time + moved // 2) for message in bag]
    write_mcap(tmp_path / "older" / "older_0.mcap", between)
    memory = memory_with(tmp_path, [*bag, *ahead])
    assert len(gaps(memory)) == 3 * len(STALLS) + 2
    doubts = asked(memory, "memory_status")["doubts"]
    assert doubts.endswith("while the recorder ran, nothing was recorded 6 times (11.13 s)")
