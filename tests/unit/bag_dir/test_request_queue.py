from __future__ import annotations

import json
import os
import stat
from typing import TYPE_CHECKING

import pytest
import structlog

from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bag_dir.request_queue import (
    MAX_AT_ONCE,
    STALE_NS,
    Outcome,
    PendingRequest,
    RequestQueue,
)

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0 = 1_795_150_800 * S
NUMBER = "0123456789abcdef" * 2


def asked(bag_dir: Path, label: str = "here", at: int = T0) -> PendingRequest:
    slot = PendingRequest(bag_dir, label, at - 30 * S, at, at)
    slot.post()
    return slot


def names(bag_dir: Path) -> list[str]:
    return sorted(path.name for path in (bag_dir / REQUESTS_FOLDER).iterdir())


def test_a_wish_is_taken_and_answered_and_nothing_is_left(tmp_path: Path) -> None:
    slot, mailbox = asked(tmp_path), RequestQueue(tmp_path)
    assert mailbox.has_requests()
    [wish] = mailbox.take(T0)
    assert wish == slot.request
    assert slot.outcome() is None
    outcome = Outcome("20261120T050000Z-here", 3, pending=True)
    mailbox.answer(wish, outcome)
    assert slot.outcome() == outcome
    slot.close()
    assert names(tmp_path) == []
    assert not mailbox.has_requests()


def test_a_refusal_is_an_answer(tmp_path: Path) -> None:
    slot, mailbox = asked(tmp_path), RequestQueue(tmp_path)
    [wish] = mailbox.take(T0)
    mailbox.answer(wish, Outcome(refused="there is no room"))
    assert slot.outcome() == Outcome(refused="there is no room")


def test_a_wish_can_be_withdrawn_until_it_is_taken(tmp_path: Path) -> None:
    first, second, mailbox = asked(tmp_path), asked(tmp_path), RequestQueue(tmp_path)
    assert first.withdraw()
    assert [wish.number for wish in mailbox.take(T0)] == [second.request.number]
    assert not second.withdraw()


def test_a_wish_that_was_taken_and_not_answered_is_taken_again(tmp_path: Path) -> None:
    slot = asked(tmp_path)
    assert [wish.number for wish in RequestQueue(tmp_path).take(T0)] == [slot.request.number]
    again = RequestQueue(tmp_path)
    assert again.has_requests()
    assert [wish.number for wish in again.take(T0 + S)] == [slot.request.number]


def test_a_wish_whose_server_died_is_forgotten(tmp_path: Path) -> None:
    asked(tmp_path)
    assert list(RequestQueue(tmp_path).take(T0 + STALE_NS + 1)) == []
    assert names(tmp_path) == []


def test_only_so_many_are_taken_at_once(tmp_path: Path) -> None:
    for _ in range(MAX_AT_ONCE + 2):
        asked(tmp_path)
    mailbox = RequestQueue(tmp_path)
    first = list(mailbox.take(T0))
    assert len(first) == MAX_AT_ONCE
    for wish in first:
        mailbox.answer(wish, Outcome(refused="no"))
    assert len(list(mailbox.take(T0))) == 2


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 4000,
        "x" * 5000,
        "{}",
        json.dumps({"format": 1, "request": "../../etc", "label": "x"}),
        json.dumps(
            {
                "format": 1,
                "request": "f" * 32,  # another's
                "label": "x",
                "start_ns": T0,
                "end_ns": T0,
                "requested_ns": T0,
            }
        ),
        json.dumps(
            {
                "format": 1,
                "request": NUMBER,
                "label": "two\nlines",
                "start_ns": T0,
                "end_ns": T0,
                "requested_ns": T0,
            }
        ),
    ],
)
def test_what_is_no_wish_is_told_and_dropped(tmp_path: Path, text: str) -> None:
    mailbox = RequestQueue(tmp_path)
    (tmp_path / REQUESTS_FOLDER).mkdir(parents=True)
    (tmp_path / REQUESTS_FOLDER / f"{NUMBER}.json").write_text(text)
    with structlog.testing.capture_logs() as captured:
        assert list(mailbox.take(T0)) == []
    assert [event["event"] for event in captured] == ["request_ignored"]
    assert names(tmp_path) == []


def test_what_cannot_be_dropped_is_told_once_and_holds_nobody_up(tmp_path: Path) -> None:
    folder = tmp_path / REQUESTS_FOLDER
    (folder / f"{NUMBER}.json").mkdir(parents=True)
    (folder / f"{'a' * 32}.json").symlink_to("/etc/hostname")
    os.mkfifo(folder / f"{'b' * 32}.json")
    slot, mailbox = asked(tmp_path), RequestQueue(tmp_path)
    with structlog.testing.capture_logs() as captured:
        [wish] = mailbox.take(T0)
        mailbox.answer(wish, Outcome(refused="no"))
    assert [event["event"] for event in captured] == ["request_ignored"] * 3
    assert slot.outcome() is not None
    assert not mailbox.has_requests()


def test_other_files_are_left_alone_and_counted(tmp_path: Path) -> None:
    slot = asked(tmp_path)
    (tmp_path / REQUESTS_FOLDER / "notes.txt").write_text("mine")
    mailbox = RequestQueue(tmp_path)
    with structlog.testing.capture_logs() as captured:
        for wish in mailbox.take(T0):
            mailbox.answer(wish, Outcome(refused="no"))
        assert list(mailbox.take(T0)) == []
    assert [(event["event"], event["files"]) for event in captured] == [("requests_foreign", 1)]
    slot.close()
    assert names(tmp_path) == ["notes.txt"]


def test_answers_that_nobody_fetched_are_swept_away(tmp_path: Path) -> None:
    asked(tmp_path)
    mailbox = RequestQueue(tmp_path)
    [wish] = mailbox.take(T0)
    mailbox.answer(wish, Outcome(refused="no"))
    path = tmp_path / REQUESTS_FOLDER / f"{wish.number}.answer"
    os.utime(path, ns=(T0, T0))
    assert list(mailbox.take(T0 + 500 * S)) == []
    assert path.exists()
    assert list(mailbox.take(T0 + 700 * S)) == []
    assert names(tmp_path) == []


def test_another_user_may_read_a_wish_and_its_answer(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        asked(tmp_path)
        mailbox = RequestQueue(tmp_path)
        [wish] = mailbox.take(T0)
        taken = tmp_path / REQUESTS_FOLDER / f"{wish.number}.taken"
        assert stat.S_IMODE(taken.stat().st_mode) == 0o644
        mailbox.answer(wish, Outcome(refused="no"))
        answer = taken.with_suffix(".answer")
        assert stat.S_IMODE(answer.stat().st_mode) == 0o644
    finally:
        os.umask(before)


def test_no_folder_is_made_where_the_bag_directory_is_away(tmp_path: Path) -> None:
    away = tmp_path / "away"
    RequestQueue(away).open()
    with pytest.raises(OSError, match=r"\.episodic"):
        asked(away)
    assert not away.exists()
    assert not RequestQueue(away).has_requests()


def test_an_answer_that_is_none_is_not_believed(tmp_path: Path) -> None:
    slot = asked(tmp_path)
    (tmp_path / REQUESTS_FOLDER / f"{slot.request.number}.answer").write_text("[]")
    assert slot.outcome() is None
