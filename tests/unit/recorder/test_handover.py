"""One recording takes over from another: the cut, the union of both, and what a crash cut short.

What either of them holds counts, and once.
"""

import itertools
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import (
    LOG_CLOCK_NOTE,
    CutClock,
    Handover,
    Overlap,
    read_handover,
    write_handover,
    write_handovers,
)
from ros2_memory.core.bag_summary import BagSummary
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import TimeWindow
from ros2_memory.recorder import handover
from ros2_memory.recorder.handover import (
    announcing_sidecar,
    pending_sidecar,
    settle_handover,
    void_sidecar,
)
from ros2_memory.recorder.sessions import Splits
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, in_order, text, tf, transform, write_mcap
from tests.support.examples import examples
from tests.support.handovers import recover_handovers
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of
from tests.support.simulated_recorders import World

S = 10**9
T0 = 1_795_150_800 * S
READER = McapReader()
TOPICS = ("/fast", "/slow", "/latched")
LAYOUT = McapLayout(latched=frozenset({"/latched"}))
TRUNCATED = McapLayout(chunk_size=None, finish=False)


class Published(NamedTuple):
    """A message by its own number, which no code under test knows of."""

    number: int
    topic: str
    at: float  # seconds


class Stall(NamedTuple):
    """When a recorder stands still, and for how long, in seconds."""

    at: float
    lasts: float


class Recorder(NamedTuple):
    """One recorder: when it begins and ends, in seconds, how deep its queues are."""

    start: float
    stop: float
    stalls: tuple[Stall, ...] = ()
    depth: int = 2
    splits: tuple[float, ...] = ()
    delay_ns: int = 20_000
    skew_s: float = 0.0
    """By how much the clock of the publishers is ahead."""

    def receives(self, published: Iterable[Published]) -> list[Msg]:
        """What it writes: after a stall the newest messages of each queue, and the time of then."""
        received: list[Msg] = []
        queues: dict[tuple[Stall, str], list[Msg]] = {}
        for each in published:
            if not self.start <= each.at < self.stop:
                continue
            stall = next((s for s in self.stalls if s.at <= each.at < s.at + s.lasts), None)
            at = each.at if stall is None else stall.at + stall.lasts
            message = replace(
                text(T0, str(each.number), each.topic),
                log_time=T0 + round(at * S) + self.delay_ns,
                publish_time=T0 + round((each.at + self.skew_s) * S),
            )
            if stall is None:
                received.append(message)
            else:
                queues.setdefault((stall, each.topic), []).append(message)
        for queue in queues.values():
            received += queue[-self.depth :]
        return in_order(received)

    def writes(self, directory: Path, published: Iterable[Published]) -> None:
        messages = self.receives(published)
        edges = [0.0, *self.splits, 1000.0]
        directory.mkdir()
        for number, (begin, end) in enumerate(itertools.pairwise(edges)):
            split = [m for m in messages if begin <= (m.log_time - T0) / S < end]
            write_mcap(directory / f"{directory.name}_{number}.mcap", split, LAYOUT)


def publications(length_s: float, doubled: frozenset[int] = frozenset()) -> list[Published]:
    """20 and 3 messages a second; of the doubled numbers two publishers send one and the same."""
    found: list[Published] = []
    for topic, period in (("/fast", 0.05), ("/slow", 0.333)):
        at = 0.003
        while at < length_s:
            one = Published(len(found), topic, at)
            found += [one, one] if one.number in doubled else [one]
            at += period
    return sorted(found, key=lambda each: each.at)


def numbers(recording: Path, reader: McapReader | BagDirReader) -> Counter[int]:
    found = Counter[int]()
    for path in recording.glob("*.mcap"):
        records = reader.records(path, TOPICS, TimeWindow.everything())
        found.update(int(reader.decode(each).data) for each in records)  # type: ignore[attr-defined]
    return found


def assert_union(bag_dir: Path) -> None:
    """Against the messages' own numbers, in whatever way a bag is read."""
    reader = BagDirReader(READER)
    both = [numbers(bag_dir / name, READER) for name in ("a", "b")]
    counted = numbers(bag_dir / "a", reader) + numbers(bag_dir / "b", reader)
    assert counted == both[0] | both[1]
    for path in bag_dir.glob("*/*.mcap"):
        summary, everything = reader.summarize(path), TimeWindow.everything()
        forward = list(reader.records(path, TOPICS, everything))
        assert summary.count == len(forward)
        for each in summary.topics:
            times = [one.log_time for one in forward if one.channel.topic == each.topic]
            assert (each.count, each.first, each.last) == (len(times), times[0], times[-1])
        assert list(reader.records(path, TOPICS, everything, newest_first=True)) == forward[::-1]
        for topic in TOPICS:
            of_topic = [each for each in forward if each.channel.topic == topic]
            newest = next(reader.records(path, [topic], everything, newest_first=True), None)
            assert newest == (of_topic[-1] if of_topic else None)


def hand_over(
    bag_dir: Path,
    both_s: float,
    *,
    names: tuple[str, str] = ("a", "b"),
    clock: CutClock = CutClock.PUBLISH,
) -> None:
    """Writes the sidecars of a handover that was complete two seconds after both recorded."""
    began, both, ended = (T0 + round(seconds * S) for seconds in (both_s - 1, both_s, both_s + 2))
    before, after = (bag_dir / name for name in names)

    def files(folder: Path) -> tuple[str, ...]:
        spans = {p.name: READER.summarize(p) for p in folder.glob("*.mcap")}
        return tuple(
            file
            for file, each in sorted(spans.items())
            if each.empty or (each.end >= both if folder == before else each.start <= ended)
        )

    earlier, cut = read_handover(before).handover, both + S
    notes = (LOG_CLOCK_NOTE,) if clock is CutClock.LOG else ()
    begin = Overlap(began, ended, files(after))
    end = Overlap(both, ended + 30 * S, files(before))
    old = replace(earlier, clock=clock, next=after.name, counts_until=cut, end=end, notes=notes)
    new = Handover(
        clock=clock,
        previous=before.name,
        counts_from=cut,
        begin=begin,
        notes=notes,
        compared=False,
    )
    write_handovers({after: new, before: old})


STALLS = st.lists(st.builds(Stall, st.floats(3, 9), st.floats(0.05, 1.5)), max_size=2).map(tuple)
SPLITS = st.lists(st.floats(2, 10), max_size=2).map(sorted).map(tuple)
DOUBLED = st.frozensets(st.integers(60, 180), max_size=6)
DELAYS = st.integers(0, 2_000_000)


@settings(max_examples=examples(40))
@given(
    stalls=st.tuples(STALLS, STALLS),
    splits=st.tuples(SPLITS, SPLITS),
    depth=st.integers(1, 30),
    ends_after=st.floats(0, 1),
    ends=st.tuples(st.floats(1, 13), st.floats(4, 13)),
    doubled=DOUBLED,
    kind=st.sampled_from(["complete", "stopped", "void"]),
)
def test_nothing_is_lost_that_a_file_holds_and_nothing_counts_twice(
    tmp_path_factory: pytest.TempPathFactory,
    stalls: tuple[tuple[Stall, ...], tuple[Stall, ...]],
    splits: tuple[tuple[float, ...], tuple[float, ...]],
    depth: int,
    ends_after: float,
    ends: tuple[float, float],
    doubled: frozenset[int],
    kind: str,
) -> None:
    bag_dir = tmp_path_factory.mktemp("bags")
    old_stop, new_stop = {
        "complete": (7 + ends_after, 13.0),
        "stopped": ends,
        "void": (13.0, 6 + ends_after),
    }[kind]
    published = publications(13, doubled)
    Recorder(0, old_stop, stalls[0], depth, splits[0]).writes(bag_dir / "a", published)
    Recorder(4, new_stop, stalls[1], depth, splits[1], 31_000).writes(bag_dir / "b", published)
    if kind == "complete":
        hand_over(bag_dir, 5)
    else:
        write_handover(
            bag_dir / "a", Handover() if kind == "void" else announcing_sidecar(Handover(), "b")
        )
        write_handover(bag_dir / "b", void_sidecar("a") if kind == "void" else pending_sidecar("a"))
    assert settle_handover(bag_dir / "a", bag_dir / "b", READER)
    assert_union(bag_dir)


def test_short_recordings_that_follow_each_other_are_compared_in_pairs(tmp_path: Path) -> None:
    """What the second leaves to the third is not what the first has missed."""
    published = publications(16)
    Recorder(0, 7.2, (Stall(5.2, 0.5),)).writes(tmp_path / "a", published)
    Recorder(4, 10.2, (Stall(6.2, 0.5), Stall(8.9, 0.3))).writes(tmp_path / "b", published)
    Recorder(7, 16, (Stall(9.2, 0.7),)).writes(tmp_path / "c", published)
    hand_over(tmp_path, 5)
    hand_over(tmp_path, 8, names=("b", "c"))
    recover_handovers(tmp_path, READER)
    held_by = [numbers(tmp_path / name, READER) for name in "abc"]
    counted = [numbers(tmp_path / name, BagDirReader(READER)) for name in "abc"]
    assert sum(counted, Counter[int]()) == held_by[0] | held_by[1] | held_by[2]


@settings(max_examples=examples(50))
@given(
    both_s=st.floats(4.2, 6),
    ends_after_s=st.floats(0, 4),
    delays=st.tuples(DELAYS, DELAYS),
    skew_s=st.floats(-0.9, 0.9),
)
def test_without_stalls_the_cut_counts_each_once_and_nothing_is_listed(
    tmp_path_factory: pytest.TempPathFactory,
    both_s: float,
    ends_after_s: float,
    delays: tuple[int, int],
    skew_s: float,
) -> None:
    bag_dir, published = tmp_path_factory.mktemp("bags"), publications(13)
    old, new = bag_dir / "a", bag_dir / "b"
    ended = Recorder(0, both_s + 2 + ends_after_s, delay_ns=delays[0], skew_s=skew_s)
    ended.writes(old, published)
    Recorder(both_s - 0.1, 13, delay_ns=delays[1], skew_s=skew_s).writes(new, published)
    hand_over(bag_dir, both_s)
    before = (old / "handover.json").stat().st_mtime_ns
    assert settle_handover(old, new, READER)
    assert (old / "handover.json").stat().st_mtime_ns == before
    after = read_handover(new).handover
    assert (after.compared, after.also_counts, after.counts_elsewhere) == (True, {}, {})
    assert_union(bag_dir)


@pytest.mark.parametrize("published_at", ["log", "zero"])
def test_without_publish_times_the_cut_stays_and_a_note_says_so(
    tmp_path: Path, published_at: str
) -> None:
    for name, start, stop in (("a", 0.0, 7.5), ("b", 4.0, 13.0)):
        messages = Recorder(start, stop, delay_ns=0).receives(publications(13))
        written = [
            replace(each, publish_time=0 if published_at == "zero" else each.log_time)
            for each in messages
        ]
        write_mcap(tmp_path / name / f"{name}_0.mcap", written, LAYOUT)
    hand_over(tmp_path, 5, clock=CutClock.LOG)
    assert settle_handover(tmp_path / "a", tmp_path / "b", READER)
    after = read_handover(tmp_path / "b").handover
    assert (after.notes, after.also_counts) == ((LOG_CLOCK_NOTE,), {})
    assert_union(tmp_path)


def test_the_newest_closed_split_is_the_last_of_those_that_retention_did_not_delete(
    tmp_path: Path,
) -> None:
    """It shows by which time a recorder stamps, and no longer does once it is gone."""
    for number in range(11):
        write_mcap(tmp_path / f"a_{number}.mcap", [boolean(T0 + number * S, True)])
    write_mcap(tmp_path / "a_11.mcap", [boolean(T0 + 11 * S, True)], TRUNCATED)
    splits = Splits(tmp_path, READER)
    assert splits.newest_closed() is None
    splits.observe(0.0)
    assert splits.newest_closed() == tmp_path / "a_10.mcap"
    (tmp_path / "a_10.mcap").unlink()
    assert splits.newest_closed() == tmp_path / "a_9.mcap"


@pytest.mark.parametrize("spoiled", [0, 1, -1])
def test_of_a_file_with_a_damaged_chunk_the_cut_leaves_all_other_messages(
    tmp_path: Path, spoiled: int
) -> None:
    for name, numbered in (("a", range(100)), ("b", range(60, 300))):
        messages = [text(T0 + n * S // 10, str(n), "/fast") for n in numbered]
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages, McapLayout(chunk_size=400))
    hand_over(tmp_path, 7)
    spoil_chunk(tmp_path / "b" / "b_0.mcap", spoiled)
    memory = memory_of(tmp_path, reader=BagDirReader(McapReader(), tmp_path))
    covered = asked(memory, "data_time_range")
    assert covered["damaged"] == []
    assert [covered["earliest"], covered["latest"]] == [T0 / S, pytest.approx(T0 / S + 29.9)]
    search = {"topic": "/fast", "condition_type": "contains"}
    reply = asked(memory, "find_last_match", **search, value="250")
    assert reply["timestamp"] == pytest.approx(T0 / S + 25)
    reply = asked(memory, "find_last_match", **search, value="nothing")
    assert "b/b_0.mcap" in "".join(reply["notes"])


@patch.object(handover, "MOST_LISTED", 5)
def test_where_too_many_would_be_listed_all_count(tmp_path: Path) -> None:
    old, new = tmp_path / "a", tmp_path / "b"
    Recorder(0, 7.5).writes(old, publications(13))
    Recorder(4, 13, (Stall(5.8, 1),)).writes(new, publications(13))
    hand_over(tmp_path, 5)
    assert settle_handover(old, new, READER)
    for recording in (old, new):
        assert numbers(recording, BagDirReader(READER)) == numbers(recording, READER)


def bump(published: int, delay: int) -> Msg:
    return replace(boolean(published + delay, True), publish_time=published)


def cut_recording(bag_dir: Path, name: str, start: float, stop: float, *, delay: int) -> Path:
    """A recording cut short that received ten messages a second from start to stop."""
    first, last = round(start * 10), round(stop * 10)
    messages = [bump(T0 + n * S // 10, delay) for n in range(first, last)]
    directory = bag_dir / name
    write_mcap(directory / f"{name}_0.mcap", messages, TRUNCATED)
    return directory


def interrupted(old: Path, new: Path) -> None:
    """What a crash before the cut leaves."""
    write_handover(old, announcing_sidecar(Handover(), new.name))
    write_handover(new, pending_sidecar(old.name))


def counted(bag_dir: Path) -> Counter[int]:
    """The publish times that count, once all is settled."""
    recover_handovers(bag_dir, READER)
    found: Counter[int] = Counter()
    for path in bag_dir.glob("*/*.mcap"):
        records = BagDirReader(READER).records(path, ["/bumper"], TimeWindow.everything())
        found.update(record.publish_time for record in records)
    return found


def once(numbers: Iterable[int]) -> dict[int, int]:
    """Each of these messages of ten a second."""
    return dict.fromkeys((T0 + number * S // 10 for number in numbers), 1)


def test_a_crash_between_the_two_sidecars_is_brought_to_its_end(tmp_path: Path) -> None:
    old = cut_recording(tmp_path, "a", 0, 10, delay=5)
    new = cut_recording(tmp_path, "b", 7, 15, delay=9)
    cut = T0 + 9 * S
    write_handover(old, announcing_sidecar(Handover(), "b"))
    begin = Overlap(T0 + 6 * S, T0 + 10 * S, ("b_0.mcap",))
    write_handover(new, Handover(previous="a", counts_from=cut, begin=begin))
    assert counted(tmp_path) == once(range(150))
    assert read_handover(old).handover.counts_until == cut


def test_latched_messages_do_not_say_how_far_a_recording_reaches(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    static = tf(T0 + 99 * S, transform(T0, "a", "b", (0, 0, 0)), topic="/tf_static")
    write_mcap(directory / "a_0.mcap", [bump(T0, 5), static], TRUNCATED)
    new = cut_recording(tmp_path, "b", 0, 50, delay=9)
    interrupted(directory, new)
    assert counted(tmp_path) == once(range(500))


def test_after_a_clock_that_was_set_back_no_more_than_a_minute_is_in_doubt(tmp_path: Path) -> None:
    day = 86400
    old = cut_recording(tmp_path, "a", day, day + 2, delay=0)
    new = cut_recording(tmp_path, "b", 0, 300, delay=0)
    interrupted(old, new)
    assert len(counted(tmp_path)) >= 20 + 2400


def test_after_a_clock_that_was_set_back_a_minute_is_compared_and_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By dates the old recording has what the new one is about to record, ten minutes of it."""
    for number, (start, stop) in enumerate([(0, 600), (0, 8)]):
        messages = [bump(T0 + n * S // 10 + 1 - number, 0) for n in range(start * 10, stop * 10)]
        write_mcap(tmp_path / "a" / f"a_{number}.mcap", messages)
    write_mcap(tmp_path / "b" / "b_0.mcap", [bump(T0 + n * S // 10, 9) for n in range(50, 1000)])
    hand_over(tmp_path, 6)
    old = read_handover(tmp_path / "a").handover
    last = replace(old, end=Overlap(T0 + 6 * S, T0 + 38 * S, ("a_1.mcap",)))
    write_handover(tmp_path / "a", last)
    lengths, records = list[int](), McapReader.records

    def noting(reader: McapReader, path: Path, topics: Any, window: TimeWindow, **how: Any) -> Any:
        lengths.append(window.stop - window.start)
        return records(reader, path, topics, window, **how)

    monkeypatch.setattr(McapReader, "records", noting)
    assert settle_handover(tmp_path / "a", tmp_path / "b", READER, {"b"})
    assert 0 < max(lengths) <= 75 * S
    monkeypatch.undo()
    assert {*counted(tmp_path).values()} == {1}


def test_what_cannot_be_completed_is_reported_and_the_rest_is_completed(tmp_path: Path) -> None:
    for name in ("a", "c"):
        old = cut_recording(tmp_path, name, 0, 1, delay=0)
        write_handover(old, announcing_sidecar(Handover(), name + "2"))
    (tmp_path / "a" / ".handover.json.tmp").mkdir()
    with capture_logs() as logs:
        World(tmp_path).started(100)
    assert [each["recording"] for each in logs if each["log_level"] == "error"] == ["a"]
    assert read_handover(tmp_path / "c").handover.next is None


def test_a_bag_that_goes_while_its_handover_is_settled_is_reported_and_recording_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(
        cut_recording(tmp_path, "a", 0, 10, delay=5), cut_recording(tmp_path, "b", 7, 15, delay=9)
    )
    looks, summarize = Counter[str](), McapReader.summarize

    def vanishing(reader: McapReader, path: Path) -> BagSummary:
        looks[path.name] += 1
        if path.name == "a_0.mcap" and looks[path.name] == 2:
            raise BagVanishedError(str(path), "the file is not there any more")
        return summarize(reader, path)

    monkeypatch.setattr(McapReader, "summarize", vanishing)
    with capture_logs() as logs:
        World(tmp_path).started(100)
    reported = [each["reason"] for each in logs if each["event"] == "handover_not_settled"]
    assert reported == [f"{tmp_path / 'a' / 'a_0.mcap'}: the file is not there any more"]
    assert read_handover(tmp_path / "a").handover.counts_until is not None


def test_one_whose_predecessor_is_gone_counts_and_stays_as_it_is(tmp_path: Path) -> None:
    new = cut_recording(tmp_path, "b", 7, 15, delay=9)
    begin = Overlap(T0 + 6 * S, T0 + 10 * S, ("b_0.mcap",))
    after = Handover(previous="a", counts_from=T0 + 9 * S, begin=begin, compared=False)
    write_handover(new, after)
    with capture_logs() as logs:
        recover_handovers(tmp_path, READER)
    assert not logs
    assert read_handover(new).handover == after
    write_handover(new, pending_sidecar("a"))
    assert counted(tmp_path) == once(range(70, 150))
