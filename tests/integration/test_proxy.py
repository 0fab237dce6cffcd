"""The query server behind the proxies of docs/how-to/tls.md, configured as that page says.

Where nginx or Caddy is not on the PATH its test skips.
"""

import http.client
import json
import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.memories import ROOT
from tests.support.processes import until
from tests.support.robot_run import write_run
from tests.support.served import serving

PAGE = (ROOT / "docs/how-to/tls.md").read_text()
NAME = "robot.example"
GOOD = "kJ7-x._~+/0123456789=="
SHOWN = {"Authorization": f"Bearer {GOOD}"}
BOUND_S = 30
ASKED = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "tools/call",
    "params": {"name": "data_time_range", "arguments": {}},
}
JSON = {"Content-Type": "application/json", "Accept": "application/json, text/event-stream"}
AROUND_NGINX = """
daemon off;
master_process off;
pid {folder}/pid;
error_log stderr;
events {{}}
http {{
  access_log off;
  client_body_temp_path {folder}/body;
  proxy_temp_path {folder}/proxy;
  fastcgi_temp_path {folder}/fastcgi;
  uwsgi_temp_path {folder}/uwsgi;
  scgi_temp_path {folder}/scgi;
  {told}
}}
"""
AROUND_CADDY = """{{
  admin off
  auto_https disable_redirects
}}
{told}
"""


class Front:
    """The proxy, as a client on another machine sees it."""

    def __init__(self, port: int, certificate: Path) -> None:
        self._port = port
        self._context = ssl.create_default_context(cafile=str(certificate))
        self._open: list[Any] = []

    def close(self) -> None:
        for each in self._open:
            each.close()

    def ask(self, method: str, path: str, body: object = None, **headers: str) -> Any:
        """The response, of which the body is not read yet."""
        connection = http.client.HTTPSConnection(
            NAME, self._port, context=self._context, timeout=BOUND_S
        )
        self._open.append(connection)
        given: Any = connection
        given._create_connection = lambda *_: socket.create_connection(
            ("127.0.0.1", self._port), BOUND_S
        )
        sent = None if body is None else json.dumps(body)
        connection.request(method, path, sent, {"Host": NAME, **headers})
        response = connection.getresponse()
        self._open.append(response)
        return response

    def is_up(self) -> bool:
        try:
            return int(self.ask("GET", "/health").status) == 200
        except OSError:
            return False


def told(language: str, port: int, behind: int, certificate: Path, key: Path) -> str:
    """What the page says, for these ports and this certificate."""
    found = re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found
    text: str = found[1]
    for said, meant in (
        ("127.0.0.1:9203", f"127.0.0.1:{behind}"),
        ("listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
        ("/etc/ssl/robot.example.pem", str(certificate)),
        ("/etc/ssl/private/robot.example.key", str(key)),
        ("robot.example {\n", f"{NAME}:{port} {{\n\ttls {certificate} {key}\n"),
    ):
        text = text.replace(said, meant)
    return text


@contextmanager
def proxying(program: str, behind: int, folder: Path) -> Iterator[Front]:
    certificate, key, config = (folder / name for name in ("cert.pem", "key.pem", "config"))
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"),
            *("-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME}"),
            *("-out", str(certificate), "-keyout", str(key)),
        ],
        check=True,
        capture_output=True,
    )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    text = told(program, port, behind, certificate, key)
    around, arguments = {
        "nginx": (AROUND_NGINX, ["-e", "stderr", "-p", f"{folder}", "-c", f"{config}"]),
        "caddy": (AROUND_CADDY, ["run", "--config", f"{config}", "--adapter", "caddyfile"]),
    }[program]
    config.write_text(around.format(folder=folder, told=text))
    env = {"PATH": "/usr/bin", "HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    found = shutil.which(program)
    assert found
    with (folder / "log").open("wb") as log:
        proxy = subprocess.Popen([found, *arguments], env=env, stdout=log, stderr=log)
    try:
        front = Front(port, certificate)

        def up() -> bool | None:
            assert proxy.poll() is None, (folder / "log").read_text()
            return front.is_up() or None

        try:
            until(up, timeout_s=BOUND_S)
            yield front
        finally:
            front.close()
    finally:
        proxy.terminate()
        proxy.wait()


@pytest.fixture(params=["nginx", "caddy"])
def front(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Front]:
    for needed in (request.param, "openssl"):
        if shutil.which(needed) is None:
            pytest.skip(f"{needed} is not on the PATH")
    write_run(tmp_path / "bags")
    with (
        serving(tmp_path / "bags", tmp_path / "server.log", MEMORY_API_TOKEN=GOOD) as server,
        proxying(request.param, server.port, tmp_path) as proxy,
    ):
        yield proxy


def test_behind_a_proxy_with_tls_the_server_is_as_closed_and_as_quick_to_tell(front: Front) -> None:
    assert set(json.load(front.ask("GET", "/health"))) == {"status"}
    assert front.ask("POST", "/mcp", ASKED, **JSON).status == 401
    answered = front.ask("POST", "/mcp", ASKED, **JSON, **SHOWN)
    assert '"bags": 1' in json.load(answered)["result"]["content"][0]["text"].replace(":1", ": 1")

    assert front.ask("POST", "/mcp", ASKED, **JSON, **SHOWN, Origin=f"https://{NAME}").status == 200
    for origin in ("https://evil.example", f"https://{NAME}.evil.example", "https://robotxexample"):
        assert front.ask("POST", "/mcp", ASKED, **JSON, **SHOWN, Origin=origin).status == 403

    # The stream never ends, so a line of it comes only where nothing keeps it back.
    stream = front.ask("GET", "/sse", **SHOWN)
    assert stream.readline() == b"event: endpoint\r\n"
    assert b"/messages/?session_id=" in stream.readline()

    elsewhere = front.ask("GET", "/", Host="evil.example")
    assert elsewhere.status == 421 or elsewhere.read() == b""
