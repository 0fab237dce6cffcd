"""The Iceberg tables of a lake, as tables.yaml declares them, and rows as Arrow tables."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import pyarrow as pa
import yaml
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import schema_to_pyarrow
from pyiceberg.partitioning import PartitionField, PartitionSpec
from pyiceberg.schema import Schema as IcebergSchema
from pyiceberg.table.sorting import SortField, SortOrder
from pyiceberg.transforms import IdentityTransform

from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from datetime import date

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

NAMESPACE: Final = "ros2_memory"
ROWS_VERSION: Final = 28
"""Of what rows are made of a bag; bags whose rows are of another one are shipped again."""

_NS_PER_US: Final = 1_000
_FIRST_TIMES: Final = ("time_ns", "first_ns", "start_ns")
"""The column that `time` repeats."""
_PROPERTIES: Final = {
    "write.parquet.compression-codec": "zstd",
    "commit.manifest-merge.enabled": "true",
}
_PARTITIONED_BY: Final = ("robot", "day")
_ROW_GROUP: Final = 1 << 17
_INNER_IDS: Final = 100
"""Parts of a map have ids that no column has."""


@dataclass(frozen=True)
class LakeTable:
    """One table.

    Attributes:
        name: its name in the namespace.
        row: what a row of it is.
        columns: the type and the meaning of each column, in order.
        order: the columns that rows are sorted by.
        row_group: rows of a row group, so that engines skip those of other topics and labels.
    """

    name: str
    row: str
    columns: Mapping[str, tuple[str, str]]
    order: tuple[str, ...]
    row_group: int = _ROW_GROUP

    @cached_property
    def schema(self) -> IcebergSchema:
        """Its columns for Iceberg, each with its meaning."""
        fields = [
            {
                "id": number,
                "name": name,
                "type": _iceberg_type(kind, _INNER_IDS + 2 * number),
                "required": name in KEYS,
                "doc": meaning,
            }
            for number, (name, (kind, meaning)) in enumerate(self.columns.items(), 1)
        ]
        return IcebergSchema.model_validate({"type": "struct", "fields": fields})

    @cached_property
    def arrow_schema(self) -> pa.Schema:
        """Its columns for Arrow."""
        # Without ids: those of a table in a catalogue are others.
        return schema_to_pyarrow(self.schema, include_field_ids=False)

    def create(self, catalog: IcebergCatalog, identifier: str) -> IcebergTable:
        """Creates the table, partitioned by robot and day, in the order that `filled` keeps."""
        ids = {name: self.schema.find_field(name).field_id for name in self.columns}
        same = IdentityTransform[Any]()
        parts = (
            PartitionField(ids[name], 1000 + nth, same, name)
            for nth, name in enumerate(_PARTITIONED_BY)
        )
        return catalog.create_table(
            identifier,
            self.schema,
            partition_spec=PartitionSpec(*parts),
            sort_order=SortOrder(*(SortField(ids[name], same) for name in self.order)),
            properties={**_PROPERTIES, "write.parquet.row-group-limit": str(self.row_group)},
        )

    def sorted(self, rows: pa.Table) -> pa.Table:
        """Returns rows in the order of the table."""
        return rows.sort_by([(name, "ascending") for name in self.order])

    def filled(self, rows: Sequence[Row]) -> pa.Table:
        """Returns rows, sorted as the table is."""
        schema = self.arrow_schema
        columns = {
            field.name: _array([row.get(field.name) for row in rows], field.type)
            for field in schema
        }
        if "time" in columns:
            first = next(columns[name] for name in _FIRST_TIMES if name in columns)
            in_us = pa.array(first.to_numpy() // _NS_PER_US)
            columns["time"] = in_us.cast(schema.field("time").type)
        if "topic" in columns:
            columns["topic_key"] = _array(
                [topic_key(topic) for topic in columns["topic"].to_pylist()],
                schema.field("topic_key").type,
            )
        return self.sorted(pa.Table.from_pydict(columns, schema))


def _iceberg_type(kind: str, inner_id: int) -> object:
    if not kind.startswith("map "):
        return kind
    return {
        "type": "map",
        "key-id": inner_id,
        "key": "string",
        "value-id": inner_id + 1,
        "value": kind.removeprefix("map "),
        "value-required": False,
    }


_DECLARED: Final = yaml.safe_load(files(__package__).joinpath("tables.yaml").read_text("utf-8"))
KEYS: Final[Mapping[str, tuple[str, str]]] = _DECLARED["keys"]
"""Columns of all tables; a row has a value for each."""

TABLES: Final[Mapping[str, LakeTable]] = {
    name: LakeTable(
        name,
        table["row"],
        {**KEYS, **table["columns"]},
        tuple(table["order"]),
        table.get("row_group", _ROW_GROUP),
    )
    for name, table in _DECLARED["tables"].items()
}
"""The tables by name, `channels` first and `bags` last: in this order they are committed."""

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
        return encodable(value)
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
            opened = table.create(catalog, identifier)
        if not set(opened.schema().column_names).issuperset(table.columns):
            with opened.update_schema() as update:
                update.union_by_name(table.schema)
        found[name] = opened
    return found
