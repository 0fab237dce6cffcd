"""The data files of a table by robot and day, as its manifests list them.

A plan of pyiceberg reads all manifests that can hold a day, again for each day; over years that
takes most of an answer. Manifests never change, so each is read once.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import date, timedelta
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from pyiceberg.manifest import ManifestContent
from pyiceberg.transforms import IdentityTransform

from ros2_memory.core.errors import RefusedError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pyiceberg.manifest import ManifestFile
    from pyiceberg.partitioning import PartitionSpec
    from pyiceberg.table import Table as IcebergTable

_EPOCH: Final = date(1970, 1, 1)
_LAST: Final = "\U0010ffff"
"""After all ids of bags."""


class LakeFile(NamedTuple):
    """A Parquet file, how many rows it has, and its size (bytes).

    No id of a bag in it is before `first`, nor after `last`.
    """

    location: str
    rows: int
    size: int = 0
    first: str = ""
    last: str = _LAST


Days: TypeAlias = "Mapping[date, Sequence[LakeFile]]"
"""The files of one robot in one table by day, in order of the days."""
Partition: TypeAlias = tuple[str, date]
"""A robot and a day."""
_Files: TypeAlias = "Mapping[Partition, Sequence[LakeFile]]"


def newest(days: Days, until: date, rows: int, fewest: int) -> tuple[Days, date | None]:
    """Returns the newest days with rows up to one, and the one before them, if there is one.

    They are those of `fewest` days, and more while all have at most `rows` rows.
    """
    order = [*days]
    begin = end = bisect_right(order, until)
    total = 0
    while begin:
        day = order[begin - 1]
        total += sum(each.rows for each in days[day])
        if total > rows and day <= order[end - 1] - timedelta(days=fewest):
            break
        begin -= 1
    found = {day: days[day] for day in order[begin:end]}
    return found, order[begin - 1] if begin else None


class Partitions:
    """The files of the versions of one table that it was last shown. Not thread-safe."""

    def __init__(self) -> None:
        self._snapshot: int | None = None
        self._read: dict[str, _Files] = {}
        self._robots: dict[str, dict[date, Sequence[LakeFile]]] = {}

    def look(self, table: IcebergTable) -> Mapping[str, Days]:
        """Returns the files of a table's current version, by robot.

        Raises:
            RefusedError: another program wrote what cannot be read by robot and day.
        """
        snapshot = table.current_snapshot()
        if snapshot is None or snapshot.snapshot_id == self._snapshot:
            return self._robots
        read: dict[str, _Files] = {}
        for manifest in snapshot.manifests(table.io):
            path = manifest.manifest_path
            read[path] = self._read.get(path) or self._files(table, manifest)
        found: dict[Partition, list[LakeFile]] = {}
        for part, files in chain.from_iterable(each.items() for each in read.values()):
            found.setdefault(part, []).extend(files)
        self._robots = {}
        for robot, day in sorted(found):
            self._robots.setdefault(robot, {})[day] = found[robot, day]
        self._read, self._snapshot = read, snapshot.snapshot_id
        return self._robots

    def _files(self, table: IcebergTable, manifest: ManifestFile) -> _Files:
        entries = manifest.fetch_manifest_entry(table.io, discard_deleted=True)
        if entries and manifest.content is ManifestContent.DELETES:
            raise RefusedError(
                f"the lake's table {table.name()[-1]} has delete files, which another program "
                "wrote: rewrite them into its data files first (copy-on-write)"
            )
        spec = table.specs()[manifest.partition_spec_id]
        robot, day = (self._position(table, spec, column) for column in ("robot", "day"))
        bag_id = table.schema().find_field("bag_id").field_id
        found: dict[Partition, list[LakeFile]] = {}
        for each in (entry.data_file for entry in entries):
            when = _EPOCH + timedelta(days=each.partition[day])
            first, last = (
                bytes(bounds.get(bag_id) or b"").decode()
                for bounds in (each.lower_bounds or {}, each.upper_bounds or {})
            )
            file = LakeFile(
                each.file_path, each.record_count, each.file_size_in_bytes, first, last or _LAST
            )
            found.setdefault((str(each.partition[robot]), when), []).append(file)
        return found

    def _position(self, table: IcebergTable, spec: PartitionSpec, column: str) -> int:
        source = table.schema().find_field(column).field_id
        for position, each in enumerate(spec.fields):
            if each.source_id == source and isinstance(each.transform, IdentityTransform):
                return position
        raise RefusedError(
            f"the lake's table {table.name()[-1]} has files that are not of one {column}, which "
            "another program wrote: partition it by robot and day again"
        )
