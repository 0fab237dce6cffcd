"""Ways in which the bytes of a bag go wrong."""

from __future__ import annotations

import random


def damaged(data: bytes, seed: int) -> bytes:
    """The bytes after some accident: flipped bits, a cut, an overwritten or a lost stretch."""
    chance = random.Random(seed)
    spoiled = bytearray(data)
    at = chance.randrange(len(spoiled))
    match chance.randrange(5):
        case 0 | 1:
            for _ in range(chance.choice((1, 1, 3, 20))):
                spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
        case 2:
            del spoiled[at:]
        case 3:
            spoiled[at : at + 8] = chance.choice((b"\0", b"\xff")) * 8
        case _:
            del spoiled[at : at + chance.randrange(1, 50)]
    return bytes(spoiled)
