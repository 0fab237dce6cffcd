"""The MCP server: the tools as declared, the resources, and a prompt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import unquote

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

from ros2_memory.tools.instructions import PROMPT

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping

    from ros2_memory.core.model import JsonValue
    from ros2_memory.serving.dispatch import Dispatcher
    from ros2_memory.tools.declaration import Tool

MESSAGES_PATH: Final = "/messages/"
"""Where the clients of event streams post, each with its session in the query string."""

_LONGEST_NAME: Final = 64
_LONGEST_URI: Final = 200
_JSON: Final = "application/json"
_PROMPT_NAME: Final = "use_memory"
_PROMPT_TITLE: Final = "How to use the robot's memory"
_PROMPT_DESCRIPTION: Final = "Teaches a planner which tool answers what, in one call each."


TOPICS: Final = Resource(
    uri="episodic://topics",
    name="topics",
    description="Every recorded topic with its type, times and count.",
    mime_type=_JSON,
)
STATUS: Final = Resource(
    uri="episodic://status",
    name="status",
    description="How far the memory can be trusted just now.",
    mime_type=_JSON,
)
MOMENTS: Final = Resource(
    uri="episodic://moments",
    name="moments",
    description="What remember_moment kept, newest first.",
    mime_type=_JSON,
)
TOOLS_OF_RESOURCES: Final = {
    TOPICS.uri: "list_recorded_topics",
    STATUS.uri: "memory_status",
    MOMENTS.uri: "list_moments",
}
"""The tools whose replies are the text of the resources."""
_SCHEMA_PREFIX: Final = "episodic://schema/"
SCHEMA: Final = ResourceTemplate(
    uri_template=f"{_SCHEMA_PREFIX}{{type}}",
    name="schema",
    description="The fields that replies show of a message type, as dot-paths, e.g. "
    "nav_msgs/msg/Odometry.",
    mime_type=_JSON,
)


class EpisodicServer(MCPServer[object]):
    """The MCP server over a dispatcher: lists the tools as declared, and answers with one text.

    Text alone, without structured content: some clients forward only the latter where both exist,
    and a JSON string is what the tools promise.
    """

    def __init__(
        self, dispatcher: Dispatcher, *, name: str, version: str, instructions: str
    ) -> None:
        super().__init__(name, version=version, instructions=instructions)
        self.dispatcher = dispatcher
        self._listed = [_listed(tool) for tool in dispatcher.tools]
        has_status = any(tool.name == TOOLS_OF_RESOURCES[STATUS.uri] for tool in dispatcher.tools)
        self._resources = [TOPICS, STATUS, MOMENTS] if has_status else [TOPICS]
        self._templates = [SCHEMA] if has_status else []
        self._prompt = f"{instructions}\n{PROMPT}"

    async def list_tools(self) -> list[ListedTool]:
        """Returns the tools, in the order of their declaration."""
        return self._listed

    async def call_tool(
        self, name: str, arguments: Mapping[str, object], context: object | None = None
    ) -> CallToolResult:
        """Returns a call's reply as one text block. Raises nothing but cancellation."""
        reply = await self.dispatcher.answer(name, arguments, _client(context))
        return CallToolResult(
            content=[TextContent(type="text", text=reply.text)], is_error=reply.is_error
        )

    async def list_resources(self) -> list[Resource]:
        """Returns the resources that have no parameter."""
        return self._resources

    async def list_resource_templates(self) -> list[ResourceTemplate]:
        """Returns the template of the resources of message types."""
        return self._templates

    async def read_resource(
        self, uri: object, context: object | None = None
    ) -> Iterable[ReadResourceContents]:
        """Returns a resource's JSON: the reply of its tool, errors included.

        Raises:
            ResourceNotFoundError: there is no such resource; the client receives the code that the
                protocol has for it, -32602 (SEP-2164).
        """
        name, arguments = self._resource_call(str(uri))
        client = _client(context)
        reply = await self.dispatcher.answer(name, arguments, client, for_resource=True)
        return [ReadResourceContents(content=reply.text, mime_type=_JSON)]

    def _resource_call(self, uri: str) -> tuple[str, dict[str, JsonValue]]:
        """Returns the tool of a resource, and its arguments."""
        if self._templates and uri.startswith(_SCHEMA_PREFIX) and uri != _SCHEMA_PREFIX:
            return "describe_type", {"type": unquote(uri.removeprefix(_SCHEMA_PREFIX))}
        offered = [each.uri for each in self._resources]
        if uri in offered:
            return TOOLS_OF_RESOURCES[uri], {}
        shown = uri if len(uri) <= _LONGEST_URI else f"{uri[:_LONGEST_URI]}..."
        known = ", ".join([*offered, *(each.uri_template for each in self._templates)])
        raise ResourceNotFoundError(f"there is no resource {shown}; what can be read: {known}")

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


def _client(context: object) -> Hashable:
    """Returns an identity of the client: its session, or else its address and program.

    None over stdio, which has one client. It serves to give out turns fairly, and nothing else: a
    client may claim to be another.
    """
    request = context.request_context.request if isinstance(context, Context) else None
    if not isinstance(request, Request):
        return None
    # The body was parsed. Starlette would keep up to 1 MiB of it for as long as the call waits.
    request._body = b""
    session = request.query_params.get("session_id")
    if session is not None and request.url.path.startswith(MESSAGES_PATH):
        return session
    address = request.client.host if request.client else ""
    name = request.headers.get("mcp-session-id") or request.headers.get("user-agent", "")
    return address, name[:_LONGEST_NAME]


def _listed(tool: Tool) -> ListedTool:
    # A hint about destruction is left out of tools that only read, where it would mean nothing.
    annotations = ToolAnnotations(
        # Clients show it where a tool has no title of its own, so a title is given only once.
        title=f"{tool.title} (blocking)" if tool.blocking else None,
        read_only_hint=not tool.writes,
        destructive_hint=False if tool.writes else None,
    )
    return ListedTool(
        name=tool.name,
        title=None if tool.blocking else tool.title,
        description=tool.description,
        input_schema=dict(tool.schema),
        annotations=annotations,
    )
