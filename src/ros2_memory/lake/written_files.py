"""The files that this program wrote into a lake, and which of them nothing refers to any more.

pyiceberg rewrites tables and drops old versions from their metadata, but deletes no file, and a
process that is killed leaves files that no version ever had. A list of what lies in a store would
have files of other programs, too, also those that they are about to commit. So each file is
recorded before it is written, in the state directory, and only recorded ones are deleted: those
below the table's own location to which no version, branch or tag of the table refers.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from pyiceberg.io.pyarrow import PyArrowFile, PyArrowFileIO
from pyiceberg.manifest import ManifestEntryStatus

from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.core.timebase import WallClock

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.timebase import Ns

WRITTEN_FILE: Final = "written.jsonl"
RECORD: Final = "ros2-memory.written"
"""The setting of a `RecordingFileIO` that names the folder of its record."""


@dataclass(frozen=True, slots=True)
class Written:
    """A file, and when (ns) it was about to be written."""

    file: str
    at: Int64


WRITTEN: Final = JsonLog(WRITTEN_FILE, Written, most_bytes=sys.maxsize)


class RecordingFileIO(PyArrowFileIO):
    """Records each file durably before it is written."""

    def new_output(self, location: str) -> PyArrowFile:
        """Returns a file to be written."""
        from pathlib import Path  # noqa: PLC0415 - pyiceberg reads this class's annotations

        record = self.properties.get(RECORD)
        if record:
            # With a REST catalogue nothing else is there before the first table.
            Path(record).mkdir(parents=True, exist_ok=True)
            WRITTEN.append(Path(record), [Written(location, WallClock().now())])
        return super().new_output(location)


def file_properties(state_dir: Path) -> dict[str, str]:
    """Returns the settings of a catalogue whose files are recorded."""
    return {
        "py-io-impl": f"{RecordingFileIO.__module__}.{RecordingFileIO.__name__}",
        RECORD: os.fspath(state_dir.absolute()),
    }


def _referenced(table: IcebergTable) -> set[str]:
    """Returns the files that some version, branch or tag of a table refers to."""
    found = {table.metadata_location}
    found.update(statistics.statistics_path for statistics in table.metadata.statistics)
    for snapshot in table.metadata.snapshots:
        found.add(snapshot.manifest_list)
        for manifest in snapshot.manifests(table.io):
            if manifest.manifest_path in found:
                continue
            found.add(manifest.manifest_path)
            found.update(
                entry.data_file.file_path
                for entry in manifest.fetch_manifest_entry(table.io, discard_deleted=False)
                if entry.status is not ManifestEntryStatus.DELETED
            )
    return found


def delete_unreferenced(state_dir: Path, tables: Iterable[IcebergTable], written_before: Ns) -> int:
    """Deletes the files to which no table refers, and that were written before a time.

    Returns:
        How many were deleted.

    Raises:
        OSError: a file cannot be deleted; those that were deleted before are gone.
    """
    recorded = WRITTEN.rows(state_dir)
    old = {written.file for written in recorded if written.at < written_before}
    gone: set[str] = set()
    try:
        for table in tables:
            below = f"{table.location().rstrip('/')}/"
            own = {file for file in old if file.startswith(below) and ".." not in file}
            for file in sorted(own - _referenced(table)) if own else ():
                with suppress(FileNotFoundError):  # as after a kill
                    table.io.delete(file)
                gone.add(file)
    finally:
        if gone:
            WRITTEN.replace(
                state_dir, [written for written in recorded if written.file not in gone]
            )
    return len(gone)
