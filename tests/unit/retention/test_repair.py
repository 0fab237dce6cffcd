import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.records import McapRecord

from ros2_memory.core.errors import BagError, BagVanishedError
from ros2_memory.retention.repair import Repairer
from ros2_memory.storage.base import Closing
from ros2_memory.storage.mcap.salvage import Salvage
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.fakes import files_limited_to
from tests.support.housekeepers import files_in
from tests.unit.storage.mcap.test_writer import contents

S = 10**9
T0 = 1_790_000_000 * S
MESSAGES = [odom(T0 + n * S // 20, n / 20, 0.0) for n in range(200)]


def repairer() -> Repairer:
    return Repairer(McapReader(), McapWriter())


def left_open(path: Path) -> Path:
    layout = McapLayout(chunk_size=4000, finish=False)
    return write_mcap(path, MESSAGES, layout)


def test_a_bag_that_was_left_open_is_closed_with_its_name_rights_and_time(tmp_path: Path) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    path.chmod(0o640)
    os.utime(path, ns=(T0, T0 + 1))
    before, size = contents(path), path.stat().st_size
    (tmp_path / ".a_0.mcap.repair").write_bytes(b"half of it, of an earlier attempt")
    repaired = repairer().repair(path)
    assert repaired is not None
    assert repaired.rewritten is not None
    assert repaired.rewritten.messages == len(before)
    status = path.stat()
    assert (repaired.was_bytes, repaired.is_bytes) == (size, status.st_size)
    assert (status.st_mode & 0o777, status.st_mtime_ns) == (0o640, T0 + 1)
    assert McapReader().closing(path) is Closing.CLOSED
    assert contents(path) == before
    assert files_in(tmp_path) == ["a_0.mcap"]
    assert repairer().repair(path) is None


def test_on_a_full_disk_the_original_stays_and_the_next_attempt_repairs_it(tmp_path: Path) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    before = path.read_bytes()
    with files_limited_to(1000), pytest.raises(BagError, match="cannot be written: File too large"):
        repairer().repair(path)
    assert path.read_bytes() == before
    assert files_in(tmp_path) == ["a_0.mcap"]
    assert repairer().repair(path) is not None


def amid_reading(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """Lets something happen after each record that a repair has read."""
    records = Salvage.records

    def acting(salvage: Salvage) -> Iterator[McapRecord]:
        for record in records(salvage):
            yield record
            act()

    monkeypatch.setattr(Salvage, "records", acting)


def test_a_file_that_grows_meanwhile_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    before = path.read_bytes()

    def write_on() -> None:
        with path.open("ab") as stream:
            stream.write(b"\0")

    amid_reading(monkeypatch, write_on)
    with pytest.raises(BagError, match="written to while it was being repaired"):
        repairer().repair(path)
    assert path.read_bytes().startswith(before)
    assert files_in(tmp_path) == ["a_0.mcap"]


def test_a_file_that_is_deleted_meanwhile_does_not_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    amid_reading(monkeypatch, lambda: path.unlink(missing_ok=True))
    with pytest.raises(BagVanishedError):
        repairer().repair(path)
    assert files_in(tmp_path) == []


def test_what_does_not_hold_what_was_readable_does_not_take_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    before = path.read_bytes()

    def spoil() -> None:
        """Changes a byte of what was written, as a failing disk does."""
        with (tmp_path / ".a_0.mcap.repair").open("r+b") as stream:
            if stream.seek(0, os.SEEK_END) > 500:
                stream.seek(400)
                stream.write(b"\xff\xff\xff")

    amid_reading(monkeypatch, spoil)
    with pytest.raises(BagError, match="what was written is not"):
        repairer().repair(path)
    assert path.read_bytes() == before
    assert files_in(tmp_path) == ["a_0.mcap"]


def test_links_are_not_followed(tmp_path: Path) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    before = path.read_bytes()
    (tmp_path / "b_0.mcap").symlink_to(path)
    with pytest.raises(BagError, match="not a regular file"):
        repairer().repair(tmp_path / "b_0.mcap")
    assert path.read_bytes() == before
