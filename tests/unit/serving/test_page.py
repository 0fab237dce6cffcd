import re
from importlib import resources

import pytest

from ros2_memory.serving.page import POLICY, SCRIPTS, STYLES
from ros2_memory.serving.page.routes import page_routes
from tests.unit.serving.test_dispatch import served
from tests.unit.serving.test_web_app import EVERYWHERE, GOOD, SHOWN, app, client

FOLDER = resources.files("ros2_memory.serving.page")
HTML = FOLDER.joinpath("index.html").read_text(encoding="utf-8")
OWN = {
    name: FOLDER.joinpath(name).read_text(encoding="utf-8")
    for name in (*SCRIPTS, *STYLES)
    if not name.startswith("vendor/")
}
SCRIPT = "\n".join(text for name, text in OWN.items() if name.endswith(".js"))
PATHS = ("/", "/page/page.js", "/page/page.css")


async def test_the_page_is_three_files_and_allows_this_servers_own_and_nothing_else() -> None:
    async with client(app()) as http:
        for path, kind in zip(PATHS, ("html", "javascript", "css"), strict=True):
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
        for path in PATHS:
            assert (await http.get(path)).status_code == 200
        assert (await http.post("/")).status_code == 401
        assert (await http.post("/mcp")).status_code == 401
        for path in (route.path for route in page_routes(served().dispatcher)):
            assert (await http.get(path)).status_code == 401
            assert (await http.get(path, headers=SHOWN)).status_code != 401
