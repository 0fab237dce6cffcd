"""An Iceberg REST catalogue over an SQLite one, with what this program asks of it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from pyiceberg.catalog.rest import CreateTableRequest
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.exceptions import CommitFailedException, NoSuchTableError
from pyiceberg.table import CommitTableRequest, Table


class _Requests(BaseHTTPRequestHandler):
    """Answers requests below `/v1`."""

    def __init__(self, catalog: SqlCatalog, lock: threading.Lock, *given: object) -> None:
        self._catalog, self._lock = catalog, lock
        super().__init__(*given)  # type: ignore[arg-type]  # as the server calls it

    def log_message(self, *_: object) -> None:
        """Logs nothing."""

    def do_GET(self) -> None:
        with self._lock:
            match self._parts():
                case ["config"]:
                    self._reply(200, {"defaults": {}, "overrides": {}})
                case ["namespaces", name]:
                    known = (name,) in self._catalog.list_namespaces()
                    self._reply(200 if known else 404, {"namespace": [name], "properties": {}})
                case ["namespaces", name, "tables", table]:
                    self._reply_table(name, table)
                case _:
                    self._reply(404, {})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        with self._lock:
            match self._parts():
                case ["namespaces"]:
                    asked = json.loads(body)["namespace"]
                    is_new = tuple(asked) not in self._catalog.list_namespaces()
                    self._catalog.create_namespace_if_not_exists(tuple(asked))
                    self._reply(200 if is_new else 409, {"namespace": asked})
                case ["namespaces", name, "tables"]:
                    request = {"location": None, **json.loads(body)}
                    self._create(name, CreateTableRequest.model_validate(request))
                case ["namespaces", name, "tables", table]:
                    self._commit(name, table, CommitTableRequest.model_validate_json(body))
                case _:
                    self._reply(404, {})

    def _create(self, namespace: str, asked: CreateTableRequest) -> None:
        if asked.partition_spec is None or asked.write_order is None:
            self._reply(400, {})
            return
        self._catalog.create_table(
            f"{namespace}.{asked.name}",
            asked.table_schema,
            partition_spec=asked.partition_spec,
            sort_order=asked.write_order,
            properties=asked.properties,
        )
        self._reply_table(namespace, asked.name)

    def _commit(self, namespace: str, name: str, asked: CommitTableRequest) -> None:
        table = self._catalog.load_table(f"{namespace}.{name}")
        try:
            self._catalog.commit_table(table, asked.requirements, asked.updates)
        except CommitFailedException as error:
            self._reply(409, {"error": {"message": str(error), "type": "Conflict", "code": 409}})
            return
        self._reply_table(namespace, name)

    def _reply_table(self, namespace: str, name: str) -> None:
        try:
            table: Table = self._catalog.load_table(f"{namespace}.{name}")
        except NoSuchTableError as error:
            self._reply(404, {"error": {"message": str(error), "type": "NoSuch", "code": 404}})
            return
        metadata = json.loads(table.metadata.model_dump_json())
        self._reply(200, {"metadata-location": table.metadata_location, "metadata": metadata})

    def _parts(self) -> list[str]:
        return self.path.partition("?")[0].split("/")[2:]

    def _reply(self, status: int, content: object) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@contextmanager
def rest_catalogue(folder: Path) -> Iterator[str]:
    """Serves a catalogue whose tables lie below a folder; yields its address."""
    folder.mkdir(parents=True, exist_ok=True)
    catalog = SqlCatalog("rest", uri=f"sqlite:///{folder}/rest.sqlite", warehouse=folder.as_uri())
    answers = partial(_Requests, catalog, threading.Lock())
    with ThreadingHTTPServer(("127.0.0.1", 0), answers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
            catalog.close()
