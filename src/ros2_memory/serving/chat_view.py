"""The view of MCP Apps (SEP-1865): one document that draws the reply of a tool in a chat.

It is made of the page's own drawing code. It reaches no network, whatever the client allows: what
it shows is given to it by the client, and what it asks further goes through the client.
"""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING, Final

from mcp.server.apps import APP_MIME_TYPE
from mcp.server.lowlevel.helper_types import ReadResourceContents

from ros2_memory.serving import page

if TYPE_CHECKING:
    from collections.abc import Iterable

VIEW_URI: Final = "ui://episodic/memory"
TOOLS_WITH_VIEW: Final = frozenset(
    {"recap", "visits", "find_things", "find_matches", "trajectory_summary", "compare"}
)
_STYLES: Final = ("page.css", "chat.css")
_SCRIPTS: Final = ("text.js", "map.js", "timeline.js", "reply.js", "chat.js")


def view() -> ReadResourceContents:
    """Returns the document."""
    html = _joined(("chat.html",)).replace("<style></style>", f"<style>{_joined(_STYLES)}</style>")
    html = html.replace("<script></script>", f"<script>{_joined(_SCRIPTS)}</script>")
    return ReadResourceContents(html, APP_MIME_TYPE, {"ui": {"prefersBorder": True}})


def _joined(names: Iterable[str]) -> str:
    folder = resources.files(page)
    return "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)
