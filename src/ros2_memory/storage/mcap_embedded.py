"""What rosbag2 embeds in each MCAP file besides messages: a metadata record with its metadata.yaml.

It stands right behind the header, and again before the end, and holds the custom data that `ros2
bag record --custom-data` was given (seen in the files of Jazzy; Humble has no such option).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import yaml
from mcap.records import Metadata

from ros2_memory.storage.faults import UnreadableError
from ros2_memory.storage.mcap_file import require_mcap
from ros2_memory.storage.mcap_records import MAGIC_SIZE, RECORD, Opcode
from ros2_memory.storage.mcap_salvage import parsed
from ros2_memory.storage.open_file import OpenFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_NAME: Final = "rosbag2"
_KEY: Final = "serialized_metadata"
_MOST_BYTES: Final = 16 << 20
"""A longer metadata record is not read. It grows by 180 bytes a split."""
# The whole text lists every split: parsing it as YAML takes a thousand times as long.
_CUSTOM_DATA: Final = re.compile(r"^custom_data:[^\n]*\n(?:[ \t]+[^\n]*(?:\n|$))*", re.MULTILINE)


def custom_data(path: Path) -> dict[str, str] | None:
    """The custom data that `ros2 bag record` embedded in an MCAP file; None where it embedded none.

    Reads up to the first message or chunk, so a file that ends early has it too. None also of a
    file that is no MCAP file, or is damaged before that.

    Raises:
        OSError: it cannot be read.
    """
    try:
        with OpenFile(path) as file:
            require_mcap(file)
            for body in _metadata_first(file):
                for record in parsed([(Opcode.METADATA, body)]):
                    if isinstance(record, Metadata) and record.name == _NAME:
                        return _custom_data_in(record.metadata.get(_KEY, ""))
    except UnreadableError:
        return None
    return None


def _metadata_first(file: OpenFile) -> Iterator[bytes]:
    """The bodies of metadata records before the first message."""
    position = MAGIC_SIZE
    while position + RECORD.size <= file.size:
        opcode, length = RECORD.unpack(file.read(position, RECORD.size))
        position += RECORD.size
        if opcode in {Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END, Opcode.FOOTER}:
            return
        if opcode == Opcode.METADATA and length <= _MOST_BYTES:
            yield file.read(position, length)
        position += length


def _custom_data_in(text: str) -> dict[str, str] | None:
    found = _CUSTOM_DATA.search(text)
    if found is None:
        return None
    try:
        content: object = yaml.safe_load(found[0])
    except (yaml.YAMLError, RecursionError, ValueError):
        return None
    values = content.get("custom_data") if isinstance(content, dict) else None
    if not isinstance(values, dict):
        return None
    return {str(key): str(value) for key, value in values.items()}
