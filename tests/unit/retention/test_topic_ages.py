"""`retention.topics`: topics with a shorter life leave bags that stay."""

import errno
import fcntl
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir import durable_write
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import ERASING_FILE, EXPIRED_FILE
from ros2_memory.bag_dir.metadata_yaml import correct
from ros2_memory.bag_dir.state_files import (
    SHIPPED,
    Receipt,
    append_receipts,
    read_losses,
    unshipped,
)
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention import repair
from ros2_memory.retention.topic_ages import PATIENCE_S, TopicAge, TopicCutter
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import Msg, boolean, odom, text, tf_of, write_mcap
from tests.support.clocks import SettableClock
from tests.support.fakes import broken, failing, killed_at
from tests.support.housekeepers import HOUR, keeper_of, own_all
from tests.support.memories import reply_over
from tests.support.simulated_recorders import events

S = NS_PER_S
T0 = 1_790_000_400 * S
NOW = T0 + 30 * HOUR


def split(bag_dir: Path, hour: int, *, name: str = "rec_A", first: int = 0) -> Path:
    """Ten seconds of a robot that drives and speaks, so many hours after `T0`."""
    begin = T0 + hour * HOUR
    messages: list[Msg] = [
        tf_of(begin, "base_link", "camera", (0.1, 0, 0.3), topic="/tf_static"),
        *(odom(begin + n * S // 10, n / 10, 1.0) for n in range(100)),
        *(text(begin + first + n * S, f"word {n}", topic="/speech") for n in range(10)),
        *(boolean(begin + n * S, n % 2 == 0) for n in range(10)),
    ]
    messages.sort(key=lambda message: message.log_time)
    return write_mcap(bag_dir / name / f"{name}_{hour}.mcap", messages)


def house(
    bag_dir: Path,
    *,
    topic_ages: tuple[TopicAge, ...] = (TopicAge("/spee*", 24 * HOUR),),
    is_quiet: bool = True,
    free: int = 10**15,
    measure: Callable[[Path], int] | None = None,
    monotonic: Callable[[], float] = lambda: 0.0,
    **how: Any,
) -> Housekeeping:
    cutter = TopicCutter(
        bag_dir,
        topic_ages,
        McapReader(),
        McapWriter(),
        static_topics=("/tf_static",),
        is_quiet=lambda: is_quiet,
        measure_free=measure or (lambda _: free),
        monotonic=monotonic,
    )
    limits: dict[str, Any] = {"max_age_h": 168, "min_free_bytes": 1000, "keeps_foreign": True}
    return keeper_of(bag_dir, clock=SettableClock(NOW), cutter=cutter, **limits, **how)


def counts_of(path: Path) -> dict[str, int]:
    return {one.topic: one.count for one in McapReader().summarize(path).topics}


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """Two bags that are older than a day, and one that is not."""
    folder = tmp_path / "bags"
    for hour in (0, 1, 29):
        split(folder, hour)
    own_all(folder)
    return folder


def test_answers_say_that_it_was_deleted_and_count_it_and_metadata_what_is_left(
    bag_dir: Path,
) -> None:
    assert correct(bag_dir / "rec_A", McapReader())
    house(bag_dir).apply()
    assert not correct(bag_dir / "rec_A", McapReader())
    start = T0 / S
    old, young = (
        reply_over(bag_dir, "get_topic_in_range", topic="/speech", start=at, end=at + 9)
        for at in (start, start + 29 * 3600)
    )
    assert old["reason"] == "deleted"
    assert "10 messages deleted by retention (retention.topics): /speech (10)" in old["notes"]
    assert reply_over(bag_dir, "get_position_at", timestamp=start + 5)["x"] == 5.0
    assert len(young["samples"]) == 10
    # What a setting has deleted is no loss.
    status = reply_over(bag_dir, "memory_status")
    assert "deleted" not in status["doubts"]
    assert "20 messages deleted by retention (retention.topics): /speech (20)" in status["notes"]


def test_what_was_deleted_of_a_longer_time_than_asked_is_counted_with_that_time(
    bag_dir: Path,
) -> None:
    for nth in (1, 2):
        split(bag_dir, 0, name=f"rec_{nth}", first=nth * 10 * S)
    own_all(bag_dir)
    house(bag_dir).apply()
    start = T0 / S
    reply = reply_over(bag_dir, "get_topic_in_range", topic="/speech", start=start, end=start + 5)
    span = f"{start:.6f} to {start + 29:.6f} (29 s)"
    deleted = f"30 messages deleted by retention (retention.topics) from {span}: /speech (30)"
    assert deleted in reply["notes"]


def test_a_topic_of_which_all_messages_were_deleted_is_not_said_to_be_unrecorded(
    bag_dir: Path,
) -> None:
    last = T0 + 30 * HOUR
    write_mcap(bag_dir / "rec_B" / "rec_B_0.mcap", [odom(last + n * S, n, 1.0) for n in range(9)])
    own_all(bag_dir)
    house(bag_dir, topic_ages=(TopicAge("/speech", HOUR // 2),)).apply()
    for topic in ("/speech", "speech"):
        reply = reply_over(
            bag_dir, "find_last_match", topic=topic, condition_type="contains", value="word"
        )
        assert (reply["reason"], "was deleted" in reply["detail"]) == ("deleted", True)
    other = reply_over(bag_dir, "get_topic_at_time", topic="/never", timestamp=T0 / S)
    assert other["reason"] == "topic_not_recorded"


def test_messages_that_count_in_another_recording_go_too(bag_dir: Path) -> None:
    bag = split(bag_dir, 2, first=5 * S + 1)
    until = T0 + 2 * HOUR + 5 * S
    hidden = Overlap(None, None, (bag.name,))
    write_handover(bag.parent, Handover(next="rec_B", counts_until=until, end=hidden))
    counting = {one.topic for one in BagDirReader(McapReader()).summarize(bag).topics}
    assert "/speech" in counts_of(bag).keys() - counting
    house(bag_dir).apply()
    assert "/speech" not in counts_of(bag)
    assert counts_of(bag)["/odom"] == 100


def test_a_message_that_two_recordings_have_is_counted_once(bag_dir: Path) -> None:
    bags = [split(bag_dir, 2, name=name) for name in ("rec_B", "rec_C")]
    cut = T0 + 2 * HOUR + 5 * S
    until, begun = (Overlap(None, None, (bag.name,)) for bag in bags)
    write_handover(bags[0].parent, Handover(next="rec_C", counts_until=cut, end=until))
    write_handover(bags[1].parent, Handover(previous="rec_B", counts_from=cut, begin=begun))
    own_all(bag_dir)
    house(bag_dir).apply()
    assert [loss.lost for loss in read_losses(bag_dir, T0 + 2 * HOUR, MAX_NS)] == [5, 5]
    assert not {"/speech"}.intersection(*map(counts_of, bags))


def test_latched_topics_moments_and_foreign_bags_stay(bag_dir: Path, tmp_path: Path) -> None:
    saved = bag_dir / "rec_A" / "rec_A_0.mcap"
    moment = bag_dir / "moments" / "kept"
    moment.mkdir(parents=True)
    (moment / saved.name).hardlink_to(saved)
    foreign = split(bag_dir, 2, name="theirs")
    before = {path: path.read_bytes() for path in (saved, foreign)}
    house(bag_dir, topic_ages=(TopicAge("*", 24 * HOUR),)).apply()
    assert {path: path.read_bytes() for path in before} == before
    assert counts_of(bag_dir / "rec_A" / "rec_A_1.mcap") == {"/tf_static": 1}


@pytest.mark.parametrize(
    "why",
    [{"is_quiet": False}, {"free": 1100}, {"is_synchronised": lambda: False}, {}],
    ids=["busy", "the disk is short", "the clock may be wrong", "messages are forgotten"],
)
def test_nothing_is_cut_while(bag_dir: Path, why: dict[str, Any]) -> None:
    if not why:
        (bag_dir / ERASING_FILE).write_text("{}")
    house(bag_dir, **why).apply()
    assert counts_of(bag_dir / "rec_A" / "rec_A_0.mcap")["/speech"] == 10
    assert not (bag_dir / EXPIRED_FILE).exists()


def test_what_was_not_cut_since_the_disk_fails_is_not_said_to_be_deleted(bag_dir: Path) -> None:
    expired = bag_dir / EXPIRED_FILE
    with broken(durable_write, "flush", errno.EIO, where=lambda _: expired.exists()):
        house(bag_dir).apply()
    assert counts_of(bag_dir / "rec_A" / "rec_A_0.mcap")["/speech"] == 10
    assert "deleted by" not in str(reply_over(bag_dir, "memory_status"))


def test_a_machine_that_is_never_quiet_is_waited_for_an_hour(bag_dir: Path) -> None:
    now_s = [0.0]
    keeper = house(bag_dir, is_quiet=False, monotonic=lambda: now_s[0])
    bag = bag_dir / "rec_A" / "rec_A_0.mcap"
    with capture_logs() as logs:
        for now_s[0] in (0.0, PATIENCE_S - 1):
            keeper.apply()
            assert counts_of(bag)["/speech"] == 10
    assert len(events(logs, "topics_wait")) == 1
    now_s[0] = PATIENCE_S
    keeper.apply()
    assert "/speech" not in counts_of(bag)


def test_a_pass_ends_after_its_time_and_the_next_goes_on(bag_dir: Path) -> None:
    ticks = iter([0.0, 0.0, 0.5, 1.5, 1.5])
    house(bag_dir, monotonic=ticks.__next__).apply()
    left = [counts_of(bag_dir / "rec_A" / f"rec_A_{hour}.mcap") for hour in (0, 1)]
    assert ["/speech" in counts for counts in left] == [False, True]
    house(bag_dir).apply()
    assert "/speech" not in counts_of(bag_dir / "rec_A" / "rec_A_1.mcap")


def test_metadata_is_correct_where_the_disk_cannot_be_measured_after_a_cut(bag_dir: Path) -> None:
    assert correct(bag_dir / "rec_A", McapReader())
    measured = iter([lambda: 10**15])
    house(bag_dir, measure=lambda _: next(measured, failing())()).apply()
    left = [counts_of(bag_dir / "rec_A" / f"rec_A_{hour}.mcap") for hour in (0, 1)]
    assert ["/speech" in counts for counts in left] == [False, True]
    assert not correct(bag_dir / "rec_A", McapReader())


@patch.object(McapWriter, "cut", failing())
def test_a_bag_that_cannot_be_cut_is_told_once_and_claims_nothing(bag_dir: Path) -> None:
    keeper = house(bag_dir)
    with capture_logs() as logs:
        keeper.apply()
        keeper.apply()
    failed = [log["path"] for log in events(logs, "topics_not_cut")]
    assert failed == [str(bag_dir / "rec_A" / f"rec_A_{hour}.mcap") for hour in (0, 1)]
    assert lost(bag_dir) == []


def test_what_a_kill_interrupted_is_counted_once(bag_dir: Path) -> None:
    with killed_at(McapWriter, "cut"):
        house(bag_dir).apply()
    assert lost(bag_dir) == [10]
    house(bag_dir).apply()
    assert lost(bag_dir) == [10, 10]
    assert not [*bag_dir.glob("rec_A/.*")]


def test_a_bag_that_another_program_rewrites_is_left_to_it(bag_dir: Path) -> None:
    bag = bag_dir / "rec_A" / "rec_A_0.mcap"
    with bag.open("rb") as held, capture_logs() as logs:
        fcntl.flock(held, fcntl.LOCK_EX)
        house(bag_dir).apply()
    [told] = events(logs, "topics_not_cut")
    assert "another program rewrites it" in told["reason"]
    assert counts_of(bag)["/speech"] == 10


@pytest.fixture
def shipped(bag_dir: Path) -> Path:
    """The first of these bags, of which there is a receipt."""
    path = bag_dir / "rec_A" / "rec_A_0.mcap"
    size = path.stat().st_size
    append_receipts(bag_dir, [Receipt("rec_A/rec_A_0.mcap", "id", size, "00", "lake", 1)])
    return path


def lost(bag_dir: Path) -> list[int]:
    return [loss.lost for loss in read_losses(bag_dir, MIN_NS, MAX_NS)]


def is_shipped(path: Path) -> bool:
    bag = ("rec_A/rec_A_0.mcap", path.stat().st_size)
    return not unshipped(path.parents[1], [bag])


def test_bags_wait_until_they_are_shipped_and_count_as_shipped_afterwards(
    bag_dir: Path, shipped: Path
) -> None:
    old = [shipped, shipped.with_name("rec_A_1.mcap")]
    house(bag_dir, require_shipped=True).apply()
    assert ["/speech" in counts_of(path) for path in old] == [False, True]
    assert is_shipped(shipped)


@pytest.mark.parametrize("step", ["receipt", "new name"])
def test_a_bag_whose_cut_fails_at_its_end_stays_whole_and_shipped(
    bag_dir: Path, shipped: Path, step: str
) -> None:

    owner, name = (SHIPPED, "append") if step == "receipt" else (repair, "replace_file")
    with broken(owner, name):
        house(bag_dir, require_shipped=True).apply()
    assert counts_of(shipped)["/speech"] == 10
    assert is_shipped(shipped)
    assert lost(bag_dir) == []
    house(bag_dir, require_shipped=True).apply()
    assert "/speech" not in counts_of(shipped)
    assert is_shipped(shipped)


def test_what_went_stays_written_down_where_the_folder_cannot_be_flushed_afterwards(
    bag_dir: Path, shipped: Path
) -> None:
    with broken(repair, "flush", errno.EIO):
        house(bag_dir, require_shipped=True).apply()
    assert "/speech" not in counts_of(shipped)
    assert lost(bag_dir) == [10]
    assert is_shipped(shipped)
