"""Whether there is a directory, also where the disk does not tell."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING, Any

import pytest

from ros2_memory.core.directories import is_folder

if TYPE_CHECKING:
    from pathlib import Path


def test_what_the_disk_does_not_tell_is_not_taken_for_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(path: Any, **_: Any) -> os.stat_result:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(os, "stat", failing)
    monkeypatch.setattr(os, "lstat", failing)
    with pytest.raises(OSError, match="Input/output error"):
        is_folder(tmp_path)
