"""What a planner is answered when it asks to save a moment, and for those that are saved."""

import errno
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import MOMENT_FILE, MOMENTS_FOLDER, REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import (
    PendingRequest,
    SavedMoment,
    SaveRequest,
    make_moment_folder,
    write_saved_moment,
)
from ros2_memory.bag_dir.state_files import TRIGGERS, RuleRecord, TriggerState
from ros2_memory.core.errors import RefusedError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.insights import saved_moments
from ros2_memory.insights.saved_moments import (
    list_moments,
    remember_moment,
    show_moment,
)
from ros2_memory.results import RememberedMoment
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.tools.replies import Replies, as_json
from tests.support.bags import odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.fakes import broken
from tests.support.heartbeats import beat
from tests.support.housekeepers import keeper_of, recorder_at_work
from tests.support.memories import asked, memory_of

S = 10**9
T0 = 1_790_000_000 * S
NOW = T0 + 60 * S


@pytest.fixture(autouse=True)
def _much_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine does not fail a test."""
    monkeypatch.setattr(saved_moments, "ANSWER_TIMEOUT_S", 60.0)


def remembering(bag_dir: Path) -> Memory:
    for n in range(6):
        times = [T0 + (n * 10 + second) * S for second in range(10)]
        write_mcap(bag_dir / f"rec/rec_{n}.mcap", [odom(at, 1.0, 2.0) for at in times])
    limits = QuerySettings(kept=RetentionLimits(10**12, 10**18))
    return memory_of(bag_dir, clock=SettableClock(NOW), limits=limits)


def remember(memory: Memory, call: Call | None = None) -> RememberedMoment:
    return remember_moment(
        memory, call or Call(), "charger found", seconds_before=30, seconds_after=0
    )


def refusal(memory: Memory, call: Call | None = None) -> str:
    with pytest.raises(RefusedError) as caught:
        remember(memory, call)
    return str(caught.value)


def shown(memory: Memory) -> Any:
    return as_json(list_moments(memory, Call()), memory.index.bag_dir)


def requests(bag_dir: Path) -> list[Path]:
    folder = bag_dir / REQUESTS_FOLDER
    return list(folder.iterdir()) if folder.exists() else []


def test_a_moment_is_kept_by_the_recorder_and_then_listed(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beat(tmp_path, NOW)
    with recorder_at_work(tmp_path, SettableClock(NOW)):
        told = remember(memory)
    assert (told.label, told.start, told.end) == ("charger found", T0 + 30 * S, NOW)
    assert (told.bags, told.pending) == (3, True)  # its end is just now
    assert requests(tmp_path) == []
    [moment] = shown(memory)["moments"]
    size = sum((tmp_path / f"rec/rec_{n}.mcap").stat().st_size for n in (3, 4, 5))
    assert (moment["size_gb"], moment["complete"]) == (round(size / 1e9, 6), False)
    reply = json.loads(Replies(tmp_path, 24_000).answer(told).text)
    assert reply == {
        key: moment[key] for key in ("moment", "label", "start", "end", "bags", "pending")
    }


def test_what_the_recorder_refuses_is_reported_with_its_reason(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beat(tmp_path, NOW)
    (tmp_path / MOMENTS_FOLDER).symlink_to(tmp_path)
    with recorder_at_work(tmp_path, SettableClock(NOW)):
        assert "symbolic link" in refusal(memory)
    reply = Replies(tmp_path, 24_000).error(RefusedError("there is no room"))
    assert json.loads(reply.text) == {"error": "refused", "detail": "there is no room"}
    assert reply.is_error


@pytest.mark.parametrize(
    ("state", "at"),
    [(RecorderState.RECORDING, NOW - 60 * S), (RecorderState.STOPPED, NOW)],
)
def test_a_recorder_that_does_not_run_is_not_asked(
    tmp_path: Path, state: RecorderState, at: int
) -> None:
    memory = remembering(tmp_path)
    assert "start ros2-memory-recorder" in refusal(memory)
    beat(tmp_path, at, state)
    assert "start ros2-memory-recorder" in refusal(memory)
    assert requests(tmp_path) == []


@pytest.mark.parametrize(("patience_s", "left_s"), [(0.0, 60.0), (60.0, -1.0)])
def test_a_recorder_that_does_not_answer_is_waited_for_no_longer_than_the_call_lasts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patience_s: float, left_s: float
) -> None:
    memory = remembering(tmp_path)
    beat(tmp_path, NOW)
    monkeypatch.setattr(saved_moments, "ANSWER_TIMEOUT_S", patience_s)
    assert "did not answer" in refusal(memory, Call(Deadline.after(left_s)))
    assert requests(tmp_path) == []


def test_a_request_that_was_begun_just_in_time_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = remembering(tmp_path)
    beat(tmp_path, NOW)
    house = keeper_of(tmp_path, clock=SettableClock(NOW))
    withdraw = PendingRequest.withdraw

    def too_late(slot: PendingRequest) -> bool:
        house.keep_moments()
        return withdraw(slot)

    monkeypatch.setattr(saved_moments, "ANSWER_TIMEOUT_S", 0.0)
    monkeypatch.setattr(PendingRequest, "withdraw", too_late)
    assert remember(memory).bags == 3


def test_a_server_that_may_not_write_there_says_where(tmp_path: Path) -> None:
    memory = remembering(tmp_path)
    beat(tmp_path, NOW)
    (tmp_path / ".episodic").write_text("in the way")
    assert ".episodic/requests" in refusal(memory)


def keep(bag_dir: Path, number: int, **more: Any) -> None:
    end = T0 + number * S
    wish = SaveRequest(f"{number:032x}", f"number {number}", end - S, end, NOW)
    write_saved_moment(make_moment_folder(bag_dir, wish), replace(SavedMoment(wish), **more))


def test_rules_are_told_with_how_often_they_fired_and_what_of_a_moment_is_not_kept(
    tmp_path: Path,
) -> None:
    (tmp_path / ".episodic").mkdir()
    bumper = RuleRecord(fired=3, moments=1, refused=2, last_fired=NOW - 5 * S, problem="full")
    TRIGGERS.write(tmp_path, TriggerState({"door": RuleRecord(), "bumper": bumper}))
    missing = ("the share was used up",)
    keep(tmp_path, 1, pending=False, rule="bumper", matches=3, missing=missing)
    memory = memory_of(tmp_path, clock=SettableClock(NOW))
    told = shown(memory)
    [kept] = told["moments"]
    assert (kept["rule"], kept["matches"]) == ("bumper", 3)
    assert (kept["complete"], kept["notes"]) == (False, [*missing])
    assert told["rules"] == [
        {
            "rule": "bumper",
            "fired": 3,
            "moments": 1,
            "last_ts": (NOW - 5 * S) / S,
            "last_ago_s": 5.0,
            "refused": 2,
            "problem": "full",
        },
        {"rule": "door", "fired": 0, "moments": 0},
    ]
    assert asked(memory, "memory_status")["rules"] == told["rules"]


def test_what_keeps_moments_from_being_listed_is_said_and_its_file_named(tmp_path: Path) -> None:
    memory = memory_of(tmp_path)
    with broken(saved_moments, "stored_moments_in", errno.EACCES):
        status = asked(memory, "memory_status")
        with pytest.raises(RefusedError, match="Permission denied"):
            list_moments(memory, Call())
    assert "moments" not in status
    assert "the moments cannot be listed: Permission denied" in str(status["notes"])
    said = r"be allowed to read \.episodic/triggers\.json of"
    with broken(type(TRIGGERS), "read", errno.EACCES), pytest.raises(RefusedError, match=said):
        list_moments(memory, Call())


def test_a_moment_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    keep(tmp_path, 1)
    keep(tmp_path, 2)
    damaged, whole = sorted((tmp_path / MOMENTS_FOLDER).iterdir())
    (damaged / MOMENT_FILE).write_text("{")
    (tmp_path / MOMENTS_FOLDER / "no moment").mkdir()
    memory = memory_of(tmp_path)
    listed = shown(memory)
    assert [moment["moment"] for moment in listed["moments"]] == [whole.name]
    [note] = listed["notes"]
    assert f"1 folder in moments/ without a readable moment.json: {damaged.name} (Exp" in note
    assert note in asked(memory, "memory_status")["notes"]
    with pytest.raises(RefusedError, match=r"^its moment\.json cannot be read: Expecting"):
        show_moment(memory, Call(), damaged.name)


def test_a_file_in_the_place_of_the_folder_holds_no_moment(tmp_path: Path) -> None:
    (tmp_path / MOMENTS_FOLDER).write_text("no folder")
    assert shown(memory_of(tmp_path)) == {"moments": []}
