"""What is spoken of MCP: the tools as declared, what can be read as a resource, and a prompt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

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

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.tools.instructions import PROMPT
from ros2_memory.tools.resources import SCHEMA, STATUS, TOPICS, asked_of

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping

    from ros2_memory.serving.dispatch import Dispatcher
    from ros2_memory.tools.declaration import Tool

MESSAGES_PATH: Final = "/messages/"
"""Where the clients of event streams post, each with its session in the query string."""

_LONGEST_NAME: Final = 64
_JSON: Final = "application/json"
_PROMPT_NAME: Final = "use_memory"
_PROMPT_TITLE: Final = "How to use the robot's memory"
_PROMPT_SAYS: Final = "Teaches a planner which tool answers what, in one call each."


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
    ) -> None:
        super().__init__(name, version=version, instructions=instructions)
        self.dispatcher = dispatcher
        self._listed = [_listed(tool) for tool in dispatcher.tools]
        reads_more = any(tool.name == STATUS.tool for tool in dispatcher.tools)
        self._offered = (TOPICS, STATUS, SCHEMA) if reads_more else (TOPICS,)
        self._prompt = f"{instructions}\n{PROMPT}"

    async def list_tools(self) -> list[ListedTool]:
        """The tools, in the order of their declaration."""
        return self._listed

    async def call_tool(
        self, name: str, arguments: Mapping[str, object], context: object | None = None
    ) -> CallToolResult:
        """One call's reply as one text block. Raises nothing but cancellation."""
        client = _client(context)
        reply = await self.dispatcher.answer(name, arguments, client)
        return CallToolResult(
            content=[TextContent(type="text", text=reply.text)], is_error=reply.is_error
        )

    async def list_resources(self) -> list[Resource]:
        """What can be read as it is."""
        return [
            Resource(uri=each.uri, name=each.name, description=each.description, mime_type=_JSON)
            for each in self._offered
            if each is not SCHEMA
        ]

    async def list_resource_templates(self) -> list[ResourceTemplate]:
        """What can be read for each message type."""
        if SCHEMA not in self._offered:
            return []
        return [
            ResourceTemplate(
                uri_template=SCHEMA.uri,
                name=SCHEMA.name,
                description=SCHEMA.description,
                mime_type=_JSON,
            )
        ]

    async def read_resource(
        self, uri: object, context: object | None = None
    ) -> Iterable[ReadResourceContents]:
        """A resource's JSON: the reply of the question behind it, errors included.

        Raises:
            ResourceNotFoundError: there is no such resource; the client is told so by the code
                that the protocol has for it, -32602 (SEP-2164).
        """
        try:
            name, given = asked_of(str(uri), self._offered)
        except InvalidArgumentsError as error:
            raise ResourceNotFoundError(str(error)) from error
        reply = await self.dispatcher.read(name, given, _client(context))
        return [ReadResourceContents(content=reply.text, mime_type=_JSON)]

    async def list_prompts(self) -> list[Prompt]:
        """The one prompt."""
        return [Prompt(name=_PROMPT_NAME, title=_PROMPT_TITLE, description=_PROMPT_SAYS)]

    async def get_prompt(
        self,
        name: str,
        arguments: Mapping[str, object] | None = None,
        context: object | None = None,
    ) -> GetPromptResult:
        """What teaches a planner how to use the memory.

        Raises:
            MCPError: there is no such prompt.
        """
        del arguments, context
        if name != _PROMPT_NAME:
            raise MCPError(code=INVALID_PARAMS, message=f"there is one prompt, {_PROMPT_NAME}")
        text = TextContent(type="text", text=self._prompt)
        return GetPromptResult(
            description=_PROMPT_SAYS, messages=[PromptMessage(role="user", content=text)]
        )


def _client(context: object) -> Hashable:
    """Who asks, as far as it can be told: a session, or else an address and a program.

    None over stdio, which has one client. Nothing but turns is given by it: a client may say that
    it is another.
    """
    request = context.request_context.request if isinstance(context, Context) else None
    if not isinstance(request, Request):
        return None
    # It was parsed, and would be kept for as long as the call waits: up to 1 MiB for each.
    request._body = b""
    session = request.query_params.get("session_id")
    if session is not None and request.url.path.startswith(MESSAGES_PATH):
        return session
    address = request.client.host if request.client else ""
    name = request.headers.get("mcp-session-id") or request.headers.get("user-agent", "")
    return address, name[:_LONGEST_NAME]


def _listed(tool: Tool) -> ListedTool:
    # What only destroys or repeats itself where something is written is not said of what reads.
    annotations = ToolAnnotations(
        # Clients show it where a tool has no title of its own; twice would be once too often.
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
