"""What the tests of the commands share."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from tests.support.program import exits

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["exits"]


def left(path: Path) -> Path:
    """Nobody has written to the file for an hour."""
    hour_ago = time.time() - 3600
    os.utime(path, (hour_ago, hour_ago))
    return path
