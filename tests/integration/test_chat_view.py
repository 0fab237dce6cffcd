"""The view of MCP Apps in real Chromium, in a host made from the extension's specification."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.demo.messages import MessageSchedule
from ros2_memory.demo.recording import DemoRecorder
from ros2_memory.serving.mcp_server import VIEW_URI, EpisodicServer
from tests.integration.browser import Browser, needs_chromium
from tests.integration.test_page import ATTACK, painted, write_history
from tests.support.bags import set_mtime
from tests.support.clocks import FixedClock
from tests.support.processes import http_server
from tests.support.robot_run import T0_S

STARTED_S = 1_784_023_200
"""When the robot started, in Unix seconds: it was on its dock."""
HEARD_AFTER_S = 17
"""Seconds after its start from which on it is recorded."""
ASKED_AT_S = STARTED_S + 240.5


@contextmanager
def recorded(folder: Path) -> Iterator[None]:
    """Three laps of which the last split is open: the robot stands on its dock again."""
    start = ns_from_unix(STARTED_S)
    now = ns_from_unix(ASKED_AT_S)
    timeline = MessageSchedule(start, start + ns_from_unix(HEARD_AFTER_S))
    recorder = DemoRecorder(folder / "flat", timeline, split_duration_s=10.0, clock=FixedClock(now))
    for path in folder.rglob("*.mcap"):
        set_mtime(path, now)  # however long it took to write them
    yield
    recorder.stop()


POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; media-src 'self' data:; connect-src 'none'; frame-src 'none'; "
    "object-src 'none'; base-uri 'self'"
)
"""The restrictive default, and what the sandbox has to enforce besides."""
LAX = "default-src * 'unsafe-inline'"
"""That of a host that enforces nothing."""
HOST = """<!DOCTYPE html><title>host</title>
<meta name="viewport" content="width=device-width">
<link rel="icon" href="data:,">
<style>iframe { border: 0; width: 100%; }</style><body></body>
<script>
const heard = [], proxy = document.createElement("iframe");
proxy.setAttribute("sandbox", "allow-scripts allow-same-origin");
let context = {}, resource = null, capabilities = {};
const post = (message) => proxy.contentWindow.postMessage({ jsonrpc: "2.0", ...message }, "*");
addEventListener("message", ({ source, origin, data }) => {
  if (source !== proxy.contentWindow || origin === location.origin) return;
  heard.push(data);
  if (data.method === "ui/notifications/sandbox-proxy-ready") {
    post({ method: "ui/notifications/sandbox-resource-ready", params: resource });
  } else if (data.method === "ui/initialize") {
    post({ id: data.id, result: { protocolVersion: data.params.protocolVersion,
      hostInfo: { name: "test", version: "1" },
      hostCapabilities: capabilities, hostContext: context } });
  } else if (data.method === "ui/notifications/size-changed") {
    proxy.style.height = `${data.params.height}px`;
  }
});
function begin(given) {
  ({ context, resource, capabilities } = given);
  heard.length = 0;
  proxy.src = given.sandbox;
  document.body.append(proxy);
}
</script>"""
PROXY = """<!DOCTYPE html><title>proxy</title>
<meta name="viewport" content="width=device-width">
<style>body { margin: 0; } iframe { border: 0; width: 100%; height: 100vh; display: block; }</style>
<script>
const policy = "POLICY";
let view = null;
const ready = { jsonrpc: "2.0", method: "ui/notifications/sandbox-proxy-ready", params: {} };
addEventListener("message", ({ source, data }) => {
  if (source === parent && data.method === "ui/notifications/sandbox-resource-ready") {
    view = document.createElement("iframe");
    view.setAttribute("sandbox", "allow-scripts");
    const meta = `<meta http-equiv="Content-Security-Policy" content="${policy}">`;
    view.srcdoc = data.params.html.replace("<head>", () => `<head>${meta}`);
    document.body.append(view);
  } else if (source === parent) view.contentWindow.postMessage(data, "*");
  else if (view && source === view.contentWindow) parent.postMessage(data, "*");
});
addEventListener("DOMContentLoaded", () => parent.postMessage(ready, "*"));
</script><body></body>"""


class ChatHost:
    """A window of the browser in which one view is shown; `asked` are the paths that it served."""

    def __init__(self, browser: Browser, url: str, sandbox: str, asked: list[str]) -> None:
        self._browser = browser
        self.url, self._sandbox = url, sandbox
        self.asked = asked

    def show(
        self,
        html: str,
        given: dict[str, object],
        result: dict[str, object],
        *,
        theme: str = "light",
        tool: str = "",
        may_ask: bool = True,
        sandbox: str = "/sandbox",
    ) -> None:
        """Loads a view, and gives it the arguments and the result of a call; stays in its frame."""
        self._browser.leave_frames()
        self._browser.open(f"{self.url}/host")
        context = {"theme": theme, "toolInfo": {"tool": {"name": tool, "inputSchema": {}}}}
        capabilities: dict[str, object] = {"serverTools": {}} if may_ask else {}
        shown = {"context": context, "capabilities": capabilities, "resource": {"html": html}}
        self._browser.run("begin(arguments[0])", {**shown, "sandbox": f"{self._sandbox}{sandbox}"})
        self.await_heard("ui/notifications/initialized")
        self.tell("ui/notifications/tool-input", {"arguments": given})
        self.tell("ui/notifications/tool-result", result)
        self.enter()

    def enter(self) -> None:
        """Goes into the frame of the view."""
        self._browser.leave_frames()
        self._browser.enter_frame(0)
        self._browser.enter_frame(0)

    def heard(self, method: str) -> list[dict[str, Any]]:
        """What the view has sent of a method."""
        self._browser.leave_frames()
        script = "return heard.filter(({ method }) => method === arguments[0])"
        found: list[dict[str, Any]] = self._browser.run(script, method)
        return found

    def await_heard(self, method: str, times: int = 1) -> dict[str, Any]:
        """Returns the newest message of a method, once there are as many."""
        self._browser.leave_frames()
        script = "return heard.filter(({ method }) => method === arguments[0]).length"
        self._browser.awaits(f"{script} >= arguments[1]", method, times)
        return self.heard(method)[-1]

    def answer(self, request: dict[str, Any], **answer: object) -> None:
        """Answers a request of the view, with a `result` or an `error`."""
        self._browser.leave_frames()
        self._browser.run("post(arguments[0])", {"id": request["id"], **answer})
        self.enter()

    def tell(self, method: str, params: dict[str, object]) -> None:
        """Sends a notification to the view."""
        self._browser.leave_frames()
        self._browser.run("post(arguments[0])", {"method": method, "params": params})


@contextmanager
def chat_host(browser: Browser) -> Iterator[ChatHost]:
    """A host over two local ports, which are two origins."""
    asked: list[str] = []
    pages = {"/host": HOST, "/sandbox": PROXY.replace("POLICY", POLICY)}
    pages["/lax"] = PROXY.replace("POLICY", LAX)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            page = pages.get(self.path)
            self.send_response(404 if page is None else 200)
            self.send_header("content-type", "text/html; charset=utf-8")
            self.send_header("access-control-allow-origin", "*")
            self.end_headers()
            self.wfile.write((page or "").encode())

        def log_message(self, *_: object) -> None:
            pass

    with http_server(Handler) as host, http_server(Handler) as sandbox:
        yield ChatHost(browser, host, sandbox, asked)


pytestmark = needs_chromium

SPAN = {"start": ASKED_AT_S - 150, "end": ASKED_AT_S - 20}
STOOD = {"start": ASKED_AT_S - 100, "end": ASKED_AT_S - 20}
EARLIER = {"with_start": ASKED_AT_S - 160, "with_end": ASKED_AT_S - 120}
OBJECTS = "/vision/scene/scene_objects"
CALLS: dict[str, dict[str, Any]] = {
    "recap": SPAN,
    "visits": {"x": 10.0, "y": 3.0, "radius_m": 1.0},
    "find_things": {},
    "find_matches": {"topic": OBJECTS, "condition_type": "contains", "value": "cup"},
    "trajectory_summary": {**SPAN, "frame_id": "map"},
    "compare": {**STOOD, **EARLIER},
}
TEXTS = {
    "recap": "slowed down suddenly",
    "visits": "Entries",
    "find_things": "television",
    "find_matches": "cup",
    "trajectory_summary": "Driven",
    "compare": "Unchanged things",
}


class Robot:
    """A server over bags, and a client of it."""

    def __init__(self, bag_dir: Path) -> None:
        given = (f"recording.bag_dir='{bag_dir}'", "recorder=none", "data.now=latest")
        settings = load_settings((*given, "logging.level=error"), {})
        self.server: EpisodicServer = build_server(settings, build_memory(settings))

    def call(self, tool: str, given: dict[str, Any]) -> dict[str, Any]:
        """The result of a call as a host passes it on."""

        async def called() -> dict[str, Any]:
            async with Client(self.server) as client:
                result = await client.call_tool(tool, given)
                return result.model_dump(by_alias=True, exclude_none=True, mode="json")

        return anyio.run(called)

    def ask(self, host: ChatHost, tool: str, given: dict[str, Any], **how: Any) -> dict[str, Any]:
        """A call whose result the host shows; returns the reply."""
        result = self.call(tool, given)
        [view] = anyio.run(self.server.read_resource, VIEW_URI)
        host.show(str(view.content), given, result, tool=tool, **how)
        reply: dict[str, Any] = json.loads(result["content"][0]["text"])
        return reply


@pytest.fixture(scope="module")
def robot(scratch: Path) -> Iterator[Robot]:
    with recorded(scratch / "demo"):
        yield Robot(scratch / "demo")


@pytest.fixture
def host(chromium: Browser) -> Iterator[ChatHost]:
    """A host; what the browser complains of fails the test, and so does a request that leaves."""
    chromium.looks(width=720, height=1400)
    chromium.complaints()
    with chat_host(chromium) as shown:
        yield shown
        assert set(shown.asked) <= {"/host", "/sandbox", "/lax"}
    chromium.leave_frames()
    assert chromium.complaints() == []


def drawn(page: Browser) -> None:
    page.awaits("return shown.replies.length > 0")
    assert page.run("return performance.getEntriesByType('resource').length") == 0


@pytest.mark.parametrize("tool", sorted(CALLS))
def test_each_reply_is_drawn(robot: Robot, host: ChatHost, chromium: Browser, tool: str) -> None:
    robot.ask(host, tool, CALLS[tool])
    drawn(chromium)
    assert TEXTS[tool] in chromium.text("#chat")
    chromium.awaits("return document.getElementById('map').width > 300")
    assert painted(chromium, "#map") > 500
    assert painted(chromium, "#timeline") > 500


def test_what_is_drawn_is_the_reply_itself(robot: Robot, host: ChatHost, chromium: Browser) -> None:
    path = robot.ask(host, "trajectory_summary", CALLS["trajectory_summary"])
    drawn(chromium)
    corners = [[point["timestamp"], point["x"], point["y"]] for point in path["waypoints"]]
    shown = "return map.path.t.map((t, n) => [t, map.path.x[n], map.path.y[n]])"
    assert chromium.run(shown) == corners
    found = robot.ask(host, "find_things", {})
    drawn(chromium)
    places = [
        [thing["label"], thing["place"]["x"], thing["place"]["y"]] for thing in found["things"]
    ]
    assert chromium.run("return map.things.map(({ label, x, y }) => [label, x, y])") == places
    told = robot.ask(host, "recap", SPAN)
    drawn(chromium)
    assert chromium.run("return line.view.events.map(({ text }) => text)") == [
        event["text"] for event in told["events"]
    ]


def test_the_height_follows_the_content_and_a_click_asks_further_through_the_host(
    robot: Robot, host: ChatHost, chromium: Browser
) -> None:
    robot.ask(host, "recap", SPAN)
    drawn(chromium)
    height = "return Math.ceil(document.documentElement.getBoundingClientRect().height)"
    high = chromium.run(height)
    chromium.leave_frames()
    chromium.awaits("return proxy.clientHeight === arguments[0]", high)
    host.enter()
    assert chromium.run("return map.path.t.length") == 0
    chromium.run("document.querySelectorAll('#more button')[1].click()")
    asked = host.await_heard("tools/call")
    span = {"start": SPAN["start"], "end": SPAN["end"], "frame_id": "map", "max_waypoints": 200}
    assert asked["params"] == {"name": "trajectory_summary", "arguments": span}
    host.answer(asked, result=robot.call("trajectory_summary", span))
    chromium.awaits("return map.path.t.length > 5")
    assert "Path" in chromium.text("#further-title")
    # The stops of the recap stay on the map, and one of them is asked about.
    assert chromium.run("return map.stops.length") > 0
    x, y = chromium.run("const [stop] = map.stops; return [map.px(stop.x), map.py(stop.y)]")
    chromium.press("#map", x, y)
    asked = host.await_heard("tools/call", 2)
    assert asked["params"]["name"] == "recap"
    host.answer(asked, error={"code": -32000, "message": "denied by the user"})
    chromium.awaits(
        "return document.getElementById('asked').textContent.includes('denied by the user')"
    )


def test_nothing_is_asked_where_the_host_passes_nothing_on(
    robot: Robot, host: ChatHost, chromium: Browser
) -> None:
    robot.ask(host, "find_things", {}, may_ask=False, theme="dark")
    drawn(chromium)
    assert chromium.run("return document.querySelectorAll('#rows button').length") == 0
    assert chromium.run("return document.getElementById('more').hidden")
    ground = "return getComputedStyle(document.body).backgroundColor"
    assert chromium.run(ground) == "rgb(26, 32, 41)"
    host.enter()
    x, y = chromium.run("const [thing] = map.things; return [map.px(thing.x), map.py(thing.y)]")
    chromium.press("#map", x, y)
    assert host.heard("tools/call") == []


@pytest.mark.parametrize("sandbox", ["/sandbox", "/lax"])
def test_nothing_leaves_whatever_the_host_allows(
    robot: Robot, host: ChatHost, chromium: Browser, sandbox: str
) -> None:
    """The view has an opaque origin, and a policy of its own beside that of the host."""
    robot.ask(host, "find_things", {}, sandbox=sandbox)
    drawn(chromium)
    assert chromium.run("return origin") == "null"
    chromium.run(
        "window.broken = [];"
        "addEventListener('securitypolicyviolation', (event) => broken.push(event.disposition))"
    )
    tried = "return fetch(arguments[0]).then(() => 'left', () => 'refused')"
    assert chromium.run(tried, f"{host.url}/leak") == "refused"
    chromium.awaits("return broken.length > 0")
    assert set(chromium.run("return broken")) == {"enforce"}
    with pytest.raises(AssertionError, match="TrustedHTML"):
        chromium.run("document.body.innerHTML = '<img src=x>'")


def test_recorded_text_stays_text(scratch: Path, host: ChatHost, chromium: Browser) -> None:
    write_history(scratch / "hostile")
    told = Robot(scratch / "hostile").ask(host, "recap", {"start": T0_S, "end": T0_S + 120})
    drawn(chromium)
    assert any(ATTACK in event["text"] for event in told["events"])
    assert ATTACK in chromium.run("return document.getElementById('rows').textContent")
    assert chromium.run("return window.ran === undefined")
    assert chromium.run("return document.querySelectorAll('#chat img, #chat script').length") == 0


def test_a_reply_without_data_and_a_cancelled_call_say_so(
    robot: Robot, host: ChatHost, chromium: Browser
) -> None:
    told = robot.ask(host, "visits", {"where": "nowhere"})
    drawn(chromium)
    assert told["detail"] in chromium.text("#rows")
    host.tell("ui/notifications/tool-cancelled", {"reason": "by the user"})
    host.enter()
    chromium.awaits("return document.getElementById('title').textContent.includes('by the user')")
