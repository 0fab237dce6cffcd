"""A folder of Parquet files, one row for a message, partitioned as query engines expect it.

    DIR/[robot=NAME/]recording=rec_20261120T043000Z/date=2026-11-20/part-0.parquet

`recording` and `date` (UTC, of the log time) are columns for whatever reads such folders (Hive
partitioning). The files have the others: `topic`, `type`, `log_time` and `publish_time` (UTC, to
the nanosecond), `value` (the extracted message as JSON, long arrays thinned), and for messages with
a pose `frame_id`, `x`, `y`, `z` (m) and `qx`, `qy`, `qz`, `qw`, unrounded.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.storage.base import BagReader

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
    ]
)
_ROWS_AT_ONCE: Final = 20_000
"""Rows of one group in a file: some megabytes."""
_OPEN_AT_ONCE: Final = 16
"""Files that are being written; messages come in time order, so few recordings are under way."""

Row = dict[str, object]


class _Part:
    """One file under way, of which nothing is seen before all of the dataset is written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.beside = path.with_name(f".{path.name}.tmp")
        self.rows: list[Row] = []
        self.beside.unlink(missing_ok=True)  # or a link there would be written through
        self._writer = pq.ParquetWriter(self.beside, SCHEMA, compression="zstd")

    def flush(self) -> None:
        """Writes what has been gathered."""
        if self.rows:
            self._writer.write_table(pa.Table.from_pylist(self.rows, schema=SCHEMA))
            self.rows.clear()

    def close(self) -> None:
        """Writes the rest, and ends the file."""
        self.flush()
        self._writer.close()


class Dataset:
    """Takes messages and writes them as rows; all files appear at the end, or none.

    Args:
        root: the folder; partitions that exist already are refused.
        reader: decodes messages.
        extractor: makes values and poses of them.
        robot: the name of a further partition, so that many robots make one dataset.
    """

    def __init__(
        self, root: Path, reader: BagReader, extractor: SchemaExtractor, robot: str | None = None
    ) -> None:
        self._root = root if robot is None else root / f"robot={quote(robot, safe=' ')}"
        self._reader = reader
        self._extractor = extractor
        self._under_way: OrderedDict[Path, _Part] = OrderedDict()
        self._closed: list[_Part] = []
        self._numbers: dict[Path, int] = {}
        self.rows = 0
        self.files = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        parts = [*self._closed, *self._under_way.values()]
        try:
            for part in self._under_way.values():
                part.close()
            if kind is None:
                for part in parts:
                    part.beside.replace(part.path)
                self.files = len(parts)
        finally:
            for part in parts:
                part.beside.unlink(missing_ok=True)

    def add(self, found: StoredMessage) -> None:
        """Adds one message.

        Raises:
            InvalidArgumentsError: its partition was there before.
        """
        part = self._part(found)
        part.rows.append(self._row(found))
        self.rows += 1
        if len(part.rows) >= _ROWS_AT_ONCE:
            part.flush()

    def _part(self, found: StoredMessage) -> _Part:
        date = datetime.fromtimestamp(found.time // NS_PER_S, tz=UTC).date()
        name = quote(found.bag.recording.name, safe=" ")
        folder = self._root / f"recording={name}" / f"date={date}"
        part = self._under_way.get(folder)
        if part is None:
            part = self._under_way[folder] = self._begun(folder)
        self._under_way.move_to_end(folder)
        if len(self._under_way) > _OPEN_AT_ONCE:
            _, oldest = self._under_way.popitem(last=False)
            oldest.close()
            self._closed.append(oldest)
        return part

    def _begun(self, folder: Path) -> _Part:
        folder.mkdir(parents=True, exist_ok=True)
        if folder not in self._numbers and any(folder.glob("*.parquet")):
            raise InvalidArgumentsError(
                f"{folder} has rows already, which would stand there twice; export whole days (UTC)"
                ", name another folder, or delete this one"
            )
        number = self._numbers[folder] = self._numbers.get(folder, -1) + 1
        return _Part(folder / f"part-{number}.parquet")

    def _row(self, found: StoredMessage) -> Row:
        record = found.record
        row: Row = {
            "topic": record.channel.topic,
            "type": record.channel.type,
            "log_time": record.log_time,
            "publish_time": record.publish_time,
        }
        try:
            message = self._reader.decode(record)
        except UndecodableError as error:
            return {**row, "undecodable": error.reason}
        value = self._extractor.shown(message, record.channel.type).value
        row["value"] = _sound(json.dumps(value, ensure_ascii=False, separators=(",", ":")))
        pose = self._extractor.pose(message, record.channel.type)
        if pose is not None:
            row["frame_id"] = _sound(pose.frame_id) or None
            row.update(zip("xyz", pose.position, strict=True))
            if pose.orientation is not None:
                row.update(zip(("qx", "qy", "qz", "qw"), pose.orientation, strict=True))
        return row


def _sound(text: str) -> str:
    """The text, in which what is no Unicode is escaped as JSON has it."""
    return text.encode("utf-8", "backslashreplace").decode()
