"""All tables of a bag in one blob, and tables that unpack a column when it is asked for.

The columns of a topic are the same from bag to bag, so a blob holds none of their names: a
`Layout` does, which its caller keeps under a number. What the blob is, once decompressed (numbers
are little-endian; `k` values of 8 bytes lie in planes, the lowest byte of each first, as they then
compress best)::

    1       format (`pack.FORMAT`)
    2       t, the number of tables
    t times:
      4     number of the topic, as the caller has it
      1     which of these it has: 1 publish times, 2 places, 4 hashes of payloads
      2     p, the number of its packed columns
      2     s, the number of its sequences, also of those within sequences
      4     rows
      4 s   elements of each sequence, in order
    4       k, the number of packed columns: of each table in turn the log times, those of 1, 2
            and 4 that it has, and then, of its layout, the columns; of each sequence the owners,
            its columns and its sequences in turn
    2       length of the codecs
    ...     codecs without their type, separated by newlines
    2 k     which codec
    4 k     bytes of the column's data
    4 k     greatest error, as a float32 that is not less
    4 k     nulls
    8 k     least: an int64, uint64 or float64; 0 of texts and where there is none
    8 k     greatest, but for the bits that it has in common with the least (exclusive or)
    ...     the data, one column after the other

Publish times are packed in place of log times where both are there, and log times as what they are
later: the middleware delays every message by a little, and publishers keep time.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple, NotRequired, TypedDict, TypeVar, cast

import numpy as np

from ros2_memory.columns.pack import (
    FORMAT,
    Packed,
    compressed,
    decompressed,
    pack_columns,
    unpack,
    zone_of_texts,
)
from ros2_memory.columns.steps import EXACT, Step, step_of
from ros2_memory.columns.table import Column, Elements, Numbers, Table, Texts, Zone

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ros2_memory.storage.base import Channel, Definition, IntArray

_PUBLISHED: Final = 1
_PLACES: Final = 2
_HASHES: Final = 4


V = TypeVar("V")


class _Described(TypedDict):
    """A layout as JSON."""

    columns: dict[str, str]
    sequences: NotRequired[dict[str, _Described]]
    left_out: NotRequired[dict[str, str]]


class Kind(NamedTuple):
    """What a column is: `text` or numpy's name of its dtype, and how exactly it is stored."""

    dtype: str
    step: Step = EXACT


class Slot(NamedTuple):
    """Where a column lies among the packed ones of its table, in the order of `Layout`.

    Attributes:
        nth: its place.
        dtype: as in `Kind`.
        sequence: the number of the sequence that it is of, counted like the places; 0: none.
    """

    nth: int
    dtype: str
    sequence: int


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of the tables of one topic, type and definition.

    Attributes:
        columns: by the path of the field.
        sequences: by the path of the sequence, as `Elements` has them.
        left_out: what is no column, and why.
        slots: where a column lies among the packed ones of its table, by its path from there
            (`detections.label`), and where owners lie, by the path of the sequence and `#`.
    """

    columns: Mapping[str, Kind]
    sequences: Mapping[str, Layout] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    slots: Mapping[str, Slot] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        slots = {
            path: Slot(nth, kind.dtype, 0) for nth, (path, kind) in enumerate(self.columns.items())
        }
        sequences = 0
        for path, inner in self.sequences.items():
            own = sequences + 1
            sequences = own
            slots[f"{path}#"] = Slot(len(slots), "int64", own)
            begin = len(slots)
            for name, slot in inner.slots.items():
                whole = f"{path}.{name}".rstrip(".")
                sequences = max(sequences, own + slot.sequence)
                slots[whole] = Slot(begin + slot.nth, slot.dtype, own + slot.sequence)
        object.__setattr__(self, "slots", slots)

    @classmethod
    def of(cls, table: Table, definition: Definition | None) -> Layout:
        """Returns that of a table; the definition names the steps."""
        return cls._of(table, definition, "", table.left_out)

    @classmethod
    def _of(
        cls,
        rows: Table | Elements,
        definition: Definition | None,
        around: str,
        left_out: Mapping[str, str],
    ) -> Layout:
        columns = {
            name: _kind(column, f"{around}{name}".rstrip("."), definition)
            for name, column in rows.columns.items()
        }
        sequences = {
            name: cls._of(inner, definition, f"{around}{name}.", {})
            for name, inner in rows.elements.items()
        }
        return cls(columns, sequences, left_out)

    def to_json(self) -> str:
        """Returns it as a person can read it; equal layouts give equal texts."""
        return json.dumps(self._described(), ensure_ascii=False)

    def _described(self) -> dict[str, object]:
        found: dict[str, object] = {
            "columns": {
                path: kind.dtype if kind.step == EXACT else f"{kind.dtype} {kind.step}"
                for path, kind in self.columns.items()
            }
        }
        if self.sequences:
            found["sequences"] = {
                path: inner._described() for path, inner in self.sequences.items()
            }
        if self.left_out:
            found["left_out"] = dict(self.left_out)
        return found

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Returns the layout that was written so.

        Raises:
            ValueError: it is not one.
        """
        try:
            return cls._read(cast("_Described", json.loads(text)))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"this is not the layout of a table: {text[:80]!r}") from error

    @classmethod
    def _read(cls, described: _Described) -> Layout:
        columns: dict[str, Kind] = {}
        for path, words in described["columns"].items():
            dtype, _, step = words.partition(" ")
            columns[path] = Kind(dtype, Step.parse(step) if step else EXACT)
        sequences = {
            path: cls._read(inner) for path, inner in described.get("sequences", {}).items()
        }
        return cls(columns, sequences, described.get("left_out", {}))


def _kind(column: Column, path: str, definition: Definition | None) -> Kind:
    if isinstance(column, Texts):
        return Kind("text")
    name = column.dtype.name
    return Kind(name, step_of(path, definition) if column.dtype.kind == "f" else EXACT)


class Entry(NamedTuple):
    """A table to be packed: the number that its topic and layout have at the caller's."""

    topic: int
    layout: Layout
    table: Table


def pack_tables(entries: Iterable[Entry], *, published: bool = True, places: bool = True) -> bytes:
    """Returns the tables as one compressed blob.

    Args:
        entries: the tables, in any order.
        published: whether publish times are packed; without them they come back as log times.
        places: whether places are packed; without them they come back as 0, 1, 2.

    Raises:
        ValueError: a table has other columns than its layout.
    """
    heads: list[bytes] = []
    columns: list[tuple[Column, Step]] = []
    for topic, layout, table in entries:
        before, counts = len(columns), list[int]()
        flags = _PUBLISHED * published | _PLACES * places
        if published:
            columns.append((table.log_times - table.publish_times, EXACT))
        columns.append((table.publish_times if published else table.log_times, EXACT))
        if places:
            columns.append((table.places, EXACT))
        if table.payload_hashes is not None:
            flags |= _HASHES
            columns.append((table.payload_hashes, EXACT))
        try:
            _add_columns(layout, table, columns, counts)
        except KeyError as error:
            raise ValueError(
                f"the table of {table.channel.topic} has no {error}, which its layout has"
            ) from error
        sizes = (len(columns) - before, len(counts), len(table), *counts)
        heads.append(struct.pack(f"<IBHHI{len(counts)}I", topic, flags, *sizes))
    packs = pack_columns(columns)
    head = struct.pack("<BH", FORMAT, len(heads)) + b"".join(heads)
    return compressed(head + _directory(packs) + b"".join(packed.data for packed in packs))


def _add_columns(
    layout: Layout, rows: Table | Elements, columns: list[tuple[Column, Step]], counts: list[int]
) -> None:
    """Adds columns in the order of `Layout.slots`, and the lengths of sequences."""
    if len(rows.columns) != len(layout.columns) or len(rows.elements) != len(layout.sequences):
        raise ValueError(f"a table has other columns than its layout: {sorted(rows.columns)}")
    columns += [(rows.columns[path], kind.step) for path, kind in layout.columns.items()]
    for path, inner in layout.sequences.items():
        elements = rows.elements[path]
        counts.append(len(elements))
        columns.append((elements.owners, EXACT))
        _add_columns(inner, elements, columns, counts)


def _directory(packs: list[Packed]) -> bytes:
    """What is known of the columns, as the module's docstring shows it."""
    codecs: dict[str, int] = {}
    which = [codecs.setdefault(packed.codec.partition(" ")[2], len(codecs)) for packed in packs]
    errors = np.array([packed.error for packed in packs])
    with np.errstate(over="ignore"):
        stated = errors.astype("<f4")
    stated = np.where(stated < errors, np.nextafter(stated, np.float32(np.inf)), stated)
    sizes = np.array([len(packed.data) for packed in packs], "<u4")
    nulls = np.array([packed.zone.nulls for packed in packs], "<u4")
    least = np.frombuffer(b"".join(_eight(packed.zone.least) for packed in packs), "<u8")
    greatest = np.frombuffer(b"".join(_eight(packed.zone.greatest) for packed in packs), "<u8")
    names = "\n".join(codecs).encode()
    return b"".join(
        (
            struct.pack("<IH", len(packs), len(names)),
            names,
            _in_planes(np.array(which, "<u2")),
            _in_planes(sizes),
            _in_planes(stated),
            _in_planes(nulls),
            _in_planes(least),
            _in_planes(greatest ^ least),
        )
    )


def _eight(number: float | None) -> bytes:
    if number is None:
        return bytes(8)
    if isinstance(number, int):
        return (number & 0xFFFF_FFFF_FFFF_FFFF).to_bytes(8, "little")
    return struct.pack("<d", number)


def _in_planes(numbers: Numbers) -> bytes:
    return numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes()


class Topic(NamedTuple):
    """What the caller keeps of a topic under its number."""

    channel: Channel
    layout: Layout


def unpack_tables(
    blob: bytes, topics: Mapping[int, Topic], wanted: Callable[[int], bool] | None = None
) -> list[StoredTable]:
    """Returns the tables of a blob, in the order in which they were packed.

    Args:
        blob: what `pack_tables` returned.
        topics: the topics of the tables, by the number under which they were packed.
        wanted: of which numbers tables are returned; of all by default. Others cost nothing, and
            `topics` need not know them.

    Raises:
        ValueError: the blob is damaged, of another format, or not of these layouts.
    """
    data = decompressed(blob)
    form, count = struct.unpack_from("<BH", data)
    if form != FORMAT:
        raise ValueError(f"the blob of columns is of format {form}, this program reads {FORMAT}")
    at = 3
    heads: list[tuple[_Head, tuple[int, ...]]] = []
    for _ in range(count):
        head = _Head(*struct.unpack_from("<IBHHI", data, at))
        heads.append((head, struct.unpack_from(f"<{head.sequences}I", data, at + 13)))
        at += 13 + 4 * head.sequences
    packs = _Packs(data, at)
    first = 0
    tables: list[StoredTable] = []
    for head, counts in heads:
        if wanted is None or wanted(head.topic):
            tables.append(_table(packs, first, head, counts, topics[head.topic]))
        first += head.packs
    return tables


class _Head(NamedTuple):
    """What a blob says of a table as a whole."""

    topic: int
    flags: int
    packs: int
    sequences: int
    rows: int


class _Packs:
    """The packed columns of a blob, by their number."""

    def __init__(self, data: bytes, at: int) -> None:
        count, length = struct.unpack_from("<IH", data, at)
        at += 6
        self._data = data
        self._codecs = data[at : at + length].decode().split("\n")
        planes = np.frombuffer(data, np.uint8, 30 * count, at + length).reshape(30, count)
        self._which = _from_planes(planes[:2], "<u2").astype(np.int64)
        self._starts = np.zeros(count + 1, np.int64)
        np.cumsum(_from_planes(planes[2:6], "<u4"), out=self._starts[1:])
        self._starts += at + length + 30 * count
        self._facts = np.ascontiguousarray(planes[6:].T)

    def packed(self, nth: int, dtype: str, count: int) -> Packed:
        """Returns one of them; `count` values of this type are in it."""
        codec = f"{dtype} {self._codecs[self._which[nth]]}"
        data = self._data[self._starts[nth] : self._starts[nth + 1]]
        if dtype == "text":
            return Packed(codec, count, 0.0, zone_of_texts(data), data)
        error, nulls, least, difference = struct.unpack("<fIQQ", self._facts[nth])
        zone = Zone(nulls=nulls)
        if nulls < count:
            zone = Zone(_number(dtype, least), _number(dtype, least ^ difference), nulls)
        return Packed(codec, count, error, zone, data)


def unpacked(packed: Packed) -> Column:
    """Returns the values of a packed column."""
    return unpack(packed.codec, packed.count, packed.zone.least, packed.data)


def _from_planes(planes: NDArray[np.uint8], dtype: str) -> Numbers:
    return np.ascontiguousarray(planes.T).view(dtype).ravel()


def _number(dtype: str, bits: int) -> float:
    raw = bits.to_bytes(8, "little")
    if dtype.startswith("float"):
        return float(struct.unpack("<d", raw)[0])
    return int.from_bytes(raw, "little", signed=not dtype.startswith("u"))


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
    """A table of a blob. Its columns are unpacked when they are first asked for, by any thread."""

    known: Callable[[str], Packed] | None = None

    def error(self, path: str) -> float:
        """Returns the greatest absolute error of a column, 0.0 where it is exact.

        Args:
            path: the column; of elements `<sequence>.<column>`.

        Raises:
            KeyError: there is no such column.
        """
        return 0.0 if self.known is None else self.known(path).error

    def zone(self, path: str) -> Zone | None:
        """Returns what is known of a column without unpacking it; `path` as in `error`.

        Raises:
            KeyError: there is no such column.
        """
        return None if self.known is None else self.known(path).zone


def _table(
    packs: _Packs, first: int, head: _Head, counts: tuple[int, ...], topic: Topic
) -> StoredTable:
    """The table whose packed columns begin with number `first`."""
    rows, layout = head.rows, topic.layout
    times = iter(range(first, first + head.packs))

    def integers() -> IntArray:
        return cast("IntArray", unpacked(packs.packed(next(times), "int64", rows)))

    log_times = integers()
    publish_times = log_times
    if head.flags & _PUBLISHED:
        publish_times = integers()
        log_times += publish_times
    places = integers() if head.flags & _PLACES else np.arange(rows)
    hashes = integers() if head.flags & _HASHES else None
    begin = next(times, first + head.packs)
    if len(layout.slots) != first + head.packs - begin:
        raise ValueError(f"a blob has other columns of {topic.channel.topic} than its layout")
    counted = (rows, *counts)

    def known(path: str) -> Packed:
        slot = layout.slots[path.rstrip(".")]
        return packs.packed(begin + slot.nth, slot.dtype, counted[slot.sequence])

    def column(path: str) -> Column:
        return unpacked(known(path))

    return StoredTable(
        channel=topic.channel,
        log_times=log_times,
        publish_times=publish_times,
        places=places,
        columns=Lazily(layout.columns, column),
        elements=_lazy_elements(layout, "", column),
        left_out=layout.left_out,
        payload_hashes=hashes,
        known=known,
    )


def _lazy_elements(
    layout: Layout, around: str, column: Callable[[str], Column]
) -> Mapping[str, Elements]:
    def elements(path: str) -> Elements:
        whole = f"{around}{path}"
        inner = layout.sequences[path]
        return Elements(
            cast("IntArray", column(f"{whole}#")),
            Lazily(inner.columns, lambda name: column(f"{whole}.{name}")),
            _lazy_elements(inner, f"{whole}.", column),
        )

    return Lazily(layout.sequences, elements)
