"""Reads and changes the record with metadata.yaml that rosbag2 embeds in each MCAP file.

It follows the header, is repeated before the end, and has the custom data of `ros2 bag record
--custom-data` (seen in the files of Jazzy; Humble has no such option).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import yaml
from mcap.opcode import Opcode
from mcap.records import Metadata

from ros2_memory.storage.errors import UnreadableError
from ros2_memory.storage.file_io import OpenFile
from ros2_memory.storage.mcap.records import MAGIC_SIZE, file_records
from ros2_memory.storage.mcap.salvage import decode_record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.records import McapRecord

_NAME: Final = "rosbag2"
_KEY: Final = "serialized_metadata"
_HUMBLE_KEYS: Final = frozenset({"ROS_DISTRO"})
"""The keys of the record of Humble (seen in its files)."""
_NEXT_KEY: Final = re.compile(r"[a-z_]+:|\s*\Z")
_MAX_BYTES: Final = 16 << 20
"""A longer record is not read. The metadata record grows by 180 bytes with each split."""
_END: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END})
# The text lists every split: to parse all of it as YAML takes a thousand times as long.
_CUSTOM_DATA: Final = re.compile(r"^custom_data:[^\n]*\n(?: +[^\s#][^\n]*(?:\n|$))*", re.MULTILINE)


def custom_data(path: Path) -> dict[str, str] | None:
    """Returns the custom data that `ros2 bag record` embedded in an MCAP file; empty without any.

    Reads up to the first message or chunk, so that it works for a file that ends early. Returns
    None if that cannot be known: the file is not MCAP, ends before it, or is damaged there.

    Raises:
        OSError: it cannot be read.
    """
    try:
        with OpenFile(path) as file:
            for record in _before_messages(file):
                if isinstance(record, Metadata):
                    text = record.metadata.get(_KEY)
                    if text is not None:
                        return _custom_data_in(text) if record.name == _NAME else None
                    if record.name == _NAME and record.metadata.keys() - _HUMBLE_KEYS:
                        return None
    except UnreadableError:
        return None
    return {}


def retold(record: Metadata, edit_metadata: Callable[[str], str]) -> Metadata:
    """Returns a metadata record; that of rosbag2 with its text changed."""
    text = record.metadata.get(_KEY)
    if record.name != _NAME or text is None:
        return record
    return Metadata(name=record.name, metadata={**record.metadata, _KEY: edit_metadata(text)})


def _before_messages(file: OpenFile) -> Iterator[McapRecord]:
    """Yields the records before the first message or chunk.

    Raises:
        UnreadableError: the file ends before one, or a record before it is damaged.
    """
    for record in file_records(file):
        if (record.offset == MAGIC_SIZE) != (record.opcode == Opcode.HEADER):
            raise UnreadableError("damaged: it does not begin with one header")
        if record.opcode in _END:
            return
        read = decode_record(record.opcode, record.body(file, _MAX_BYTES))
        if read is None:
            raise UnreadableError("damaged: a record before the first message cannot be read")
        yield read
    raise UnreadableError("it ends before its first message")


def _custom_data_in(text: str) -> dict[str, str] | None:
    found = _CUSTOM_DATA.search(text)
    if found is None or not _NEXT_KEY.match(text, found.end()):
        return None
    try:
        content: object = yaml.safe_load(found[0])
    except (yaml.YAMLError, RecursionError, ValueError):
        return None
    if not isinstance(content, dict):
        return None
    values: object = content.get("custom_data")
    if values is None:
        return {}
    if not isinstance(values, dict):
        return None
    return {str(key): str(value) for key, value in values.items()}
