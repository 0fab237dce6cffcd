from __future__ import annotations

import json
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import anyio
import pytest
from mcap.writer import Writer

from ros2_memory.analysis.silences import LONGEST_OFF_NS
from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.bag_dir.state_files import (
    SCREENED,
    Excluded,
    Loss,
    ScreenState,
    append_losses,
)
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.insights.status import memory_status
from ros2_memory.results import SilentTopic
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.serving.health import Health
from ros2_memory.tools.replies import Replies
from tests.support.bags import (
    McapLayout,
    Msg,
    boolean,
    log_entry,
    odom,
    text,
    tf,
    transform,
    write_mcap,
)
from tests.support.clocks import SettableClock
from tests.support.log_lines import with_checks
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


S = 10**9
DAY = 86_400 * S
BEGIN = 1_784_000_000 * S


DRIVEN = [odom(BEGIN + t * S, 0.0, 0.0, 0.0) for t in range(50)]
FLAGS = [boolean(BEGIN + t * 60 * S, True) for t in range(61)]


def remembering(
    folder: Path,
    messages: Sequence[Msg] = DRIVEN,
    *,
    seconds: float = 60,
    kept: RetentionLimits | None = None,
) -> Memory:
    write_mcap(folder / "bag.mcap", sorted(messages, key=lambda each: each.log_time))
    clock = SettableClock(BEGIN + round(seconds * S))
    return memory_of(folder, clock=clock, limits=QuerySettings(kept=kept))


def beating(folder: Path, state: RecorderState, at: float, **more: Any) -> None:
    beat = Heartbeat(
        pid=1,
        updated=BEGIN + round(at * S),
        state=state,
        recordings=(),
        since=BEGIN,
        bytes_written=0,
        subscribed=("/a", "/b"),
        silent=("/b",),
        last_error=None,
        interval_s=2.0,
    )
    write_heartbeat(folder, replace(beat, **more))


def shown(memory: Memory, folder: Path) -> dict[str, Any]:
    reply: dict[str, Any] = json.loads(
        Replies(folder, 24_000).answer(memory_status(memory, Call())).text
    )
    return reply


def test_a_memory_that_records_well_is_to_be_trusted(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beating(tmp_path, RecorderState.RECORDING, 59)
    told = shown(memory, tmp_path)
    assert told["doubts"] == "no loss or fault was found"
    assert (told["recorder"], told["recorder_alive"]) == ("recording", True)
    assert told["newest_age_s"] == 11.0
    assert told["never_heard"] == ["/b"]
    assert (told["restarts"], told["missing"]) == (0, [])
    assert told["fell_silent"] == []


def test_the_recorders_own_topics_do_not_make_old_data_new(tmp_path: Path) -> None:
    """The robot died at 10 s, and the recorder logs each split that it opens."""
    driven = [odom(BEGIN + t * S, 0.0, 0.0, 0.0) for t in range(11)]
    splits = [log_entry(BEGIN + t * S, 20, "rosbag2_recorder", "opened") for t in range(0, 60, 10)]
    memory = remembering(tmp_path, [*driven, *splits])
    assert shown(memory, tmp_path)["newest_age_s"] == 10.0  # of whoever recorded this
    beating(tmp_path, RecorderState.RECORDING, 59)
    told = shown(memory, tmp_path)
    assert (told["recorder_alive"], told["newest_age_s"]) == (True, 50.0)
    assert f"no message since {BEGIN // S + 10}.000000 but on topics that the" in told["doubts"]
    ahead = BEGIN + 365 * 86_400 * S
    write_mcap(tmp_path / "rec" / "ahead.mcap", [odom(ahead, 0.0, 0.0, 0.0)])
    assert shown(memory, tmp_path)["newest_age_s"] == 50.0


def test_where_another_program_records_the_status_says_so(tmp_path: Path) -> None:
    finished = shown(remembering(tmp_path, [text(BEGIN, "x")]), tmp_path)
    assert finished["recorder"] is None
    bag = tmp_path / "rec" / "rec_0.mcap"
    write_mcap(bag, [text(BEGIN + each * S, "x") for each in range(50)])
    written = bag.read_bytes()
    clock = SettableClock(BEGIN + 60 * S)
    memory = memory_of(tmp_path, clock=clock)
    for second, end in ((59, 600), (62, 300)):
        bag.write_bytes(written[:-end])
        os.utime(bag, (BEGIN // S + second, BEGIN // S + second))
        clock.at = BEGIN + (second + 1) * S
        status = shown(memory, tmp_path)
        # A file without an end that nobody was seen to write to may be left of a crash.
        expected = "another recorder" if second == 62 else None
        assert status["recorder"] == expected
        assert not status["recorder_alive"]
    beating(tmp_path, RecorderState.RECORDING, 59.0)
    status = shown(memory_of(tmp_path, clock=SettableClock(BEGIN + 60 * S)), tmp_path)
    assert status["recorder"] == "recording"


def test_what_was_lost_is_in_the_status_and_a_memory_that_lost_some_is_not_whole(
    tmp_path: Path,
) -> None:
    memory = remembering(tmp_path)
    beating(tmp_path, RecorderState.RECORDING, 59, lost={"/odom": 7})
    append_losses(
        tmp_path,
        [
            Loss("/odom", BEGIN + 10 * S, BEGIN + 11 * S, 4, "stamps"),
            Loss("/odom", BEGIN + 20 * S, BEGIN + 21 * S, 3, "counter"),
        ],
    )
    told = shown(memory, tmp_path)
    assert told["lost_last_hour"] == {"/odom": 7}
    assert told["doubts"] == (
        "3 messages lost before they were recorded: /odom (3); 4 messages missing by the cadence "
        "of header stamps (never published, or lost): /odom (4)"
    )


def test_what_a_publisher_sent_that_did_not_fit_is_said_to_be_missing(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    spans = [(BEGIN + 10 * S, BEGIN + 11 * S + 1), (BEGIN + 13 * S, BEGIN + 14 * S + 1)]
    append_losses(tmp_path, [Loss("/odom", *span, 0, "refused") for span in spans])
    sentence = (
        f"messages of a publisher of /odom were not recorded from {BEGIN // S + 10}.000000 to "
        f"{BEGIN // S + 14}.000000 (4 s), as its QoS or type did not fit the subscription: "
        "how many is not known"
    )
    assert shown(memory, tmp_path)["doubts"] == sentence


def test_what_an_unexpected_end_cost_is_in_the_status_with_the_gap(tmp_path: Path) -> None:
    for name, seconds in (("a", range(20)), ("b", range(37, 50)), ("c", range(60, 70))):
        (tmp_path / name).mkdir()
        messages = [odom(BEGIN + t * S // 2, 0.0, 0.0, 0.0) for t in seconds]
        write_mcap(tmp_path / name / f"{name}_0.mcap", messages)
    memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 36 * S))
    beating(tmp_path, RecorderState.RECORDING, 35)
    assert shown(memory, tmp_path)["doubts"] == "no loss or fault was found"
    append_losses(tmp_path, [Loss("*", BEGIN + 9 * S, BEGIN + 24 * S, 0, "hung")])
    assert shown(memory, tmp_path)["doubts"] == (
        f"nothing was recorded from {BEGIN // S + 9}.500000 to {BEGIN // S + 18}.500000 (9 s), "
        "because ros2 bag record hung"
    )


def test_a_window_has_what_is_missing_in_it_and_a_comparison_says_in_which(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    append_losses(
        tmp_path,
        [
            Loss("/odom", BEGIN + 10 * S, BEGIN + 11 * S, 1, "counter"),
            Loss("/odom", BEGIN + 30 * S, BEGIN + 31 * S, 6, "counter"),
        ],
    )
    begin = BEGIN / S
    for start, lost in ((0, 1), (12, 0), (25, 6)):
        window = {"start": begin + start, "end": begin + start + 15}
        found = asked(memory, tmp_path, "get_topic_in_range", topic="/odom", **window)
        notes = [note for note in found.get("notes", ()) if "lost" in note]
        assert [int(note[0]) for note in notes] == [lost] * bool(lost)
    asks = {"start": begin, "end": begin + 20, "with_start": begin + 21, "with_end": begin + 45}
    notes = asked(memory, tmp_path, "compare", **asks)["notes"]
    assert "from start to end: 1 message lost before it was recorded: /odom (1)" in notes
    assert (
        "from with_start to with_end: 6 messages lost before they were recorded: /odom (6)" in notes
    )


def test_age_that_is_held_is_reported_while_the_recorder_lives(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beating(tmp_path, RecorderState.RECORDING, 59, age_held="72 bags stay")
    told = shown(memory, tmp_path)
    assert told["notes"] == ["72 bags stay"]
    assert told["doubts"] == "no loss or fault was found"
    beating(tmp_path, RecorderState.RECORDING, 59, unshipped="2 bags were deleted unshipped")
    assert shown(memory, tmp_path)["notes"] == ["2 bags were deleted unshipped"]
    beating(tmp_path, RecorderState.STOPPED, -100, age_held="72 bags stay")
    assert "notes" not in shown(memory, tmp_path)


def test_splits_that_are_held_back_and_stretches_that_were_excluded(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beating(tmp_path, RecorderState.RECORDING, 59, held_back="1 split is not served")
    SCREENED.write(tmp_path, ScreenState(excluded=[Excluded(0, 10**9)]))
    told = shown(memory, tmp_path)
    assert told["doubts"] == "1 split is not served"
    [note] = told["notes"]
    assert note.startswith("excluded by the rules of recording.exclude_when")
    assert note.endswith(": 0.000000 to 1.000000")


@pytest.mark.parametrize(("now", "told"), [("wall", ("died", False)), ("latest", (None, None))])
def test_a_heartbeat_that_was_copied_with_bags_to_replay_is_no_recorder_of_them(
    now: Literal["wall", "latest"], told: tuple[str | None, bool | None], tmp_path: Path
) -> None:
    memory = remembering(tmp_path, seconds=1e6)
    memory = replace(memory, limits=replace(memory.limits, now=now))
    beating(tmp_path, RecorderState.RECORDING, 1)
    reply = shown(memory, tmp_path)
    assert (reply["recorder"], reply["recorder_alive"]) == told
    assert ("the recorder died" in reply["doubts"]) == (now == "wall")


def test_a_recorder_that_is_started_beside_a_server_of_bags_to_replay_is_shown(
    tmp_path: Path,
) -> None:
    memory = remembering(tmp_path, seconds=60)
    memory = replace(memory, limits=QuerySettings(now="latest"))
    assert shown(memory, tmp_path)["recorder"] is None
    beating(tmp_path, RecorderState.RECORDING, 59)
    reply = shown(memory, tmp_path)
    assert (reply["recorder"], reply["recorder_alive"]) == ("recording", True)
    health = anyio.run(Health(memory, "1"))
    assert health["recorder"]["live"] is True  # type: ignore[index,call-overload]


def test_restarts_and_topics_that_nobody_offers_are_reported(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    missing = tuple(f"/gone_{n:02}" for n in range(30))
    beating(tmp_path, RecorderState.RECORDING, 59, restarts=3, missing=missing)
    told = shown(memory, tmp_path)
    assert told["restarts"] == 3
    assert told["missing"] == [*missing[: len(told["missing"])]]
    assert told["missing_count"] == 30


@pytest.mark.parametrize(
    ("state", "at", "more", "doubts"),
    [
        (RecorderState.RECORDING, -100, {}, "the recorder died"),
        (RecorderState.PAUSED, 59, {}, "the recorder is paused: it gives no reason"),
        (RecorderState.WAITING, 59, {"waiting_for": "no clock"}, "the recorder waits: no clock"),
        (RecorderState.STOPPED, 59, {}, "no loss or fault was found"),
    ],
)
def test_a_recorder_that_does_not_record_is_reported(
    tmp_path: Path, state: RecorderState, at: float, more: dict[str, str], doubts: str
) -> None:
    memory = remembering(tmp_path)
    beating(tmp_path, state, at, **more)
    assert shown(memory, tmp_path)["doubts"] == doubts


def test_a_topic_that_was_heard_often_and_then_no_more_fell_silent(tmp_path: Path) -> None:
    messages = [
        *(odom(BEGIN + t * S, 0.0, 0.0, 0.0) for t in range(100)),
        *(boolean(BEGIN + t * S, True) for t in range(80)),  # a second apart, silent for 20
        *(text(BEGIN + t * S, "hi") for t in range(0, 90, 15)),  # 15 apart, silent for 24
        tf(BEGIN, transform(BEGIN, "a", "b", (0, 0, 0)), topic="/tf_static"),
    ]
    answer = memory_status(remembering(tmp_path, messages), Call())
    assert answer.fell_silent == (SilentTopic("/bumper", BEGIN + 79 * S),)


def test_how_often_a_topic_comes_leaves_out_when_the_robot_was_off(tmp_path: Path) -> None:
    days = [BEGIN + day * 86_400 * S for day in range(3)]
    messages = [odom(day + t * S, 0.0, 0.0) for day in days for t in range(600)]
    heard = [boolean(day + t * S, True) for day in days for t in range(550)]
    memory = remembering(tmp_path, [*messages, *heard[:-10]])
    fallen = SilentTopic("/bumper", days[2] + 539 * S)
    assert memory_status(memory, Call()).fell_silent == (fallen,)


@pytest.mark.parametrize(("docked_s", "fell"), [(190, []), (260, ["/odom"])])
def test_what_a_docked_robot_does_not_say_did_not_fall_silent(
    tmp_path: Path, docked_s: int, fell: list[str]
) -> None:
    """It drives for 100 s and is docked for 200 s, again and again; then for as long, or longer."""
    for nth in range(40 + docked_s // 10):
        seconds = range(10 * nth, 10 * nth + 10)
        messages = [boolean(BEGIN + t * S, True) for t in seconds]
        if nth < 40:
            messages += [odom(BEGIN + t * S, 0.0, 0.0, 0.0) for t in seconds if t % 300 < 100]
        write_mcap(tmp_path / "a" / f"a_{nth}.mcap", messages)
    answer = memory_status(memory_of(tmp_path), Call())
    assert [each.topic for each in answer.fell_silent] == fell


@pytest.mark.parametrize(("later", "fell"), [(0, ["/bumper"]), (S, [])])
def test_what_was_recorded_before_a_long_gap_did_not_fall_silent(
    tmp_path: Path, later: int, fell: list[str]
) -> None:
    """That may be the recording of another robot."""
    bumps = [boolean(BEGIN + t * S, True) for t in range(80)]
    write_mcap(tmp_path / "a" / "a_0.mcap", bumps)
    again = bumps[-1].log_time + LONGEST_OFF_NS + later
    poses = [odom(again + t * S, 0.0, 0.0, 0.0) for t in range(80)]
    write_mcap(tmp_path / "b" / "b_0.mcap", poses)
    answer = memory_status(memory_of(tmp_path), Call())
    assert [each.topic for each in answer.fell_silent] == fell


def test_damaged_files_are_counted_and_reported(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no bag at all, whatever its name says")
    told = shown(remembering(tmp_path, seconds=9e6), tmp_path)
    assert told["damaged"] == 1
    assert "1 damaged bag file" in told["doubts"]


def test_an_empty_memory_has_a_status_too(tmp_path: Path) -> None:
    told = shown(memory_of(tmp_path), tmp_path)
    assert (told["earliest"], told["latest"], told["newest_age_s"]) == (None, None, None)
    assert told["recorder"] is None
    assert told["budget"] == {
        "used_gb": 0.0,
        "max_gb": None,
        "foreign_gb": None,
        "growth_gb_per_day": None,
    }


def test_what_a_live_recorder_counts_is_what_the_budget_has(tmp_path: Path) -> None:
    memory = remembering(tmp_path, kept=RetentionLimits(10**6, 7 * DAY))
    beating(tmp_path, RecorderState.RECORDING, 59, counted_bytes=4_900_000, state_bytes=4_700_000)
    budget = shown(memory, tmp_path)["budget"]
    assert (budget["used_gb"], budget["state_gb"]) == (0.0049, 0.0047)
    beating(tmp_path, RecorderState.RECORDING, 59, counted_bytes=200_000, state_bytes=50_000)
    budget = shown(memory, tmp_path)["budget"]
    assert (budget["used_gb"], budget["state_gb"]) == (0.0002, 0.00005)


def test_some_messages_at_once_show_no_growth(tmp_path: Path) -> None:
    kept = RetentionLimits(10**9, 7 * DAY)
    memory = remembering(tmp_path, [boolean(BEGIN + t, True) for t in range(2)], kept=kept)
    beating(tmp_path, RecorderState.RECORDING, 1)
    answer = memory_status(memory, Call())
    assert answer.budget.used > 0
    assert answer.budget.per_day is None


def test_the_budget_says_when_it_is_full_and_how_far_back_it_will_reach(tmp_path: Path) -> None:
    memory = remembering(tmp_path, FLAGS)
    size = (tmp_path / "bag.mcap").stat().st_size
    beating(tmp_path, RecorderState.RECORDING, 59)
    beside = (tmp_path / "recorder.json").stat().st_size
    budget = RetentionLimits(max_total_bytes=size * 49 + beside, max_age_ns=7 * DAY)
    memory = replace(memory, limits=replace(memory.limits, kept=budget))
    answer = memory_status(memory, Call())
    assert (answer.budget.used, answer.budget.state) == (size + beside, beside)
    assert answer.budget.per_day == size * 24  # all within an hour
    told = shown(memory, tmp_path)["budget"]
    assert told["full_in_days"] == 2.0
    assert told["keeps_days"] == 2.05
    older = replace(memory.limits, kept=replace(budget, max_age_ns=DAY))
    assert shown(replace(memory, limits=older), tmp_path)["budget"]["keeps_days"] == 1.0


SOUND = "no loss or fault was found"


@pytest.mark.parametrize(
    ("state", "at"),
    [
        (None, 0),
        (RecorderState.RECORDING, 0),
        (RecorderState.STOPPED, 59),
        (RecorderState.PAUSED, 59),
    ],
)
def test_no_growth_is_predicted_of_bags_that_nobody_writes(
    tmp_path: Path, state: RecorderState | None, at: float
) -> None:
    memory = remembering(tmp_path, FLAGS, kept=RetentionLimits(10**9, 7 * DAY))
    if state is not None:
        beating(tmp_path, state, at)
    told = shown(memory, tmp_path)["budget"]
    assert (told["max_gb"], told["growth_gb_per_day"]) == (1.0, None)
    assert "full_in_days" not in told
    assert "keeps_days" not in told


@pytest.mark.parametrize("fills", [False, True])
def test_a_part_of_a_bag_that_cannot_be_read_is_named_once_something_met_it(
    tmp_path: Path, fills: bool
) -> None:
    driven = [odom(BEGIN + t * S // 10, t / 20, 0.0) for t in range(100)]
    bag = write_mcap(tmp_path / "rec" / "rec_0.mcap", driven, McapLayout(chunk_size=3000))
    spoil_chunk(bag, 3)
    memory = memory_of(tmp_path, clock=SettableClock(BEGIN + 60 * S))
    if fills:
        memory = with_store(memory, tmp_path)
    else:
        assert shown(memory, tmp_path)["doubts"] == SOUND
        asked(memory, tmp_path, "trajectory_summary", start=BEGIN / S, end=BEGIN / S + 10)
    assert shown(memory, tmp_path)["doubts"].startswith("1 bag could not be read whole; data_time")
    [note] = asked(memory, tmp_path, "data_time_range")["notes"]
    assert note.startswith("rec/rec_0.mcap: damaged: ")
    write_mcap(bag, driven)
    memory.index.refresh()
    assert shown(memory, tmp_path)["doubts"] == SOUND


class TestWhatIsMissingIsNamedAndCounted:
    def doubts(self, folder: Path, storage: str = "mcap") -> str:
        doubts = shown(memory_of(folder, storage=storage), folder)["doubts"]
        assert isinstance(doubts, str)
        return doubts

    def recording(self, folder: Path, *listed: tuple[str, int]) -> None:
        """Two splits of five messages each, and a metadata.yaml that lists those given."""
        for split in range(2):
            messages = [odom(BEGIN + (10 * split + t) * S, 0.0, 0.0) for t in range(5)]
            write_mcap(folder / f"rec_{split}.mcap", messages)
        names = "".join(f"  - {name}\n" for name, _ in listed)
        files = "".join(f"  - path: {name}\n    message_count: {n}\n" for name, n in listed)
        (folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 9\n"
            f"  message_count: {sum(n for _, n in listed)}\n"
            f"  relative_file_paths:\n{names}  files:\n{files}"
        )

    def test_an_empty_folder(self, tmp_path: Path) -> None:
        assert self.doubts(tmp_path).startswith("no bag is here")

    def test_a_bag_that_a_crash_left_open(self, tmp_path: Path) -> None:
        path = write_mcap(tmp_path / "bag.mcap", [odom(BEGIN + t * S, 0.0, 0.0) for t in range(9)])
        path.write_bytes(path.read_bytes()[:-100])
        assert self.doubts(tmp_path).startswith("1 bag was left open by a crash")

    def test_a_file_that_may_be_being_written_or_left_by_a_crash(self, tmp_path: Path) -> None:
        messages = [odom(BEGIN + t * S, 0.0, 0.0) for t in range(9)]
        path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
        content = path.read_bytes()[:-100]
        path.write_bytes(content)
        clock = SettableClock(path.stat().st_mtime_ns + S)

        def doubts(memory: Memory) -> str:
            return str(shown(memory, tmp_path)["doubts"])

        memory, young = memory_of(tmp_path, clock=clock), "1 file has no end yet"
        assert young in doubts(memory)
        # Seen to grow, it is being written.
        path.write_bytes(content + b"x")
        assert young not in doubts(memory)
        # So is one that a live recorder names.
        assert young in doubts(memory_of(tmp_path, clock=clock))
        named = {"updated": clock.now(), "recordings": ("rec",)}
        beating(tmp_path, RecorderState.RECORDING, 0, **named)
        assert young not in doubts(memory_of(tmp_path, clock=clock))

    def test_files_that_are_not_read(self, tmp_path: Path) -> None:
        write_mcap(tmp_path / "bag.mcap", [odom(BEGIN, 0.0, 0.0)])
        for n in range(3):
            (tmp_path / f"old_{n}.db3").write_bytes(b"SQLite format 3\0")
        assert self.doubts(tmp_path) == "3 files are not read; data_time_range says why"

    def test_a_topic_that_cannot_be_decoded(self, tmp_path: Path) -> None:
        with (tmp_path / "bag.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("odd.Odd", "protobuf", b"")
            channel = writer.register_channel("/odd", "protobuf", schema)
            writer.add_message(channel, BEGIN, b"", BEGIN)
            writer.finish()
        assert self.doubts(tmp_path) == "1 topic cannot be decoded: /odd"

    @pytest.mark.parametrize(
        ("listed", "doubts"),
        [
            (
                [("rec_0.mcap", 5), *((f"rec_{n}.mcap", 20) for n in range(1, 14))],
                "lists 12 missing files and 255 messages that no file here contains",
            ),
            (
                [("rec_0.mcap", 5), ("rec_1.mcap", 255)],
                "metadata.yaml of rec lists 250 messages that no file here contains",
            ),
            ([("rec_0.mcap", 5), ("rec_1.mcap", 5)], SOUND),
            ([("rec_0.mcap.zstd", 5), ("rec/rec_1.mcap", 5)], SOUND),  # compressed by file
        ],
    )
    def test_splits_and_messages_that_metadata_lists(
        self, tmp_path: Path, listed: list[tuple[str, int]], doubts: str
    ) -> None:
        self.recording(tmp_path / "rec", *listed)
        assert self.doubts(tmp_path).endswith(doubts)

    def test_a_recording_of_which_metadata_alone_is_left(self, tmp_path: Path) -> None:
        self.recording(tmp_path / "rec", ("rec_0.mcap", 5), ("rec_1.mcap", 5))
        for each in (tmp_path / "rec").glob("*.mcap"):
            each.unlink()
        doubts = self.doubts(tmp_path)
        assert "lists 2 missing files and 10 messages" in doubts

    def test_metadata_that_cannot_be_read_is_not_compared_and_reported(
        self, tmp_path: Path
    ) -> None:
        self.recording(tmp_path / "rec", ("rec_0.mcap", 5))
        (tmp_path / "rec" / "metadata.yaml").write_text("")
        assert self.doubts(tmp_path).startswith("metadata.yaml of rec cannot be read")

    def test_the_oldest_splits_that_retention_deleted_are_not_missing(self, tmp_path: Path) -> None:
        listed = [(f"rec_{n}.mcap", 5) for n in range(-3, 3)]
        self.recording(tmp_path / "rec", *listed)
        assert "lists 4 missing files" in self.doubts(tmp_path)
        beating(tmp_path, RecorderState.STOPPED, 59)
        assert "lists 1 missing file and 5 messages" in self.doubts(tmp_path)

    def test_of_a_recording_that_is_not_its_own_retention_deletes_nothing(
        self, tmp_path: Path
    ) -> None:
        self.recording(tmp_path / "rec", *((f"rec_{n}.mcap", 5) for n in range(-3, 3)))
        beating(tmp_path, RecorderState.STOPPED, 59)
        own = tmp_path / ".episodic" / "recordings.jsonl"
        own.parent.mkdir()
        inode = (tmp_path / "rec").stat().st_ino
        own.write_text(with_checks('{"bag_dir_id": "5f0c"}'))
        assert "lists 4 missing files" in self.doubts(tmp_path)
        with own.open("a") as stream:
            stream.write(with_checks(json.dumps({"recording": "rec", "inode": inode})))
        assert "lists 1 missing file" in self.doubts(tmp_path)

    def test_nothing_behind_a_link_is_looked_at(self, tmp_path: Path) -> None:
        self.recording(tmp_path / "bags" / "rec", ("rec_0.mcap", 5), ("gone.mcap", 5))
        memory = memory_of(tmp_path / "bags")
        snapshot = memory.index.snapshot()
        (tmp_path / "bags" / "rec").rename(tmp_path / "outside")
        (tmp_path / "bags" / "rec").symlink_to(tmp_path / "outside")
        (absent,) = memory.absent_splits(snapshot)
        assert (absent.files, absent.unreadable) == ((), True)

    def test_splits_cut_by_a_handover_hold_fewer_than_listed(self, tmp_path: Path) -> None:
        self.recording(tmp_path / "rec", ("rec_0.mcap", 9), ("rec_1.mcap", 9))
        (tmp_path / "rec" / "handover.json").write_text("{}")
        assert self.doubts(tmp_path) == SOUND
