"""Which texts each message of a topic has, bag by bag: what counts sightings without reading.

The order of messages matters, their times do not: only where the topic was silent for so long
that a sighting ends. A text takes a bit for each message, less where it stays or stays away.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.intervals import SILENCE_NS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from ros2_memory.core.timebase import Ns

MAX_TEXTS: Final = 32
MAX_TEXT_CHARS: Final = 400
MAX_MESSAGES: Final = 4_096
"""Nothing is stored of a bag with more texts, more characters in them, or more messages."""


class TextRuns(NamedTuple):
    """Which texts the messages of one topic have, in order.

    Attributes:
        size: how many messages there are.
        silent: the bit of each message that comes after a silence that ends sightings.
        texts: for each text the bits of the messages with it, the first message's lowest.
    """

    size: int
    silent: int
    texts: Mapping[str, int]


class TextRunsBuilder:
    """Takes the texts of messages in order, until they are too many."""

    def __init__(self) -> None:
        self._size = 0
        self._silent = 0
        self._last: Ns | None = None
        self._chars = 0
        self._bits: dict[str, int] = {}
        self._is_given_up = False
        # The newest messages have the same texts, from this one on.
        self._same: Collection[str] = ()
        self._since = 0

    def give_up(self) -> None:
        """Stores nothing for this topic, since the texts of a message are unknown."""
        self._is_given_up = True

    def add(self, time: Ns, texts: Collection[str]) -> None:
        """Takes the next message."""
        if self._is_given_up:
            return
        if self._last is not None and time - self._last > SILENCE_NS:
            self._silent |= 1 << self._size
        self._last = time
        if texts is not self._same:
            self._take()
            self._same, self._since = texts, self._size
        self._size += 1

    def _take(self) -> None:
        """Takes the texts of the newest messages, which have the same."""
        bits = (1 << self._size) - (1 << self._since)
        if bits:
            for text in self._same:
                known = self._bits.get(text)
                if known is None:
                    self._chars += len(text)
                    known = 0
                self._bits[text] = known | bits
        self._since = self._size
        self._is_given_up |= (
            len(self._bits) > MAX_TEXTS or self._chars > MAX_TEXT_CHARS or self._size > MAX_MESSAGES
        )

    def runs(self) -> TextRuns | None:
        """Returns the texts of all messages; None where they are too many, or none has any."""
        self._take()
        if self._is_given_up or not self._bits:
            return None
        return TextRuns(self._size, self._silent, dict(sorted(self._bits.items())))


def encode_text_runs(runs: TextRuns) -> bytes:
    """Encodes texts, and where each of them comes and goes."""
    head = json.dumps([runs.size, *runs.texts], separators=(",", ":"))
    width = _width(runs.size)
    columns = (runs.silent, *runs.texts.values())
    # Bits of changes are mostly 0, which packs better.
    changes = [(bits ^ bits << 1).to_bytes(width, "little") for bits in columns]
    return b"".join((head.encode("ascii"), b"\n", *changes))


def decode_text_runs(packed: bytes) -> TextRuns:
    """Decodes what `encode_text_runs` encoded.

    Raises:
        ValueError: the bytes are not valid.
    """
    head, _, rest = packed.partition(b"\n")
    size, *texts = json.loads(head)
    width = _width(size)
    if len(rest) != width * (len(texts) + 1):
        raise ValueError("not the texts of messages: some are missing, or more follow")
    columns = [_from_changes(each, size) for each in _parts(rest, width)]
    return TextRuns(size, columns[0], dict(zip(texts, columns[1:], strict=True)))


def _width(size: int) -> int:
    """Returns how many bytes the changes of so many messages take."""
    return (size + 8) // 8


def _parts(packed: bytes, width: int) -> Iterator[bytes]:
    return (packed[at : at + width] for at in range(0, len(packed), width))


def _from_changes(packed: bytes, size: int) -> int:
    """Returns the bits whose changes these are: each is the sum of the changes until it."""
    bits = int.from_bytes(packed, "little")
    reach = 1
    while reach <= size:
        bits ^= bits << reach
        reach <<= 1
    return bits & ((1 << size) - 1)
