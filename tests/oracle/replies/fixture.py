"""The recorded calls and replies: for each world a file of JSON lines in tests/data/replies.

The first line has the world's name, its settings and its named places; each other one a call, its
reply from the bags alone, and, under `stored`, the reply with a store where that differs.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import zstandard

from tests.oracle.replies.asking import Call

FOLDER: Final = Path(__file__).resolve().parents[2] / "data" / "replies"
_LEVEL: Final = 22
_MOST_BYTES: Final = 100_000_000


@dataclass
class Replied:
    """A call and its replies; `stored` is None where a store changes nothing."""

    call: Call
    reply: Any
    stored: Any = None


@dataclass
class Record:
    """What was recorded of a world."""

    world: str
    settings: Sequence[str]
    places: dict[str, Any]
    replies: list[Replied] = field(default_factory=list)

    def write(self) -> int:
        """Writes its file, and returns the file's size in bytes."""
        head = {"world": self.world, "settings": [*self.settings], "places": self.places}
        rows: list[dict[str, Any]] = [head]
        for replied in self.replies:
            row = {"call": replied.call.as_json(), "reply": replied.reply}
            rows.append(row | ({} if replied.stored is None else {"stored": replied.stored}))
        lines = [json.dumps(row, ensure_ascii=False, separators=(",", ":")) for row in rows]
        packed = zstandard.ZstdCompressor(level=_LEVEL).compress("\n".join(lines).encode())
        FOLDER.mkdir(parents=True, exist_ok=True)
        path_of(self.world).write_bytes(packed)
        return len(packed)

    @classmethod
    def read(cls, world: str) -> "Record":
        """The record of a world.

        Raises:
            FileNotFoundError: none was made.
        """
        packed = path_of(world).read_bytes()
        text = zstandard.ZstdDecompressor().decompress(packed, max_output_size=_MOST_BYTES)
        head, *rows = map(json.loads, text.decode().split("\n"))
        replies = [
            Replied(Call.from_json(row["call"]), row["reply"], row.get("stored")) for row in rows
        ]
        return cls(head["world"], head["settings"], head["places"], replies)


def path_of(world: str) -> Path:
    """The file of a world's replies."""
    return FOLDER / f"{world}.jsonl.zst"
