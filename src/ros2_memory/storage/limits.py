"""How much memory and time a file may take that anybody may have written.

No size that a file states is allocated for: it is compared with these first, and with what is
really there.
"""

from __future__ import annotations

from typing import Final

MAX_CHUNK_MB: Final = 64
"""What one chunk or one message may hold, unpacked, unless the configuration says otherwise."""
MAX_SECTION_BYTES: Final = 64 << 20
"""What one record, and a summary section, may hold: it is held in memory as a whole."""
MAX_CHUNK_MESSAGES: Final = 1_000_000
"""More messages than these take more memory than their chunk, and seconds to look through."""
MAX_CHANNELS: Final = 5_000
"""The largest robots have some hundred topics; every list and search goes through all there are."""
MAX_NAMES_CHARS: Final = 1 << 20
"""Names of all topics and types of one file, which are held for as long as the bag lies there."""
MAX_DEFINITION_BYTES: Final = 1 << 20
"""A larger one is not used, so no more of it is held than what shows that it is larger."""
MAX_CHUNK_DECLARATIONS: Final = 20_000
"""Schemas and channels in one chunk; a writer declares each once."""
MESSAGE_BYTES: Final = 64
"""What a message takes besides itself while its file is looked through."""
MAX_CHUNKS: Final = 150_000
"""Each is kept in mind for as long as its file is asked about."""
MAX_TIMES_PACKED: Final = 100
"""Nothing that a robot records shrinks to less than this part of itself, but for what is small."""
_ALWAYS_ALLOWED: Final = 32 << 20


def most_unpacked(packed: int) -> int:
    """How many bytes so many compressed bytes may unpack to; more is made to do harm."""
    return _ALWAYS_ALLOWED + MAX_TIMES_PACKED * packed


def too_large(what: str, max_bytes: int) -> str:
    """The reason why something is not read."""
    return (
        f"{what} is larger than the {max_bytes >> 20} MiB allowed; where that is right, raise"
        " reader.max_chunk_mb"
    )
