"""What a tool is, and how one query is declared under all its names."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, TypeAlias, cast

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.history.view import TimeRange
from ros2_memory.insights.at_each import in_each
from ros2_memory.tools.reply_size import to_json_text
from ros2_memory.tools.schema import Signature

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from datetime import time

    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import Answer, OneAnswer
    from ros2_memory.tools.arguments import Arguments, TimeArgument

Question: TypeAlias = "Callable[[Memory, Call], Answer]"
"""A query with its arguments bound."""
SHOWN_ALONE: Final = frozenset(
    {"frame_id", "limit", "max_samples", "max_waypoints", "oldest_first"}
)
"""Arguments that bound what is shown, and change no count."""
Query: TypeAlias = "Callable[..., Answer]"  # type: ignore[explicit-any]
"""A function of a memory, a call, and the fields of its arguments as keywords, as a test holds."""


@dataclass(frozen=True)
class Tool:
    """One tool as clients see it.

    `describe` returns the description and the JSON schema of the arguments. `question` checks a
    call's arguments and binds them to the query. `writes`: it changes what is stored.
    """

    name: str
    title: str
    describe: Callable[[], tuple[str, JsonObject]]
    blocking: bool
    question: Callable[[Mapping[str, object]], Question]
    writes: bool = False

    @property
    def description(self) -> str:
        """Returns the text from which planners learn what the tool answers."""
        return self._described[0]

    @property
    def schema(self) -> JsonObject:
        """Returns the JSON schema of the arguments."""
        return self._described[1]

    @property
    def arguments(self) -> dict[str, JsonObject]:
        """Returns the JSON schema of each argument."""
        properties = self.schema["properties"]
        named = properties.items() if isinstance(properties, dict) else ()
        return {name: each for name, each in named if isinstance(each, dict)}

    @cached_property
    def _described(self) -> tuple[str, JsonObject]:
        # Made when it is asked for: 20 ms for all tools, of which a program may call one.
        return self.describe()


def _span_of(arguments: Mapping[str, object]) -> TimeRange:
    """Returns the window of a call, whose bounds may be arguments of their own."""
    span = arguments.get("span")
    if isinstance(span, TimeRange):
        return span
    names = ("start_s", "end_s", "last_s")
    start, end, last = (cast("float | None", arguments.get(name)) for name in names)
    return TimeRange(start, end, last)


@dataclass(frozen=True, slots=True)
class ToolName:
    """One name of a query, and the arguments that replace its moment or span."""

    name: str
    title: str
    when: type[TimeArgument] | None = None


@dataclass(frozen=True, slots=True)
class ToolDeclaration:
    """A query and all its names.

    `shows_example`: its schema alone does not show how it is called.
    `count` answers in place of `query` where `by` is given. It need not take arguments that only
    bound what is shown (`SHOWN_ALONE`); others that it does not take are refused.
    """

    names: tuple[ToolName, ...]
    description: str
    arguments: type[Arguments]
    query: Query
    blocking: bool = False
    writes: bool = False
    shows_example: bool = False
    count: Query | None = None

    def tools(self, defaults: Mapping[str, object], *, plain_times: bool = False) -> Iterator[Tool]:
        """Yields a tool for each name; `defaults` fill the description's placeholders.

        `plain_times`: see `Signature`.
        """
        for each in self.names:
            signature = Signature(self.arguments, each.when, plain_times=plain_times)
            yield Tool(
                each.name,
                each.title,
                partial(self._describe, each, signature, defaults),
                self.blocking,
                partial(self._question, signature),
                self.writes,
            )

    def _describe(
        self, name: ToolName, signature: Signature, defaults: Mapping[str, object]
    ) -> tuple[str, JsonObject]:
        """Returns what planners read: in full for the first name; the others refer to it."""
        first, when = self.names[0], name.when
        if name is first or when is None:
            text = self.description.format(when=when.text if when else "", **defaults)
        else:
            extra = f", with {when.extra_reply}" if when.extra_reply else ""
            text = f"As {first.name}, {when.text}{extra}."
        if self.blocking:
            text = f"Blocking. {text}"
        if self.shows_example and name is first:
            text = f"{text} Example: {to_json_text(signature.example)}"
        schema = signature.json_schema()
        properties = schema["properties"]
        if name is not first and isinstance(properties, dict):
            shared = Signature(self.arguments).json_schema()["properties"]
            for argument, each in properties.items():
                if isinstance(each, dict) and isinstance(shared, dict) and argument in shared:
                    each.pop("description", None)
        return text, schema

    def _question(self, signature: Signature, given: Mapping[str, object]) -> Question:
        arguments = dict(signature.parse(given))
        between = cast("tuple[time, time] | None", arguments.pop("between", None))
        query, chosen = self._bound(arguments)
        if between is None:
            return lambda memory, call: query(memory, call, **chosen)

        def asked(memory: Memory, call: Call) -> Answer:
            def ask(fixed: Memory, own: TimeRange) -> OneAnswer:
                parts = {"span": own, "start_s": own.start_s, "end_s": own.end_s, "last_s": None}
                bounds = {name: value for name, value in parts.items() if name in chosen}
                return cast("OneAnswer", query(fixed, call, **{**chosen, **bounds}))

            return in_each(memory, call, _span_of(chosen), between, ask)

        return asked

    def _bound(self, arguments: dict[str, object]) -> tuple[Query, dict[str, object]]:
        """Returns the query that answers, or that counts, and its arguments.

        Raises:
            InvalidArgumentsError: one of them cannot be combined with `by`.
        """
        by = None if self.count is None else arguments.pop("by")
        if self.count is None or by is None:
            return self.query, arguments
        taken = inspect.signature(self.count).parameters
        refused = [
            self.arguments.model_fields[name].alias or name
            for name, value in arguments.items()
            if name not in taken and name not in SHOWN_ALONE and value not in (None, ())
        ]
        if refused:
            raise InvalidArgumentsError(f"{', '.join(refused)} cannot be combined with by")
        chosen = {name: value for name, value in arguments.items() if name in taken}
        return self.count, {"by": by, **chosen}
