"""Splits that are screened before they are served, with real files."""

import errno
import itertools
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.bag_dir.layout import METADATA_FILE, SCREENED_FILE
from ros2_memory.bag_dir.state_files import SCREENED, excluded_between, read_withheld
from ros2_memory.core.errors import BagUnreachableError, RecorderError
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.retention import repair
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.triggers import screening
from ros2_memory.triggers.exclusion import ExclusionRule
from tests.support.bags import McapLayout, Msg, diagnostics, odom, write_mcap
from tests.support.examples import LONG
from tests.support.fakes import broken
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of
from tests.support.noting_reader import fail_reading
from tests.support.screened_bags import T0, S, ScreenedBags, mode, off, on, privacy, word, words
from tests.support.simulated_recorders import events

LATCHED_DIAGNOSTICS = McapLayout(latched=frozenset({"/diagnostics"}))


@pytest.fixture
def bags(tmp_path: Path) -> ScreenedBags:
    return ScreenedBags(tmp_path / "bags")


def halves(begin: int, stop: int) -> list[float]:
    return [n + 0.5 for n in range(begin, stop)]


@patch.object(screening, "MOST_EXCLUDED", 3)
def test_what_was_excluded_long_ago_is_neither_never_nor_a_gap(bags: ScreenedBags) -> None:
    for begin in range(0, 160, 20):
        around = [*map(off, range(begin, begin + 9)), *map(off, range(begin + 13, begin + 20))]
        said = [*around, on(begin + 10), off(begin + 12), *words(begin, begin + 20)]
        bags.split(sorted(said, key=lambda message: message.log_time))
        bags.step()
    bags.end()
    memory, begun = memory_of(bags.bag_dir), T0 / S
    inside = {"topic": "/chatter", "start": begun + 10.2, "end": begun + 11.8}
    assert asked(memory, "get_topic_in_range", **inside)["reason"] == "deleted"
    searched = {"topic": "/chatter", "condition_type": "contains", "value": "zebra"}
    found = asked(memory, "find_last_match", **searched, before=begun + 30)
    assert "excluded by the rules" in found["notes"][0]
    assert len(excluded_between(bags.bag_dir, 0, MAX_NS)) <= 6


def test_a_recording_from_before_is_left_alone(bags: ScreenedBags) -> None:
    bags.begin(0)
    (bags.bag_dir / SCREENED_FILE).unlink()
    bags.screening = bags.new()
    bags.split([on(0), *words(0, 10)])
    bags.step()
    assert bags.seconds() == halves(0, 10)


def test_a_topic_that_falls_silent(bags: ScreenedBags) -> None:
    said = [*map(off, range(5)), *words(0, 10)]
    bags.split(said, McapLayout(latched=frozenset()))
    bags.end()
    assert bags.seconds() == halves(0, 6)


@pytest.mark.parametrize("layout", [McapLayout(latched=frozenset()), LATCHED_DIAGNOSTICS])
def test_what_other_nodes_report_does_not_end_what_one_excludes(
    tmp_path: Path, layout: McapLayout
) -> None:
    """The camera is private from 5 to 14 s, over two splits; the lidar reports between."""
    private = parse_condition("contains", "private", 0.5)
    camera = privacy(topic="/diagnostics", condition=private, margin=0)
    bags = ScreenedBags(tmp_path / "bags", camera)
    for begin in (0, 10):
        said = words(begin, begin + 10)
        for second in range(begin, begin + 10):
            at, state = T0 + second * S, "private" if 5 <= second < 15 else "open"
            said += [diagnostics(at, camera=(0, state)), diagnostics(at + 1000, lidar=(0, "fine"))]
        bags.split(said, layout)
        bags.step()
    bags.end()
    assert bags.seconds() == [*halves(0, 5), *halves(15, 20)]


def test_a_split_is_held_back_while_a_late_message_may_exclude_its_end(tmp_path: Path) -> None:
    """Messages come up to a second late, and a margin of a second before them is excluded."""
    bags = ScreenedBags(tmp_path / "bags", privacy(), privacy(name="without margin", margin=0))
    bags.split([off(-2), *words(0, 10)])
    bags.split(words(10, 12))
    bags.step()
    assert bags.seconds() == []
    bags.split([on(10.5), word(11.6)])
    bags.step()
    assert bags.seconds() == halves(0, 9)


@pytest.mark.parametrize(
    ("said", "problem"),
    [
        (word(5, "/privacy_mode"), "/privacy_mode: the values hold no boolean"),
        (replace(off(5), body=b""), "the rule privacy: "),
    ],
    ids=["another type", "not decoded"],
)
def test_a_message_that_cannot_show_it_is_unknown_and_reported(
    bags: ScreenedBags, said: Msg, problem: str
) -> None:
    bags.split([off(-2), said, *words(0, 10)])
    bags.end()
    assert bags.seconds() == halves(0, 4)
    assert problem in (bags.screening.problem() or "")


def test_a_rule_for_a_field_that_is_not_there_cuts_nothing_until_it_is_corrected(
    tmp_path: Path,
) -> None:
    def rule(field: str) -> ExclusionRule:
        condition = parse_condition("above", 5, 0.5, field)
        return privacy(topic="/odom", condition=condition, stale=100 * S)

    def driven(begin: int, stop: int) -> list[Msg]:
        return [odom(T0 + n * S, float(n), 0.0) for n in range(begin, stop)]

    bags = ScreenedBags(tmp_path / "bags", rule("pose.position.x"))
    with capture_logs() as logs:
        for name, begin in ((bags.begin(0), 0), (bags.begin(1), 10), (bags.begin(20), 20)):
            bags.split([*driven(begin, begin + 10), *words(begin, begin + 10)], of=name)
            bags.step()
        bags.end()
    assert bags.served() == []
    [said] = bags.screening.failing_rules()
    assert "have no field 'pose.position.x'; their fields are: " in said
    assert "3 splits are not served" in (bags.screening.problem() or "")
    # Every ten minutes; a step is a minute.
    [failed] = events(logs, "exclusion_rule_fails")
    assert failed["log_level"] == "error"
    bags.now_s += 600
    with capture_logs() as logs:
        bags.step()
    assert len(events(logs, "exclusion_rule_fails")) == 1
    # As the message has it, and as the schema map names it.
    bags.rules = (rule("pose.pose.position.x"),)
    bags.screening = bags.new()
    bags.end()
    assert bags.seconds() == halves(0, 5)
    assert (bags.screening.failing_rules(), bags.screening.problem()) == ((), None)


def test_what_holds_at_the_end_holds_after_a_restart(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags", privacy(excludes_unknown=False))
    bags.split([on(2), *words(0, 10)])
    bags.end()
    bags.screening = bags.new()
    new = bags.begin(30)
    bags.split([off(32), *words(30, 40)])
    metadata = bags.bag_dir / new / METADATA_FILE
    metadata.write_text("")
    bags.end()
    assert bags.seconds() == [0.5, *halves(33, 40)]
    assert "message_count: 7" in metadata.read_text()


@patch.object(screening, "MOST_EXCLUDED", 3)
def test_a_latched_message_that_was_excluded_long_ago_does_not_come_back(
    bags: ScreenedBags,
) -> None:
    maps = [word(1, "/map"), word(6, "/map")]
    name = bags.begin(0)
    bags.split([off(0), *maps[:1], on(5), *maps[1:], off(8), *words(0, 10)])
    for begin in range(10, 120, 10):
        before, name = name, bags.begin(begin)
        bags.end(before)
        bags.split([off(begin), on(begin + 3), off(begin + 6), *words(begin, begin + 10)])
        bags.step()
    before, name = name, bags.begin(120)
    bags.end(before)
    again = [replace(each, log_time=T0 + 121 * S, publish_time=each.log_time) for each in maps]
    bags.split([off(120), *again, off(121), *words(121, 130)])
    bags.end()
    assert bags.seconds("/map") == [1.0, 121.0]


@pytest.mark.parametrize("flushes", [True, False])
def test_a_latched_topic_is_excluded_until_a_newer_message_is_not(
    bags: ScreenedBags, *, flushes: bool
) -> None:
    # Nothing is known of the mode yet: what the next recording receives again may be served.
    bags.split([word(1, "/map"), *words(0, 10)])
    bags.split([off(12), *words(10, 20)])
    bags.step()
    assert bags.screening.excluded_latched() == set()
    bags.split([on(22), word(25, "/map"), *words(20, 30)])
    bags.split([off(32), *words(30, 40)])
    bags.split(words(40, 50))
    with nullcontext() if flushes else broken(repair, "flush", errno.EIO):
        bags.step()
    assert bags.screening.excluded_latched() == {"/map"}
    assert bags.screening.problem() is None
    bags.split([word(55, "/map"), *words(50, 60)])
    bags.end()
    assert bags.screening.excluded_latched() == set()
    assert bags.seconds("/map") == [55.0]


def test_a_split_that_cannot_be_read_stays_held_back(bags: ScreenedBags) -> None:
    name = bags.begin(0)
    bags.split([off(-2), *words(0, 10)])
    spoil_chunk(bags.split([on(12), *words(10, 20)]), 0)
    bags.split(words(20, 30))
    bags.end()
    # Since it may have said that the condition holds, the next one is unknown.
    assert bags.seconds() == halves(0, 9)
    assert f"{name}_1.mcap" in (bags.screening.problem() or "")
    assert read_withheld(bags.bag_dir).holds(name, f"{name}_1.mcap")


def test_a_split_that_the_disk_never_gives_holds_others_back_for_a_day(
    bags: ScreenedBags, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = bags.begin(0)
    bags.split([off(-2), *words(0, 10)])
    bad = bags.split([off(10), *words(10, 20)])
    bags.split([off(20), *words(20, 30)])
    fault = BagUnreachableError(str(bad), "it cannot be opened or read: Input/output error")
    fail_reading(monkeypatch, "records", lambda path: fault if path == bad else None)
    bags.live.clear()
    for _ in range(24):
        with pytest.raises(BagUnreachableError):
            bags.step()
        assert bags.served() == []
        bags.now_s += 3540
    bags.end()
    assert [path.name for path in bags.served()] == [f"{name}_0.mcap", f"{name}_2.mcap"]
    assert f"{bad.name}: it cannot be opened" in (bags.screening.problem() or "")


def test_a_bag_of_others_in_a_recording_is_neither_changed_nor_served(bags: ScreenedBags) -> None:
    name = bags.begin(0)
    bags.split([off(0), on(2), *words(0, 10)])
    theirs = write_mcap(bags.bag_dir / name / "theirs_0.mcap", words(0, 10))
    before = theirs.read_bytes()
    bags.end()
    assert theirs.read_bytes() == before
    assert [path.name for path in bags.served()] == [f"{name}_0.mcap"]
    assert f"{name}/theirs_0.mcap" in (bags.screening.problem() or "")


def test_a_full_disk_or_a_state_that_cannot_be_read_changes_and_serves_nothing(
    bags: ScreenedBags,
) -> None:
    name = bags.begin(0)
    split = bags.split([off(-2), on(5), *words(0, 10)])
    before = split.read_bytes()

    with broken(SCREENED, "write"):
        with pytest.raises(OSError, match="No space"):
            bags.end()
        with pytest.raises(RecorderError, match=r"screened\.json: No space"):
            bags.begin(20)
    assert (split.read_bytes(), bags.served()) == (before, [])
    # Nor does a full disk on which a split cannot be cut.
    with broken(McapWriter, "cut"):
        bags.end()
        problem = bags.screening.problem() or ""
        assert "1 split is not served" in problem
        assert f"{name}/{split.name}: No space left on device" in problem
        assert ([*split.parent.iterdir()], bags.served()) == ([split], [])
    bags.end()
    assert (bags.seconds(), bags.screening.problem()) == (halves(0, 4), None)
    # One that is damaged serves nothing, and begins nothing.
    (bags.bag_dir / SCREENED_FILE).write_text("{")
    assert bags.served() == []
    bags.screening = bags.new()
    with pytest.raises(RecorderError, match="delete this file"):
        bags.begin(20)


def test_a_clock_that_is_set_back_leaves_nothing_sure(bags: ScreenedBags) -> None:
    bags.split([off(-2), *words(0, 30)])
    bags.split([on(12), *words(10, 20)])
    bags.split(words(15, 25))
    bags.split(words(40, 50))
    bags.end()
    # It held from 12 s on by one of the two clocks, and is not known to have ended.
    assert bags.seconds() == halves(0, 9)


def test_a_recording_that_never_began_is_forgotten(bags: ScreenedBags) -> None:
    failed, name = bags.begin(0), bags.begin(1)
    bags.split([off(1), *words(2, 10)])
    bags.live.discard(failed)
    bags.split(words(10, 20))
    bags.step()
    assert len(bags.served()) == 1
    state = SCREENED.read(bags.bag_dir)
    assert state is not None
    assert [*state.recordings] == [name]


STEPS = st.lists(st.tuples(st.integers(1, 4), st.sampled_from([None, True, False])), max_size=6)


class _Killed(BaseException):
    """The end of the process, at a point that the test chooses."""


def interrupted_at(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kills the process at the nth of the points at which the disk shows a difference."""
    left = itertools.count(count, -1)

    def point() -> None:
        if not next(left):
            raise _Killed

    def dying(owner: object, name: str, *, before: bool = True) -> None:
        real = getattr(owner, name)

        def call(*args: object, **given: object) -> object:
            if before:
                point()
            found = real(*args, **given)
            point()
            return found

        monkeypatch.setattr(owner, name, call)

    dying(SCREENED, "write")
    dying(repair, "replace_file")
    dying(McapWriter, "cut", before=False)


def record_a_day(bags: ScreenedBags, step: Callable[[], None]) -> None:
    """Two recordings with a rotation while it holds, screened now and then."""
    old = bags.begin(0)
    bags.split([off(-2), word(1, "/map"), *words(0, 4)])
    step()
    bags.split([on(5), *words(4, 8)])
    step()
    new = bags.begin(7)
    bags.split(words(8, 10), of=old)
    bags.live.discard(old)
    bags.split([on(8.2, published=5), word(8.4, "/map"), *words(8, 12)])
    step()
    bags.split([off(13), *words(12, 20)])
    step()
    step()
    bags.split([word(21, "/map"), *words(20, 24)])
    bags.live.discard(new)
    for _ in range(4):
        step()


POINTS = 34
EXPECTED = [*halves(0, 4), *halves(14, 24)]


@pytest.mark.parametrize("moment", range(0, POINTS + 1, 1 if LONG else 2))
def test_a_kill_at_any_point_serves_nothing_unscreened(
    bags: ScreenedBags, moment: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed = 0

    def started_again(act: Callable[..., Any]) -> Callable[..., Any]:
        def acting(*given: float) -> Any:
            nonlocal killed
            try:
                return act(*given)
            except _Killed:
                killed += 1
                bags.screening = bags.new()
                return act(*given)

        return acting

    def step() -> None:
        bags.step()
        assert {*bags.seconds()} <= {*EXPECTED}

    for name in ("begin", "step"):
        monkeypatch.setattr(bags, name, started_again(getattr(bags, name)))
    with monkeypatch.context() as patched:
        interrupted_at(moment, patched)
        record_a_day(bags, step)
    bags.end()
    assert bags.seconds() == EXPECTED
    assert bags.seconds("/map") == [1.0, 21.0]
    assert list(bags.bag_dir.rglob(".*.mcap*")) == []
    # As many points as there are; the next one is never reached.
    assert killed == (moment < POINTS)


@given(STEPS, st.integers(0, 2**24))
def test_however_a_recording_is_cut_into_splits(
    tmp_path_factory: pytest.TempPathFactory, said: list[tuple[int, bool | None]], seed: int
) -> None:
    """And whenever it is looked at: what stays is what its messages say, one by one."""
    times = list(itertools.accumulate(by for by, _ in said))
    modes = [
        mode(time + 0.25, value=value)
        for time, (_, value) in zip(times, said, strict=True)
        if value is not None
    ]
    messages = sorted([word(0), *words(0, 20), *modes], key=lambda each: each.log_time)
    bags = ScreenedBags(tmp_path_factory.mktemp("bags") / "bags")
    cuts = [at for at in range(1, len(messages)) if (seed >> (at % 24)) & 7 == 1]
    for start, stop in itertools.pairwise([0, *cuts, len(messages)]):
        bags.split(messages[start:stop])
        if seed & (1 << (start % 24)):
            bags.step()
    bags.end()

    def state(at: float) -> bool | None:
        before = [each for each in modes if each.log_time <= T0 + at * S]
        return None if not before else before[-1].body.data  # type: ignore[attr-defined]

    def stays(at: float) -> bool:
        return all(
            state(at + by / 100) is False for by in range(-100, 101, 5) if at + by / 100 >= 0
        )

    assert bags.seconds() == [at for at in [0.0, *halves(0, 20)] if stays(at)]
