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
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.stored_message import StoredMessage
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
_DAY_NS: Final = 86_400 * NS_PER_S
_NO_POSE: Final = (None,) * 7
_MAX_OPEN_FILES: Final = 16
"""Messages come in time order, so few recordings are written at a time."""

Row = tuple[object, ...]
"""The values of a message, in the order of the columns."""


class _PartFile:
    """One file being written; messages are buffered for a row group."""

    def __init__(self, path: Path) -> None:
        self.rows: list[Row] = []
        self._writer = pq.ParquetWriter(path, SCHEMA, compression="zstd")

    def flush(self) -> None:
        """Writes what is buffered as a row group."""
        if self.rows:
            columns = dict(zip(SCHEMA.names, zip(*self.rows, strict=True), strict=True))
            self._writer.write_table(pa.Table.from_pydict(columns, schema=SCHEMA))
            self.rows.clear()

    def close(self) -> None:
        """Writes what is buffered, and ends the file."""
        self.flush()
        self._writer.close()


class Dataset:
    """Writes messages as rows, and counts the rows and the files.

    Args:
        root: the folder; partitions that exist already are refused.
        robot: the name of a further partition, so that many robots share a dataset; not one of
            bags that have none.

    Attributes:
        undecoded: the types of messages of which rows have no value.
    """

    def __init__(
        self, root: Path, reader: BagReader, extractor: SchemaExtractor, robot: str | None
    ) -> None:
        self._dataset = root
        self._root = root if robot is None else root / f"robot={quote(robot, safe=' ')}"
        self._reader = reader
        self._extractor = extractor
        self.rows = 0
        self.files = 0
        self.undecoded: set[str] = set()

    def write(self, messages: Iterable[StoredMessage]) -> None:
        """Writes all messages; the files appear at the end, or none where it fails.

        Raises:
            InvalidArgumentsError: the partition of a message existed before, or the others have a
                robot, or none.
        """
        is_alone = self._root == self._dataset
        other, change = ("robot=*", "give") if is_alone else ("recording=*", "leave out")
        if mixed := next(self._dataset.glob(other), None):
            raise InvalidArgumentsError(
                f"{mixed} may have these rows already, which would be there twice; {change} "
                "--robot, or name another folder"
            )
        parts: dict[tuple[str, Ns], _PartFile] = {}  # the one used last stands last
        written: dict[Path, Path] = {}  # by its final path, where each file lies meanwhile
        self._root.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self._root, prefix=".") as temporary:
            for stored in messages:
                key = stored.bag.recording.name, stored.time // _DAY_NS
                part = parts.pop(key, None)
                if part is None:
                    temporary_file = Path(temporary) / str(len(written))
                    written[self._new_file(*key, written)] = temporary_file
                    part = _PartFile(temporary_file)
                    if len(parts) == _MAX_OPEN_FILES:
                        parts.pop(next(iter(parts))).close()
                parts[key] = part
                part.rows.append(self._row(stored.record))
                self.rows += 1
                if len(part.rows) >= _GROUP_ROWS:
                    part.flush()
            for part in parts.values():
                part.close()
            for path, temporary_file in written.items():
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary_file.replace(path)
        self.files = len(written)

    def _new_file(self, recording: str, day: int, others: Collection[Path]) -> Path:
        """Returns the path of a further file of a partition."""
        date = datetime.fromtimestamp(day * _DAY_NS // NS_PER_S, tz=UTC).date()
        folder = self._root / f"recording={quote(recording, safe=' ')}" / f"date={date}"
        if any(folder.glob("*.parquet")):
            raise InvalidArgumentsError(
                f"{folder} has rows already, which would be there twice; export whole days (UTC)"
                ", name another folder, or delete this one"
            )
        return folder / f"part-{sum(path.parent == folder for path in others)}.parquet"

    def _row(self, record: Record) -> Row:
        """Returns the row of a message."""
        channel = record.channel
        row = (channel.topic, channel.type, record.log_time, record.publish_time)
        try:
            message = self._reader.decode(record)
        except UndecodableError as error:
            self.undecoded.add(channel.type)
            return (*row, None, error.reason, None, *_NO_POSE, None)
        shown = self._extractor.shown(message, channel.type)
        # The text for replies is ASCII with escapes; a column of UTF-8 has the letters themselves.
        text = encodable(_AS_JSON(shown.value) if "\\" in shown.text else shown.text)
        stamp = self._extractor.stamp(message)
        pose = self._extractor.pose(message, channel.type)
        if pose is None:
            return (*row, text, None, None, *_NO_POSE, stamp)
        frame = encodable(pose.frame_id) or None
        return (*row, text, None, frame, *pose.position, *(pose.orientation or _NO_POSE[3:]), stamp)
