"""What is read of a summary section."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest
from mcap.opcode import Opcode

from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.index import DoubtError, index_from_summary, read_summary
from tests.support.bags import boolean, text, write_mcap
from tests.support.mcap_surgery import SMALL, edit_summary

if TYPE_CHECKING:
    from pathlib import Path


def bag(path: Path) -> Path:
    """Several chunks, of one topic and of two."""
    messages = [text(time, f"{time:0100d}") for time in range(11)]
    return write_mcap(
        path, [text(0, ""), boolean(0, data=True), *messages, boolean(12, data=True)], SMALL
    )


@pytest.mark.parametrize(
    ("opcode", "size_at", "reason"),
    [
        (Opcode.CHUNK_INDEX, 32, "a chunk index is shorter than it states"),
        (Opcode.STATISTICS, 42, "the statistics are shorter than they state"),
    ],
)
@pytest.mark.parametrize("more", [1, 30, 1 << 30])
def test_a_record_that_states_more_than_it_has_is_not_believed(
    tmp_path: Path, opcode: Opcode, size_at: int, reason: str, more: int
) -> None:
    path = bag(tmp_path / "a.mcap")

    def state_more(body: bytearray) -> None:
        (size,) = struct.unpack_from("<I", body, size_at)
        struct.pack_into("<I", body, size_at, size + more)

    edit_summary(path, opcode, state_more)
    with OpenFile(path) as file:
        with pytest.raises(UnreadableError, match=reason):
            read_summary(file)
        with pytest.raises(DoubtError, match=f"its summary section is not used .*{reason}"):
            index_from_summary(file)
