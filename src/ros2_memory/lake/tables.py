"""The Iceberg tables of a lake: their columns, partitions and order, and rows as Arrow tables.

Every row has `robot`, `bag_id` and `day` (UTC, of the start of its bag). Tables are partitioned by
robot and day, and sorted by `topic_key` (the topic without slashes, which some engines do not take
in folder names) and time. Times are there twice: `*_ns` are nanoseconds of log time since the
epoch, exact; `time` is the same as a timestamp of microseconds, for people and for engines.

    bags        a row for each bag: which file, when, how much, metres and standstill of it alone
    channels    a row for each channel of a bag: its definition, and its messages, packed
    poses       the robot's track in the map and in its own frame, thinned to `error_m`
    sightings   a row for each detection of each message
    things      a row for each place where a detector saw a label in the bag
    events      standstills, sudden stops, toggles, errors, and labels in view, of the bag alone
    messages    a row for each message of the topics that are chosen for it: scalars in maps by
                their dot-paths, JSON for the rest

New columns are added at the end, and old lakes get them when they are opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Final, Literal

import pyarrow as pa
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.partitioning import PartitionField, PartitionSpec
from pyiceberg.schema import Schema as IcebergSchema
from pyiceberg.table.sorting import SortField, SortOrder
from pyiceberg.transforms import IdentityTransform
from pyiceberg.types import (
    BinaryType,
    BooleanType,
    DateType,
    DoubleType,
    IcebergType,
    LongType,
    MapType,
    NestedField,
    StringType,
    TimestamptzType,
)

from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from datetime import date

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    Kind = Literal[
        "text",
        "long",
        "double",
        "bool",
        "bytes",
        "date",
        "time",
        "texts",
        "longs",
        "doubles",
        "bools",
    ]

NAMESPACE: Final = "ros2_memory"
ROWS_VERSION: Final = 27
"""Of what rows are made of a bag; bags whose rows are of another one are shipped again."""

_NS_PER_US: Final = 1_000


def _map(field_id: int, kind: IcebergType) -> MapType:
    return MapType(field_id, StringType(), field_id + 1, kind, value_required=False)


_TYPES: Final[Mapping[Kind, tuple[IcebergType, pa.DataType]]] = {
    "text": (StringType(), pa.large_string()),
    "long": (LongType(), pa.int64()),
    "double": (DoubleType(), pa.float64()),
    "bool": (BooleanType(), pa.bool_()),
    "bytes": (BinaryType(), pa.large_binary()),
    "date": (DateType(), pa.date32()),
    "time": (TimestamptzType(), pa.timestamp("us", tz="UTC")),
    "texts": (_map(101, StringType()), pa.map_(pa.large_string(), pa.large_string())),
    "longs": (_map(103, LongType()), pa.map_(pa.large_string(), pa.int64())),
    "doubles": (_map(105, DoubleType()), pa.map_(pa.large_string(), pa.float64())),
    "bools": (_map(107, BooleanType()), pa.map_(pa.large_string(), pa.bool_())),
}
"""The last four are maps from texts; their fields have ids that no column has."""
_KEYS: Final[Mapping[str, Kind]] = {"robot": "text", "bag_id": "text", "day": "date"}
"""Columns of all tables; a row has a value for each."""
_PROPERTIES: Final = {
    "write.parquet.compression-codec": "zstd",
    "commit.manifest-merge.enabled": "true",
}


@dataclass(frozen=True, slots=True)
class LakeTable:
    """One table.

    Attributes:
        name: its name in the namespace.
        columns: the kind of each column besides `robot`, `bag_id` and `day`, in the order of a row.
        order: the columns that rows are sorted by.
        row_group: rows of a row group, so that engines skip those of other topics and labels.
    """

    name: str
    columns: Mapping[str, Kind]
    order: tuple[str, ...]
    row_group: int = 1 << 17

    def schema(self) -> IcebergSchema:
        """Returns its columns for Iceberg."""
        fields = [
            NestedField(number, name, _TYPES[kind][0], required=name in _KEYS)
            for number, (name, kind) in enumerate({**_KEYS, **self.columns}.items(), 1)
        ]
        return IcebergSchema(*fields)

    def partition(self) -> PartitionSpec:
        """Returns its partitions: robot and day."""
        schema = self.schema()
        return PartitionSpec(
            *(
                PartitionField(
                    schema.find_field(name).field_id, 1000 + nth, IdentityTransform(), name
                )
                for nth, name in enumerate(("robot", "day"))
            )
        )

    def sort_order(self) -> SortOrder:
        """Returns its order, which `to_arrow` keeps."""
        schema = self.schema()
        return SortOrder(
            *(
                SortField(schema.find_field(name).field_id, IdentityTransform())
                for name in self.order
            )
        )

    def arrow_schema(self) -> pa.Schema:
        """Returns its columns for Arrow."""
        return pa.schema(
            [
                pa.field(name, _TYPES[kind][1], nullable=name not in _KEYS)
                for name, kind in {**_KEYS, **self.columns}.items()
            ]
        )


TABLES: Final[Mapping[str, LakeTable]] = {
    each.name: each
    for each in (
        LakeTable(
            "bags",
            {
                "recording": "text",
                "file": "text",
                "size": "long",
                "sha256": "text",
                "mtime_ns": "long",
                "made_of": "text",
                "start_ns": "long",
                "end_ns": "long",
                "time": "time",
                "messages": "long",
                "undecodable": "long",
                "detections": "long",
                "pose_topic": "text",
                "map_frame": "text",
                "poses": "long",
                "distance_m": "double",
                "gap_m": "double",
                "max_mps": "double",
                "stood_s": "double",
                "summary": "text",
                "counts": "bytes",
            },
            ("start_ns",),
        ),
        LakeTable(
            "channels",
            {
                "topic": "text",
                "topic_key": "text",
                "channel": "long",
                "type": "text",
                "encoding": "text",
                "latched": "bool",
                "schema_encoding": "text",
                "schema": "bytes",
                "metadata": "text",
                "messages": "long",
                "first_ns": "long",
                "last_ns": "long",
                "has_payloads": "bool",
                "packed": "bytes",
            },
            ("topic_key", "first_ns"),
            row_group=1024,
        ),
        LakeTable(
            "poses",
            {
                "topic": "text",
                "topic_key": "text",
                "frame_id": "text",
                "time_ns": "long",
                "time": "time",
                "x": "double",
                "y": "double",
                "heading": "double",
                "begins": "bool",
                "error_m": "double",
            },
            ("topic_key", "frame_id", "time_ns"),
        ),
        LakeTable(
            "sightings",
            {
                "topic": "text",
                "topic_key": "text",
                "type": "text",
                "time_ns": "long",
                "time": "time",
                "message": "long",
                "label": "text",
                "score": "double",
                "frame_id": "text",
                "x": "double",
                "y": "double",
                "z": "double",
                "robot_frame": "text",
                "robot_x": "double",
                "robot_y": "double",
            },
            ("topic_key", "label", "time_ns"),
        ),
        LakeTable(
            "things",
            {
                "topic": "text",
                "topic_key": "text",
                "label": "text",
                "count": "long",
                "first_ns": "long",
                "last_ns": "long",
                "time": "time",
                "frame_id": "text",
                "x": "double",
                "y": "double",
                "z": "double",
                "spread_m": "double",
                "best_score": "double",
            },
            ("topic_key", "label", "first_ns"),
        ),
        LakeTable(
            "events",
            {
                "topic": "text",
                "topic_key": "text",
                "kind": "text",
                "first_ns": "long",
                "last_ns": "long",
                "time": "time",
                "text": "text",
                "value": "double",
                "count": "long",
                "x": "double",
                "y": "double",
            },
            ("topic_key", "kind", "first_ns"),
        ),
        LakeTable(
            "messages",
            {
                "topic": "text",
                "topic_key": "text",
                "type": "text",
                "time_ns": "long",
                "time": "time",
                "publish_ns": "long",
                "message": "long",
                "value": "text",
                "undecodable": "text",
                "flags": "bools",
                "integers": "longs",
                "numbers": "doubles",
                "texts": "texts",
            },
            ("topic_key", "time_ns"),
        ),
    )
}
"""The tables by name; `bags` is committed last, so that a bag with a row there is whole."""

Row = tuple[object, ...]
"""The values of a table's own columns, in order."""


def topic_key(topic: str) -> str:
    """Returns a topic without slashes: `/vision/objects` is `vision.objects`."""
    return topic.strip("/").replace("/", ".")


def day_of(time_ns: Ns) -> date:
    """Returns the day (UTC) of a time."""
    return datetime.fromtimestamp(time_ns // NS_PER_S, tz=UTC).date()


def end_of(day: date) -> Ns:
    """Returns the last log time of a day (UTC)."""
    next_day = datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1)
    return int(next_day.timestamp()) * NS_PER_S - 1


def microseconds(time_ns: Ns) -> int:
    """Returns a time for a column of timestamps."""
    return time_ns // _NS_PER_US


def to_arrow(
    table: LakeTable, robot: str, day: date, rows_of: Mapping[str, Sequence[Row]]
) -> pa.Table:
    """Returns rows of one robot's bags of one day, by bag id, sorted as the table is."""
    schema = table.arrow_schema()
    rows = [row for of_bag in rows_of.values() for row in of_bag]
    ids = [bag_id for bag_id, of_bag in rows_of.items() for _ in of_bag]
    columns = zip(*rows, strict=True) if rows else ((),) * len(table.columns)
    values = ([robot] * len(rows), ids, [day] * len(rows), *columns)
    arrays = [_array(each, field.type) for each, field in zip(values, schema, strict=True)]
    order = [(name, "ascending") for name in table.order]
    return pa.Table.from_arrays(arrays, schema=schema).sort_by(order)


def _array(values: Sequence[object], kind: pa.DataType) -> pa.Array:
    try:
        return pa.array(values, kind)
    except UnicodeEncodeError:
        # UTF-8 has no lone surrogates, which bytes of a hostile bag decode to.
        return pa.array([*map(_encodable, values)], kind)


def _encodable(value: object) -> object:
    """Returns a text, or the names and values of a map, as UTF-8 can have them."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, list | tuple):
        return type(value)(map(_encodable, value))
    return value


def open_tables(
    catalog: IcebergCatalog, names: Iterable[str], namespace: str = NAMESPACE
) -> dict[str, IcebergTable]:
    """Returns tables by name; makes those that are missing, and adds columns that are new."""
    catalog.create_namespace_if_not_exists(namespace)
    found: dict[str, IcebergTable] = {}
    for name in names:
        table, identifier = TABLES[name], f"{namespace}.{name}"
        try:
            opened = catalog.load_table(identifier)
        except NoSuchTableError:
            opened = catalog.create_table(
                identifier,
                table.schema(),
                partition_spec=table.partition(),
                sort_order=table.sort_order(),
                properties={
                    **_PROPERTIES,
                    "write.parquet.row-group-limit": str(table.row_group),
                },
            )
        known = {each.name for each in opened.schema().fields}
        if not known.issuperset(table.columns):
            with opened.update_schema() as update:
                for column, kind in table.columns.items():
                    if column not in known:
                        update.add_column(column, _TYPES[kind][0])
        found[name] = opened
    return found
