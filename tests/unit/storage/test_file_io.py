"""Files that are open for reads at any offset, in pieces or read at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.file_io import OpenFile

if TYPE_CHECKING:
    from pathlib import Path

CONTENT = bytes(range(256))


@pytest.mark.parametrize("at_once", [False, True])
def test_a_file_has_the_same_bytes_in_pieces_and_at_once(tmp_path: Path, *, at_once: bool) -> None:
    path = tmp_path / "a"
    path.write_bytes(CONTENT)
    with OpenFile(path, at_once=at_once) as file:
        assert file.read(3, 5) == CONTENT[3:8]
        assert file.read(256, 0) == b""
        assert file.read_each([0, 250], 10) == [CONTENT[:10], CONTENT[250:]]
        for offset, length in ((250, 7), (-1, 1), (0, -1)):
            with pytest.raises(UnreadableError, match="bytes past its end"):
                file.read(offset, length)


def test_a_file_that_is_read_at_once_can_become_shorter_meanwhile(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(CONTENT)
    with OpenFile(path, at_once=True) as file:
        path.write_bytes(CONTENT[:10])
        assert file.read(0, 256) == CONTENT
    with OpenFile(path) as file:
        path.write_bytes(b"")
        with pytest.raises(UnreadableError, match="became shorter"):
            file.read(0, 10)
