"""An Iceberg REST catalogue over an SQLite one, with what this program asks of it."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler
from pathlib import Path

from pyiceberg.catalog.rest import CreateTableRequest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.exceptions import CommitFailedException, NoSuchTableError
from pyiceberg.table import CommitTableRequest

from tests.support.processes import http_server


class _Requests(BaseHTTPRequestHandler):
    """Answers requests below `/v1`."""

    def __init__(self, catalog: SqlCatalog, lock: threading.Lock, *given: object) -> None:
        self._catalog, self._lock = catalog, lock
        super().__init__(*given)  # type: ignore[arg-type]  # as the server calls it

    def log_message(self, *_: object) -> None:
        """Logs nothing."""

    def do_GET(self) -> None:
        status = 404
        content: object = {"error": {"message": "none", "type": "NoSuch", "code": status}}
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        try:
            with self._lock:
                status, content = self._answer(body) or (status, content)
        except NoSuchTableError:
            pass
        except CommitFailedException as error:
            status = 409
            content = {"error": {"message": str(error), "type": "Conflict", "code": status}}
        data = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def do_POST(self) -> None:
        self.do_GET()

    def _answer(self, body: bytes) -> tuple[int, object] | None:
        catalog, parts = self._catalog, self.path.partition("?")[0].split("/")[2:]
        found: tuple[int, object] | None = None
        match self.command, *parts:
            case "GET", "config":
                found = 200, {"defaults": {}, "overrides": {}}
            case "GET", "namespaces", name if (name,) in catalog.list_namespaces():
                found = 200, {"namespace": [name], "properties": {}}
            case "POST", "namespaces":
                asked = json.loads(body)["namespace"]
                is_new = tuple(asked) not in catalog.list_namespaces()
                catalog.create_namespace_if_not_exists(tuple(asked))
                found = 200 if is_new else 409, {"namespace": asked}
            case "POST", "namespaces", name, "tables":
                new = CreateTableRequest.model_validate({"location": None, **json.loads(body)})
                assert new.partition_spec is not None
                assert new.write_order is not None
                catalog.create_table(
                    f"{name}.{new.name}",
                    new.table_schema,
                    partition_spec=new.partition_spec,
                    sort_order=new.write_order,
                    properties=new.properties,
                )
                found = self._table(f"{name}.{new.name}")
            case "POST", "namespaces", name, "tables", known:
                commit = CommitTableRequest.model_validate_json(body)
                table = catalog.load_table(f"{name}.{known}")
                catalog.commit_table(table, commit.requirements, commit.updates)
                found = self._table(f"{name}.{known}")
            case "GET", "namespaces", name, "tables", known:
                found = self._table(f"{name}.{known}")
        return found

    def _table(self, name: str) -> tuple[int, object]:
        table = self._catalog.load_table(name)
        metadata = json.loads(table.metadata.model_dump_json())
        return 200, {"metadata-location": table.metadata_location, "metadata": metadata}


@contextmanager
def rest_catalogue(folder: Path) -> Iterator[str]:
    """Serves a catalogue whose tables lie below a folder; yields its address."""
    folder.mkdir(parents=True, exist_ok=True)
    catalog = SqlCatalog("rest", uri=f"sqlite:///{folder}/rest.sqlite", warehouse=folder.as_uri())
    answers = partial(_Requests, catalog, threading.Lock())
    try:
        with http_server(answers) as address:
            yield address
    finally:
        catalog.close()
