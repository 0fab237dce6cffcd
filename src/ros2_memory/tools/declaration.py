"""What a tool is, and how one query is declared under all its names."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeVar

from ros2_memory.tools.arguments import Arguments
from ros2_memory.tools.reply_size import to_json_text
from ros2_memory.tools.schema import Signature

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import Answer
    from ros2_memory.tools.arguments import TimeArgument
    from ros2_memory.tools.reply_size import JsonObject

Question: TypeAlias = "Callable[[Memory, Call], Answer]"
"""A query with its arguments bound."""

A = TypeVar("A", bound=Arguments)


@dataclass(frozen=True, slots=True)
class Tool:
    """One tool as clients see it.

    `question` checks a call's arguments and binds them to the query. `writes`: it changes what is
    stored.
    """

    name: str
    title: str
    description: str
    schema: JsonObject
    blocking: bool
    question: Callable[[Mapping[str, object]], Question]
    writes: bool = False


@dataclass(frozen=True, slots=True)
class ToolName:
    """One name of a query.

    `when_text` replaces {when} in the description. `extra_reply` names the keys that its reply has
    in addition to that of the query's first name.
    """

    name: str
    title: str
    when: type[TimeArgument] | None = None
    when_text: str = ""
    extra_reply: str = ""


@dataclass(frozen=True, slots=True)
class ToolDeclaration(Generic[A]):
    """A query and all its names."""

    names: tuple[ToolName, ...]
    description: str
    arguments: type[A]
    query: Callable[[Memory, Call, A], Answer]
    blocking: bool = False
    writes: bool = False

    def tools(self, defaults: Mapping[str, object]) -> Iterator[Tool]:
        """Yields a tool for each name; `defaults` fill the description's placeholders."""
        for each in self.names:
            signature = Signature(self.arguments, each.when)
            description = self._description(each, defaults)
            text = f"{description} Example: {to_json_text(signature.example)}"
            if self.blocking:
                text = f"Blocking, up to {defaults['timeout']} s. {text}"
            yield Tool(
                each.name,
                each.title,
                text,
                signature.json_schema(),
                self.blocking,
                partial(self._question, signature),
                self.writes,
            )

    def _description(self, name: ToolName, defaults: Mapping[str, object]) -> str:
        """Returns the full description for the first name, and a reference to it for the others."""
        first = self.names[0]
        if name is first:
            return self.description.format(when=name.when_text, **defaults)
        extra = f" Reply: the same, {name.extra_reply}." if name.extra_reply else ""
        return f"As {first.name}, {name.when_text}.{extra}"

    def _question(self, signature: Signature[A], given: Mapping[str, object]) -> Question:
        arguments = signature.parse(given)
        return lambda memory, call: self.query(memory, call, arguments)
