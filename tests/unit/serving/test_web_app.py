"""What the server shows over HTTP and to whom, and the files of its page."""

import re
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import resources
from itertools import product
from typing import Any

import anyio
import httpx2
import pytest
from starlette.types import ASGIApp

from ros2_memory.serving.page import POLICY, SCRIPTS, STYLES
from ros2_memory.serving.page.routes import page_routes
from ros2_memory.serving.web_app import web_app
from tests.unit.serving.test_dispatch import served, tool, value

HOME = "http://127.0.0.1:9203"
EVERYWHERE = ".".join("0000")
GOOD = "kJ7-x._~+/0123456789=="
SHOWN = {"authorization": f"Bearer {GOOD}"}
MCP_HEADERS = {"accept": "application/json, text/event-stream"}


def app(
    host: str = "127.0.0.1",
    api_token: str | None = None,
    recorder: dict[str, Any] | None = None,
) -> ASGIApp:
    server = served(tool("ask", lambda _: value(7)))

    async def health() -> Any:
        known = {} if recorder is None else {"recorder": recorder}
        return {"status": "ok", "bags": 3, **known}

    return web_app(
        server,
        host=host,
        health=health,
        tokens={api_token: None} if api_token else {},
        page=page_routes(server.dispatcher),
    )


@asynccontextmanager
async def running(web: Any) -> AsyncIterator[None]:
    """The application between its startup and its shutdown, as a web server brackets it."""
    to_app, from_server = anyio.create_memory_object_stream[Any](1)
    from_app, to_server = anyio.create_memory_object_stream[Any](1)
    with to_app, from_server, from_app, to_server:
        async with anyio.create_task_group() as tasks:
            scope: Any = {"type": "lifespan", "asgi": {"version": "3.0"}, "state": {}}
            tasks.start_soon(web, scope, from_server.receive, from_app.send)
            await to_app.send({"type": "lifespan.startup"})
            assert (await to_server.receive())["type"] == "lifespan.startup.complete"
            yield
            await to_app.send({"type": "lifespan.shutdown"})
            assert (await to_server.receive())["type"] == "lifespan.shutdown.complete"


def client(web: ASGIApp, base_url: str = HOME) -> httpx2.AsyncClient:
    return httpx2.AsyncClient(transport=httpx2.ASGITransport(app=web), base_url=base_url)


def call_tool(name: str) -> dict[str, Any]:
    return {
        "jsonrpc": "2.0",
        "id": 1,
        "method": "tools/call",
        "params": {"name": name, "arguments": {}},
    }


@pytest.mark.parametrize(
    ("recorder", "status"),
    [
        ({"state": "recording", "live": True}, 200),
        ({"state": "recording", "live": False}, 503),
        ({"state": "waiting", "live": True, "waiting_for": "/clock"}, 503),
        ({"state": "paused", "live": True}, 503),
        ({"state": "recording", "live": True, "failing_rules": ["the rule a: no field"]}, 503),
        ({"state": "recording", "live": True, "required_missing": ["/odom: no publisher"]}, 503),
        ({"state": "recording", "live": True, "degraded": ["silent: /scan"]}, 200),
        (None, 503),
    ],
)
async def test_whether_it_records_is_a_status_of_its_own(
    recorder: dict[str, Any] | None, status: int
) -> None:
    async with client(app(recorder=recorder)) as http:
        assert (await http.get("/health")).status_code == 200
        shown = await http.get("/health/recording")
    assert shown.status_code == status
    assert shown.json()["recording"] is (status == 200)
    for key in ("waiting_for", "degraded", "required_missing"):
        assert (shown.json()[key] or None) == (recorder or {}).get(key)
    async with client(app(recorder=recorder, api_token=GOOD)) as http:
        hidden = await http.get("/health/recording")
    assert (hidden.status_code, hidden.json()) == (status, {"recording": status == 200})


HELLO: dict[str, Any] = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {
        "protocolVersion": "2025-11-25",
        "capabilities": {},
        "clientInfo": {"name": "test", "version": "1"},
    },
}
SESSION = "mcp-session-id"
OLD = {SESSION: "of-before-a-restart"}


async def test_a_conversation_is_named_where_it_begins_and_each_otherwise() -> None:
    web = app()
    async with running(web), client(web) as http:
        begun = [await http.post("/mcp", json=HELLO, headers=MCP_HEADERS) for _ in range(3)]
    names = {response.headers[SESSION] for response in begun}
    assert len(names) == 3
    assert all(name.isalnum() and len(name) >= 32 for name in names)


@pytest.mark.parametrize(("body", "given"), [(HELLO, OLD), ("ask", {}), ("ask", OLD)])
async def test_a_client_that_has_a_name_is_given_no_other_and_a_call_needs_none(
    body: Any, given: dict[str, str]
) -> None:
    web = app()
    async with running(web), client(web) as http:
        asked = call_tool(body) if body == "ask" else body
        response = await http.post("/mcp", json=asked, headers=MCP_HEADERS | given)
    assert (response.status_code, SESSION in response.headers) == (200, False)


FOREIGN = [
    *("evil.example", "localhost.evil.example:9203", "127.0.0.1.nip.io", "localhost:80.evil.com"),
    *("[::1].evil.com", "[::1].evil.com:9203", "[::1]evil.com", "[::1]:80.evil.com", "[localhost]"),
    *("evil@localhost", "localhost/evil.com", "localhost?", "localhost#", "evil.com\\@localhost"),
    *("localhost\n", " localhost", "::1", "[::1", "[", "", ":9203", "localhost:80:80"),
]


@pytest.mark.parametrize("host", ["127.0.0.1", EVERYWHERE, "192.168.7.20", "robot.lan"])
async def test_every_path_refuses_the_host_names_of_other_sites(host: str) -> None:
    async with client(app(host)) as http:
        others = ["192.168.7.20:9203"] if host == "127.0.0.1" else []
        for path, name in product(PATHS[1:], [*FOREIGN, *others]):
            response = await http.get(path, headers={"host": name})
            assert response.status_code == 421, (path, name)


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("127.0.0.1", "127.0.0.1:9203"),
        ("127.0.0.1", "localhost"),
        ("localhost", "[::1]:9203"),
        (EVERYWHERE, "localhost:9203"),
        (EVERYWHERE, "192.168.7.20:9203"),
        ("::", "[fd00::7]:9203"),
        (EVERYWHERE, f"{socket.gethostname()}:9203"),
        (EVERYWHERE, f"{socket.gethostname().upper()}.local"),
        ("robot.lan", "robot.lan:9203"),
    ],
)
async def test_the_server_answers_to_its_own_names_and_addresses(host: str, name: str) -> None:
    async with client(app(host)) as http:
        response = await http.get("/health", headers={"host": name, "origin": f"http://{name}"})
    assert response.status_code == 200


PATHS = ["/", "/health", "/health/recording", "/metrics", "/sse", "/mcp", "/messages/"]
VISIT = {"sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "http://6.6.6.6:9203", "null", "http://[", ""),
        "javascript://localhost",
        "http://localhost:6274",
        "http://127.0.0.1",
        "http://127.0.0.1:9204",
        "http://[::1]:9203",
        "ftp://127.0.0.1:9203",
        "http://127.0.0.1:9203/",
        "http://user@127.0.0.1:9203",
        "http://127.0.0.1:9203 http://evil.example",
        "127.0.0.1:9203",
        "file://",
    ],
)
async def test_other_sites_and_malformed_origins_are_refused(origin: str) -> None:
    async with client(app()) as http:
        for path in PATHS:
            assert (await http.get(path, headers={"origin": origin})).status_code == 403, path
            both = [("origin", HOME), ("origin", origin)]
            assert (await http.get(path, headers=both)).status_code == 403, path


@pytest.mark.parametrize("site", ["cross-site", "same-site", "", "other", "none, cross-site"])
async def test_requests_that_another_site_is_behind_are_refused(site: str) -> None:
    kinds: tuple[dict[str, str], ...] = (
        {},
        {"sec-fetch-mode": "no-cors"},
        {**VISIT, "sec-fetch-dest": "iframe"},
    )
    async with client(app()) as http:
        for method, path, more in product(("GET", "POST", "HEAD", "OPTIONS"), PATHS, kinds):
            headers = {"sec-fetch-site": site, **more}
            response = await http.request(method, path, headers=headers)
            assert response.status_code == 403, (method, path, more)


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none", "same-origin"])
async def test_a_person_may_follow_a_link_to_the_page_and_to_nothing_else(site: str) -> None:
    async with client(app()) as http:
        response = await http.get("/", headers={"sec-fetch-site": site, **VISIT})
        assert response.status_code == 200
        if site in {"cross-site", "same-site"}:
            for path in PATHS[1:]:
                other = await http.get(path, headers={"sec-fetch-site": site, **VISIT})
                assert other.status_code == 403
            posted = await http.post("/", headers={"sec-fetch-site": site, **VISIT})
            assert posted.status_code == 403


FOLDER = resources.files("ros2_memory.serving.page")
HTML = FOLDER.joinpath("index.html").read_text(encoding="utf-8")
OWN = {
    name: FOLDER.joinpath(name).read_text(encoding="utf-8")
    for name in (*SCRIPTS, *STYLES)
    if not name.startswith("vendor/")
}
SCRIPT = "\n".join(text for name, text in OWN.items() if name.endswith(".js"))
FILES = ("/", "/page/page.js", "/page/page.css")


async def test_the_page_is_three_files_and_allows_this_servers_own_and_nothing_else() -> None:
    async with client(app()) as http:
        for path, kind in zip(FILES, ("html", "javascript", "css"), strict=True):
            response, head = await http.get(path), await http.head(path)
            assert response.status_code == head.status_code == 200
            assert response.headers["content-type"] == f"text/{kind}; charset=utf-8"
            assert head.content == b""
            assert head.headers["content-length"] == response.headers["content-length"]
            assert response.headers["content-security-policy"] == POLICY
            assert response.headers["x-content-type-options"] == "nosniff"
            assert response.headers["referrer-policy"] == "no-referrer"
        assert (await http.get("/")).text == HTML
        assert (await http.post("/")).status_code == 404
        for path in ("/index.html", "/page/", "/page/main.js", "/page/../auth.py"):
            assert (await http.get(path)).status_code == 404
    allowed = dict(each.split(" ", 1) for each in POLICY.split("; "))
    for what in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert allowed[what] == "'none'"
    for what in ("script-src", "style-src", "connect-src"):
        assert allowed[what] == "'self'"
    assert allowed["require-trusted-types-for"] == "'script'"
    assert "unsafe" not in POLICY


async def test_a_browser_that_has_a_file_is_not_sent_it_again() -> None:
    async with client(app()) as http:
        first = await http.get("/page/page.js")
        again = await http.get("/page/page.js", headers={"if-none-match": first.headers["etag"]})
    assert again.status_code == 304
    assert again.content == b""


def test_it_has_nothing_inline_or_of_elsewhere_and_text_never_becomes_markup_or_code() -> None:
    assert re.findall(r"<script[^>]*>(?!</script>)", HTML) == []
    assert not re.search(r"<style|\sstyle=|\son\w+=", HTML)
    for text in (HTML, *OWN.values()):
        assert re.findall(r"\w+://[^\s\"'<]+", text) == []
    assert re.findall(r"(?:src|href)=\"([^\"]*)\"", HTML) == [
        "data:,",
        "/page/page.css",
        "/page/page.js",
        "#timeline",
    ]
    assert not re.search(r"@import|url\(", "".join(OWN.values()))
    assert not re.search(r"\bimport\b|XMLHttpRequest|WebSocket|EventSource", SCRIPT)
    assert len(re.findall(r"\bfetch\(", SCRIPT)) == 1
    forbidden = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function"
    assert not re.search(forbidden, SCRIPT)
    for name in re.findall(r"<(?:input|select|progress)[^>]* id=\"([\w-]+)\"", HTML):
        assert re.search(rf"<label for=\"{name}\"", HTML), name
    assert "MIT License" in FOLDER.joinpath("vendor/LICENSE").read_text("utf-8")
    assert "uPlot 1.6.32" in FOLDER.joinpath("vendor/README.md").read_text("utf-8")


def test_it_keeps_the_token_for_its_tab_alone() -> None:
    assert not re.search(r"localStorage|cookie|indexedDB", SCRIPT)
    assert set(re.findall(r"sessionStorage\.\w+\((\w+)", SCRIPT)) == {"TOKEN"}
    # It is never part of an address, which is logged and kept.
    assert "token" not in OWN["main.js"].partition("function remember")[2].partition("\n}\n")[0]


@pytest.mark.parametrize("host", ["127.0.0.1", EVERYWHERE, "192.168.7.20", "robot.lan"])
async def test_it_is_shown_without_the_token_which_it_asks_for(host: str) -> None:
    base = "http://127.0.0.1:9203" if host == "127.0.0.1" else "http://192.168.7.20:9203"
    async with client(app(host, api_token=GOOD), base) as http:
        for path in FILES:
            assert (await http.get(path)).status_code == 200
        assert (await http.post("/")).status_code == 401
        assert (await http.post("/mcp")).status_code == 401
        for path in (route.path for route in page_routes(served().dispatcher)):
            assert (await http.get(path)).status_code == 401
            assert (await http.get(path, headers=SHOWN)).status_code != 401
