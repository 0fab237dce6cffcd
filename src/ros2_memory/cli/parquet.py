"""Writes Parquet files, a row for each message, partitioned as query engines expect it.

    DIR/[robot=NAME/]recording=rec_20261120T043000Z/date=2026-11-20/part-0.parquet

`recording` and `date` (UTC, of the log time) are columns for whatever reads such folders (Hive
partitioning). The files have the others: `topic`, `type`, `log_time` and `publish_time` (UTC, to
the nanosecond), `value` (the extracted message as JSON, long arrays thinned), for messages with
a pose `frame_id`, `x`, `y`, `z` (m) and `qx`, `qy`, `qz`, `qw`, unrounded, and for those with a
header its stamp, `header_stamp` (UTC, to the nanosecond).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from ros2_memory.bag_dir.layout import recorded_as
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.temporary import hidden_folder
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import NS_PER_DAY, utc_day

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from pathlib import Path

    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.storage.base import BagReader, Record

SCHEMA: Final = pa.schema(
    [
        ("topic", pa.dictionary(pa.int32(), pa.string())),
        ("type", pa.dictionary(pa.int32(), pa.string())),
        ("log_time", pa.timestamp("ns", tz="UTC")),
        ("publish_time", pa.timestamp("ns", tz="UTC")),
        ("value", pa.string()),
        ("undecodable", pa.string()),
        ("frame_id", pa.string()),
        *((name, pa.float64()) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")),
        ("header_stamp", pa.timestamp("ns", tz="UTC")),
    ]
)
_GROUP_ROWS: Final = 20_000
"""Rows of a row group: some megabytes."""
_AS_JSON: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_MAX_OPEN_FILES: Final = 16
"""Messages come in time order, so few recordings are written at a time."""

Row = dict[str, object]
"""The values of a message by column; a column that is missing is null."""


class _PartFile:
    """A Parquet file that is being written; rows are buffered for a row group."""

    def __init__(self, path: Path) -> None:
        self._rows: list[Row] = []
        self._writer = pq.ParquetWriter(path, SCHEMA, compression="zstd")

    def add(self, row: Row) -> None:
        """Adds a row, and writes a row group if the buffer is full."""
        self._rows.append(row)
        if len(self._rows) >= _GROUP_ROWS:
            self._write_group()

    def close(self) -> None:
        """Writes the buffered rows, and ends the file."""
        if self._rows:
            self._write_group()
        self._writer.close()

    def _write_group(self) -> None:
        self._writer.write_table(pa.Table.from_pylist(self._rows, schema=SCHEMA))
        self._rows.clear()


@dataclass(eq=False, repr=False)
class Dataset:
    """Writes messages as rows of partitioned Parquet files.

    Args:
        root: the folder; partitions that exist already are refused.
        bag_dir: the folder of the recordings.
        reader: decodes the messages.
        extractor: reads values and poses of decoded messages.
        robot: the name of a further partition, so that many robots share a dataset; None for a
            dataset of one robot.

    Attributes:
        rows: the number of rows written.
        files: the number of files written.
        undecoded: the types of messages whose rows have no value.
    """

    root: Path
    bag_dir: Path
    reader: BagReader
    extractor: SchemaExtractor
    robot: str | None
    rows: int = 0
    files: int = 0
    undecoded: set[str] = field(default_factory=set)

    def write(self, messages: Iterable[StoredMessage]) -> None:
        """Writes all messages. The files appear at the end; if it fails, none does.

        Raises:
            InvalidArgumentsError: a partition exists already, or the existing ones are by robot and
                these are not, or the reverse.
        """
        folder, name_of = self._partitions_folder(), cache(self._name_of)
        open_parts: dict[tuple[str, int], _PartFile] = {}  # the one used last stands last
        temporary_by_path: dict[Path, Path] = {}
        folder.mkdir(parents=True, exist_ok=True)
        with hidden_folder(folder) as temporary:
            for stored in messages:
                partition = name_of(stored.recording), stored.time // NS_PER_DAY
                part = open_parts.pop(partition, None)
                if part is None:
                    if len(open_parts) == _MAX_OPEN_FILES:
                        open_parts.pop(next(iter(open_parts))).close()
                    path = _new_file(folder, *partition, temporary_by_path)
                    temporary_by_path[path] = temporary / str(len(temporary_by_path))
                    part = _PartFile(temporary_by_path[path])
                open_parts[partition] = part
                part.add(self._row(stored.record))
                self.rows += 1
            for part in open_parts.values():
                part.close()
            for path, temporary_file in temporary_by_path.items():
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary_file.replace(path)
        self.files = len(temporary_by_path)

    def _name_of(self, recording: Path) -> str:
        """Returns a recording's path in the bag directory, without the folder of a saved moment."""
        if recording == self.bag_dir:
            return recording.name
        recorded = recorded_as(self.bag_dir, str(recording))
        return recorded.removeprefix(f"{self.bag_dir}/")

    def _partitions_folder(self) -> Path:
        """Returns the folder of the partitions by recording.

        Raises:
            InvalidArgumentsError: the dataset is partitioned by robot, and this part is not; or
                the reverse.
        """
        folder, other, change = self.root, "robot=*", "give"
        if self.robot is not None:
            folder /= f"robot={quote(self.robot, safe=' ')}"
            other, change = "recording=*", "leave out"
        if mixed := next(self.root.glob(other), None):
            raise InvalidArgumentsError(
                f"{mixed} may have these rows already, which would be there twice; {change} "
                "--robot, or name another folder"
            )
        return folder

    def _row(self, record: Record) -> Row:
        channel = record.channel
        row: Row = {
            "topic": channel.topic,
            "type": channel.type,
            "log_time": record.log_time,
            "publish_time": record.publish_time,
        }
        try:
            message = self.reader.decode(record)
        except UndecodableError as error:
            self.undecoded.add(channel.type)
            return row | {"undecodable": error.reason}
        shown = self.extractor.shown(message, channel.type)
        # The text for replies is ASCII with escapes; a column of UTF-8 has the letters themselves.
        row["value"] = encodable(_AS_JSON(shown.value) if "\\" in shown.text else shown.text)
        row["header_stamp"] = self.extractor.stamp(message)
        if pose := self.extractor.pose(message, channel.type):
            row["frame_id"] = encodable(pose.frame_id) or None
            row |= zip(("x", "y", "z"), pose.position, strict=True)
            row |= zip(("qx", "qy", "qz", "qw"), pose.orientation or (), strict=False)
        return row


def _new_file(folder: Path, recording: str, day: int, others: Collection[Path]) -> Path:
    """Returns the path of a further file of a recording and a day (since 1970, UTC).

    Raises:
        InvalidArgumentsError: an earlier export wrote files there.
    """
    partition = (
        folder / f"recording={quote(recording, safe=' ')}" / f"date={utc_day(day * NS_PER_DAY)}"
    )
    if any(partition.glob("*.parquet")):
        raise InvalidArgumentsError(
            f"{partition} has rows already, which would be there twice; export whole days (UTC)"
            ", name another folder, or delete this one"
        )
    number = sum(path.parent == partition for path in others)
    return partition / f"part-{number}.parquet"
