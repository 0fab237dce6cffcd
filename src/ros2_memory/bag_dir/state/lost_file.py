"""`.episodic/lost.jsonl`: messages that were published and are in no bag, as far as is known.

The recorder appends a line for each hole that it finds in a topic, and for each end of a recording
that it did not ask for; `ros2-memory forget` one for each hole that it makes into the middle of
bags. The query server reads them, for the notes of answers. Lines of other versions, and a last
line that a crash cut short, are ignored.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from pydantic import TypeAdapter

from ros2_memory.bag_dir.durable_write import append_durably, open_plain, write_durably
from ros2_memory.bag_dir.json_fields import Count, Int64, json_object, validated
from ros2_memory.bag_dir.layout import LOST_FILE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

MOST_BYTES: Final = 1 << 20
"""A longer file loses its older half."""
EVERY_TOPIC: Final = "*"
"""Stands for the topics of a recording that ended unexpectedly."""
INTERRUPTIONS: Final = MappingProxyType(
    {
        "died": "ros2 bag record died",
        "hung": "ros2 bag record hung",
        "unclean": "the recorder ended without a shutdown",
    }
)
"""How a recording may end unexpectedly, and the words for it."""
Interruption: TypeAlias = Literal["died", "hung", "unclean"]
"""A key of `INTERRUPTIONS`."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Messages of a topic that are missing between two log times.

    `by` is what shows it: a counter in the messages, the cadence of their header stamps (then they
    may never have been published either), or rosbag2's own count; or they were deleted by request.
    The unexpected end of a recording is of `EVERY_TOPIC`, from when it last grew to when that was
    noticed, with a key of `INTERRUPTIONS`. How many messages it cost is not known, and `lost` 0.
    """

    topic: str
    start: Int64
    stop: Int64
    lost: Count
    by: Literal["counter", "stamps", "rosbag2", "forgotten", "died", "hung", "unclean"]

    @property
    def interrupts(self) -> bool:
        """Whether this is the unexpected end of a recording."""
        return self.by in INTERRUPTIONS


_LOSS: Final = TypeAdapter(Loss)


def append_losses(bag_dir: Path, losses: Iterable[Loss]) -> None:
    """Appends losses, and drops the oldest where the file is too long.

    Raises:
        OSError: the file cannot be written.
    """
    target = bag_dir / LOST_FILE
    target.parent.mkdir(exist_ok=True)
    append_durably(target, "".join(f"{json.dumps(asdict(each))}\n" for each in losses))
    if target.stat().st_size > MOST_BYTES:
        with open_plain(target) as stream:
            lines = stream.read().decode(errors="replace").splitlines(keepends=True)
        write_durably(target, "".join(lines[len(lines) // 2 :]))


def read_losses(bag_dir: Path, start: Ns, stop: Ns) -> Sequence[Loss]:
    """Returns the losses that fall between two log times; none where there is no file."""
    path = bag_dir / LOST_FILE
    try:
        status = path.stat()
        return [
            each
            for each in _parsed(path, status.st_mtime_ns, status.st_size)
            if each.start < stop and start < each.stop
        ]
    except (OSError, ValueError):
        return ()


# Asked for by every answer; the key says when the file has changed.
@lru_cache(2)
def _parsed(path: Path, _mtime_ns: int, _size: int) -> Sequence[Loss]:
    with open_plain(path) as stream:
        lines = stream.read(2 * MOST_BYTES).decode(errors="replace").splitlines()
    losses: list[Loss] = []
    for line in lines:
        try:
            losses.append(validated(_LOSS, json_object(line)))
        except (ValueError, RecursionError):
            continue
    return losses
