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
from functools import cached_property
from typing import TYPE_CHECKING, Final, TypeAlias

import pyarrow as pa
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import schema_to_pyarrow
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

NAMESPACE: Final = "ros2_memory"
ROWS_VERSION: Final = 27
"""Of what rows are made of a bag; bags whose rows are of another one are shipped again."""

_NS_PER_US: Final = 1_000
_TEXT: Final = StringType()
_LONG: Final = LongType()
_DOUBLE: Final = DoubleType()
_BOOL: Final = BooleanType()
_BYTES: Final = BinaryType()
_TIME: Final = TimestamptzType()
_KEYS: Final[Mapping[str, IcebergType]] = {"robot": _TEXT, "bag_id": _TEXT, "day": DateType()}
"""Columns of all tables; a row has a value for each."""
_TOPIC: Final[Mapping[str, IcebergType]] = {"topic": _TEXT, "topic_key": _TEXT}
_SPANS: Final = (("time_ns", "time_ns"), ("first_ns", "last_ns"), ("start_ns", "end_ns"))
_PROPERTIES: Final = {
    "write.parquet.compression-codec": "zstd",
    "commit.manifest-merge.enabled": "true",
}


def _map(field_id: int, kind: IcebergType) -> MapType:
    """Returns the type of a map from texts; its fields have ids that no column has."""
    return MapType(field_id, _TEXT, field_id + 1, kind, value_required=False)


@dataclass(frozen=True)
class LakeTable:
    """One table.

    Attributes:
        name: its name in the namespace.
        columns: the type of each column besides `robot`, `bag_id` and `day`, in order.
        order: the columns that rows are sorted by.
        row_group: rows of a row group, so that engines skip those of other topics and labels.
    """

    name: str
    columns: Mapping[str, IcebergType]
    order: tuple[str, ...]
    row_group: int = 1 << 17

    @property
    def span(self) -> tuple[str, str]:
        """The columns of the first and the last time (ns) of a row; a null is the first."""
        return next(pair for pair in _SPANS if pair[0] in self.columns)

    def schema(self) -> IcebergSchema:
        """Returns its columns for Iceberg."""
        return IcebergSchema(
            *(
                NestedField(number, name, kind, required=name in _KEYS)
                for number, (name, kind) in enumerate({**_KEYS, **self.columns}.items(), 1)
            )
        )

    def partition(self) -> PartitionSpec:
        """Returns its partitions: robot and day."""
        return PartitionSpec(
            *(
                PartitionField(self._id(name), 1000 + nth, IdentityTransform(), name)
                for nth, name in enumerate(("robot", "day"))
            )
        )

    def sort_order(self) -> SortOrder:
        """Returns its order, which `filled` keeps."""
        return SortOrder(*(SortField(self._id(name), IdentityTransform()) for name in self.order))

    @cached_property
    def arrow_schema(self) -> pa.Schema:
        """Its columns for Arrow."""
        # Without ids: those of a table in a catalogue are others.
        return schema_to_pyarrow(self.schema(), include_field_ids=False)

    def filled(self, rows: Sequence[Row]) -> pa.Table:
        """Returns rows, sorted as the table is."""
        schema = self.arrow_schema
        columns = {
            field.name: _array([row.get(field.name) for row in rows], field.type)
            for field in schema
        }
        if "time" in columns:
            first = columns[self.span[0]].to_numpy() // _NS_PER_US
            columns["time"] = pa.array(first).cast(schema.field("time").type)
        if "topic" in columns:
            columns["topic_key"] = _array(
                [topic_key(topic) for topic in columns["topic"].to_pylist()],
                schema.field("topic_key").type,
            )
        order = [(name, "ascending") for name in self.order]
        return pa.Table.from_pydict(columns, schema).sort_by(order)

    def _id(self, column: str) -> int:
        return self.schema().find_field(column).field_id


TABLES: Final[Mapping[str, LakeTable]] = {
    each.name: each
    for each in (
        LakeTable(
            "channels",
            {
                **_TOPIC,
                "channel": _LONG,
                "type": _TEXT,
                "encoding": _TEXT,
                "latched": _BOOL,
                "schema_encoding": _TEXT,
                "schema": _BYTES,
                "metadata": _TEXT,
                "messages": _LONG,
                "first_ns": _LONG,
                "last_ns": _LONG,
                "has_payloads": _BOOL,
                "packed": _BYTES,
            },
            ("topic_key", "first_ns"),
            row_group=1024,
        ),
        LakeTable(
            "poses",
            {
                **_TOPIC,
                "frame_id": _TEXT,
                "time_ns": _LONG,
                "time": _TIME,
                "x": _DOUBLE,
                "y": _DOUBLE,
                "heading": _DOUBLE,
                "begins": _BOOL,
                "error_m": _DOUBLE,
            },
            ("topic_key", "frame_id", "time_ns"),
        ),
        LakeTable(
            "sightings",
            {
                **_TOPIC,
                "type": _TEXT,
                "time_ns": _LONG,
                "time": _TIME,
                "message": _LONG,
                "label": _TEXT,
                "score": _DOUBLE,
                "frame_id": _TEXT,
                "x": _DOUBLE,
                "y": _DOUBLE,
                "z": _DOUBLE,
                "robot_frame": _TEXT,
                "robot_x": _DOUBLE,
                "robot_y": _DOUBLE,
            },
            ("topic_key", "label", "time_ns"),
        ),
        LakeTable(
            "things",
            {
                **_TOPIC,
                "label": _TEXT,
                "count": _LONG,
                "first_ns": _LONG,
                "last_ns": _LONG,
                "time": _TIME,
                "frame_id": _TEXT,
                "x": _DOUBLE,
                "y": _DOUBLE,
                "z": _DOUBLE,
                "spread_m": _DOUBLE,
                "best_score": _DOUBLE,
            },
            ("topic_key", "label", "first_ns"),
        ),
        LakeTable(
            "events",
            {
                **_TOPIC,
                "kind": _TEXT,
                "first_ns": _LONG,
                "last_ns": _LONG,
                "time": _TIME,
                "text": _TEXT,
                "value": _DOUBLE,
                "count": _LONG,
                "x": _DOUBLE,
                "y": _DOUBLE,
            },
            ("topic_key", "kind", "first_ns"),
        ),
        LakeTable(
            "messages",
            {
                **_TOPIC,
                "type": _TEXT,
                "time_ns": _LONG,
                "time": _TIME,
                "publish_ns": _LONG,
                "message": _LONG,
                "value": _TEXT,
                "undecodable": _TEXT,
                "flags": _map(107, _BOOL),
                "integers": _map(103, _LONG),
                "numbers": _map(105, _DOUBLE),
                "texts": _map(101, _TEXT),
            },
            ("topic_key", "time_ns"),
        ),
        LakeTable(
            "bags",
            {
                "recording": _TEXT,
                "file": _TEXT,
                "size": _LONG,
                "sha256": _TEXT,
                "mtime_ns": _LONG,
                "made_of": _TEXT,
                "start_ns": _LONG,
                "end_ns": _LONG,
                "time": _TIME,
                "messages": _LONG,
                "undecodable": _LONG,
                "detections": _LONG,
                "pose_topic": _TEXT,
                "map_frame": _TEXT,
                "poses": _LONG,
                "distance_m": _DOUBLE,
                "gap_m": _DOUBLE,
                "max_mps": _DOUBLE,
                "stood_s": _DOUBLE,
                "summary": _TEXT,
                "counts": _BYTES,
            },
            ("start_ns",),
        ),
    )
}
"""The tables by name, `bags` last: in this order they are committed, and what is there is whole."""

Row: TypeAlias = "Mapping[str, object]"
"""Values by column; others are null, but for `time` and `topic_key`, which follow from these."""


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
                update.union_by_name(table.schema())
        found[name] = opened
    return found
