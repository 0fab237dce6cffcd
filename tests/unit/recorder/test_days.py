"""The folder `memory/`: what stays of bags that retention deletes; moments beside it."""

import errno
import json
import operator
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import cache
from itertools import count, cycle
from pathlib import Path
from typing import Any, NamedTuple
from unicodedata import normalize
from unittest.mock import Mock

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from structlog.testing import capture_logs

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import ERASING_FILE, LEAVING_FILE, THINNED_FILE
from ros2_memory.bag_dir.moment_file import Outcome
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import (
    LEAVING,
    SUPERSEDED,
    THINNED,
    Thinned,
    read_superseded,
    read_thinned,
)
from ros2_memory.core.errors import BagError, BagUnreachableError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_DAY, NS_PER_S, Clock
from ros2_memory.recorder import days as recorder_days
from ros2_memory.recorder.days import GRACE_S, MONTH_NS, MemoryDays, MemoryLimits
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.recorder.thinning import times_near
from ros2_memory.retention import collect
from ros2_memory.storage.base import BagWriter, Channel, Record
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support import housekeepers
from tests.support.bags import (
    Msg,
    battery,
    boolean,
    detections,
    goals,
    header,
    in_order,
    make,
    mcap_content,
    odom,
    text,
    tf,
    tf_of,
    transform,
    typestore,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.examples import LONG
from tests.support.fakes import broken, files_limited_to
from tests.support.housekeepers import keeper_of, own_all
from tests.support.mcap_surgery import unpacked
from tests.support.memories import reply_over, shipped_extractor
from tests.support.noting_reader import fail_reading
from tests.support.program import Program, exits
from tests.unit.cli.conftest import locked

S = NS_PER_S
T0 = 1_790_000_400 * S  # 13:20 on 21 September 2026
T0_S = T0 / S
__all__ = ["exits"]
DAY_FILE = "memory/20260921.thinned.mcap"


def split(
    bag_dir: Path, start: int, *, name: str = "rec_A", labels: Sequence[str] | None = ("mug",)
) -> Path:
    """A split of a minute that begins so many seconds after `T0`; the robot drives along x.

    With None in place of labels its detector says nothing.
    """
    path = bag_dir / name / f"{name}_{start // 60}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content_of_split(start, None if labels is None else (*labels,)))
    return path


def splits(bag_dir: Path, minutes: Iterable[int]) -> None:
    for minute in minutes:
        split(bag_dir, 60 * minute)


@cache
def content_of_split(start: int, labels: tuple[str, ...] | None) -> bytes:
    begin = T0 + start * S
    times = range(begin, begin + 60 * S, S // 2)
    messages: list[Msg] = [tf_of(begin, "base_link", "camera", (0.1, 0, 0.3), topic="/tf_static")]
    for at in times:
        messages.append(odom(at, (at - T0) / S / 4, 1.0))
        messages.append(boolean(at, (at - T0) // (30 * S) % 2 == 1))
    if labels is not None:
        messages += [detections(at, labels) for at in times[::2]]
    messages += [battery(at, 0.9 - (at - T0) / S / 1e5) for at in times[::2]]
    messages.append(text(begin + 7 * S, "the code is 4711"))
    return mcap_content(in_order(messages))


def days_of(
    bag_dir: Path,
    *,
    writer: BagWriter | None = None,
    limits: MemoryLimits | None = None,
    keeps: bool = True,
    monotonic: Callable[[], float] = time.monotonic,
) -> MemoryDays:
    return MemoryDays(
        bag_dir,
        BagDirReader(McapReader()),
        writer or McapWriter(),
        OwnRecordings(bag_dir),
        shipped_extractor(),
        limits=(limits or MemoryLimits()) if keeps else None,
        static_topics=("/tf_static",),
        monotonic=monotonic,
    )


def house(bag_dir: Path, now: int, **how: Any) -> Housekeeping:
    return keeper_of(bag_dir, clock=SettableClock(now), keeps_foreign=True, **how)


def keep_all(
    bag_dir: Path,
    name: str = "rec_A",
    *,
    days: MemoryDays | None = None,
    clock: Clock | None = None,
    **how: Any,
) -> None:
    """Lists what lies there as the recorder's own, and keeps the days of one recording."""
    own_all(bag_dir)
    index = IndexManager(
        bag_dir,
        BagDirReader(McapReader()),
        clock or SettableClock(T0 + 10**6 * S),
        refresh_s=0.0,
        split_duration_s=60.0,
    )
    snapshot = index.refresh()
    files = {bag.file for bag in snapshot.bags if bag.recording.name == name}
    (days or days_of(bag_dir, **how)).keep(snapshot, files)


def messages_in(path: Path) -> list[Record]:
    reader = McapReader()
    topics = [channel.topic for channel in reader.channels(path)]
    return list(reader.records(path, topics, TimeWindow.everything()))


def record(bag_dir: Path, messages: Iterable[Msg]) -> Path:
    """A split with these messages, in order of time."""
    return write_mcap(bag_dir / "rec_A" / "rec_A_0.mcap", in_order(messages))


def bags_left(bag_dir: Path, name: str = "rec_A") -> int:
    return len([*bag_dir.glob(f"{name}/*.mcap")])


def topics_in(bag_dir: Path) -> Counter[str]:
    return Counter(record.channel.topic for record in messages_in(bag_dir / DAY_FILE))


def days_in(bag_dir: Path) -> list[str]:
    return sorted(path.name for path in bag_dir.glob("memory/*.mcap"))


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    (tmp_path / "bags").mkdir()
    return tmp_path / "bags"


def test_a_day_has_what_changes_and_what_was_seen_and_no_text(bag_dir: Path) -> None:
    splits(bag_dir, range(3))
    keep_all(bag_dir)
    found = topics_in(bag_dir)
    assert "/chatter" not in found
    assert 175 <= found["/odom"] <= 200
    assert found["/bumper"] <= 60
    assert found["/vision/scene/scene_objects"] == 180
    assert b"4711" not in (bag_dir / DAY_FILE).read_bytes()
    assert McapReader().summarize(bag_dir / DAY_FILE).complete


def test_of_a_topic_that_retention_gives_a_shorter_life_nothing_stays(bag_dir: Path) -> None:
    """The budget may delete its bags before that is over."""
    splits(bag_dir, range(3))
    keep_all(
        bag_dir, days=days_of(bag_dir, limits=MemoryLimits(short_lived=("/vision/*/*", "/tf*")))
    )
    found = topics_in(bag_dir)
    assert "/vision/scene/scene_objects" not in found
    assert {"/odom", "/tf_static"} <= found.keys()


def test_what_a_kill_left_unfinished_of_a_day_goes_with_the_next_pass(bag_dir: Path) -> None:
    left = bag_dir / "memory/.20260801.thinned.mcap.repair"
    left.parent.mkdir()
    left.write_bytes(b"half of it")
    house(bag_dir, T0 + 3600 * S, max_age_h=24, memory=days_of(bag_dir)).apply()
    assert not left.exists()


def test_days_that_nobody_wants_go_after_a_day_of_running_and_not_before(bag_dir: Path) -> None:
    split(bag_dir, 0)
    keep_all(bag_dir)
    monotonic = SettableClock(0)

    def started(*, keeps: bool = False) -> Housekeeping:
        days = days_of(bag_dir, keeps=keeps, monotonic=lambda: monotonic.now() / S)
        keeper = house(bag_dir, T0 + 100 * S, memory=days)
        keeper.apply()
        return keeper

    keeper = started()
    for _ in range(23):
        monotonic.at += 3600 * S
        keeper.apply()
    status = reply_over(bag_dir, "memory_status")
    assert [note for note in status["notes"] if "memory/ is deleted" in note and "1.0 h" in note]
    # What it was off for does not count, nor what ran before it was wanted again.
    monotonic.at += 10**6 * S
    started(keeps=True)
    assert "memory/ is deleted" not in str(reply_over(bag_dir, "memory_status"))
    keeper = started()
    monotonic.at += 23 * 3600 * S
    keeper.apply()
    assert (bag_dir / DAY_FILE).exists()
    keeper = started()
    monotonic.at += 3601 * S
    keeper.apply()
    assert not (bag_dir / "memory").exists()
    assert not (bag_dir / LEAVING_FILE).exists()


def test_days_that_somebody_deletes_first_are_not_announced_any_more(bag_dir: Path) -> None:
    split(bag_dir, 0)
    keep_all(bag_dir)
    house(bag_dir, T0 + 100 * S, memory=days_of(bag_dir, keeps=False)).apply()
    assert "memory/ is deleted" in str(reply_over(bag_dir, "memory_status"))
    shutil.rmtree(bag_dir / "memory")
    house(bag_dir, T0 + 100 * S).apply()  # as a recorder that starts and finds no days has it
    assert "memory/ is deleted" not in str(reply_over(bag_dir, "memory_status"))


def test_days_go_a_day_after_a_warning_also_where_the_disk_was_full_at_first(
    bag_dir: Path,
) -> None:
    split(bag_dir, 0)
    keep_all(bag_dir)
    monotonic = SettableClock(0)
    days = days_of(bag_dir, keeps=False, monotonic=lambda: monotonic.now() / S)
    with broken(type(LEAVING), "write"), pytest.raises(OSError, match="No space"):
        days.clear()
    monotonic.at += 3600 * S
    with capture_logs() as logs:
        days.clear()
    assert [entry["event"] for entry in logs] == ["memory_leaves"]
    monotonic.at += 23 * 3600 * S
    days.clear()
    assert days_in(bag_dir)


def test_nothing_is_written_while_messages_are_forgotten(bag_dir: Path) -> None:
    split(bag_dir, 0)
    own_all(bag_dir)
    (bag_dir / ERASING_FILE).parent.mkdir(exist_ok=True)
    (bag_dir / ERASING_FILE).write_text("{}")
    with pytest.raises(BagError, match="being forgotten"):
        keep_all(bag_dir)
    assert not (bag_dir / DAY_FILE).exists()


def test_each_file_of_a_day_ages_with_it_but_for_those_of_a_wrong_date_or_by_an_unsure_clock(
    bag_dir: Path,
) -> None:
    """Where a day is damaged, or of others, another file is written beside it."""
    split(bag_dir, 0)
    write_mcap(bag_dir / "rec_A" / "old.mcap", [odom(n * S, n, 0.0) for n in range(1, 9)])
    keep_all(bag_dir)
    damaged = (bag_dir / DAY_FILE).read_bytes()[:-100]
    (bag_dir / DAY_FILE).write_bytes(damaged)
    split(bag_dir, 600, name="rec_B")
    keep_all(bag_dir, "rec_B")
    assert (bag_dir / DAY_FILE).read_bytes() == damaged
    assert messages_in(bag_dir / "memory/20260921-1.thinned.mcap")
    three = [f"{name}.thinned.mcap" for name in ("19700101", "20260921-1", "20260921")]
    days = days_of(bag_dir, limits=MemoryLimits(max_age_ns=10 * NS_PER_DAY))
    for now in (None, T0 + 10 * NS_PER_DAY):
        days.limit(now)
        assert days_in(bag_dir) == three
    days.limit(T0 + 11 * NS_PER_DAY)
    assert days_in(bag_dir) == three[:1]


def drive_and_stand(bag_dir: Path, name: str, start: int) -> Path:
    """Half a minute of driving, a minute of standing, and half a minute of driving on."""
    begin = T0 + start * S
    messages: list[Msg] = []
    for at in range(begin, begin + 120 * S, S // 5):
        seconds = (at - begin) / S
        driven = min(seconds, 30.0) + max(seconds - 90.0, 0.0)
        messages.append(odom(at, start + driven / 4, 1.0))
        messages.append(boolean(at, 30 <= seconds < 90))
    return write_mcap(bag_dir / name / f"{name}_{start}.mcap", in_order(messages))


@pytest.mark.parametrize("pause", [12, 60])
def test_what_was_not_recorded_is_not_answered_from_memory(bag_dir: Path, pause: int) -> None:
    drive_and_stand(bag_dir, "rec_A", 0)
    drive_and_stand(bag_dir, "rec_B", 120 + pause)
    # Bags that are not thinned show how often the topics have a message.
    drive_and_stand(bag_dir, "rec_C", 4000)
    own_all(bag_dir)

    def asked() -> tuple[Any, list[float]]:
        window = {"start": T0_S, "end": T0_S + 119.8}
        bumper = reply_over(bag_dir, "get_topic_in_range", topic="/bumper", by="value", **window)
        return reply_over(bag_dir, "recap", **window), [row[2] for row in bumper["rows"]]

    recap, times = asked()
    for name in ("rec_A", "rec_B"):
        keep_all(bag_dir, name)
        shutil.rmtree(bag_dir / name)
    middle = reply_over(bag_dir, "get_position_at", timestamp=T0_S + 120 + pause / 2)
    assert middle["error"] == "no_data", middle
    assert middle["reason"] == ("gap" if pause > 20 else "deleted")
    standing = reply_over(bag_dir, "get_position_at", timestamp=T0_S + 60)
    assert standing["x"] == 7.5
    thinned, times_then = asked()
    assert thinned["stood_s"] == pytest.approx(recap["stood_s"], abs=3.0)
    assert "nothing" not in str(thinned["events"])
    # The last message of a state may be up to 7 s before the end.
    assert times_then == pytest.approx(times, abs=7.5)


STARTS = (0, 60, 10 * 3600 + 2370, 12 * 3600)
"""Of the splits that go (s after `T0`): one is across midnight, and one on the next day."""


def poses_in(folder: Path) -> list[int]:
    """How many poses there are of each of these splits."""
    windows = ({"start": T0_S + at, "end": T0_S + at + 59.9} for at in STARTS)
    replies = (reply_over(folder, "get_topic_in_range", topic="/odom", **each) for each in windows)
    return [reply["total"] for reply in replies]


def delete_a_day_later(folder: Path) -> None:
    house(folder, T0 + (53 * 3600 + 60) * S, max_age_h=24, memory=days_of(folder)).apply()


class Undisturbed(NamedTuple):
    """Bags before their deletion and after it, and the poses of each split."""

    before: Path
    after: Path
    whole: list[int]
    thinned: list[int]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    before, after = (tmp_path_factory.mktemp("bags") / name for name in ("before", "after"))
    for start in STARTS:
        split(before, start)
    for hour in (30, 53):
        split(before, hour * 3600, name="rec_B")
    shutil.copytree(before, after)
    own_all(after)
    whole = poses_in(after)
    delete_a_day_later(after)
    return Undisturbed(before, after, whole, poses_in(after))


@pytest.mark.parametrize("steps", range(7) if LONG else (0, 3, 5))
def test_a_kill_at_any_step_counts_no_message_twice_and_loses_none(
    tmp_path: Path, undisturbed: Undisturbed, steps: int
) -> None:
    bag_dir = shutil.copytree(undisturbed.before, tmp_path / "bags")
    own_all(bag_dir)
    left = iter(range(steps))

    def is_after_the_last(*given: object) -> bool:
        is_change = any(".thinned.mcap" in str(each) or "rec_A" in str(each) for each in given)
        if is_change and next(left, None) is None:
            raise KeyboardInterrupt
        return False

    with (
        pytest.raises(KeyboardInterrupt) if steps < 6 else nullcontext(),
        broken(Path, "replace", where=is_after_the_last),
        broken(collect, "remove_bag", where=is_after_the_last),
    ):
        delete_a_day_later(bag_dir)
    possible = zip(undisturbed.whole, undisturbed.thinned, strict=True)
    assert all(map(operator.contains, possible, poses_in(bag_dir)))
    delete_a_day_later(bag_dir)
    assert poses_in(bag_dir) == undisturbed.thinned
    for name in ("memory/20260921.thinned.mcap", "memory/20260922.thinned.mcap"):
        assert messages_in(bag_dir / name) == messages_in(undisturbed.after / name)
    assert not bags_left(bag_dir)


def test_the_oldest_days_go_by_age_and_by_size_and_all_when_nothing_is_to_stay(
    bag_dir: Path,
) -> None:
    for day in range(4):
        split(bag_dir, 86_400 * day)
    keep_all(bag_dir)
    names = [f"202609{number}.thinned.mcap" for number in (21, 22, 23, 24)]
    assert days_in(bag_dir) == names
    size = (bag_dir / DAY_FILE).stat().st_size
    for gone, limits in (
        (1, MemoryLimits(max_age_ns=84 * 3600 * S)),
        (2, MemoryLimits(max_bytes=5 * size // 2)),
    ):
        days_of(bag_dir, limits=limits).limit(T0 + 4 * 86_400 * S)
        assert days_in(bag_dir) == names[gone:]
    (bag_dir / "memory" / "mine.mcap").write_bytes(b"of somebody else")
    leaving = days_of(bag_dir, keeps=False, monotonic=iter((0.0, GRACE_S)).__next__)
    leaving.clear()
    leaving.clear()
    assert [path.name for path in (bag_dir / "memory").iterdir()] == ["mine.mcap"]


def test_age_deletes_whole_hours_and_what_stays_answers(bag_dir: Path) -> None:
    """Splits of 13:20 to 14:40; at 14:10 plus a day the hour from 13:00 is too old."""
    splits(bag_dir, range(0, 80, 10))
    own_all(bag_dir)
    asked = {"timestamp": T0_S + 600}
    exact = reply_over(bag_dir, "get_position_at", **asked)
    newest = split(bag_dir, 86_400 + 3000, name="rec_B")
    own_all(bag_dir)
    days = days_of(bag_dir)
    house(bag_dir, T0 + (86_400 + 3060) * S, max_age_h=24, memory=days).apply()
    left = sorted(path.name for path in (bag_dir / "rec_A").glob("*.mcap"))
    assert len(left) == 4
    assert newest.exists()
    reply = reply_over(bag_dir, "get_position_at", **asked)
    assert reply["from"] == "memory"
    assert reply["resolution_s"] == 1
    assert reply["x"] == pytest.approx(exact["x"], abs=0.3)
    assert [
        note for note in reply["notes"] if "it was within x 150.00 to 150.25 and y 1.00" in note
    ]
    assert "from" not in reply_over(bag_dir, "get_position_at", timestamp=T0_S + 3000)
    later = {"start": T0_S + 3000, "end": T0_S + 3030}
    for start, is_thinned in ((600, True), (3030, False)):
        other = {"with_start": T0_S + start, "with_end": T0_S + start + 30}
        assert ("from" in reply_over(bag_dir, "compare", **later, **other)) is is_thinned
    whole = reply_over(bag_dir, "get_topic_at_time", topic="/battery_state", timestamp=T0_S + 604.5)
    assert whole["reason"] == "deleted"


def test_a_full_disk_does_not_wait_until_a_whole_hour_is_too_old(bag_dir: Path) -> None:
    """By age the split of 13:20 would be room enough, but those of 13:30 to 13:50 still stay."""
    splits(bag_dir, range(0, 40, 10))
    split(bag_dir, 86_400 + 300, name="rec_B")
    own_all(bag_dir)
    full = sum(path.stat().st_size for path in bag_dir.rglob("rec_*/*.mcap"))

    def free(_: Path) -> int:
        return full - sum(path.stat().st_size for path in bag_dir.rglob("rec_*/*.mcap"))

    now, memory = T0 + (86_400 + 360) * S, days_of(bag_dir)
    keeper = house(bag_dir, now, max_age_h=24, memory=memory, measure_free=free)
    keeper.apply()
    assert bags_left(bag_dir) == 4
    keeper.make_room(1000)
    assert free(bag_dir) >= 1000


def test_never_is_said_with_what_did_not_stay(bag_dir: Path) -> None:
    splits(bag_dir, range(3))
    keep_all(bag_dir, limits=MemoryLimits(texts=("/chat*",)))
    shutil.rmtree(bag_dir / "rec_A")
    wanted = {"topic": "/chatter", "condition_type": "contains"}
    found = reply_over(bag_dir, "find_last_match", **wanted, value="4711")
    assert (found["value"], found["from"]) == ({"value": "the code is 4711"}, "memory")
    never = reply_over(bag_dir, "find_last_match", **wanted, value="scissors")
    assert never["timestamp"] is None
    assert any("only some messages stayed" in note for note in never["notes"])


def test_a_full_disk_costs_no_more_of_what_stays_than_makes_room_for_the_rest(
    bag_dir: Path,
) -> None:
    splits(bag_dir, range(5))
    split(bag_dir, 7200, name="rec_B")
    own_all(bag_dir)
    memory = days_of(bag_dir, writer=(writer := McapWriter()))
    at_first = broken(writer, "write", where=lambda *_: bags_left(bag_dir, "rec_*") == 6)
    with at_first, capture_logs() as logs:
        house(bag_dir, T0 + 7300 * S, max_bytes=1, memory=memory).apply()
    assert [log["lost"] for log in logs if log["event"] == "memory_not_kept"] == [1]
    assert bags_left(bag_dir, "rec_*") == 1
    assert {int(one.log_time - T0) // (60 * S) for one in messages_in(bag_dir / DAY_FILE)} == {
        *range(1, 5)
    }


def unreachable(path: Path) -> BagError | None:
    reason = "it cannot be opened: Too many open files"
    return BagUnreachableError(str(path), reason) if path.parent.name == "rec_A" else None


def test_pauses_of_other_days_are_not_compared_with_messages(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = [(T0 - 6 * S, T0 - 5 * S), (T0 + 64 * S, T0 + 70 * S)]
    far = [(T0 - nth * 2700 * S, T0 - nth * 2700 * S + S) for nth in range(200, 0, -1)]
    split(bag_dir, 0)
    (bag_dir / "memory").mkdir()
    THINNED.write(bag_dir, Thinned(far[0][0], pauses=(*far, *near)))
    compared = Mock(wraps=times_near)
    monkeypatch.setattr(recorder_days, "times_near", compared)
    keep_all(bag_dir)
    assert compared.called
    assert [call.args[0] for call in compared.call_args_list] == [near] * compared.call_count


GOLDEN = Path(__file__).resolve().parents[2] / "data" / "memory_day_1.mcap"
"""A day as the first version with this folder wrote it, of one minute."""


def test_days_of_earlier_versions_are_read(bag_dir: Path) -> None:
    (bag_dir / "memory").mkdir()
    shutil.copy(GOLDEN, bag_dir / DAY_FILE)
    reply = reply_over(bag_dir, "get_position_at", timestamp=T0_S + 30)
    assert (round(reply["x"], 1), reply["from"]) == (7.5, "memory")
    seen = {"topic": "/vision/scene/scene_objects", "condition_type": "contains"}
    found = reply_over(bag_dir, "find_last_match", **seen, value="mug")
    assert found["value"]["detections"][0]["label"] == "mug"


def test_a_day_across_a_step_of_the_clock_is_read_by_the_hours_that_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that begins in 1970, and is set in the middle of a split."""
    for name, begin in (("rec_A", 0), ("rec_B", 20 * S)):
        early = [boolean(begin + nth * S, True) for nth in range(10)]
        later = [boolean(T0 + begin + nth * S, False) for nth in range(10)]
        write_mcap(tmp_path / name / f"{name}_0.mcap", [*early, *later])
    looks, read = count(1), McapReader.records

    def counted(*given: Any, **how: Any) -> Any:
        assert next(looks) < 50
        return read(*given, **how)

    monkeypatch.setattr(McapReader, "records", counted)
    for name in ("rec_A", "rec_B"):
        keep_all(tmp_path, name)
    assert next(looks) > 1


def test_a_clock_that_was_ahead_hides_nothing_and_pushes_no_day_out(bag_dir: Path) -> None:
    ahead = 400 * 86_400
    now = SettableClock(T0 + (ahead + 100) * S)
    for start, name in ((ahead, "rec_A"), (0, "rec_B"), (86_400, "rec_C")):
        split(bag_dir, start, name=name)
        keep_all(bag_dir, name, clock=now)
        (bag_dir / name / f"{name}_{start // 60}.mcap").unlink()
        now = SettableClock(T0 + 86_400 * S)
    assert read_thinned(bag_dir).since == T0
    assert "are not known" not in str(reply_over(bag_dir, "data_time_range"))
    days = days_in(bag_dir)
    size = sum(path.stat().st_size for path in (bag_dir / "memory").glob("*.mcap"))
    days_of(bag_dir, limits=MemoryLimits(max_bytes=size - 1)).limit(T0 + 90_000 * S)
    assert days_in(bag_dir) == days[:2]


def decoded(bag_dir: Path) -> dict[str, list[Any]]:
    """The messages of the day by topic."""
    found: dict[str, list[Any]] = {}
    for one in messages_in(bag_dir / DAY_FILE):
        found.setdefault(one.channel.topic, []).append(McapReader().decode(one))
    return found


def labels_in(bag_dir: Path) -> set[str]:
    return {
        seen.label
        for each in decoded(bag_dir)["/vision/scene/scene_objects"]
        for seen in each.detections
    }


NAMES = ("anna", "McDonald", "O'Brien", "Anna Maria", "Tante_Inge", "user1", "Jürgen", "!")
PEOPLE = (
    *("Person", "alte Frau", "niño", "行人", "TrackedPerson", "PERSON_2", "0", "MÄDCHEN", "NIÑO"),
    *(normalize("NFD", "mädchen"), "Anna", "McDonald", "O'Brien", "AnnaMaria", "tante_inge"),
    *("user1", "JÜRGEN"),
)
THINGS = {"mug", "drill", "surface", "Manometer", "user 12", "Maria", "?"}
STATES = (
    {"state": "held", "object": "mug"},
    {"state": "held", "object": "person"},
    {"class": "EVT", "of": [{"label": "child"}, {"class_id": 0}]},
)


def joints(topic: str, *names: str, efforts: int = 0) -> Msg:
    kind, at = "sensor_msgs/msg/JointState", np.array([0.1, 0.2, 0.3])
    fields = {"position": at, "velocity": np.zeros(0), "effort": np.zeros(efforts)}
    return Msg(topic, kind, T0, make(kind, header=header(T0, "1"), name=[*names], **fields))


def seen_by(kind: str, entry: str, listed: str, named: str, **fields: object) -> Msg:
    found = [make(entry, **fields, **{named: name}) for name in ("cup_3", "person_17")]
    return Msg(f"/{listed}", kind, T0, make(kind, header=header(T0, "camera"), **{listed: found}))


def test_people_are_taken_out_whatever_names_them_unless_their_label_is_named(
    bag_dir: Path,
) -> None:
    """In words of several languages, labels, numbers of models, frames, topics, joints and JSON."""
    times = [T0 + n * S for n in range(60)]
    frames = [
        transform(T0, "map", each, (0.123456789, 0, 0)) for each in ("base_link", "person_1", "2")
    ]
    record(
        bag_dir,
        [
            *(detections(at, (*PEOPLE, *THINGS)) for at in times),
            *(tf(at, *frames[: 1 + nth % 2]) for nth, at in enumerate(times)),
            tf(T0, *frames, topic="/tf_static"),
            tf_of(T0, "map", "child", (0.1, 0, 0.3), topic="/tf_static"),
            *(boolean(at, at % 2 == 0, topic="/face/is_seen") for at in times),
            *(
                text(at, json.dumps(state), "/arm")
                for at, state in zip(times, cycle(STATES), strict=False)
            ),
            joints("/joints", "neck_yaw", "face_pitch", "arm"),
            joints("/whose", "neck_yaw", "face_pitch", "arm", efforts=6),
            # Servos on a bus are called so, and labels of numbers are people's.
            joints("/servos", "1", "2", "3"),
            seen_by(
                "darknet_ros_msgs/msg/BoundingBoxes",
                "darknet_ros_msgs/msg/BoundingBox",
                "bounding_boxes",
                "Class",
                probability=0.9,
                xmin=4,
            ),
            seen_by(
                "yolo_msgs/msg/DetectionArray",
                "yolo_msgs/msg/Detection",
                "detections",
                "id",
                class_name="thing",
                score=0.9,
            ),
        ],
    )
    keep_all(bag_dir, limits=MemoryLimits(people=NAMES, texts=("/arm",)))
    stays = decoded(bag_dir)
    assert stays.keys().isdisjoint({"/face/is_seen", "/whose"})
    assert labels_in(bag_dir) == THINGS
    assert {each.child_frame_id for one in stays["/tf"] for each in one.transforms} == {"base_link"}
    [static] = stays["/tf_static"]
    assert [each.child_frame_id for each in static.transforms] == ["base_link", "2"]
    assert {each.transform.translation.x for each in static.transforms} == {0.123456789}
    assert {each.data for each in stays["/arm"]} == {json.dumps(STATES[0])}
    for topic, names, at in (
        ("/joints", ["neck_yaw", "arm"], [0.1, 0.3]),
        ("/servos", ["1", "2", "3"], [0.1, 0.2, 0.3]),
    ):
        [message] = stays[topic]
        assert message.name == names
        assert message.position.tolist() == pytest.approx(at, abs=0.001)
    assert [each.Class for each in stays["/bounding_boxes"][0].bounding_boxes] == ["cup_3"]
    assert [each.id for each in stays["/detections"][0].detections] == ["cup_3"]
    assert b"Person" not in (bag_dir / DAY_FILE).read_bytes()
    (bag_dir / DAY_FILE).unlink()
    keep_all(bag_dir, limits=MemoryLimits(labels=("Person",), people=NAMES))
    assert labels_in(bag_dir) == {*THINGS, "Person"}


def test_samples_do_not_stay_and_each_change_of_a_goal_does(bag_dir: Path) -> None:
    kind = "std_msgs/msg/Float32MultiArray"
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    samples = make(kind, layout=layout, data=np.ones(65, np.float32))
    spectrum = [Msg("/spectrum", kind, T0 + n * S, samples) for n in range(30)]
    states = [goals(T0 + n * S // 2, {1: 2 if n < 21 else 4}) for n in range(60)]
    record(bag_dir, [*spectrum, *states])
    keep_all(bag_dir)
    found = {(one.log_time - T0) / S for one in messages_in(bag_dir / DAY_FILE)}
    assert {*topics_in(bag_dir)} == {"/drive/_action/status"}
    assert found >= {10.0, 10.5}
    assert len(found) < 20


@pytest.mark.parametrize("first", [(), ({"label": "mug", "score": 0.9},)])
@pytest.mark.parametrize("cut", [1, 300])
def test_of_a_json_detector_that_sees_nothing_at_most_one_message_a_second_stays(
    bag_dir: Path, first: Sequence[object], cut: int
) -> None:
    """600 messages at 10 Hz, each with its own stamp; the first may have seen something."""
    messages: list[Msg] = []
    for nth in range(600):
        said = {"stamp": T0_S + nth / 10, "detections": [] if nth else [*first]}
        messages.append(text(T0 + nth * S // 10, json.dumps(said), "/objects"))
    for nth, part in enumerate((messages[:cut], messages[cut:])):
        write_mcap(bag_dir / "rec_A" / f"rec_A_{nth}.mcap", part)
    keep_all(bag_dir, limits=MemoryLimits(texts=("/objects",)))
    assert 9 <= topics_in(bag_dir)["/objects"] <= 60 + 2


def test_json_that_changes_slowly_and_other_texts_keep_each_change(bag_dir: Path) -> None:
    """At 10 Hz: a state for 2 s each, and the lines of a log."""
    messages: list[Msg] = []
    for nth in range(600):
        at = T0 + nth * S // 10
        messages.append(text(at, json.dumps({"task": nth // 20}), "/task"))
        messages.append(text(at, f"line {nth}", "/log"))
    record(bag_dir, messages)
    keep_all(bag_dir, limits=MemoryLimits(texts=("/*",)))
    stayed: dict[str, set[int]] = {"/task": set(), "/log": set()}
    for message in messages_in(bag_dir / DAY_FILE):
        stayed[message.channel.topic].add((message.log_time - T0) * 10 // S)
    assert stayed["/task"] >= {nth for nth in range(19, 599) if nth % 20 in {0, 19}}
    assert len(stayed["/task"]) < 80
    assert stayed["/log"] == {*range(600)}


def test_a_field_that_is_called_length_makes_no_array(bag_dir: Path) -> None:
    size, parcel = "my_msgs/msg/Size", "my_msgs/msg/Parcel"
    typestore().register(get_types_from_msg("float64 length\n", size))
    typestore().register(get_types_from_msg("Size size\n", parcel))
    said = make(parcel, size=make(size, length=400.0))
    record(bag_dir, [Msg("/parcel", parcel, T0 + n * S, said) for n in range(10)])
    keep_all(bag_dir)
    assert {*topics_in(bag_dir)} == {"/parcel"}


def test_numbers_too_large_to_be_rounded_stay_as_they_are(bag_dir: Path) -> None:
    """FLT_MAX and DBL_MAX say "no limit", and have no multiple that is a number of their type."""
    most_32, most_64 = float(np.finfo(np.float32).max), float(np.finfo(np.float64).max)
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    limits = np.array([most_32, 0.1, -most_32], np.float32)
    bodies = {
        "/limit": make("std_msgs/msg/Float64", data=most_64),
        "/limits": make("std_msgs/msg/Float32MultiArray", layout=layout, data=limits),
        "/goal": make("geometry_msgs/msg/Point", x=1e305, y=-most_64, z=0.123456789),
    }
    times = range(T0, T0 + 60 * S, S)
    messages: list[Msg] = []
    for topic, body in bodies.items():
        kind = type(body).__name__.replace("__", "/")
        messages += [Msg(topic, kind, at, body) for at in times]
    record(bag_dir, messages)
    keep_all(bag_dir)
    stays = {topic: messages[0] for topic, messages in decoded(bag_dir).items()}
    assert stays["/limit"].data == most_64
    assert stays["/limits"].data.tolist() == pytest.approx(limits.tolist(), rel=1e-6)
    assert (stays["/goal"].x, stays["/goal"].y) == (1e305, -most_64)
    assert stays["/goal"].z == pytest.approx(0.123456789, abs=5e-5)


def test_messages_that_cannot_be_written_are_counted_and_named(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encode = McapReader.encode

    def fail(reader: McapReader, channel: Channel, message: object) -> bytes:
        if channel.topic == "/battery_state":
            raise UndecodableError(channel.topic, channel.type, "too large")
        return encode(reader, channel, message)

    splits(bag_dir, range(2))
    keep_all(bag_dir)
    written = topics_in(bag_dir).pop("/battery_state")
    (bag_dir / DAY_FILE).unlink()
    monkeypatch.setattr(McapReader, "encode", fail)
    with capture_logs() as logs:
        keep_all(bag_dir)
    assert "/battery_state" not in topics_in(bag_dir)
    [lost] = [event for event in logs if event["event"] == "memory_not_written"]
    assert (lost["topic"], lost["messages"]) == ("/battery_state", written)
    assert lost["reason"] == "too large"


def test_after_a_month_numbers_have_one_message_a_minute_once_and_again_with_what_is_added(
    bag_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splits(bag_dir, range(10))
    own_all(bag_dir)
    keep_all(bag_dir)
    path, battery_only = bag_dir / DAY_FILE, "/battery_state"
    now, whole, before = T0 + MONTH_NS + 2 * 86_400 * S, path.read_bytes(), topics_in(bag_dir)
    # One that is damaged still says so.
    path.write_bytes(damaged := whole[:300] + bytes(100) + whole[400:])
    days_of(bag_dir).limit(now)
    assert path.read_bytes() == damaged
    path.write_bytes(whole)
    days_of(bag_dir).limit(T0 + 2 * 86_400 * S)
    assert path.read_bytes() == whole
    days_of(bag_dir).limit(now)
    after, status = topics_in(bag_dir), path.stat()
    assert before[battery_only] > 80
    assert after[battery_only] <= 10 + 2 * 8 + 1
    assert after | {battery_only: 0} == before | {battery_only: 0}
    # The bags that could not be deleted yet count no more than before.
    assert read_superseded(bag_dir).days == {DAY_FILE: (status.st_size, status.st_mtime_ns)}
    with monkeypatch.context() as patched:
        patched.setattr(BagDirReader, "batches", lambda *_, **__: pytest.fail("it is read again"))
        days_of(bag_dir).limit(now)
    assert path.stat().st_ino == status.st_ino
    split(bag_dir, 600, name="rec_B")
    keep_all(bag_dir, "rec_B")
    before = topics_in(bag_dir)
    days_of(bag_dir).limit(now)
    assert after[battery_only] < topics_in(bag_dir)[battery_only] < before[battery_only]


def test_a_recorder_thins_a_day_again_that_a_full_disk_left_or_to_which_it_added_bags(
    bag_dir: Path,
) -> None:
    splits(bag_dir, range(10))
    now, days = T0 + MONTH_NS + 2 * NS_PER_DAY, days_of(bag_dir)
    keep_all(bag_dir, days=days)
    whole = topics_in(bag_dir)
    with broken(McapWriter, "write"), pytest.raises((BagError, OSError), match="No space left"):
        days.limit(now)
    for _ in range(2):
        days.limit(now)
    assert topics_in(bag_dir)["/battery_state"] < whole["/battery_state"]
    split(bag_dir, 600, name="rec_B")
    keep_all(bag_dir, "rec_B", days=days)
    added = topics_in(bag_dir)
    days.limit(now)
    assert topics_in(bag_dir)["/battery_state"] < added["/battery_state"]


def test_where_a_day_cannot_be_written_the_limits_take_the_oldest_and_age_waits_for_a_day(
    bag_dir: Path,
) -> None:
    """The hour from 13:00 is too old, that from 14:00 is not."""
    splits(bag_dir, range(0, 80, 10))
    split(bag_dir, 86_400 + 3000, name="rec_B")
    own_all(bag_dir)
    sizes = [path.stat().st_size for path in bag_dir.rglob("rec_*/*.mcap")]
    monotonic = SettableClock(0)
    keeper = house(
        bag_dir,
        T0 + (86_400 + 3060) * S,
        max_age_h=24,
        max_bytes=sum(sizes) - min(sizes) // 2,
        memory=days_of(bag_dir),
        monotonic=lambda: monotonic.now() / S,
    )
    for monotonic.at, first in ((0, 10), (90_000 * S, 40)):
        with broken(McapWriter, "write", where=lambda _, path, *__: path.parent.name == "memory"):
            keeper.apply()
        left = {path.name for path in (bag_dir / "rec_A").glob("*.mcap")}
        assert left == {f"rec_A_{minute}.mcap" for minute in range(first, 80, 10)}


@pytest.mark.parametrize(("way", "is_lasting"), [("records", True), ("batches", False)])
def test_what_the_disk_does_not_give_holds_others_for_two_days_and_stays_if_it_comes(
    bag_dir: Path, way: str, is_lasting: bool
) -> None:
    for start, name in ((0, "rec_A"), (600, "rec_C"), (72_000, "rec_B")):
        split(bag_dir, start, name=name)
    own_all(bag_dir)
    clock = SettableClock(0)
    how: dict[str, Any] = {"monotonic": lambda: clock.now() / S}
    memory = days_of(bag_dir, **how)
    keeper = house(bag_dir, T0 + 72_700 * S, max_age_h=12, memory=memory, **how)
    with pytest.MonkeyPatch.context() as patched:
        fail_reading(patched, way, unreachable)
        keeper.apply()
        assert bags_left(bag_dir, "rec_[AC]") == 2
        assert not days_in(bag_dir)
        # A day for its latched messages, then one for what stays of it.
        with capture_logs() as logs:
            for clock.at in range(0, 172_802 * S if is_lasting else 1, 3600 * S):
                keeper.apply()
    lost = {entry["path"] for entry in logs if entry["event"] == "memory_not_read"}
    assert bool(lost) is is_lasting
    keeper.apply()
    assert not bags_left(bag_dir, "rec_[AC]")
    [day] = bag_dir.glob("memory/*.mcap")
    assert (McapReader().summarize(day).start >= T0 + 600 * S) is is_lasting


@pytest.fixture
def blind(bag_dir: Path) -> Path:
    """The day of nine minutes, in the middle three of which the detector was silent."""
    for nth in range(9):
        split(bag_dir, 60 * nth, labels=None if nth in {3, 4, 5} else ("mug",))
    keep_all(bag_dir)
    shutil.rmtree(bag_dir / "rec_A")
    return bag_dir


def test_a_topic_is_forgotten_with_its_silence_and_to_the_byte(blind: Path, exits: Program) -> None:
    def forget(topic: str, until_s: float) -> None:
        window = ("--start", T0_S, "--end", T0_S + until_s)
        exits(0, "forget --yes --topic", topic, *window, "--bag-dir", blind)

    forget("/odom", 300)
    assert read_thinned(blind).silences
    assert b"mug" in b"".join(unpacked(blind / DAY_FILE))
    forget("/vision/*", 300)
    assert not read_thinned(blind).silences
    assert not reply_over(blind, "data_time_range").get("silences")
    forget("/vision/*", 3600)
    assert b"mug" not in b"".join(unpacked(blind / DAY_FILE))
    assert "/vision/scene/scene_objects" not in topics_in(blind)
    assert "/odom" in topics_in(blind)


def test_a_silence_is_forgotten_with_its_day_but_not_beside_a_recorder(
    blind: Path, exits: Program
) -> None:
    split(blind, 2 * 86_400, name="rec_B")
    keep_all(blind, "rec_B")
    shutil.rmtree(blind / "rec_B")
    words = ("--start", T0_S, "--end", T0_S + 3600, "--yes", "--bag-dir", blind)
    with locked(blind):
        assert "only the recorder may" in exits(1, "forget", *words).out
    assert (blind / DAY_FILE).exists()
    exits(0, "forget", *words)
    assert not (blind / DAY_FILE).exists()
    asked = reply_over(blind, "data_time_range", start=T0_S, end=T0_S + 3600)
    assert (asked["silences"], read_thinned(blind).silences) == ([], ())


def test_a_silence_of_deleted_bags_goes_on_and_ends_as_others_show(bag_dir: Path) -> None:
    whole = bag_dir.with_name("whole")

    def check() -> None:
        both = [reply_over(folder, "data_time_range")["silences"] for folder in (bag_dir, whole)]
        assert both[0] == both[1]

    for folder in (bag_dir, whole):
        splits(folder, range(3))
        split(folder, 180, name="rec_B", labels=None)
    keep_all(bag_dir)
    shutil.rmtree(bag_dir / "rec_A")
    check()
    for start, labels in ((240, None), (300, ("mug",))):
        for folder in (bag_dir, whole):
            split(folder, start, name="rec_B", labels=labels)
        check()
    for folder in (bag_dir, whole):
        split(folder, 360, name="rec_C")
    keep_all(bag_dir, "rec_B")
    shutil.rmtree(bag_dir / "rec_B")
    check()


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_silence_goes_with_the_last_day_of_its_time_or_that_in_which_it_goes_on_since(
    bag_dir: Path, goes_on: bool
) -> None:
    later = 2 * 86_400
    for start, labels in ((0, ("mug",)), (60, None), (120, None if goes_on else ("mug",))):
        split(bag_dir, start, labels=labels)
    split(bag_dir, later, labels=None if goes_on else ("mug",))
    keep_all(bag_dir)
    assert read_thinned(bag_dir).silences
    days = days_of(bag_dir, limits=MemoryLimits(max_age_ns=86_400 * S))
    days.limit(T0 + (later + 3600) * S)
    assert not read_thinned(bag_dir).silences
    days.limit(T0 + 10 * later * S)
    assert [*(bag_dir / "memory").iterdir()] == []


def test_days_whose_bags_nobody_looked_at_say_so(blind: Path) -> None:
    note = "silences and steps of the clock within the days of memory/ are not known"
    assert note not in reply_over(blind, "data_time_range").get("notes", ())
    (blind / THINNED_FILE).write_text("{")
    assert note in reply_over(blind, "data_time_range")["notes"]
    split(blind, 3600, name="rec_B")
    keep_all(blind, "rec_B")
    notes = reply_over(blind, "data_time_range")["notes"]
    [said] = [each for each in notes if "memory/ before" in each]
    assert said.endswith("are not known")


def test_a_list_of_bags_in_days_that_cannot_be_read_is_not_replaced(bag_dir: Path) -> None:
    days = days_of(bag_dir)
    for name, second in (("rec_A", 0), ("rec_B", 7200)):
        split(bag_dir, second, name=name)
    keep_all(bag_dir, days=days)
    with broken(SUPERSEDED, "read", errno.EMFILE), pytest.raises(OSError, match="Too many"):
        keep_all(bag_dir, "rec_B", days=days)
    keep_all(bag_dir, "rec_B", days=days)
    assert {bag.partition("/")[0] for bag in read_superseded(bag_dir).bags} == {"rec_A", "rec_B"}


@pytest.mark.parametrize("size", [1000, 5000])
def test_a_write_that_fails_leaves_the_day_as_it_was(bag_dir: Path, size: int) -> None:
    split(bag_dir, 0)
    keep_all(bag_dir)
    before = (bag_dir / DAY_FILE).read_bytes()
    split(bag_dir, 60, name="rec_B")
    with files_limited_to(size), pytest.raises(BagError, match="too large"):
        keep_all(bag_dir, "rec_B")
    assert (bag_dir / DAY_FILE).read_bytes() == before
    left = sorted(path.name for path in (bag_dir / "memory").iterdir())
    assert left == ["20260921.thinned.mcap", "thinned.json"]


NEWEST = T0 + 20 * 3600 * S


def window(first: int, stop: int) -> dict[str, float]:
    return {"start": T0_S + 60 * first, "end": T0_S + 60 * stop - 0.1}


def saved(keeper: Housekeeping, bag_dir: Path, start: int, end: int) -> Outcome:
    """Asks for the time between so many seconds after `T0`."""
    since = (T0 - housekeepers.T0) // S
    return housekeepers.kept(keeper, bag_dir, since + start, since + end, at=NEWEST)


class Bags(NamedTuple):
    """A folder before its day is thinned and after it, and who thinned it."""

    whole: Path
    thinned: Path
    keeper: Housekeeping

    def ask(self, tool: str, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return reply_over(self.whole, tool, **given), reply_over(self.thinned, tool, **given)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Bags:
    """Splits of eight minutes, of which two moments have two each; and the next morning."""
    folder = tmp_path_factory.mktemp("bags")
    for nth in range(18, 26):
        split(folder, 60 * nth, labels=("mug", f"thing{nth}"))
    write_mcap(folder / "rec_B" / "rec_B_0.mcap", [odom(NEWEST + n * S, n, 1.0) for n in range(9)])
    own_all(folder)
    keeper = house(folder, NEWEST, max_age_h=12, memory=days_of(folder))
    for start, end in ((1205, 1315), (1445, 1500)):
        assert saved(keeper, folder, start, end).bags == 2
    whole = shutil.copytree(folder, tmp_path_factory.mktemp("whole") / "bags")
    keeper.apply()
    assert not (folder / "rec_A").exists()
    return Bags(whole, folder, keeper)


def test_a_moment_answers_its_time_and_the_day_what_is_around_it(bags: Bags) -> None:
    assert len([*(bags.thinned / "moments").rglob("*.mcap")]) == 4
    times = {record.log_time for record in messages_in(bags.thinned / DAY_FILE)}
    assert not [at for at in times if T0 + 1200 * S <= at < T0 + 1320 * S]
    for tool, given in (
        ("get_topic_in_range", {"topic": "/odom", **window(20, 22)}),
        ("get_position_at", {"timestamp": T0_S + 1250}),
        ("get_topic_at_time", {"topic": "/chatter", "timestamp": T0_S + 1208}),
    ):
        before, after = bags.ask(tool, **given)
        assert after == before
    # Across its edges nothing is counted twice, and nothing is missing.
    before, after = bags.ask("recap", **window(18, 26))
    assert after["from"] == "memory"
    assert after["distance_m"] == pytest.approx(before["distance_m"], rel=0.01)
    for label in ("thing19", "thing20", "thing21", "thing22"):
        seen = {"topic": "/vision/*", "condition_type": "contains", "value": label}
        assert [each["total"] for each in bags.ask("find_matches", **seen)] == [1, 1]
    # Several moments of a recording and the day around them are of one robot.
    assert "several robots" not in str(after)
    assert "mixed" not in str(reply_over(bags.thinned, "memory_status"))


def test_nothing_can_be_saved_of_a_time_of_which_a_thinned_day_alone_is_left(bags: Bags) -> None:
    assert "deleted" in str(saved(bags.keeper, bags.thinned, 1090, 1120).refused)


def test_a_moment_that_was_deleted_by_hand_leaves_no_memory_of_its_time(
    bags: Bags, tmp_path: Path
) -> None:
    folder = shutil.copytree(bags.thinned, tmp_path / "bags")
    shutil.rmtree(folder / "moments")
    assert reply_over(folder, "get_position_at", timestamp=T0_S + 1250)["error"] == "no_data"
    assert reply_over(folder, "get_position_at", timestamp=T0_S + 1150)["from"] == "memory"
