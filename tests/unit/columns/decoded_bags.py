"""Bags as tables, and the same messages decoded one by one."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from mcap.writer import Writer

from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.table import Table, joined
from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BagReader, Record
from tests.support.leaves import Comparison
from tests.support.mcap_surgery import raw_mcap
from tests.unit.columns.drawn_types import DrawnTypes

EVERYTHING: Final = TimeWindow.everything()


def tables_of(reader: BagReader, path: Path) -> list[Table]:
    """All tables of a bag, those of several groups joined; errors of lost messages are passed.

    Without the messages that cannot be decoded.
    """
    parts: dict[object, list[Table]] = {}
    groups = map(Group.tables, undecoded(reader, path, skip_undecodable=True))
    while True:
        try:
            group = next(groups)
        except StopIteration:
            break
        except BagError:
            continue
        for table in group:
            parts.setdefault((table.channel.topic, table.channel.schema), []).append(table)
    return [joined(tables) for tables in parts.values()]


def records_of(reader: BagReader, path: Path, topics: set[str]) -> Iterator[Record]:
    records = reader.records(path, topics, EVERYTHING)
    while True:
        try:
            yield next(records)
        except StopIteration:
            return
        except BagError:
            continue


def compared(reader: BagReader, path: Path, tables: Sequence[Table]) -> Comparison:
    """Compares tables with the records of a bag, decoded one by one."""
    topics = {table.channel.topic for table in tables}
    records: dict[object, list[Record]] = {}
    for record in records_of(reader, path, topics):
        records.setdefault((record.channel.topic, record.channel.schema), []).append(record)
    assert records.keys() == {(table.channel.topic, table.channel.schema) for table in tables}
    comparison = Comparison()
    for table in tables:
        found = records[table.channel.topic, table.channel.schema]
        kept, messages = found, []
        if "" not in table.left_out:
            kept = []
            for record in found:
                try:
                    messages.append(reader.decode(record))
                    kept.append(record)
                except UndecodableError:
                    pass
            comparison.table(table, messages)
        assert table.log_times.tolist() == [record.log_time for record in kept]
        if "" not in table.left_out:
            assert table.publish_times.tolist() == [record.publish_time for record in kept]
    return comparison


def decoded_alike(reader: BagReader, path: Path) -> Comparison:
    comparison = compared(reader, path, tables_of(reader, path))
    assert comparison.wrong == []
    return comparison


def bag_of(
    path: Path,
    types: DrawnTypes,
    payloads: Sequence[bytes],
    *,
    is_idl: bool = False,
) -> Path:
    """A bag of one topic."""

    def fill(writer: Writer) -> None:
        encoding, definition = ("ros2idl", types.idl()) if is_idl else ("ros2msg", types.msg())
        schema = writer.register_schema(types.root, encoding, definition.encode())
        channel = writer.register_channel("/drawn", "cdr", schema)
        for nth, payload in enumerate(payloads):
            writer.add_message(channel, 10 + nth, payload, 5 + nth)

    return raw_mcap(path, fill, profile="ros2", chunk_size=4096)
