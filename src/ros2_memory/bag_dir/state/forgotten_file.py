"""`.episodic/forgotten.jsonl`: what `ros2-memory forget` deleted, for the lake that may have it.

A line is written before each deletion. `ros2-memory ship` deletes the same from the lake before it
ships anything, and stores there what it did: lines of this file are never removed. A line that a
crash cut short is ignored, since nothing was deleted for it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from pydantic import TypeAdapter

from ros2_memory.bag_dir.durable_write import append_durably, open_plain
from ros2_memory.bag_dir.json_fields import Int64, json_object, validated
from ros2_memory.bag_dir.layout import FORGOTTEN_FILE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

_MOST_BYTES: Final = 64 << 20


@dataclass(frozen=True, slots=True)
class ForgottenBag:
    """A bag that was deleted as a whole: its recording, its file, and its first log time."""

    recording: str
    file: str
    first: Int64


@dataclass(frozen=True, slots=True)
class Forgetting:
    """What was deleted between two log times (half-open): messages of topics, or whole bags."""

    start: Int64
    stop: Int64
    topics: tuple[str, ...] = ()
    bags: tuple[ForgottenBag, ...] = ()


_FORGETTING: Final = TypeAdapter(Forgetting)


def append_forgettings(bag_dir: Path, forgettings: Iterable[Forgetting]) -> None:
    """Appends durably what is about to be deleted.

    Raises:
        OSError: the file cannot be written, as where the bag directory is mounted read-only.
    """
    target = bag_dir / FORGOTTEN_FILE
    target.parent.mkdir(exist_ok=True)
    append_durably(target, "".join(f"{json.dumps(asdict(each))}\n" for each in forgettings))


def read_forgettings(bag_dir: Path) -> Sequence[Forgetting]:
    """Returns what was deleted, the oldest first; nothing where there is no file.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is damaged: what was deleted is unknown.
    """
    try:
        with open_plain(bag_dir / FORGOTTEN_FILE) as stream:
            data = stream.read(_MOST_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return ()
    if len(data) > _MOST_BYTES:
        raise ValueError(f"it is larger than {_MOST_BYTES} bytes")
    lines = data.decode().split("\n")
    found: dict[Forgetting, None] = {}
    for number, line in enumerate(lines, 1):
        try:
            forgetting = validated(_FORGETTING, json_object(line))
        except (json.JSONDecodeError, RecursionError) as error:
            # A whole line ends with the list of bags; of one that was cut, nothing was deleted.
            if not line or (line.startswith("{") and not line.endswith("]}")):
                continue
            raise ValueError(f"line {number}: it is damaged: {error}") from error
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
        if not (forgetting.topics or forgetting.bags):
            raise ValueError(f"line {number}: it names no topics and no bags")
        found[forgetting] = None
    return [*found]
