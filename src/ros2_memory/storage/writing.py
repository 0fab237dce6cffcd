"""The port for writing bag files. The docstrings are the contract.

Whatever goes wrong is a `BagError` about the file that was to be written, and nothing is left of
that file; `reason` says what was wrong.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.storage.base import ROS2_PROFILE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from ros2_memory.storage.base import Record


@dataclass(frozen=True, slots=True)
class Rewritten:
    """What became of a file that was cut short.

    `lost_bytes` are the bytes of it that made no whole record; how many messages never reached the
    disk nobody knows. `notes` are sentences on what was lost.
    """

    messages: int
    lost_bytes: int
    notes: tuple[str, ...] = ()


class BagWriter(ABC):
    """Writes closed, indexed bag files."""

    @abstractmethod
    def write(self, path: Path, records: Iterable[Record], *, profile: str = ROS2_PROFILE) -> None:
        """Writes a bag that holds these messages, in the order given, and nothing else.

        Payloads, both times, definitions and the metadata of channels stay as they are; ROS 2
        types are named `package/msg/Name`, as every reader knows them. `profile` is MCAP's. The bag
        is on the disk when this returns. There must be no file of that name.

        Raises:
            BagError: it cannot be written; or what `records` raises.
        """

    @abstractmethod
    def rewrite(
        self, source: Path, target: Path, progress: Callable[[int], None] | None = None
    ) -> Rewritten:
        """Writes all that can be read of a file that was cut short into one that is whole.

        Schemas, channels, metadata, attachments, both times and sequence numbers stay as they are,
        and so does the order; what makes no whole record is left out. The target was read back and
        compared with the source, and is on the disk, when this returns. There must be no file of
        its name; the source is only read. `progress` is told how many bytes of it were read.

        Raises:
            BagVanishedError: the source is not there.
            BagError: nothing of the source can be read, or the target cannot be written, or it
                does not hold what was readable.
        """
