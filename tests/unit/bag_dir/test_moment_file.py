"""Saved moments, and the requests for them."""

import errno
import json
import os
import re
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from ros2_memory.bag_dir import moment_file
from ros2_memory.bag_dir.layout import MOMENT_FILE, REQUESTS_FOLDER, bag_kind
from ros2_memory.bag_dir.moment_file import (
    MAX_AT_ONCE,
    STALE_NS,
    Outcome,
    PendingRequest,
    RequestQueue,
    SavedMoment,
    SaveRequest,
    fault_of_label,
    folder_name,
    make_moment_folder,
    read_saved_moment,
    stored_moments_in,
    write_saved_moment,
)
from tests.support.bags import set_mtime
from tests.support.fakes import broken

S = 10**9
T0 = 1_795_150_800 * S  # 2026-11-20T05:00:00Z
NUMBER = "0123456789abcdef" * 2


def request(label: str = "charger found", number: str = NUMBER) -> SaveRequest:
    return SaveRequest(number, label, T0 - 30 * S, T0, T0)


def test_a_label_is_what_can_be_seen_and_is_not_too_long() -> None:
    for label in ("a", "Küche, 2. Stock", "充電 /../ etc", "x" * 120, "it's 🙂"):
        assert fault_of_label(label) is None
    unseen = ("", "  ", "two\nlines", "tab\t", "nul\0", "\u202eedoc", "\ud800", "\u2028")
    for label in (*unseen, "x" * 121):
        assert fault_of_label(label)


def test_moments_of_one_label_and_second_have_folders_of_their_own(tmp_path: Path) -> None:
    names = [make_moment_folder(tmp_path, request()).name for _ in range(3)]
    assert names == [f"20261120T050000Z-charger-found{end}" for end in ("", "_2", "_3")]


@given(st.text(max_size=130))
def test_any_label_names_a_folder_that_is_safe(label: str) -> None:
    name = folder_name(request(label))
    assert re.fullmatch(r"20261120T050000Z-[a-z0-9]+(-[a-z0-9]+)*", name)
    assert bag_kind(name) is None
    assert len(name) < 64


@given(
    st.text(min_size=1, max_size=120).filter(lambda text: not fault_of_label(text)),
    st.booleans(),
    st.lists(st.text(st.characters(exclude_categories=["Cs"])), max_size=3),
)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory,
    label: str,
    pending: bool,
    missing: list[str],
) -> None:
    folder = tmp_path_factory.mktemp("moment")
    moment = SavedMoment(request(label), pending, tuple(missing))
    write_saved_moment(folder, moment)
    assert read_saved_moment(folder) == moment
    complete = json.loads((folder / MOMENT_FILE).read_text())["complete"]
    assert complete == (not pending and not missing)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "[" * 100_000,
        '{"format": 2}',
        '{"format": 1}',
        json.dumps({**request().to_json(), "end_ns": 4, "pending": False, "missing": []}),
    ],
)
def test_a_moment_whose_file_says_something_else_cannot_be_read(tmp_path: Path, text: str) -> None:
    folder = make_moment_folder(tmp_path, request())
    (folder / MOMENT_FILE).write_text(text)
    stored = stored_moments_in(tmp_path)
    assert ([*stored.readable], [*stored.unreadable]) == ([], [folder.name])


def asked(bag_dir: Path, label: str = "here", at: int = T0) -> PendingRequest:
    posted = PendingRequest(bag_dir, label, at - 30 * S, at, at)
    posted.post()
    return posted


def refuse_all(queue: RequestQueue) -> int:
    """Answers what is asked for; returns how much that is."""
    requests = [*queue.take(T0)]
    for request in requests:
        queue.answer(request.number, Outcome(refused="no"))
    return len(requests)


def names(bag_dir: Path) -> list[str]:
    return sorted(path.name for path in (bag_dir / REQUESTS_FOLDER).iterdir())


def test_requests_and_answers_that_nobody_waits_for_are_swept_away(tmp_path: Path) -> None:
    posted, queue = asked(tmp_path), RequestQueue(tmp_path)
    assert list(queue.take(T0 + STALE_NS + 1)) == []
    [name] = names(tmp_path)
    assert name == f"{posted.request.number}.answer"
    set_mtime(tmp_path / REQUESTS_FOLDER / name, T0)
    for after_s, left in ((500, [name]), (700, [])):
        assert list(queue.take(T0 + after_s * S)) == []
        assert names(tmp_path) == left


def test_only_so_many_are_taken_at_once(tmp_path: Path) -> None:
    for _ in range(MAX_AT_ONCE + 2):
        asked(tmp_path)
    queue = RequestQueue(tmp_path)
    assert [refuse_all(queue), refuse_all(queue)] == [MAX_AT_ONCE, 2]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 4000,
        "x" * 5000,
        "{}",
        json.dumps({"format": 1, "request": "../../etc", "label": "x"}),
        json.dumps(request(number="f" * 32).to_json()),  # another's
        json.dumps({**request().to_json(), "label": "two\nlines"}),
    ],
)
def test_what_is_no_request_is_told_and_dropped(tmp_path: Path, text: str) -> None:
    queue = RequestQueue(tmp_path)
    (tmp_path / REQUESTS_FOLDER).mkdir(parents=True)
    (tmp_path / REQUESTS_FOLDER / f"{NUMBER}.json").write_text(text)
    with capture_logs() as captured:
        assert list(queue.take(T0)) == []
    assert [event["event"] for event in captured] == ["request_ignored"]
    assert names(tmp_path) == [f"{NUMBER}.answer"]


def test_who_asked_is_told_that_the_disk_did_not_give_the_request(tmp_path: Path) -> None:
    posted, queue = asked(tmp_path), RequestQueue(tmp_path)
    with broken(moment_file, "_read_request", errno.EIO):
        assert list(queue.take(T0)) == []
    assert "Input/output error" in str(posted.outcome())
    posted.close()
    assert names(tmp_path) == []


def test_what_cannot_be_dropped_is_told_once_and_holds_nobody_up(tmp_path: Path) -> None:
    folder = tmp_path / REQUESTS_FOLDER
    (folder / f"{NUMBER}.json").mkdir(parents=True)
    (folder / f"{'a' * 32}.json").symlink_to("/etc/hostname")
    os.mkfifo(folder / f"{'b' * 32}.json")
    posted, queue = asked(tmp_path), RequestQueue(tmp_path)
    with capture_logs() as captured:
        assert refuse_all(queue) == 1
    assert [event["event"] for event in captured] == ["request_ignored"] * 3
    assert posted.outcome() is not None
    assert not queue.has_requests()


def test_requests_whose_place_is_taken_hold_nobody_up(tmp_path: Path) -> None:
    """A request is renamed when it is taken, and a folder already has each new name."""
    folder = tmp_path / REQUESTS_FOLDER
    for number in range(MAX_AT_ONCE):
        (folder / f"{number:032x}.taken").mkdir(parents=True)
        (folder / f"{number:032x}.json").write_text("{}")
    asked(tmp_path)
    queue = RequestQueue(tmp_path)
    with capture_logs() as captured:
        assert sum(refuse_all(queue) for _ in range(4)) == 1
    assert [event["event"] for event in captured] == ["request_ignored"] * (2 * MAX_AT_ONCE)
    assert not queue.has_requests()


def test_another_user_may_read_a_request_and_its_answer(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        asked(tmp_path)
        refuse_all(RequestQueue(tmp_path))
    finally:
        os.umask(before)
    files = [*(tmp_path / REQUESTS_FOLDER).iterdir()]
    assert [stat.S_IMODE(path.stat().st_mode) for path in files] == [0o644] * len(files)
