"""The MCP server: the tools as declared, the resources, a prompt, and the view of MCP Apps.

The view (SEP-1865) is one document that draws the reply of a tool in a chat, with the page's
drawing code. It reaches no network, whatever the client allows: the client gives it the reply, and
passes on its further questions.
"""

from __future__ import annotations

import itertools
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias
from urllib.parse import unquote

import anyio
import anyio.to_thread
from mcp.server.apps import APP_MIME_TYPE, Apps
from mcp.server.caching import CacheableMethod, CacheHint
from mcp.server.lowlevel.helper_types import ReadResourceContents
from mcp.server.mcpserver import Context, MCPServer
from mcp.server.mcpserver.exceptions import ResourceNotFoundError
from mcp.shared.exceptions import MCPError
from mcp.types import (
    INVALID_PARAMS,
    CallToolResult,
    GetPromptResult,
    Prompt,
    PromptMessage,
    Resource,
    ResourceTemplate,
    TextContent,
    ToolAnnotations,
)
from mcp.types import Tool as ListedTool
from starlette.requests import Request

from ros2_memory.serving.auth import access_of
from ros2_memory.serving.page import joined
from ros2_memory.serving.stdio import stdio_messages
from ros2_memory.tools.instructions import prompt

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Hashable, Iterable, Mapping

    from ros2_memory.columns.fill import Progress
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.serving.dispatch import Dispatcher
    from ros2_memory.tools.declaration import Tool


VIEW_URI: Final = "ui://episodic/memory"
_STYLES: Final = ("page.css", "chat.css")
_SCRIPTS: Final = ("text.js", "map.js", "timeline.js", "reply.js", "chat.js")


def view() -> ReadResourceContents:
    """Returns the view as one HTML document."""
    html = joined(("chat.html",)).replace("<style></style>", f"<style>{joined(_STYLES)}</style>")
    html = html.replace("<script></script>", f"<script>{joined(_SCRIPTS)}</script>")
    return ReadResourceContents(html, APP_MIME_TYPE, {"ui": {"prefersBorder": True}})


MESSAGES_PATH: Final = "/messages/"
"""Where the clients of event streams post, each with its session in the query string."""

_LONGEST_NAME: Final = 64
_LONGEST_URI: Final = 200
_JSON: Final = "application/json"
_PROMPT_NAME: Final = "use_memory"
_PROMPT_TITLE: Final = "How to use the robot's memory"
_PROMPT_DESCRIPTION: Final = "Explains to a planner which tool answers which question."


def _resource(name: str, description: str) -> Resource:
    return Resource(uri=f"episodic://{name}", name=name, description=description, mime_type=_JSON)


class _TemplateTool(NamedTuple):
    """A template of resources.

    Attributes:
        template: as clients see it.
        tool: the tool whose reply is the text of the resource.
        argument: the argument of the tool that the last part of the URI gives.
    """

    template: ResourceTemplate
    tool: str
    argument: str


RESOURCES: Final = {
    "list_recorded_topics": _resource(
        "topics", "Every recorded topic with its type, times and count."
    ),
    "memory_status": _resource(
        "status", "Recorder state, age of the newest data, damaged files and silent topics."
    ),
    "list_moments": _resource(
        "moments", "Moments saved by remember_moment or a rule, newest first."
    ),
}
"""The resources by the tools whose replies are their text."""
_Report: TypeAlias = "Callable[[float, float | None, str | None], Awaitable[None]]"

LISTS_CACHED: Final = CacheHint(ttl_ms=3_600_000, scope="public")
"""Lists are the same for every client, and change only with the configuration."""
_LISTS: Final[tuple[CacheableMethod, ...]] = (
    "server/discover",
    "tools/list",
    "prompts/list",
    "resources/list",
    "resources/templates/list",
)
PROGRESS_EVERY_S: Final = 1.0

_SCHEMA_PREFIX: Final = "episodic://schema/"
SCHEMA: Final = ResourceTemplate(
    uri_template=f"{_SCHEMA_PREFIX}{{type}}",
    name="schema",
    description="The fields that replies show of a message type, as dot-paths, e.g. "
    "nav_msgs/msg/Odometry.",
    mime_type=_JSON,
)
_MOMENT_PREFIX: Final = "episodic://moments/"
MOMENT: Final = ResourceTemplate(
    uri_template=f"{_MOMENT_PREFIX}{{id}}",
    name="moment",
    description="One saved moment, by its name in episodic://moments.",
    mime_type=_JSON,
)
_TEMPLATES: Final = {
    _SCHEMA_PREFIX: _TemplateTool(SCHEMA, "describe_type", "type"),
    _MOMENT_PREFIX: _TemplateTool(MOMENT, "show_moment", "moment"),
}
"""The templates by the prefix of their URIs."""


class EpisodicServer(MCPServer[object]):
    """The MCP server over a dispatcher: lists the tools as declared, and answers with one text.

    Text alone, without structured content: some clients forward only the latter where both exist,
    and a JSON string is what the tools promise.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        *,
        name: str,
        version: str,
        instructions: str,
        progress: Callable[[], Progress] | None = None,
    ) -> None:
        """Makes the server; `progress` returns how far the store of columns is filled."""
        super().__init__(
            name,
            version=version,
            instructions=instructions,
            # Lists do not change while the server runs, so no notifications are sent.
            subscriptions=False,
            cache_hints=dict.fromkeys(_LISTS, LISTS_CACHED),
            extensions=[Apps()],
        )
        self._progress = progress
        self.dispatcher = dispatcher
        self._listed_tools = [*map(_listed_tool, dispatcher.tools.values())]
        additions = "memory_status" in dispatcher.tools
        self._prompt = f"{instructions}\n{prompt(additions=additions)}"
        self._resources = {
            tool: resource for tool, resource in RESOURCES.items() if tool in dispatcher.readable
        }
        self._templates = {
            prefix: template
            for prefix, template in _TEMPLATES.items()
            if template.tool in dispatcher.readable
        }

    async def run_stdio_async(self) -> None:
        """Serves stdin and stdout until stdin ends."""
        server = self._lowlevel_server
        async with stdio_messages() as (messages, replies):
            await server.run(messages, replies, server.create_initialization_options())

    async def list_tools(self) -> list[ListedTool]:
        """Returns the tools, in the order of their declaration."""
        return self._listed_tools

    async def call_tool(
        self, name: str, arguments: Mapping[str, object], context: object | None = None
    ) -> CallToolResult:
        """Returns the reply to a call as one text block. Raises nothing but cancellation.

        Meanwhile a client that asks for progress receives it every `PROGRESS_EVERY_S`.
        """
        request = _http_request(context)
        if request is not None:
            request._body = b""  # it was parsed, and Starlette would keep it during the call
        async with anyio.create_task_group() as tasks:
            if isinstance(context, Context):
                meta = context.request_context.meta or {}
                if "progress_token" in meta:
                    tasks.start_soon(self._report_progress, context.report_progress)
            reply = await self.dispatcher.answer(
                name,
                arguments,
                _client(request),
                for_page=_is_page(request),
                robots=_robots(request),
            )
            tasks.cancel_scope.cancel()
        return CallToolResult(
            content=[TextContent(type="text", text=reply.text)], is_error=reply.is_error
        )

    async def _report_progress(self, report: _Report) -> None:
        """Reports the seconds of a call, and how far the store is filled, until cancelled."""
        for elapsed_s in itertools.count(1):
            await anyio.sleep(PROGRESS_EVERY_S)
            sentence = None
            if self._progress is not None:
                progress = await anyio.to_thread.run_sync(self._progress, abandon_on_cancel=True)
                sentence = _describe_progress(progress)
            with suppress(anyio.ClosedResourceError, anyio.BrokenResourceError):
                await report(elapsed_s, None, sentence)

    async def list_resources(self) -> list[Resource]:
        """Returns the resources that have no parameter."""
        return [*self._resources.values()]

    async def list_resource_templates(self) -> list[ResourceTemplate]:
        """Returns the templates of the resources of message types and of saved moments."""
        return [row.template for row in self._templates.values()]

    async def read_resource(
        self, uri: object, context: object | None = None
    ) -> Iterable[ReadResourceContents]:
        """Returns a resource's JSON, which is the reply of its tool or an error; or the view.

        Raises:
            ResourceNotFoundError: there is no such resource; the client receives the code that the
                protocol has for it, -32602 (SEP-2164).
        """
        if str(uri) == VIEW_URI:
            return [view()]
        name, arguments = self._resource_call(str(uri))
        request = _http_request(context)
        reply = await self.dispatcher.answer(
            name, arguments, _client(request), for_resource=True, robots=_robots(request)
        )
        return [ReadResourceContents(content=reply.text, mime_type=_JSON)]

    def _resource_call(self, uri: str) -> tuple[str, JsonObject]:
        """Returns the tool of a resource, and its arguments.

        Raises:
            ResourceNotFoundError: there is no such resource.
        """
        for prefix, template in self._templates.items():
            if uri.startswith(prefix) and uri != prefix:
                return template.tool, {template.argument: unquote(uri.removeprefix(prefix))}
        tools = {resource.uri: tool for tool, resource in self._resources.items()}
        if uri in tools:
            return tools[uri], {}
        shown = uri if len(uri) <= _LONGEST_URI else f"{uri[:_LONGEST_URI]}..."
        templates = [row.template.uri_template for row in self._templates.values()]
        uris = ", ".join([*tools, *templates])
        raise ResourceNotFoundError(f"unknown resource {shown}; the resources are: {uris}")

    async def list_prompts(self) -> list[Prompt]:
        """Returns the one prompt."""
        return [Prompt(name=_PROMPT_NAME, title=_PROMPT_TITLE, description=_PROMPT_DESCRIPTION)]

    async def get_prompt(
        self,
        name: str,
        arguments: Mapping[str, object] | None = None,
        context: object | None = None,
    ) -> GetPromptResult:
        """Returns the text that teaches a planner how to use the memory.

        Raises:
            MCPError: there is no such prompt.
        """
        del arguments, context
        if name != _PROMPT_NAME:
            raise MCPError(code=INVALID_PARAMS, message=f"there is one prompt, {_PROMPT_NAME}")
        text = TextContent(type="text", text=self._prompt)
        return GetPromptResult(
            description=_PROMPT_DESCRIPTION, messages=[PromptMessage(role="user", content=text)]
        )


def _describe_progress(progress: Progress) -> str | None:
    """Returns e.g. `40 % of the bags stored`; None if none waits."""
    if not progress.waiting:
        return None
    return f"{progress.percent} % of the bags stored"


def _http_request(context: object) -> Request | None:
    """Returns the HTTP request of a call; None over stdio."""
    request = context.request_context.request if isinstance(context, Context) else None
    return request if isinstance(request, Request) else None


def _client(request: Request | None) -> Hashable:
    """Returns an identity of the client: its session, or else its address and program.

    None over stdio, which has one client. It only serves to give out turns fairly: a client may
    claim to be another.
    """
    if request is None:
        return None
    session = request.query_params.get("session_id")
    if session is not None and request.url.path.startswith(MESSAGES_PATH):
        return session
    address = request.client.host if request.client else ""
    name = request.headers.get("mcp-session-id") or request.headers.get("user-agent", "")
    return address, name[:_LONGEST_NAME]


def _robots(request: Request | None) -> frozenset[str] | None:
    """Returns the robots that the token of a request is for; None for all."""
    access = None if request is None else access_of(request.scope)
    return None if access is None else access.robots


def _is_page(request: Request | None) -> bool:
    """Returns whether the server's own page asks: only browsers name the site of a request."""
    return request is not None and request.headers.get("sec-fetch-site") == "same-origin"


def _listed_tool(tool: Tool) -> ListedTool:
    """Returns a tool as `tools/list` shows it."""
    # Hints about what a call changes mean nothing for tools that only read.
    annotations = ToolAnnotations(
        read_only_hint=not tool.writes,
        destructive_hint=False if tool.writes else None,
        idempotent_hint=False if tool.writes else None,
        open_world_hint=False,
    )
    return ListedTool(
        name=tool.name,
        title=tool.title,
        description=tool.description,
        input_schema=dict(tool.schema),
        annotations=annotations,
        _meta={"ui": {"resourceUri": VIEW_URI}} if tool.drawn else None,
    )
