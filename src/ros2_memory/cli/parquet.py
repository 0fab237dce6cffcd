"""Writes Parquet files, a row for each message, partitioned as query engines expect it.

    DIR/[robot=NAME/]recording=rec_20261120T043000Z/date=2026-11-20/part-0.parquet

`recording` and `date` (UTC, of the log time) are columns for whatever reads such folders (Hive
partitioning). The files have the others: `topic`, `type`, `log_time` and `publish_time` (UTC, to
the nanosecond), `value` (the extracted message as JSON, long arrays thinned), and for messages with
a pose `frame_id`, `x`, `y`, `z` (m) and `qx`, `qy`, `qz`, `qw`, unrounded.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from contextlib import ExitStack
from datetime import UTC, datetime
from itertools import chain
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Ns
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.history.duplicates import StoredMessage
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
    ]
)
_GROUP_ROWS: Final = 20_000
"""Rows of a row group: some megabytes."""
_AS_JSON: Final = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode
_DAY_NS: Final = 86_400 * NS_PER_S
_NO_POSE: Final = (None,) * 7
_MAX_OPEN_FILES: Final = 16
"""Messages come in time order, so few recordings are written at a time."""

_COLUMNS: Final = tuple(SCHEMA.names)
Row = tuple[object, ...]
"""The values of a message, in the order of the columns."""


class _PartFile:
    """One file being written, under a temporary name until the dataset is complete."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.temporary = path.with_name(f".{path.name}.tmp")
        self._rows: list[Row] = []
        self.temporary.unlink(missing_ok=True)  # or a link there would be written through
        self.writer = pq.ParquetWriter(self.temporary, SCHEMA, compression="zstd")

    def add(self, row: Row) -> None:
        """Takes the row of the next message."""
        self._rows.append(row)
        if len(self._rows) >= _GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        """Writes what is buffered, and ends the file."""
        self._flush()
        self.writer.close()

    def _flush(self) -> None:
        """Writes what is buffered as a row group."""
        if self._rows:
            columns = dict(zip(_COLUMNS, zip(*self._rows, strict=True), strict=True))
            self.writer.write_table(pa.Table.from_pydict(columns, schema=SCHEMA))
            self._rows.clear()


class Dataset:
    """Writes messages as rows, and counts the rows and the files.

    Args:
        root: the folder; partitions that exist already are refused.
        reader: decodes messages.
        extractor: extracts their values and poses.
        robot: the name of a further partition, so that many robots share a dataset.

    Attributes:
        rows: how many were written.
        files: how many.
        undecoded: the types of messages of which rows have no value.
    """

    def __init__(
        self, root: Path, reader: BagReader, extractor: SchemaExtractor, robot: str | None = None
    ) -> None:
        self._root = root if robot is None else root / f"robot={quote(robot, safe=' ')}"
        self._reader = reader
        self._extractor = extractor
        self._open: OrderedDict[Path, _PartFile] = OrderedDict()
        self._parts: dict[Path, list[_PartFile]] = {}
        self._newest: tuple[BagFile, Ns, _PartFile] | None = None
        self._cleanup = ExitStack()
        self.rows = 0
        self.files = 0
        self.undecoded: set[str] = set()

    def write(self, messages: Iterable[StoredMessage]) -> None:
        """Writes all messages; the files appear at the end, or none where it fails.

        Raises:
            InvalidArgumentsError: the partition of a message existed before.
        """
        with self._cleanup:
            for each in messages:
                self._add(each)
            for part in self._open.values():
                part.close()
            for part in chain.from_iterable(self._parts.values()):
                part.temporary.replace(part.path)
                self.files += 1

    def _add(self, stored: StoredMessage) -> None:
        self._part_for(stored).add(self._row(stored.record))
        self.rows += 1

    def _part_for(self, stored: StoredMessage) -> _PartFile:
        """Returns the file of a message's partition."""
        day = stored.time // _DAY_NS
        if self._newest is None or self._newest[0] is not stored.bag or self._newest[1] != day:
            self._newest = (stored.bag, day, self._part_of(stored))
        return self._newest[2]

    def _part_of(self, stored: StoredMessage) -> _PartFile:
        """Opens that file, if need be, and closes the one that was unused for longest."""
        date = datetime.fromtimestamp(stored.time // NS_PER_S, tz=UTC).date()
        name = quote(stored.bag.recording.name, safe=" ")
        folder = self._root / f"recording={name}" / f"date={date}"
        if folder not in self._open:
            self._open[folder] = self._new_part(folder)
        self._open.move_to_end(folder)
        if len(self._open) > _MAX_OPEN_FILES:
            _, oldest = self._open.popitem(last=False)
            oldest.close()
        return self._open[folder]

    def _new_part(self, folder: Path) -> _PartFile:
        folder.mkdir(parents=True, exist_ok=True)
        if folder not in self._parts and any(folder.glob("*.parquet")):
            raise InvalidArgumentsError(
                f"{folder} has rows already, which would be there twice; export whole days (UTC)"
                ", name another folder, or delete this one"
            )
        parts = self._parts.setdefault(folder, [])
        part = _PartFile(folder / f"part-{len(parts)}.parquet")
        self._cleanup.callback(part.temporary.unlink, missing_ok=True)
        self._cleanup.enter_context(part.writer)
        parts.append(part)
        return part

    def _row(self, record: Record) -> Row:
        """Returns the row of a message."""
        channel = record.channel
        row = (channel.topic, channel.type, record.log_time, record.publish_time)
        try:
            message = self._reader.decode(record)
        except UndecodableError as error:
            self.undecoded.add(channel.type)
            return (*row, None, error.reason, None, *_NO_POSE)
        shown = self._extractor.shown(message, channel.type)
        # The text for replies is ASCII with escapes; a column of UTF-8 has the letters themselves.
        text = encodable(_AS_JSON(shown.value) if "\\" in shown.text else shown.text)
        pose = self._extractor.pose(message, channel.type)
        if pose is None:
            return (*row, text, None, None, *_NO_POSE)
        frame = encodable(pose.frame_id) or None
        return (*row, text, None, frame, *pose.position, *(pose.orientation or _NO_POSE[3:]))
