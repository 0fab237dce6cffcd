"""The Iceberg tables of a lake, as tables.yaml declares them: rows as Arrow tables, and conditions.

The column `packed` has the messages of one channel of a bag: both times and the payload of each
message. If another channel of the bag has a message of the same log time, it also has the places of
the messages in the file, for their order.

The decompressed bytes are (numbers are little-endian and lie in planes, the lowest byte of each
number first, since they compress best like this)::

    1       format: 1, or 2 with places
    1       0: times alone; 1: payloads, too
    4       n, the number of messages
    8 n     log times, each since the one before
    8 n     publish times, each since the log time
    8 n     places, each since the one before; only in format 2
    4 n     the size of each payload
    ...     the payloads: in planes if all have one size, else one after the other

No later version makes these bytes again, so this format is read for ever.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import cached_property
from importlib.resources import files
from itertools import count
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import numpy as np
import pyarrow as pa
import yaml
from pyiceberg import expressions as ex
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import schema_to_pyarrow
from pyiceberg.partitioning import PARTITION_FIELD_ID_START, PartitionField, PartitionSpec
from pyiceberg.schema import Schema as IcebergSchema
from pyiceberg.table.sorting import SortField, SortOrder
from pyiceberg.transforms import IdentityTransform

from ros2_memory.columns.pack import byte_planes, compress, decompress, from_planes
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import NS_PER_S, NS_PER_US, Ns
from ros2_memory.storage.base import Batch, Channel, IntArray

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.model import TimeWindow

_PLAIN: Final = 1
_PLACED: Final = 2
_HEAD: Final = struct.Struct("<BBI")
NAMESPACE: Final = "ros2_memory"
ROWS_VERSION: Final = 45
"""The version of the rules that make rows of a bag. A change ships all bags again."""

_FIRST_TIMES: Final = ("time_ns", "first_ns", "start_ns")
_PROPERTIES: Final = {
    "write.parquet.compression-codec": "zstd",
    "commit.manifest-merge.enabled": "true",
}
_PARTITIONED_BY: Final = ("robot", "day")
_ROW_GROUP: Final = 1 << 17


@dataclass(frozen=True)
class LakeTable:
    """One table.

    Attributes:
        name: its name in the namespace.
        row: what a row stands for.
        columns: the type and the meaning of each column, in order.
        order: the columns that rows are sorted by.
        row_group: how many rows a row group has: engines skip groups of other topics and labels.
    """

    name: str
    row: str
    columns: Mapping[str, tuple[str, str]]
    order: tuple[str, ...]
    row_group: int = _ROW_GROUP

    @cached_property
    def schema(self) -> IcebergSchema:
        """Its columns for Iceberg, each with its meaning."""
        fields, ids = [], count(1)
        for name, (kind, meaning) in self.columns.items():
            iceberg_type: object = kind
            if kind.startswith("map "):
                iceberg_type = {
                    "type": "map",
                    "key-id": next(ids),
                    "key": "string",
                    "value-id": next(ids),
                    "value": kind.removeprefix("map "),
                    "value-required": False,
                }
            field = {"id": next(ids), "name": name, "type": iceberg_type, "doc": meaning}
            fields.append({**field, "required": name in KEYS})
        return IcebergSchema.model_validate({"type": "struct", "fields": fields})

    @cached_property
    def arrow_schema(self) -> pa.Schema:
        """Its columns for Arrow."""
        # Without ids: a catalogue gives a table other ones.
        return schema_to_pyarrow(self.schema, include_field_ids=False)

    def create(self, catalog: IcebergCatalog, identifier: str) -> IcebergTable:
        """Creates the table, partitioned by robot and day, in the order that `sort` makes."""
        ids = {name: self.schema.find_field(name).field_id for name in self.columns}
        same = IdentityTransform[Any]()
        parts = [
            PartitionField(ids[name], field_id, same, name)
            for field_id, name in enumerate(_PARTITIONED_BY, PARTITION_FIELD_ID_START)
        ]
        return catalog.create_table(
            identifier,
            self.schema,
            partition_spec=PartitionSpec(*parts),
            sort_order=SortOrder(*(SortField(ids[name], same) for name in self.order)),
            properties={**_PROPERTIES, "write.parquet.row-group-limit": str(self.row_group)},
        )

    def sort(self, rows: pa.Table) -> pa.Table:
        """Returns rows in the order of the table."""
        return rows.sort_by([(name, "ascending") for name in self.order])

    def to_arrow(self, rows: Iterable[Row]) -> pa.Table:
        """Returns rows for Arrow, with `time` and `topic_key`. NaN becomes null, except in maps."""
        whole = [*rows]
        values = {name: [row.get(name) for row in whole] for name in self.columns}
        if "time" in values:  # repeats the first time, in microseconds
            first = next(name for name in _FIRST_TIMES if name in values)
            values["time"] = [cast("int", time) // NS_PER_US for time in values[first]]
        if "topic_key" in values:
            topics = map(str, values["topic"])
            values["topic_key"] = [topic.strip("/").replace("/", ".") for topic in topics]
        columns = [_column(field, values[field.name]) for field in self.arrow_schema]
        return pa.Table.from_arrays(columns, schema=self.arrow_schema)


def _column(field: pa.Field, values: list[object]) -> pa.Array:
    try:
        return pa.array(values, field.type, from_pandas=not pa.types.is_map(field.type))
    except UnicodeEncodeError:
        # UTF-8 has no lone surrogates, which bytes of a hostile bag decode to.
        return pa.array([*map(_encodable, values)], field.type)


_DECLARED: Final = yaml.safe_load(files(__package__).joinpath("tables.yaml").read_text("utf-8"))
KEYS: Final[Mapping[str, tuple[str, str]]] = _DECLARED["keys"]
"""Columns of all tables; a row has a value for each."""

TABLES: Final[Mapping[str, LakeTable]] = {
    name: LakeTable(name, **{**of, "columns": {**KEYS, **of["columns"]}, "order": (*of["order"],)})
    for name, of in _DECLARED["tables"].items()
}
"""The tables by name, `channels` first and `bags` last: in this order they are committed."""

Row: TypeAlias = "Mapping[str, object]"
"""Values by column; others are null, but for `time` and `topic_key`, which follow from these."""


class ShippedBag(NamedTuple):
    """The columns of `bags` that identify a bag.

    Attributes:
        robot: the name of the robot.
        bag_id: see `rows.bag_id_of`.
        day: the day (UTC) of its first message.
        file: its path below the bag directory.
        size: the size of its file in bytes.
        sha256: the hash of its file, in hexadecimal.
        mtime_ns: the mtime of its file.
        made_of: see `RowMaker.made_of`.
        start_ns: the log time of its first message.
        end_ns: the log time of its last message.
    """

    robot: str
    bag_id: str
    day: date
    file: str
    size: int
    sha256: str
    mtime_ns: Ns
    made_of: str
    start_ns: Ns
    end_ns: Ns


def end_of(day: date) -> Ns:
    """Returns the last log time of a day (UTC)."""
    next_day = datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1)
    return int(next_day.timestamp()) * NS_PER_S - 1


def _encodable(value: object) -> object:
    """Returns a value whose texts can be encoded in UTF-8."""
    if isinstance(value, str):
        return encodable(value)
    if isinstance(value, list | tuple):
        return type(value)(map(_encodable, value))
    return value


def _is(kind: type[ex.BooleanExpression], column: str, value: object) -> ex.BooleanExpression:
    # Pydantic's plugin for mypy takes the constructors to have other parameters.
    return cast("Callable[[str, object], ex.BooleanExpression]", kind)(column, value)


def rows_with(**allowed: Collection[str]) -> ex.BooleanExpression:
    """Returns the condition for the rows that have one of the allowed values in each column.

    The bounds let Iceberg pass over files, none of which it compares with a long list.
    """
    if not all(allowed.values()):
        return ex.AlwaysFalse()
    conditions: list[ex.BooleanExpression] = []
    for column, values in allowed.items():
        conditions.append(_is(ex.In, column, values))
        conditions.append(_is(ex.GreaterThanOrEqual, column, min(values)))
        conditions.append(_is(ex.LessThanOrEqual, column, max(values)))
    return ex.And(*conditions)


def bags_condition(bags: Collection[tuple[str, date, str]]) -> ex.BooleanExpression:
    """Returns the condition for the rows of bags, given by robot, day and id.

    No two bags have one id, so their robots and days only let Iceberg pass over other files.
    """
    robots, days, ids = zip(*bags, strict=True) if bags else ((), (), ())
    return rows_with(robot={*robots}, day={*map(date.isoformat, days)}, bag_id={*ids})


def window_condition(
    robot: str, columns: tuple[str, str], window: TimeWindow, topics: Collection[str] = ()
) -> ex.BooleanExpression:
    """Returns the condition for the rows of a robot whose span reaches into a window.

    `columns` name its first and last time (inclusive). With `topics`, only their rows are meant.
    """
    first, last = columns
    return ex.And(
        _is(ex.EqualTo, "robot", robot),
        _is(ex.LessThan, first, window.stop),
        _is(ex.GreaterThanOrEqual, last, window.start),
        _is(ex.In, "topic", topics) if topics else ex.AlwaysTrue(),
    )


def open_tables(catalog: IcebergCatalog, names: Iterable[str]) -> dict[str, IcebergTable]:
    """Returns tables by name. Missing tables are created, and new columns are added."""
    catalog.create_namespace_if_not_exists(NAMESPACE)
    tables: dict[str, IcebergTable] = {}
    for name in names:
        table, identifier = TABLES[name], f"{NAMESPACE}.{name}"
        try:
            opened = catalog.load_table(identifier)
        except NoSuchTableError:
            opened = table.create(catalog, identifier)
        if not set(opened.schema().column_names).issuperset(table.columns):
            with opened.update_schema() as update:
                update.union_by_name(table.schema)
        tables[name] = opened
    return tables


def packed_messages(
    log_times: IntArray,
    publish_times: IntArray,
    payloads: Sequence[bytes] | None,
    places: IntArray | None = None,
) -> bytes:
    """Returns messages as bytes, see above.

    The arguments are in order of the log times. Without `payloads` or `places` the bytes do not
    have them.
    """
    form = _PLAIN if places is None else _PLACED
    parts = [
        _HEAD.pack(form, payloads is not None, len(log_times)),
        byte_planes(np.diff(log_times, prepend=np.int64(0)), 8),
        byte_planes(publish_times - log_times, 8),
    ]
    if places is not None:
        parts.append(byte_planes(np.diff(places, prepend=np.int64(0)), 8))
    if payloads is not None:
        sizes = np.fromiter(map(len, payloads), np.int64, len(payloads))
        joined = b"".join(payloads)
        if len(sizes) and (sizes == sizes[0]).all():
            rows = np.frombuffer(joined, np.uint8).reshape(len(sizes), -1)
            joined = rows.T.tobytes()
        parts += [byte_planes(sizes, 4), joined]
    return compress(b"".join(parts))


def unpacked_messages(data: bytes, channel: Channel) -> Batch:
    """Returns the messages that `packed_messages` packed; their payloads are empty if it had none.

    Raises:
        ValueError: the bytes are damaged, or of a later format.
    """
    content = decompress(data)
    try:
        form, has_payloads, count = _HEAD.unpack_from(content)
    except struct.error as error:
        raise ValueError("packed messages are cut short") from error
    if form not in (_PLAIN, _PLACED):
        raise ValueError(
            f"messages are packed in format {form}; this program reads {_PLAIN}, {_PLACED}"
        )
    at = _HEAD.size

    def column(width: int) -> IntArray:
        """Reads the next column, of so many bytes for each number."""
        nonlocal at
        begin, at = at, at + width * count
        return np.asarray(from_planes(content, begin, count, width), np.int64)

    logged = np.cumsum(column(8))
    published = logged + column(8)
    places = np.cumsum(column(8)) if form == _PLACED else np.arange(count)
    sizes, payloads = np.zeros(count, np.int64), b""
    if has_payloads:
        sizes = column(4)
        payloads = content[at:]
        if len(payloads) != sizes.sum():
            raise ValueError("packed messages are cut short")
        if count and (sizes == sizes[0]).all():
            payloads = np.frombuffer(payloads, np.uint8).reshape(-1, count).T.tobytes()
    starts = np.cumsum(sizes) - sizes
    return Batch(channel, logged, published, places, payloads, starts, sizes)
