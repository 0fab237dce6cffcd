"""The view of MCP Apps in real Chromium, in a host made from the extension's specification."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client
from mcp.types import TextResourceContents

from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.config import load_settings
from ros2_memory.serving.mcp_server import VIEW_URI, EpisodicServer
from tests.integration.browser import Browser, browsing, needs_chromium
from tests.integration.chat_host import ChatHost, chat_host
from tests.integration.test_page import ATTACK, painted, write_history
from tests.support.demo_bags import ASKED_AT_S, recorded
from tests.support.robot_run import T0_S

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

    def view(self) -> str:
        async def read() -> str:
            async with Client(self.server) as client:
                [content] = (await client.read_resource(VIEW_URI)).contents
                assert isinstance(content, TextResourceContents)
                return content.text

        return anyio.run(read)

    def ask(self, host: ChatHost, tool: str, given: dict[str, Any], **how: Any) -> dict[str, Any]:
        """A call whose result the host shows; returns the reply."""
        result = self.call(tool, given)
        host.show(self.view(), given, result, tool=tool, **how)
        reply: dict[str, Any] = json.loads(result["content"][0]["text"])
        return reply


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("chat")


@pytest.fixture(scope="module")
def robot(scratch: Path) -> Iterator[Robot]:
    with recorded(scratch / "demo"):
        yield Robot(scratch / "demo")


@pytest.fixture(scope="module")
def chromium(scratch: Path) -> Iterator[Browser]:
    with browsing(scratch) as browser:
        browser.looks(width=720, height=1400)
        yield browser


@pytest.fixture
def host(chromium: Browser) -> Iterator[ChatHost]:
    """A host; what the browser complains of fails the test, and so does a request that leaves."""
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
    assert (
        chromium.run(
            "return map.paths[0].t.map((t, n) => [t, map.paths[0].x[n], map.paths[0].y[n]])"
        )
        == corners
    )
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


def test_a_click_asks_further_through_the_host(
    robot: Robot, host: ChatHost, chromium: Browser
) -> None:
    robot.ask(host, "recap", SPAN)
    drawn(chromium)
    assert chromium.run("return map.paths[0].t.length") == 0
    chromium.run("document.querySelectorAll('#more button')[1].click()")
    asked = host.await_heard("tools/call")
    span = {"start": SPAN["start"], "end": SPAN["end"], "frame_id": "map", "max_waypoints": 200}
    assert asked["params"] == {"name": "trajectory_summary", "arguments": span}
    host.answer(asked, result=robot.call("trajectory_summary", span))
    chromium.awaits("return map.paths[0].t.length > 5")
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


def test_the_height_follows_the_content(robot: Robot, host: ChatHost, chromium: Browser) -> None:
    robot.ask(host, "recap", SPAN)
    drawn(chromium)
    height = chromium.run(
        "return Math.ceil(document.documentElement.getBoundingClientRect().height)"
    )
    chromium.leave_frames()
    chromium.awaits("return proxy.clientHeight === arguments[0]", height)


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
