from __future__ import annotations

import asyncio
import base64
import hashlib
import re
import socket
from importlib import resources

import pytest

from ros2_memory.serving.page import policy
from tests.support.processes import BOUND_S, listening
from tests.unit.serving.test_web_app import EVERYWHERE, GOOD, SHOWN, app, client

PAGE = resources.files("ros2_memory.serving.page").joinpath("index.html")
HTML = PAGE.read_text(encoding="utf-8")
SVG = "http://www.w3.org/2000/svg"


async def test_the_page_is_served_at_the_root() -> None:
    async with client(app()) as http:
        response = await http.get("/")
        head = await http.head("/")
    assert response.status_code == head.status_code == 200
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert response.text == HTML
    assert head.content == b""
    assert head.headers["content-length"] == response.headers["content-length"]


async def test_on_a_socket_the_headers_alone_answer_a_head_request() -> None:
    async with listening(app(), lifespan="on") as server:
        port = server.servers[0].sockets[0].getsockname()[1]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for ending in ("HEAD / HTTP/1.1", "GET / HTTP/1.1\r\nConnection: close"):
            writer.write(f"{ending}\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        async with asyncio.timeout(BOUND_S):
            answers = await reader.read()
        writer.close()
    assert answers.count(b"HTTP/1.1 200 OK") == 2
    assert answers.count(b"</html>") == 1


async def test_only_the_root_is_the_page_and_only_to_be_read() -> None:
    async with client(app()) as http:
        assert (await http.post("/")).status_code == 404
        assert (await http.get("/index.html")).status_code == 404


async def test_its_policy_allows_its_own_script_and_style_and_nothing_else() -> None:
    async with client(app()) as http:
        headers = (await http.get("/")).headers
    reply = dict(each.split(" ", 1) for each in headers["content-security-policy"].split("; "))
    for kind in ("script", "style"):
        [body] = re.findall(f"<{kind}>(.*?)</{kind}>", HTML, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert reply[f"{kind}-src"] == f"'sha256-{digest}'"
    for what in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert reply[what] == "'none'"
    assert reply["connect-src"] == "'self'"
    assert reply["require-trusted-types-for"] == "'script'"
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"


def test_a_script_that_is_not_the_pages_own_has_another_hash() -> None:
    ours, theirs = (policy(f"<script>{each}</script>".encode()) for each in ("a()", "b()"))
    assert ours != theirs


async def test_on_the_loopback_address_it_is_shown_without_a_token_which_it_asks_for() -> None:
    async with client(app(api_token=GOOD)) as http:
        assert (await http.get("/")).status_code == 200
        assert (await http.post("/")).status_code == 401
        assert (await http.post("/mcp")).status_code == 401


@pytest.mark.parametrize("host", [EVERYWHERE, "192.168.7.20", "robot.lan"])
async def test_where_others_reach_the_server_it_is_closed_without_the_token(host: str) -> None:
    async with client(app(host, api_token=GOOD), "http://192.168.7.20:9203") as http:
        assert (await http.get("/")).status_code == 401
        assert (await http.get("/", headers=SHOWN)).text == HTML


async def test_a_name_that_was_rebound_to_this_machine_gets_no_page() -> None:
    async with client(app()) as http:
        assert (await http.get("/", headers={"host": "evil.example"})).status_code == 421
        assert (await http.get("/", headers={"origin": "http://evil.example"})).status_code == 403
        its = socket.gethostname() + ".evil.example"
        assert (await http.get("/", headers={"host": its})).status_code == 421


def test_nothing_of_it_comes_from_elsewhere() -> None:
    assert set(re.findall(r"\w+://[^\s\"'<]+", HTML)) == {SVG}
    assert re.findall(r"(?:src|href)=\"([^\"]*)\"", HTML) == ["data:,", "#ask"]
    assert not re.search(r"@import|url\(|\bimport\b|XMLHttpRequest|WebSocket|EventSource", HTML)
    assert re.findall(r"fetch\(([^,]+),", HTML) == ['"/mcp"']


def test_text_never_becomes_markup_or_code() -> None:
    forbidden = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function"
    assert not re.search(forbidden, HTML)
    assert not re.search(r"\son\w+=", HTML)


def test_nothing_of_it_moves_so_there_is_nothing_to_reduce() -> None:
    assert not re.search(r"@keyframes|animation|transition|scroll-behavior|<animate", HTML)


def test_it_keeps_the_token_nowhere() -> None:
    assert not re.search(r"localStorage|sessionStorage|cookie|indexedDB|history\.", HTML)


def test_every_field_of_it_has_a_label() -> None:
    for name in re.findall(r"<(?:input|select)[^>]* id=\"([\w-]+)\"", HTML):
        is_wrapped = re.search(rf"<label>[^<]*<select id=\"{name}\"", HTML)
        assert is_wrapped or f'<label for="{name}">' in HTML, name
