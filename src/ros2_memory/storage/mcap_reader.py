"""The adapter `mcap`: single `.mcap` files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.core.model import MCAP
from ros2_memory.storage.file_reader import FileReader

if TYPE_CHECKING:
    from pathlib import Path


class McapReader(FileReader):
    """Reads `.mcap` files alone, with or without metadata.yaml beside them."""

    def reads(self, path: Path) -> bool:
        """Returns whether the name ends with `.mcap`."""
        return path.suffix == MCAP
