"""Tables whose columns are unpacked when they are first asked for, and that know what was lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

from ros2_memory.columns.pack import Known, folded
from ros2_memory.columns.table import Column, Elements, Table, Zone, joined

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from ros2_memory.columns.layout import Layout
    from ros2_memory.storage.base import Channel, Definition, IntArray

V = TypeVar("V")


class Lazily(Mapping[str, V]):
    """A mapping whose values are made when they are first asked for, and kept."""

    def __init__(self, names: Collection[str], make: Callable[[str], V]) -> None:
        self._names = names
        self._make = make
        self._made: dict[str, V] = {}

    def __getitem__(self, name: str) -> V:
        made = self._made.get(name)
        if made is None:
            if name not in self._names:
                raise KeyError(name)
            made = self._made[name] = self._make(name)
        return made

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True, slots=True, eq=False)
class StoredTable(Table):
    """A table whose columns are unpacked when they are first asked for, by any thread.

    Attributes:
        number: that of its topic at the caller's.
        known: what is known of a column, by its path from the table; raises KeyError where there
            is none.
    """

    number: int = field(kw_only=True)
    known: Callable[[str], Known] = field(kw_only=True)

    def error(self, path: str) -> float:
        """Returns the greatest absolute error of a column; 0.0: it is exact.

        Args:
            path: the column; of elements `<sequence>.<column>`.

        Raises:
            KeyError: there is no such column.
        """
        return self.known(path).error

    def zone(self, path: str) -> Zone | None:
        """Returns what is known of a column without unpacking it; None where there is no such one.

        `path` is as in `error`.
        """
        try:
            return self.known(path).zone
        except KeyError:
            return None


def joined_stored(tables: Sequence[StoredTable]) -> StoredTable:
    """Returns tables of one topic, type and definition as one, that still knows what was lost.

    Its columns are unpacked already. A zone is that of all tables together, an error the greatest.
    """
    whole = joined(tables)

    @cache
    def known(path: str) -> Known:
        parts = [table.known(path) for table in tables]
        return Known(max(part.error for part in parts), _joined_zone([part.zone for part in parts]))

    return StoredTable(
        whole.channel,
        whole.log_times,
        whole.publish_times,
        whole.places,
        whole.columns,
        whole.elements,
        whole.left_out,
        whole.payload_hashes,
        whole.undecodable,
        whole.undecodable_reason,
        whole.definition,
        number=tables[0].number,
        known=known,
    )


def _joined_zone(zones: Sequence[Zone]) -> Zone:
    leasts = [zone.least for zone in zones if zone.least is not None]
    greatests = [zone.greatest for zone in zones if zone.greatest is not None]
    words = [zone.words for zone in zones if zone.words is not None]
    return Zone(
        min(leasts, default=None),
        max(greatests, default=None),
        sum(zone.nulls for zone in zones),
        folded("\n".join(words).split("\n")) if len(words) == len(zones) else None,
    )


class Topic(NamedTuple):
    """What the caller keeps of a topic under its number."""

    channel: Channel
    layout: Layout
    definition: Definition | None = None


class Times(NamedTuple):
    """What a table has besides its columns."""

    log_times: IntArray
    publish_times: IntArray
    places: IntArray
    payload_hashes: IntArray | None = None


def lazy_table(
    number: int,
    topic: Topic,
    times: Times,
    known: Callable[[str], Known],
    column: Callable[[str], Column],
) -> StoredTable:
    """Returns a table that asks for its columns when they are needed, and keeps them.

    Args:
        number: of the topic at the caller's.
        topic: its channel and layout.
        times: what it has besides columns.
        known: what is known of a column, by the paths of `Layout.slots`.
        column: the column, or the owners, at such a path.
    """
    layout = topic.layout

    def elements_in(inside: Layout, around: str) -> Mapping[str, Elements]:
        def elements(path: str) -> Elements:
            whole, inner = f"{around}{path}", inside.sequences[path]
            return Elements(
                cast("IntArray", column(f"{whole}#")),
                Lazily(inner.columns, lambda name: column(f"{whole}.{name}".rstrip("."))),
                elements_in(inner, f"{whole}."),
            )

        return Lazily(inside.sequences, elements)

    return StoredTable(
        topic.channel,
        times.log_times,
        times.publish_times,
        times.places,
        Lazily(layout.columns, column),
        elements_in(layout, ""),
        layout.left_out,
        times.payload_hashes,
        definition=topic.definition,
        number=number,
        known=lambda path: known(path.rstrip(".")),
    )
