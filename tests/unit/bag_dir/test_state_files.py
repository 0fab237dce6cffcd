"""The files below `.episodic/`: what stands in them, and what no damage, kill or link does.

They are given as an installed robot has them on its disk, so their formats are tested, too.
"""

import errno
import fcntl
import os
import re
import stat
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias
from unittest.mock import Mock, call, patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir import durable_write, state_files
from ros2_memory.bag_dir.durable_write import flush_bags, locked
from ros2_memory.bag_dir.json_files import JsonDocument, JsonLog
from ros2_memory.bag_dir.own_recordings import LIST
from ros2_memory.bag_dir.state_files import (
    DELETED,
    ERASING,
    EXPIRED,
    FORGOTTEN,
    LOST,
    RECORDED,
    SCREENED,
    SHIPPED,
    SUPERSEDED,
    TRIGGERS,
    ConditionInterval,
    Erasure,
    Expired,
    Loss,
    Receipt,
    RecordingScreen,
    ScreenState,
    Superseded,
    append_losses,
    append_receipts,
    read_deleted,
    read_forgettings,
    read_losses,
    read_receipts,
    read_withheld,
    unshipped,
)
from ros2_memory.core.spans import united
from tests.support.examples import examples
from tests.support.fakes import broken
from tests.support.log_lines import with_checks

Log: TypeAlias = JsonLog[Any]
Document: TypeAlias = JsonDocument[Any]

FORGOTTEN_ROWS = [
    '{"start": 2, "stop": 3, "topics": ["/camera", "/odd]}"], "bags": []}',
    '{"start": 1, "stop": 9, "topics": [], "bags": [{"recording": "}", "file": "]}", "first": 4}]}',
]
ROWS: list[tuple[Log, str]] = [
    (RECORDED, '{"recording": "rec_A", "recorded_s": 3600.5, "clock_right": true}\n'),
    (LOST, '{"topic": "/odom", "start": -1, "stop": 9, "lost": 4, "by": "stamps"}\n'),
    (
        DELETED,
        r"""{"recording": "", "files": [], "spans": [[1, 5]]}
{"recording": "rec_\udcff", "files": ["a_0.mcap"], "spans": [[1, 5], [8, 9]]}
""",
    ),
    (
        SHIPPED,
        r"""{"bag": "\u00fc", "bag_id": "b", "size": 5, "sha256": "0", "lake": "l", "at": 7}
""",
    ),
    (FORGOTTEN, "".join(f"{row}\n" for row in FORGOTTEN_ROWS)),
    (
        LIST,
        r"""{"recording": "rec_A"}
{"recording": "rec_A", "inode": 7, "generation": 9}
{"recording": "old/run\udcff", "inode": 8, "adopted": true}
""",
    ),
]
LOGS = [(log, with_checks(text)) for log, text in ROWS]
# In one line each.
ERASURE = r"""{"format":1,"topics":["/a"],"windows":[[1,2]],"latched":["/\u00e4"],
"files":["f\udcff"],"counts":[{"topic":"/a","start":1,"stop":2,"count":3}]}"""
SCREEN = """{"format":1,"recordings":{"rec_A":{"done":false,"start":1,"end":null,
"files":{"a.mcap":"read"},"heard":{"home":[{"first":1,"last":2,"holds":null,"lasts":false}]},
"unclear":[[1,2]],"holding":{"home":{"left":1}}}},"excluded":[{"start":1,"stop":2,"held":true}],
"earlier":[[0,1]],"earlier_held":[[0,1]]}"""
RULES = r"""{"format":1,"rules":{"t\u00fcr":{"fired":1,"moments":2,"refused":3,"last_fired":null,
"problem":"\u00df","unstored":null,"never":null,"always_since":null,"begun":[1],"newest":[{"number":"00000000000000000000000000000000",
"start":1,"end":2,"matches":1,"known":false,"stored":false}],
"runs":{"/a":{"first":1,"last":2,"fired":false,"lasts":false}}}},"searched":{"\udcff":1},"before":"x",
"latched":{"/m":{"published":{"a":1},"begun":{"a":2},"payload":"ff"}},"unread":{"\udcff":"\u00df"}}"""
DOCUMENTS: list[tuple[Document, str]] = [
    (ERASING, ERASURE.replace("\n", "")),
    (SCREENED, SCREEN.replace("\n", "")),
    (TRIGGERS, RULES.replace("\n", "")),
]


def name_of(value: object) -> str:
    return Path(value.name).name if isinstance(value, JsonLog | JsonDocument) else ""


def laid(bag_dir: Path, file: Log | Document, content: str | bytes) -> Path:
    """Puts a file there, as it was written before."""
    path = bag_dir / file.name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(file: Log | Document, bag_dir: Path) -> Any:
    return file.rows(bag_dir) if isinstance(file, JsonLog) else file.read(bag_dir)


def replace(file: Log | Document, bag_dir: Path, value: Any) -> None:
    (file.replace if isinstance(file, JsonLog) else file.write)(bag_dir, value)


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of what is flushed from now on."""
    names: list[str] = []

    def fsync(descriptor: int) -> None:
        names.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    monkeypatch.setattr(os, "fsync", fsync)
    return names


@pytest.mark.parametrize(("file", "text"), [*LOGS, *DOCUMENTS], ids=name_of)
class TestEveryFile:
    def test_it_is_written_as_it_stands_on_robots(
        self, tmp_path: Path, file: Log | Document, text: str
    ) -> None:
        assert not read(file, tmp_path)
        path = laid(tmp_path, file, text)
        value = read(file, tmp_path)
        path.unlink()
        replace(file, tmp_path, value)
        assert path.read_text() == text

    def test_it_is_on_the_disk_before_it_gets_its_name_and_stands_where_the_disk_is_full(
        self, tmp_path: Path, flushed: list[str], file: Log | Document, text: str
    ) -> None:
        path = laid(tmp_path, file, text)
        value = read(file, tmp_path)
        replace(file, tmp_path, value)
        written = path.read_text()
        assert flushed == [f".{path.name}.tmp", ".episodic"]
        with broken(os, "fsync"):
            with pytest.raises(OSError, match="No space left"):
                replace(file, tmp_path, value)
            if isinstance(file, JsonLog):
                with pytest.raises(OSError, match="No space left"):
                    file.append(tmp_path, value * 9)
        assert path.read_text() == written
        assert [*path.parent.iterdir()] == [path]

    def test_nothing_is_read_or_written_behind_a_link_nor_read_of_what_is_no_file(
        self, tmp_path: Path, file: Log | Document, text: str
    ) -> None:
        elsewhere = laid(tmp_path, file, text)
        value = read(file, tmp_path)
        linked, within = tmp_path / "linked", tmp_path / "within"
        linked.mkdir()
        (linked / ".episodic").symlink_to(elsewhere.parent)
        (within / ".episodic").mkdir(parents=True)
        (within / file.name).symlink_to(elsewhere)
        ways = [partial(read, file, within), partial(replace, file, linked, value)]
        if isinstance(file, JsonLog):
            ways += [partial(file.append, bag_dir, value) for bag_dir in (linked, within)]
        for way in ways:
            with pytest.raises(OSError, match="symbolic link"):
                way()
        assert elsewhere.read_text() == text
        # What is no file at all is told at once, too.
        elsewhere.unlink()
        os.mkfifo(elsewhere)
        with pytest.raises(ValueError, match="not a regular file"):
            read(file, tmp_path)


@pytest.mark.parametrize(("log", "text"), LOGS, ids=name_of)
class TestLogs:
    def test_what_root_writes_belongs_to_the_owner_of_the_bag_directory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log: Log, text: str
    ) -> None:
        path = laid(tmp_path, log, text)
        rows, status_of, given = log.rows(tmp_path), Path.stat, Mock()

        def owned(at: Path, **how: bool) -> os.stat_result:
            status = status_of(at, **how)
            return status if at != tmp_path else os.stat_result((*status[:4], 71, 72, *status[6:]))

        monkeypatch.setattr(Path, "stat", owned)
        monkeypatch.setattr(os, "chown", given)
        log.append(tmp_path, rows)
        log.replace(tmp_path, rows)
        assert given.mock_calls == [call(path, 71, 72, follow_symlinks=False)] * 2

    def test_rows_are_appended_and_newer_ones_read_as_far_as_they_are_known_and_checked(
        self, tmp_path: Path, log: Log, text: str
    ) -> None:
        newer = re.sub(r', "crc32": "\w*"}', ', "mood": ["fine"]}', text)
        path = laid(tmp_path, log, with_checks(newer))
        rows = log.rows(tmp_path)
        path.unlink()
        sizes = [log.append(tmp_path, [row]) for row in rows]
        assert path.read_text() == text
        assert sizes[-1] == path.stat().st_size
        # Those without a check are not believed.
        laid(tmp_path, log, re.sub(r', "crc32": "\w*"', "", text) + text)
        assert log.rows(tmp_path) == rows

    def test_a_line_with_a_flipped_bit_or_that_a_crash_cut_costs_itself_alone(
        self, tmp_path: Path, log: Log, text: str
    ) -> None:
        row = text.splitlines()[-1].encode()
        laid(tmp_path, log, row)
        [right] = log.rows(tmp_path)
        for bit in range(0, 8 * len(row), 13):
            flipped = bytearray(row)
            flipped[bit // 8] ^= 1 << bit % 8
            laid(tmp_path, log, bytes(flipped) + b"\n" + row)
            assert {*map(str, log.rows(tmp_path))} == {str(right)}
        for length in range(1, len(row), 5):
            laid(tmp_path, log, row + b"\n" + row[:length])
            assert log.rows(tmp_path) == [right]
            log.append(tmp_path, [right])
            assert log.rows(tmp_path) == [right] * 2

    @settings(max_examples=examples(20), deadline=None)
    @given(junk=st.binary(max_size=99) | st.sampled_from([b"{", b"[" * 5000, b"[1]", b'{"by": 7}']))
    def test_lines_that_mean_nothing_are_named_and_spoil_no_other(
        self, tmp_path_factory: pytest.TempPathFactory, log: Log, text: str, junk: bytes
    ) -> None:
        bag_dir = tmp_path_factory.mktemp("bags")
        laid(bag_dir, log, b"%b\n%b\n" % (junk, text.splitlines()[-1].encode()))
        *before, last = log.lines(bag_dir)
        assert last.number == junk.count(b"\n") + 2
        assert last.row is not None
        assert log.rows(bag_dir)[-1] == last.row
        for line in before:
            assert (line.row is None) == (line.error is not None)
            assert line.text in junk

    def test_of_too_long_a_file_the_newest_rows_are_read(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log: Log, text: str
    ) -> None:
        laid(tmp_path, log, text * 50)
        rows = log.rows(tmp_path)
        monkeypatch.setattr(log, "most_bytes", 600)
        left_out, *found = log.lines(tmp_path)
        assert (left_out.number, left_out.row, len(found) > 1) == (0, None, True)
        assert "larger than 600 bytes" in str(left_out.error)
        assert [line.row for line in found] == rows[-len(found) :]


@pytest.mark.parametrize(("document", "text"), DOCUMENTS, ids=name_of)
class TestDocuments:
    @pytest.mark.parametrize(
        ("content", "told"),
        [
            ("", "Expecting value"),
            ('{"format":1,', "Expecting property name"),
            ("[" * 100_000, "nothing but brackets"),
            ("[]", "not a JSON object"),
            ("{}", "its format is None, and only 1 is known"),
            ('{"format": 2}', "its format is 2, and only 1 is known"),
            ('{"format": []}', "only 1 is known"),
            ('{"format": 1, "topics": 7, "rules": 7, "recordings": 7}', r"^\w+: "),
            (b"\xff", "utf-8"),
        ],
    )
    def test_a_damaged_or_newer_one_is_told(
        self, tmp_path: Path, document: Document, text: str, content: str | bytes, told: str
    ) -> None:
        laid(tmp_path, document, text)
        laid(tmp_path, document, content)
        with pytest.raises(ValueError, match=told):
            document.read(tmp_path)

    def test_the_other_program_may_read_it_whatever_the_umask(
        self, tmp_path: Path, document: Document, text: str
    ) -> None:
        path = laid(tmp_path, document, text)
        before = os.umask(0o077)
        try:
            document.write(tmp_path, document.read(tmp_path))
        finally:
            os.umask(before)
        assert stat.S_IMODE(path.stat().st_mode) == 0o644


T0 = 1_790_000_000 * 10**9
WEEK = [f"rec_20261120T{n // 60:06}Z/rec_20261120T{n // 60:06}Z_{n}.mcap" for n in range(60_000)]
FLICKER = [ConditionInterval(T0 + n, T0 + n, bool(n % 2)) for n in range(20_000)]


@pytest.mark.parametrize(
    ("document", "value"),
    [
        (ERASING, Erasure(("/camera",), ((T0, T0 + 1),), files=(*WEEK,))),
        (SUPERSEDED, Superseded({}, dict.fromkeys(WEEK, "memory/20261120.thinned.mcap"))),
        (SCREENED, ScreenState({"rec_A": RecordingScreen(heard={"privacy": FLICKER})})),
    ],
    ids=name_of,
)
def test_what_a_week_of_bags_or_a_condition_that_flickers_makes_is_read_back(
    tmp_path: Path, document: Document, value: object
) -> None:
    document.write(tmp_path, value)
    assert document.read(tmp_path) == value


def test_losses_are_those_of_a_window_and_the_oldest_are_dropped_but_for_what_was_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = [Loss("/chatter", n, n + 1, 5, "forgotten") for n in range(3)]
    others.append(Loss("/camera", 2000, 3000, 0, "refused"))
    losses = [Loss("/odom", n * 10, n * 10 + 5, 1, "stamps") for n in reversed(range(100))]
    append_losses(tmp_path, [*others, *losses])
    assert read_losses(tmp_path, 31, 50) == losses[95:97]
    monkeypatch.setattr(state_files, "MOST_LOST_BYTES", 6000)
    append_losses(tmp_path, losses[:1])
    found = read_losses(tmp_path, 0, 3000)
    assert [loss for loss in found if loss.by != "stamps"] == others
    assert {*losses[:10]} < {*found}
    assert len(found) < 60


@patch.object(state_files, "MOST_LOST_BYTES", 6000)
def test_a_publisher_that_is_refused_all_day_hides_nothing_older(tmp_path: Path) -> None:
    forgotten = Loss("/speech", 0, 1, 5, "forgotten")
    append_losses(tmp_path, [forgotten])
    for hour in range(24):
        spans = [(T0 + n * 10**10, T0 + (n + 1) * 10**10) for n in range(hour * 40, hour * 40 + 40)]
        append_losses(tmp_path, [Loss("/camera", *span, 0, "refused") for span in spans])
    losses = read_losses(tmp_path, 0, 2 * T0)
    assert [loss for loss in losses if loss.by != "refused"] == [forgotten]
    refused = ((loss.start, loss.stop) for loss in losses if loss.by == "refused")
    assert united(refused) == [(T0, spans[-1][1])]


@patch.object(state_files, "_MOST_EXPIRED", 20)
def test_all_that_expired_is_known_however_often_the_robot_was_off(tmp_path: Path) -> None:
    expired, hour = Expired(), 3600 * 10**9
    for n in range(50):
        loss = Loss("/camera", T0 + n * hour, T0 + n * hour + 10**9, 5, "expired")
        expired = expired.then(f"rec_A/rec_A_{n}.mcap", [loss])
    EXPIRED.write(tmp_path, expired)
    assert read_losses(tmp_path, T0, T0 + hour)
    everything = read_losses(tmp_path, 0, 2 * T0)
    assert (len(everything) <= 21, sum(loss.lost for loss in everything)) == (True, 250)


@patch.object(state_files, "MOST_LOST_BYTES", 100)
def test_rows_that_one_program_appends_while_another_shortens_the_file_stay(tmp_path: Path) -> None:
    losses = [Loss("/chatter", T0 + n, T0 + n + 1, 1, "forgotten") for n in range(80)]
    with ThreadPoolExecutor(2) as pool:
        [*pool.map(lambda loss: append_losses(tmp_path, [loss]), losses)]
    assert {*read_losses(tmp_path, 0, 2 * T0)} == {*losses}


def test_on_a_mount_without_locks_receipts_are_appended(tmp_path: Path) -> None:
    receipt = Receipt("rec/rec_0.mcap", "id", 1, "00", "lake", 1)
    with broken(fcntl, "flock", errno.ENOLCK):
        append_receipts(tmp_path, [receipt])
    with broken(fcntl, "flock", errno.EIO), pytest.raises(OSError, match="Input/output"):
        append_receipts(tmp_path, [receipt])
    assert read_receipts(tmp_path) == {receipt.bag: receipt}


def test_an_error_of_who_has_locked_a_file_is_passed_on(tmp_path: Path) -> None:
    """Opening another file may block, as one that a file server has leased."""
    with pytest.raises(BlockingIOError, match="leased"), locked(tmp_path / "x", os.O_CREAT):
        raise BlockingIOError("leased")


@patch.object(state_files, "_SPARE_RECEIPTS", 10)
def test_receipts_of_bags_that_are_gone_are_dropped_where_they_are_most(tmp_path: Path) -> None:
    (tmp_path / "here").touch()
    for number in range(8):
        given = [Receipt(name, "id", number, "00", "hub", 0) for name in (f"gone{number}", "here")]
        append_receipts(tmp_path, given)
    receipts = read_receipts(tmp_path)
    assert receipts["here"].size == 7
    assert "gone7" in receipts
    assert "gone0" not in receipts
    bags = [("here", 7), ("here", 6), ("new", 1)]
    assert unshipped(tmp_path, bags) == {"here", "new"}
    assert unshipped(tmp_path, bags[:1]) == frozenset()


def test_where_a_file_cannot_be_read_nothing_is_lost_or_shipped_and_all_is_held_back(
    tmp_path: Path,
) -> None:
    name = "rec_20261120T043000Z"
    assert not read_withheld(tmp_path).holds_some(name)
    for file in (LOST, DELETED, SHIPPED, SCREENED):
        (tmp_path / file.name).mkdir(parents=True)
    assert read_losses(tmp_path, 0, 9) == []
    assert read_deleted(tmp_path) == {}
    assert unshipped(tmp_path, [("a", 1)]) == {"a"}
    assert read_withheld(tmp_path).holds(name, "a.mcap")
    assert not read_withheld(tmp_path).holds("copied", "a.mcap")


def test_rows_that_were_not_appended_since_the_disk_fails_are_not_there_twice_then(
    tmp_path: Path,
) -> None:
    loss = Loss("/odom", 0, 9, 4, "stamps")
    with broken(durable_write, "flush", errno.EIO), pytest.raises(OSError, match="Input/output"):
        append_losses(tmp_path, [loss])
    assert read_losses(tmp_path, 0, 9) == []
    append_losses(tmp_path, [loss])
    assert read_losses(tmp_path, 0, 9) == [loss]


# The lake deletes by this file: no line of it may be passed over in silence.


def test_a_line_is_cut_or_an_error(tmp_path: Path) -> None:
    whole, last = with_checks("\n".join(FORGOTTEN_ROWS)).splitlines(keepends=True)
    laid(tmp_path, FORGOTTEN, whole + last + last)
    topics, _ = read_forgettings(tmp_path)
    for cut in (last[:length] for length in range(len(last) - 1)):
        laid(tmp_path, FORGOTTEN, whole + cut)
        if cut.endswith(("]}", '"}')):  # within a name that looks like the end of a line
            with pytest.raises(ValueError, match="line 2: it is damaged"):
                read_forgettings(tmp_path)
        else:
            assert read_forgettings(tmp_path) == [topics]


@pytest.mark.parametrize("at", [0, 1])
@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('{"start" 1, "stop": 2, "topics": [], "bags": []}', "it is damaged: "),
        ("[]", "it is not a JSON object"),
        ('{"start": "1", "stop": 2}', "start: "),
        ('{"start": 1, "stop": 2, "topics": ["/a"], "crc32": "00000000"}', "its check"),
        ('{"start": 1, "stop": 2, "topics": ["/a"]}', "its check"),
        (with_checks('{"start": 1, "stop": 2}').rstrip(), "it names no topics and no bags"),
    ],
)
def test_a_damaged_line_is_an_error_wherever_it_is(
    tmp_path: Path, at: int, line: str, told: str
) -> None:
    lines = with_checks("\n".join(FORGOTTEN_ROWS)).splitlines()
    lines[at] = line
    laid(tmp_path, FORGOTTEN, "".join(f"{each}\n" for each in lines))
    with pytest.raises(ValueError, match=f"line {at + 1}: {told}"):
        read_forgettings(tmp_path)


def test_closed_splits_are_flushed_and_then_their_directory_and_what_cannot_be_is_named(
    tmp_path: Path, flushed: list[str]
) -> None:
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert flush_bags(tmp_path, ["a.mcap", "b.mcap", "gone.mcap"]) == []
    assert flushed == ["a.mcap", "b.mcap", tmp_path.name]
    with broken(os, "fsync", errno.EIO):
        split, directory = flush_bags(tmp_path, ["a.mcap"])
    assert split.startswith(str(tmp_path / "a.mcap"))
    assert "power cut" in split
    assert directory.startswith(str(tmp_path))
