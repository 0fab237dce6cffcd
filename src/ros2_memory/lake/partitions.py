"""The data files of a table by robot and day, as its manifests list them.

A plan of pyiceberg reads all manifests that can hold a day, again for each day; over years that
takes most of an answer. Manifests never change, so each is read once.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
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


Partition: TypeAlias = tuple[str, date]
"""A robot and a day."""
_Files: TypeAlias = "Mapping[Partition, Sequence[LakeFile]]"


class Days:
    """The files of one robot in one table. Immutable.

    Args:
        files: by day.
    """

    def __init__(self, files: Mapping[date, tuple[LakeFile, ...]]) -> None:
        self._days = sorted(files)
        self._files = files

    @property
    def known(self) -> Sequence[date]:
        """The days with rows, in order."""
        return self._days

    def files(self, first: date, last: date) -> list[LakeFile]:
        """Returns the files of days, both inclusive, in order of the days."""
        begin, end = bisect_left(self._days, first), bisect_right(self._days, last)
        return [*chain.from_iterable(self._files[day] for day in self._days[begin:end])]

    def newest(self, until: date, rows: int, days: int) -> tuple[date, date] | None:
        """Returns the first and last of the newest days up to one; None where none has rows.

        They are those of `days` days, and more while all have at most `rows` rows.
        """
        end = bisect_right(self._days, until)
        if not end:
            return None
        last = self._days[end - 1]
        first, at_least, total = last, last - timedelta(days=days - 1), 0
        for day in reversed(self._days[:end]):
            total += sum(each.rows for each in self._files[day])
            if total > rows and day < at_least:
                break
            first = day
        return first, last


NO_DAYS: Final = Days({})
"""Of a robot that has no row."""


class Partitions:
    """The files of the versions of one table that it was last shown. Not thread-safe.

    Args:
        name: of the table.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._snapshot: int | None = None
        self._read: dict[str, _Files] = {}
        self._robots: dict[str, Days] = {}

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
        found: dict[str, dict[date, tuple[LakeFile, ...]]] = {}
        for (robot, day), files in chain.from_iterable(each.items() for each in read.values()):
            of_robot = found.setdefault(robot, {})
            of_robot[day] = (*of_robot.get(day, ()), *files)
        self._robots = {robot: Days(found[robot]) for robot in sorted(found)}
        self._read, self._snapshot = read, snapshot.snapshot_id
        return self._robots

    def _files(self, table: IcebergTable, manifest: ManifestFile) -> _Files:
        entries = manifest.fetch_manifest_entry(table.io, discard_deleted=True)
        if entries and manifest.content is ManifestContent.DELETES:
            raise RefusedError(
                f"the lake's table {self._name} has delete files, which another program wrote: "
                "rewrite them into its data files first (copy-on-write)"
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
            f"the lake's table {self._name} has files that are not of one {column}, which another "
            "program wrote: partition it by robot and day again"
        )
