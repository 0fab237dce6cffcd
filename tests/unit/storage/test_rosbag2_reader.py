import gc
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import zstandard

from ros2_memory.core.errors import BagContradictionError, BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from ros2_memory.storage.scratch import Scratch
from tests.support.bags import text, write_db3, write_mcap
from tests.support.mcap_surgery import chatter
from tests.support.memories import asked, memory_of
from tests.unit.storage.test_mcap_reader import read, times

EVERYTHING = TimeWindow.everything()
UNPACKING = """\
import sys
from pathlib import Path
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
reader = Rosbag2Reader()
reader.summarize(Path(sys.argv[1]))
print("unpacked", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def scratch_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary files of this test lie; garbage is looked for among its own objects alone."""
    gc.freeze()
    root = tmp_path / "temporary"
    root.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(root))
    return root


def change(path: Path, *statements: str) -> Path:
    with closing(sqlite3.connect(path)) as base:
        for statement in statements:
            base.execute(statement)
        base.commit()
    return path


def compressed(path: Path) -> Path:
    """Replaces a bag by its compressed file."""
    target = path.with_name(path.name + ".zstd")
    target.write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()
    return target


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@pytest.mark.parametrize("asked_first", ["newest", "records", "summarize"])
def test_an_index_that_is_declared_descending_and_stored_ascending_is_not_believed(
    tmp_path: Path, asked_first: str
) -> None:
    path = write_db3(tmp_path / "a.db3", [text(at, "x") for at in range(1000, 1400)])
    change(
        path,
        "PRAGMA writable_schema = 1",
        "UPDATE sqlite_master SET sql = replace(sql, 'ASC', 'DESC') WHERE type = 'index'",
    )
    upto, reader = TimeWindow(0, 1200), Rosbag2Reader()
    if asked_first == "newest":
        with pytest.raises(BagError, match="index by time is damaged"):
            next(reader.records(path, ["/chatter"], upto, newest_first=True), None)
    if asked_first == "records":
        with pytest.raises(BagContradictionError):
            read(reader, path)
    assert any("index by time is damaged" in note for note in reader.summarize(path).notes)
    for newest_first in (False, True):
        records = reader.records(path, ["/chatter"], upto, newest_first=newest_first)
        with pytest.raises(BagContradictionError):
            next(records)
        assert times([*records]) == sorted(range(1000, 1200), reverse=newest_first)


@pytest.mark.parametrize("time", [2**63 - 1, -(2**63), -7])
def test_a_time_that_no_clock_shows_is_left_out_and_reported(tmp_path: Path, time: int) -> None:
    path = write_db3(tmp_path / "a.db3", chatter(3))
    change(path, f"UPDATE messages SET timestamp = {time} WHERE id = 2")  # noqa: S608
    reader = Rosbag2Reader()
    summary = reader.summarize(path)
    assert summary.count == len(read(reader, path)) == 2
    assert summary.notes == ("left out: 1 message without a possible log time",)
    # Its distance to the others may not fit into 64 bits.
    memory = memory_of(tmp_path, storage="rosbag2")
    reply = asked(memory, "data_time_range")
    assert (reply["bags"], reply["gaps"], reply["earliest"]) == (1, [], 0)


def test_what_is_in_the_wal_is_read_and_the_folder_left_as_it_was(tmp_path: Path) -> None:
    """Of a recorder that writes ahead, as with rosbag2's `resilient` preset, and goes on."""
    live, left = write_db3(tmp_path / "bags" / "live.db3", chatter(2)), tmp_path / "left"
    insert, reader = "INSERT INTO messages VALUES (NULL,1,?,x'00')", Rosbag2Reader()
    with closing(sqlite3.connect(live)) as base:
        base.execute("PRAGMA journal_mode=WAL").fetchall()
        base.execute("PRAGMA wal_autocheckpoint=0").fetchall()
        base.execute(insert, (5,))
        base.commit()
        shutil.copytree(live.parent, left, ignore=shutil.ignore_patterns("*-shm"))
        before = {file: file.read_bytes() for file in left.iterdir()}
        assert len(before) == 2
        path = left / live.name
        summary = reader.summarize(path)
        assert times(read(reader, path)) == times(read(reader, live)) == [0, 1, 5]
        assert (summary.count, summary.complete) == (3, False)
        assert summary.notes[0].startswith("its writer did not finish it")
        assert {file: file.read_bytes() for file in left.iterdir()} == before
        # One that grows is read anew.
        base.execute(insert, (9,))
        base.commit()
        assert times(read(reader, live)) == [0, 1, 5, 9]


def test_a_transaction_that_was_cut_off_is_rolled_back(tmp_path: Path) -> None:
    path, killed = write_db3(tmp_path / "live" / "a.db3", chatter(2)), tmp_path / "killed"
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        base.execute("PRAGMA cache_size=1").fetchall()
        base.execute("BEGIN")
        rows = [(time, b"\0" * 4000) for time in range(100, 300)]
        base.executemany("INSERT INTO messages(topic_id,timestamp,data) VALUES (1,?,?)", rows)
        shutil.copytree(path.parent, killed)
    assert (killed / "a.db3-journal").stat().st_size
    reader = Rosbag2Reader()
    assert not reader.is_finished(killed / "a.db3")
    assert times(read(reader, killed / "a.db3")) == [0, 1]


def test_a_file_of_several_frames_is_read_whole(tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "a.mcap", chatter(50)).read_bytes()
    frames = map(zstandard.compress, (data[:900], data[900:1500], data[1500:]))
    skippable = b"\x50\x2a\x4d\x18\x04\x00\x00\x00note"
    path, reader = tmp_path / "a.mcap.zstd", Rosbag2Reader()
    path.write_bytes(b"".join((skippable, *frames)))
    assert reader.is_finished(path)
    assert times(read(reader, path)) == list(range(50))
    assert reader.summarize(path).complete


def test_a_compressed_file_is_closed_only_at_the_very_end_of_its_frames(tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "a.mcap", chatter(3)).read_bytes()
    first, second = map(zstandard.compress, (data[:300], data[300:]))
    path, reader, closed = tmp_path / "cut.mcap.zstd", Rosbag2Reader(), []
    for size in range(len(first + second) + 1):
        path.write_bytes((first + second)[:size])
        if reader.is_finished(path):
            closed.append(size)
    # A cut between two whole frames cannot be told from a file that ends there.
    assert closed == [len(first), len(first + second)]


def test_decompressed_files_stay_within_their_bound_and_none_in_use_is_deleted_for_it(
    tmp_path: Path, scratch_root: Path
) -> None:
    paths = [
        compressed(write_mcap(tmp_path / f"{n}.mcap", [text(1, "0" * size)]))
        for n, size in enumerate((400_000, 400_000, 400_000, 700_000))
    ]
    reader = Rosbag2Reader(unpack_max_mb=1)
    for path in (*paths, *paths):
        assert len(read(reader, path)) == 1
        assert 400_000 < size_of(scratch_root) <= 1 << 20
    held = reader.records(paths[-1], ["/chatter"], EVERYTHING)
    next(held)
    with pytest.raises(BagError, match=r"more than the 1 MiB allowed .* raise unpack_max_mb"):
        reader.summarize(paths[0])
    assert list(held) == []
    assert reader.summarize(paths[0]).count == 1


def test_a_reading_may_end_while_its_thread_unpacks_another_file() -> None:
    """As where garbage is collected meanwhile: a lock that no thread takes twice would hang."""
    scratch = Scratch(1 << 20)

    def fill(folder: Path, _reserve: Callable[[int], None]) -> tuple[Path, str]:
        held.close()
        return folder, ""

    def two_files() -> None:
        with held, scratch.use("other", fill) as (folder, _):
            assert folder.is_dir()

    held = ExitStack()
    held.enter_context(scratch.use("one", lambda folder, _reserve: (folder, "")))
    thread = threading.Thread(target=two_files, daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive()


def test_what_a_killed_program_had_unpacked_is_deleted_by_the_next(
    tmp_path: Path, scratch_root: Path
) -> None:
    path = compressed(write_db3(tmp_path / "a.db3", chatter(3)))
    program = [sys.executable, "-c", UNPACKING, str(path)]
    env = os.environ | {"TMPDIR": str(scratch_root)}
    pipe = subprocess.PIPE

    def unpacked(program: subprocess.Popen[bytes], *others: Path) -> Path:
        assert program.stdout is not None
        assert program.stdout.readline() == b"unpacked\n"
        (folder,) = {*scratch_root.iterdir()} - {*others}
        an_hour_ago = time.time() - 3600
        os.utime(folder, (an_hour_ago, an_hour_ago))
        return folder

    with subprocess.Popen(program, stdin=pipe, stdout=pipe, env=env) as killed:
        abandoned = unpacked(killed)
        killed.kill()
    with subprocess.Popen(program, stdin=pipe, stdout=pipe, env=env) as living:
        in_use = unpacked(living, abandoned)
        reader = Rosbag2Reader()
        reader.summarize(path)
        assert not abandoned.exists()
        assert size_of(in_use) > 0
        living.communicate()
    del reader
    gc.collect()
    assert [*scratch_root.iterdir()] == []


def test_the_bag_of_2018_has_no_format_column_short_type_names_and_no_index(tmp_path: Path) -> None:
    hello = text(0, "hello").payload.hex()
    path = change(
        tmp_path / "old.db3",
        "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL)",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,"
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)",
        "INSERT INTO topics VALUES (1, '/chatter', 'std_msgs/String')",
        *(
            f"INSERT INTO messages VALUES (NULL, 1, {at}, x'{hello}')"  # noqa: S608
            for at in (3, 1, 2, 1)
        ),
    )
    reader = Rosbag2Reader()
    (topic,) = reader.summarize(path).topics
    found = (topic.type, topic.encoding, topic.count, topic.latched)
    assert found == ("std_msgs/msg/String", "cdr", 4, False)
    records = read(reader, path)
    assert times(records) == [1, 1, 2, 3]
    assert getattr(reader.decode(records[0]), "data", "") == "hello"


@pytest.mark.parametrize("zeros", [0, 500, 20_000])
def test_of_a_file_that_is_damaged_further_on_the_first_messages_are_read(
    tmp_path: Path, zeros: int
) -> None:
    path = write_db3(tmp_path / "run_0.db3", [text(time, "x" * 200) for time in range(2000)])
    data = bytearray(path.read_bytes())
    at = len(data) * 4 // 5 // 4096 * 4096  # where a page ends
    data[at - zeros :] = bytes(zeros) + data[at:] if zeros else b""
    path.write_bytes(data)
    reader = Rosbag2Reader()
    summary = reader.summarize(path)
    assert 1000 < summary.count < 2000
    assert not summary.complete
    [note] = summary.schema.notes
    assert note == f"damaged: only its first {summary.count} messages can be read"
    for newest_first in (False, True):
        records = reader.records(path, ["/chatter"], EVERYTHING, newest_first=newest_first)
        found = [record.log_time for record in records]
        assert found == sorted(range(summary.count), reverse=newest_first)
