"""A client with MCP Apps, as its specification of 2026-01-26 has it: a web page that shows views.

The host and the sandbox proxy have different origins. The proxy loads the view into a frame that
may run scripts and nothing else, under the policy for a resource that declares no domains. What the
view asks is answered by the test.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from typing import Any, Final

from tests.integration.browser import Browser
from tests.support.processes import http_server

POLICY: Final = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; media-src 'self' data:; connect-src 'none'; frame-src 'none'; "
    "object-src 'none'; base-uri 'self'"
)
"""The restrictive default, and what the sandbox has to enforce besides."""
LAX: Final = "default-src * 'unsafe-inline'"
"""That of a host that enforces nothing."""
HOST: Final = """<!DOCTYPE html><title>host</title>
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
PROXY: Final = """<!DOCTYPE html><title>proxy</title>
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
