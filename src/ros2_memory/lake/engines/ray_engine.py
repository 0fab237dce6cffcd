"""Daft on a Ray cluster, for lakes that outgrow one machine (the extra `ray`)."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import daft
import pyarrow as pa
from daft.exceptions import DaftCoreException
from daft.io import IOConfig, S3Config

from ros2_memory.lake.engines.base import LakeEngine, expanded, failed, text_literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.lake.engines.base import DataFiles, Parameters, Value


class RayEngine(LakeEngine):
    """Has the workers of a cluster read the files, so they must see them: a store, or one mount.

    Args:
        address: of the cluster, `ray://host:10001` or `auto`; without one a cluster is started on
            this machine.
    """

    def __init__(self, address: str | None = None) -> None:
        self._address = address
        self._lock = threading.Lock()
        self._is_joined = False

    def select(self, sql: str, tables: Mapping[str, DataFiles], parameters: Parameters) -> pa.Table:
        """Runs the select on the cluster, which is joined with the first one."""
        try:
            self._join()
            frames = {name: _frame(files) for name, files in tables.items()}
            return daft.sql(expanded(sql, parameters, _literal), **frames).to_arrow()
        except (DaftCoreException, OSError, RuntimeError, ValueError, pa.ArrowException) as error:
            raise failed(error) from error

    def _join(self) -> None:
        with self._lock:
            if not self._is_joined:
                daft.set_runner_ray(self._address, noop_if_initialized=True)
                self._is_joined = True


def _literal(_: str, value: Value) -> str:
    return text_literal(value) if isinstance(value, str) else repr(value)


def _frame(files: DataFiles) -> daft.DataFrame:
    """Returns all rows of a table, with all columns."""
    empty = daft.from_arrow(files.schema.empty_table())
    if not files.locations:
        return empty
    found = daft.read_parquet([*files.locations], io_config=_io_config(files.store))
    known = set(found.column_names)
    lacking = {
        field.name: daft.lit(None).cast(empty.schema()[field.name].dtype)
        for field in files.schema
        if field.name not in known
    }
    return found.with_columns(lacking) if lacking else found


def _io_config(store: Mapping[str, str]) -> IOConfig:
    return IOConfig(
        s3=S3Config(
            endpoint_url=store.get("s3.endpoint"),
            region_name=store.get("s3.region"),
            key_id=store.get("s3.access-key-id"),
            access_key=store.get("s3.secret-access-key"),
            session_token=store.get("s3.session-token"),
        )
    )
