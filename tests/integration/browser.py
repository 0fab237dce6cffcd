"""Real Chromium, driven through chromedriver by the W3C WebDriver protocol.

A few commands over HTTP are all that the tests need, so there is no driver library.
"""

import base64
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.support.processes import PATIENCE_S, until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
CHROMEDRIVER = shutil.which("chromedriver")
TAB = "\ue004"
ENTER = "\ue007"
RIGHT = "\ue014"

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None or CHROMEDRIVER is None,
    reason="chromium and chromedriver are not installed (Debian: chromium, chromium-driver)",
)


class Browser:
    """One window, with the profile of nobody."""

    def __init__(self, driver: str, profile: Path) -> None:
        self._http = httpx2.Client(timeout=PATIENCE_S)
        self._session = driver
        flags = (
            "headless",
            "no-sandbox",
            "disable-gpu",
            "disable-dev-shm-usage",
            "disable-background-networking",
            "disable-component-update",
            "disable-sync",
            "no-first-run",
            f"user-data-dir={profile}",
        )
        options = {"binary": CHROMIUM, "args": [f"--{flag}" for flag in flags]}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        told = self._ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._session = f"{driver}/session/{told['sessionId']}"

    def close(self) -> None:
        self._ask("DELETE", "")
        self._http.close()

    def open(self, url: str) -> None:
        self._ask("POST", "/url", {"url": url})

    def run(self, script: str, *arguments: object) -> Any:
        """What a function body returns, run in the page."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": arguments})

    def enter_frame(self, index: int) -> None:
        """From here on all is in a frame of what was the page, also of another origin."""
        self._ask("POST", "/frame", {"id": index})

    def leave_frames(self) -> None:
        self._ask("POST", "/frame", {"id": None})

    def text(self, selector: str) -> str:
        return str(self.run("return document.querySelector(arguments[0]).innerText", selector))

    def awaits(self, script: str, *arguments: object) -> None:
        """Until it returns something that is true."""
        until(lambda: self.run(script, *arguments) or None)

    def point(self, selector: str, x: float, y: float) -> None:
        """Moves the mouse to a place (px) of an element."""
        self._mouse(self._move(selector, x, y))

    def press(self, selector: str, x: float = 5, y: float = 5) -> None:
        """Clicks at a place of an element."""
        self.drag(selector, (x, y), (x, y))

    def drag(self, selector: str, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Presses the mouse at a place of an element, moves it to another, and lets it go."""
        begin, stop = self._move(selector, *start), self._move(selector, *end)
        middle = {**stop, "x": (begin["x"] + stop["x"]) // 2, "y": (begin["y"] + stop["y"]) // 2}
        down, up = ({"type": f"pointer{kind}", "button": 0} for kind in ("Down", "Up"))
        moves = [] if begin == stop else [middle, stop]
        self._mouse(begin, down, *moves, up)

    def _move(self, selector: str, x: float, y: float) -> dict[str, Any]:
        box = self.run(
            "const shown = document.querySelector(arguments[0]);"
            "shown.scrollIntoView({ block: 'center' });"
            "const box = shown.getBoundingClientRect(); return [box.left, box.top];",
            selector,
        )
        at = {"x": round(box[0] + x), "y": round(box[1] + y)}
        return {"type": "pointerMove", "duration": 0, "origin": "viewport", **at}

    def _mouse(self, *actions: dict[str, Any]) -> None:
        kind = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        self._ask("POST", "/actions", {"actions": [{**kind, "actions": [*actions]}]})

    def keys(self, typed: str) -> None:
        """Types on the keyboard, wherever the focus is."""
        strokes = [{"type": kind, "value": each} for each in typed for kind in ("keyDown", "keyUp")]
        keyboard = {"type": "key", "id": "keyboard", "actions": strokes}
        self._ask("POST", "/actions", {"actions": [keyboard]})

    def complaints(self) -> list[str]:
        """What stands in the console since it was last asked for."""
        return [each["message"] for each in self._ask("POST", "/se/log", {"type": "browser"})]

    def looks(self, *, width: int, height: int, dark: bool = False) -> None:
        """The size of the window and the colour scheme that its user prefers."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self._devtools("Emulation.setDeviceMetricsOverride", size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._devtools("Emulation.setEmulatedMedia", {"features": [scheme]})

    def timezone(self, name: str) -> None:
        """Where its user is; empty: where it runs."""
        self._devtools("Emulation.setTimezoneOverride", {"timezoneId": name})

    def screenshot(self) -> bytes:
        """As PNG."""
        taken = self._devtools("Page.captureScreenshot", {})
        return base64.b64decode(taken["data"])

    def _devtools(self, command: str, params: dict[str, Any]) -> Any:
        return self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": params})

    def _ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        data = None if method == "DELETE" else body or {}
        response = self._http.request(method, f"{self._session}{path}", json=data)
        told = response.json()["value"]
        if response.is_error:
            raise AssertionError(f"{path}: {told['error']}: {told['message']}")
        return told


@contextmanager
def browsing(scratch: Path) -> Iterator[Browser]:
    """A browser of its own, gone with its profile's folder in the end."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert CHROMEDRIVER is not None
    driver = subprocess.Popen(
        [CHROMEDRIVER, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        url = f"http://127.0.0.1:{port}"
        until(lambda: _is_ready(url) or None)
        browser = Browser(url, scratch / "profile")
        try:
            yield browser
        finally:
            browser.close()
    finally:
        driver.terminate()
        driver.wait()


def _is_ready(url: str) -> bool:
    try:
        return bool(httpx2.get(f"{url}/status", timeout=PATIENCE_S).json()["value"]["ready"])
    except httpx2.TransportError:
        return False
