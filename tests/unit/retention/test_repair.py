import errno
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from mcap.records import McapRecord

from ros2_memory.cli.maintenance.recover import recover_files
from ros2_memory.core.errors import BagError, BagVanishedError
from ros2_memory.retention import repair
from ros2_memory.retention.repair import Repairer
from ros2_memory.storage.mcap.salvage import Salvage
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, along_x, write_mcap
from tests.support.fakes import broken, files_limited_to
from tests.support.housekeepers import files_in
from tests.unit.storage.mcap.test_writer import contents

S = 10**9
T0 = 1_790_000_000 * S
MESSAGES = along_x(T0, 10, mps=1.0, hz=20)


REPAIRER = Repairer(McapReader(), McapWriter())


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A bag that was left open."""
    layout = McapLayout(chunk_size=4000, finish=False)
    return write_mcap(tmp_path / "a_0.mcap", MESSAGES, layout)


def test_a_bag_that_was_left_open_is_closed_with_its_name_rights_and_time(path: Path) -> None:
    path.chmod(0o640)
    os.utime(path, ns=(T0, T0 + 1))
    before, size = contents(path), path.stat().st_size
    path.with_name(".a_0.mcap.repair").write_bytes(b"half of it, of an earlier attempt")
    repaired = REPAIRER.repair(path)
    assert repaired is not None
    assert repaired.rewritten is not None
    assert repaired.rewritten.messages == len(before)
    status = path.stat()
    assert (repaired.was_bytes, repaired.is_bytes) == (size, status.st_size)
    assert (status.st_mode & 0o777, status.st_mtime_ns) == (0o640, T0 + 1)
    assert McapReader().is_finished(path)
    assert contents(path) == before
    assert files_in(path.parent) == ["a_0.mcap"]
    assert REPAIRER.repair(path) is None


def test_on_a_full_disk_the_original_stays_and_the_next_attempt_repairs_it(path: Path) -> None:
    before = path.read_bytes()
    with files_limited_to(1000), pytest.raises(BagError, match="cannot be written: File too large"):
        REPAIRER.repair(path)
    assert path.read_bytes() == before
    assert files_in(path.parent) == ["a_0.mcap"]
    assert REPAIRER.repair(path) is not None


@pytest.mark.parametrize("is_empty", [False, True])
def test_what_was_done_is_said_where_the_folder_cannot_be_flushed(
    path: Path, *, is_empty: bool
) -> None:
    if is_empty:
        path.write_bytes(b"")
    with broken(repair, "flush", errno.EIO):
        outcome = recover_files(path, force=True)
    assert (outcome.removed, outcome.repaired, outcome.failed) == (is_empty, not is_empty, 0)
    assert path.exists() is not is_empty
    assert "a_0.mcap was changed, and a power cut may undo that: Input/output" in outcome.lines[0]


def write_on(path: Path) -> None:
    with path.open("ab") as stream:
        stream.write(b"\0")


def spoil_what_was_written(path: Path) -> None:
    """Changes a byte of it, as a failing disk does."""
    with path.with_name(".a_0.mcap.repair").open("r+b") as stream:
        if stream.seek(0, os.SEEK_END) > 500:
            stream.seek(400)
            stream.write(b"\xff\xff\xff")


@pytest.mark.parametrize(
    ("act", "told", "left"),
    [
        (write_on, "written to meanwhile", ["a_0.mcap"]),
        (partial(Path.unlink, missing_ok=True), "a_0.mcap", []),
        (spoil_what_was_written, "what was written is not", ["a_0.mcap"]),
    ],
    ids=["it grows", "it is deleted", "the disk spoils what is written"],
)
def test_a_file_stays_as_it_is_where_meanwhile(
    path: Path,
    monkeypatch: pytest.MonkeyPatch,
    act: Callable[[Path], None],
    told: str,
    left: list[str],
) -> None:
    before, records = path.read_bytes(), Salvage.records

    def acting(salvage: Salvage) -> Iterator[McapRecord]:
        for record in records(salvage):
            yield record
            act(path)

    monkeypatch.setattr(Salvage, "records", acting)
    with pytest.raises(BagError if left else BagVanishedError, match=told):
        REPAIRER.repair(path)
    assert files_in(path.parent) == left
    assert not left or path.read_bytes().startswith(before)


def test_links_are_not_followed(path: Path) -> None:
    before = path.read_bytes()
    (link := path.with_name("b_0.mcap")).symlink_to(path)
    with pytest.raises(BagError, match="not a regular file"):
        REPAIRER.repair(link)
    assert path.read_bytes() == before
