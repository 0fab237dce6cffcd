"""What a tool is, and how one question is declared under all its names."""

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
    from ros2_memory.results import Account
    from ros2_memory.tools.arguments import TimeArgument
    from ros2_memory.tools.reply_json import Answer
    from ros2_memory.tools.reply_size import JsonObject

Question: TypeAlias = "Callable[[Memory, Call], Answer | Account]"

A = TypeVar("A", bound=Arguments)


@dataclass(frozen=True, slots=True)
class Tool:
    """One tool as clients see it; `question` checks what is given and binds it to its query.

    `writes`: it changes what is kept.
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
    """One name of a question.

    `said` takes the place of {when} in the description; `more` is what the reply has besides that
    of the question's first name.
    """

    name: str
    title: str
    when: type[TimeArgument] | None = None
    said: str = ""
    more: str = ""


@dataclass(frozen=True, slots=True)
class ToolDeclaration(Generic[A]):
    """A question and all its names."""

    variants: tuple[ToolName, ...]
    description: str
    arguments: type[A]
    ask: Callable[[Memory, Call, A], Answer | Account]
    blocking: bool = False
    writes: bool = False

    def tools(self, facts: Mapping[str, object]) -> Iterator[Tool]:
        """The tools; `facts` fill the description's placeholders."""
        for variant in self.variants:
            signature = Signature(self.arguments, variant.when)
            what = self._told(variant, facts)
            text = f"{what} Example: {to_json_text(signature.example)}"
            if self.blocking:
                text = f"Blocking, up to {facts['timeout']} s. {text}"
            yield Tool(
                variant.name,
                variant.title,
                text,
                signature.json_schema(),
                self.blocking,
                partial(self._question, signature),
                self.writes,
            )

    def _told(self, variant: ToolName, facts: Mapping[str, object]) -> str:
        """What it answers: in full under the first name, and under the others by that."""
        first = self.variants[0]
        if variant is first:
            return self.description.format(when=variant.said, **facts)
        also = f" Reply: the same, {variant.more}." if variant.more else ""
        return f"As {first.name}, {variant.said}.{also}"

    def _question(self, signature: Signature[A], given: Mapping[str, object]) -> Question:
        arguments = signature.read(given)
        return lambda memory, call: self.ask(memory, call, arguments)
