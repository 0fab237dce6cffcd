"""Files that are open for reads at any offset, in pieces or read at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.file_io import OpenFile

if TYPE_CHECKING:
    from pathlib import Path

CONTENT = bytes(range(256))


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
