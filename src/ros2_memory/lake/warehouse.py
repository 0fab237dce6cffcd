"""Opens a lake: its Iceberg catalogue, its files and its tables.

The catalogue is an SQLite file in the state directory, or a REST service. Whatever goes wrong there
becomes a `LakeError`, in whose sentence no secret is.
"""

from __future__ import annotations

import logging
import warnings
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from pyiceberg.catalog.rest import RestCatalog
from pyiceberg.catalog.sql import SqlCatalog

from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_MS
from ros2_memory.lake.tables import NAMESPACE, open_tables
from ros2_memory.lake.written_files import file_properties

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.timebase import Ns

CATALOGUE_FILE: Final = "catalogue.sqlite"
_MOST_CHARS: Final = 500
_MASK: Final = "********"


@dataclass(frozen=True, slots=True)
class LakeLocation:
    """Where a lake is.

    Attributes:
        warehouse: the URI below which its files lie: `file:///...`, `s3://...`.
        state_dir: the lock of its writer, and the catalogue where that is SQLite.
        catalog: what lists its tables.
        uri: of a REST catalogue, or of another database; None for the SQLite file.
        properties: of the catalogue and of the file store, as pyiceberg names them.
        secrets: likewise, and never shown.
        namespace: of its tables.
    """

    warehouse: str
    state_dir: Path
    catalog: Literal["sql", "rest"] = "sql"
    uri: str | None = None
    properties: Mapping[str, str] = field(default_factory=dict)
    secrets: Mapping[str, str] = field(default_factory=dict, repr=False)
    namespace: str = NAMESPACE

    @property
    def _is_file(self) -> bool:
        return self.catalog == "sql" and self.uri is None

    @contextmanager
    def translated(self, what: str) -> Iterator[None]:
        """Turns the errors of catalogues and stores into `LakeError`s without secrets.

        Raises:
            LakeError: it failed; `what` says what was being done.
        """
        try:
            yield
        except LakeError:
            raise
        except Exception as error:  # noqa: BLE001 - each store raises errors of its own
            raise LakeError(f"{what} failed: {self.redacted(error)}") from None

    def redacted(self, error: Exception) -> str:
        """Returns an error's sentence, shortened, without secrets."""
        text = f"{type(error).__name__}: {error}"
        for secret in sorted(filter(None, self.secrets.values()), key=len, reverse=True):
            text = text.replace(secret, _MASK)
        return text[:_MOST_CHARS]

    @contextmanager
    def opened(self) -> Iterator[IcebergCatalog]:
        """Opens the catalogue.

        Raises:
            LakeError: it cannot be opened.
        """
        # It logs each file that it opens, at the level of our own events.
        logging.getLogger("pyiceberg").setLevel(logging.WARNING)
        kind = RestCatalog if self.catalog == "rest" else SqlCatalog
        with self.translated("opening the lake's catalogue"):
            if self._is_file:
                self.state_dir.mkdir(parents=True, exist_ok=True)
            file = self.state_dir.absolute() / CATALOGUE_FILE
            properties = {
                **self.properties,
                **self.secrets,
                **file_properties(self.state_dir),
                "warehouse": self.warehouse,
                "uri": f"sqlite:///{file}" if self._is_file else self.uri or "",
            }
            catalog = kind("lake", **properties)
        with closing(catalog):
            yield catalog

    def last_commit(self) -> Ns | None:
        """Returns when a bag was last committed; None where none was. Makes nothing.

        Raises:
            LakeError: the lake cannot be read.
        """
        if self._is_file and not (self.state_dir / CATALOGUE_FILE).exists():
            return None
        with self.opened() as catalog, self.translated("looking into the lake"):
            name = f"{self.namespace}.bags"
            if not catalog.table_exists(name):
                return None
            newest = catalog.load_table(name).current_snapshot()
            return None if newest is None else newest.timestamp_ms * NS_PER_MS

    def tables(self, catalog: IcebergCatalog, names: Iterable[str]) -> dict[str, IcebergTable]:
        """Returns tables by name, made where they are missing.

        Raises:
            LakeError: they cannot be opened.
        """
        with self.translated("opening the lake's tables"):
            return open_tables(catalog, names, self.namespace)


@contextmanager
def quiet_deletes() -> Iterator[None]:
    """Keeps pyiceberg from warning that a delete, which mostly repeats nothing, matched no row."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Delete operation did not match", UserWarning)
        yield


def location_of(warehouse: str, state_dir: Path | None) -> tuple[str, Path]:
    """Returns the URI of a warehouse that may be given as a path, and the state directory.

    Raises:
        ValueError: the warehouse is on no file system, and there is no state directory.
    """
    scheme, found, rest = warehouse.partition("://")
    if found and scheme != "file":
        if state_dir is None:
            raise ValueError(f"a warehouse in {scheme} needs lake.state_dir, a local folder")
        return warehouse, state_dir
    folder = Path(rest if found else warehouse).expanduser().absolute()
    return folder.as_uri(), folder / ".ros2-memory" if state_dir is None else state_dir
