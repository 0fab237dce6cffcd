"""What a tool is, how one query is declared under all its names, and the check of its arguments."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast

from pydantic import ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import abbreviate, similar
from ros2_memory.core.timebase import StoppedClock
from ros2_memory.history.view import AtTime, TimeRange
from ros2_memory.insights.at_each import at_each, in_each
from ros2_memory.tools.arguments import (
    FORMS_OF_TIME,
    REGION_KINDS,
    TIME_KINDS,
    Arguments,
    TimeArgument,
)
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from datetime import time

    from pydantic_core.core_schema import NullableSchema

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import Answer, MomentAnswer, OneAnswer


_MAX_UNKNOWN_NAMED: Final = 5
_MAX_PROBLEMS_NAMED: Final = 10
_KINDS: Final = {
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "array": "a list",
    "object": "an object",
}
_TIME: Final = "Unix seconds or ISO 8601 text"
_BOUNDS: Final = {
    "minimum": "at least",
    "exclusiveMinimum": "more than",
    "maximum": "at most",
}


@dataclass(frozen=True)
class Signature:
    """The arguments of a tool: those of a model, with a `TimeArgument` for its moment or span.

    With `plain_times` the schema declares times as numbers only and places as names only, since
    some clients refuse an argument of two types; the other types are still accepted. Of several
    arguments of which one must be given, the schema then has the first alone, as in the
    specification.
    """

    _arguments: type[Arguments]
    _when: type[TimeArgument] | None = None
    plain_times: bool = False

    @cached_property
    def _properties(self) -> dict[str, JsonObject]:
        """Returns the JSON schema of each argument."""
        properties: dict[str, JsonObject] = {}
        for name, schema in _schemas_of(self._arguments).items():
            if self._when is not None and name == self._when.replaces:
                properties.update(_schemas_of(self._when))
            else:
                properties[name] = schema
        if self.plain_times and self._when is not None:
            for name in self._when.either[1:]:
                del properties[name]
        return properties

    @cached_property
    def _required(self) -> list[str]:
        return [name for name, schema in self._properties.items() if "default" not in schema]

    @property
    def _either(self) -> tuple[str, ...]:
        """Returns the arguments of which exactly one must be given."""
        either = () if self._when is None else self._when.either
        return either[:1] if self.plain_times else either

    @property
    def example(self) -> JsonObject:
        """Returns a call with the required arguments alone."""
        required = {*self._required, *self._either[:1]}
        return {
            name: _example_value(schema)
            for name, schema in self._properties.items()
            if name in required
        }

    @property
    def arguments(self) -> dict[str, JsonObject]:
        """Returns the schema of each argument as `tools/list` shows it, without empty defaults."""
        arguments: dict[str, JsonObject] = {}
        for name, schema in self._properties.items():
            shown: JsonObject = {key: item for key, item in schema.items() if key != "examples"}
            if shown.get("default") in (None, []):
                shown.pop("default", None)
            arguments[name] = _with_plain_times(shown) if self.plain_times else shown
        return arguments

    @property
    def required(self) -> list[str]:
        """Returns the arguments that `tools/list` shows as required."""
        return [*self._required, *(self._either if self.plain_times else ())]

    def parse(self, given: Mapping[str, object]) -> Arguments:
        """Returns the checked arguments. A null for an optional argument counts as not given.

        Raises:
            InvalidArgumentsError: an argument is unknown, missing or invalid. The message names the
                first ten with their values and an example, and counts the others.
        """
        present = {
            name: value
            for name, value in given.items()
            if value is not None or name in self._required
        }
        problems = [
            *self._unknown_arguments(given),
            *self._missing_arguments(present),
            *self._ambiguous_arguments(present),
        ]
        values = dict(present)
        if self._when is not None:
            try:
                values[self._when.replaces] = self._when.model_validate(present).replacement()
            except ValidationError as error:
                problems += self._invalid_arguments(error, given)
        try:
            arguments = self._arguments.model_validate(values)
        except ValidationError as error:
            problems += self._invalid_arguments(error, given)
        else:
            if not problems:
                return arguments
        more = len(problems) - _MAX_PROBLEMS_NAMED
        if more > 0:
            problems[_MAX_PROBLEMS_NAMED:] = [f"and {more} more problems"]
        raise InvalidArgumentsError("; ".join(problems))

    def _unknown_arguments(self, given: Mapping[str, object]) -> Iterator[str]:
        unknown = [name for name in given if name not in self._properties]
        names_all = False
        for name in unknown[:_MAX_UNKNOWN_NAMED]:
            near = similar(name, self._properties, 1)
            hint = f"; do you mean {near[0]}?" if near else ""
            yield f"unknown argument {abbreviate(name)}{hint}"
            names_all = names_all or not near
        if names_all:
            names = ", ".join(self._properties)
            yield f"the arguments are: {names}" if names else "the tool takes none"
        more = len(unknown) - _MAX_UNKNOWN_NAMED
        if more > 0:
            yield f"and {more} more unknown arguments"

    def _missing_arguments(self, present: Mapping[str, object]) -> Iterator[str]:
        for name in self._required:
            if name not in present:
                yield f"{name} is missing: {_describe_values(self._properties[name])}"

    def _ambiguous_arguments(self, present: Mapping[str, object]) -> Iterator[str]:
        """Yields a problem unless exactly one of the alternatives is given."""
        either = self._either
        named = [name for name in either if present.get(name) not in (None, [])]
        if len(named) > 1:
            yield f"{' and '.join(named)} were both given: give only one"
        elif either and not named:
            others = f"; or {' or '.join(either[1:])}" if either[1:] else ""
            expected = _describe_values(self._properties[either[0]])
            yield f"{either[0]} is missing: {expected}{others}"

    def _invalid_arguments(
        self, error: ValidationError, given: Mapping[str, object]
    ) -> Iterator[str]:
        reported: set[str] = set()
        for fault in error.errors(include_url=False, include_context=False, include_input=False):
            name = str(fault["loc"][0])
            if fault["type"] == "missing" or name in reported or name not in self._properties:
                continue
            reported.add(name)
            reason = fault["msg"].removeprefix("Value error, ")
            why = f", which {reason}" if fault["type"] == "value_error" else ""
            expected = _describe_values(self._properties[name])
            yield f"{name} was {abbreviate(given[name])}{why}; expected {expected}"


class _Schema(GenerateJsonSchema):
    """The JSON schema of arguments: without titles, and without null as an alternative."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def field_title_should_be_set(self, schema: object) -> bool:
        del schema
        return False


@cache
def _schemas_of(arguments: type[Arguments]) -> Mapping[str, JsonObject]:
    """Returns the JSON schema of each argument; an optional one has a default and no null."""
    schema: Mapping[str, Mapping[str, JsonObject]] = arguments.model_json_schema(
        schema_generator=_Schema
    )
    return schema.get("properties", {})


def _with_plain_times(schema: JsonObject) -> JsonObject:
    """Returns the schema of an argument with one type; see `Signature.plain_times`."""
    plain = dict(schema)
    for kinds in (REGION_KINDS, TIME_KINDS):
        if plain.get("type") == [*kinds]:
            plain["type"] = kinds[0]
    if plain.get("description") == FORMS_OF_TIME:
        del plain["description"]
    return plain


def _describe_values(schema: JsonObject) -> str:
    """Returns the allowed values of an argument in words: `a number of at least 0, e.g. 2`."""
    text = _describe_type(schema)
    bounds: list[str] = []
    for key, word in _BOUNDS.items():
        bound = schema.get(key)
        if isinstance(bound, int | float):
            bounds.append(f"{word} {bound:.10g}")
    if bounds:
        text += f" of {' and '.join(bounds)}"
    if "description" in schema:
        text += f" ({str(schema['description']).rstrip('.')})"
    if "examples" in schema:
        text += f", e.g. {to_json_text(_example_value(schema))}"
    return text


def _describe_type(schema: JsonObject) -> str:
    allowed, kinds = schema.get("enum"), schema.get("type")
    if isinstance(allowed, list):
        return f"one of {', '.join(map(to_json_text, allowed))}"
    if kinds == [*TIME_KINDS]:
        return _TIME
    kinds = kinds if isinstance(kinds, list) else [kinds]
    return " or ".join([_KINDS[str(kind)] for kind in kinds])


def _example_value(schema: JsonObject) -> JsonValue:
    examples = schema.get("examples")
    return examples[0] if isinstance(examples, list) and examples else schema.get("default")


Question: TypeAlias = "Callable[[Memory, Call], Answer]"
"""A query with its arguments bound."""
SHOWN_ALONE: Final = frozenset(
    {"frame_id", "limit", "max_samples", "max_waypoints", "oldest_first"}
)
"""Arguments that bound what is shown, and change no count."""
Query: TypeAlias = "Callable[..., Answer]"  # type: ignore[explicit-any]
"""A function of a memory, a call, and the fields of its arguments as keywords; a test checks it."""


class Described(NamedTuple):
    """What planners read of a tool.

    Attributes:
        text: from which they learn what it answers.
        arguments: the JSON schema of each argument.
        required: the arguments that must be given.
    """

    text: str
    arguments: Mapping[str, JsonObject]
    required: Sequence[str]


@dataclass(frozen=True)
class Tool:
    """One tool as clients see it.

    Attributes:
        name: of the tool.
        title: its name for people.
        describe: returns what planners read.
        blocking: whether it may take long.
        question: checks the arguments of a call and binds them to the query.
        writes: whether it changes what is stored.
        drawn: as in `ToolName`.
    """

    name: str
    title: str
    describe: Callable[[], Described]
    blocking: bool
    question: Callable[[Mapping[str, object]], Question]
    writes: bool = False
    drawn: bool = False

    @property
    def description(self) -> str:
        """Returns the text from which planners learn what the tool answers."""
        return self.described.text

    @property
    def arguments(self) -> Mapping[str, JsonObject]:
        """Returns the JSON schema of each argument."""
        return self.described.arguments

    @property
    def schema(self) -> JsonObject:
        """Returns the JSON schema of all arguments, as `tools/list` shows it.

        It does not forbid others: the reply to an unknown one names similar arguments.
        """
        schema: JsonObject = {"type": "object", "properties": {**self.arguments}}
        if required := self.described.required:
            schema["required"] = [*required]
        return schema

    @cached_property
    def described(self) -> Described:
        """What planners read, made when it is first asked for: 20 ms for all tools."""
        return self.describe()


@dataclass(frozen=True, slots=True)
class ToolName:
    """One name of a query, and the arguments that replace its moment or span.

    `drawn`: chats that can do so show its reply as a map and a timeline (MCP Apps).
    """

    name: str
    title: str
    when: type[TimeArgument] | None = None
    drawn: bool = False


@dataclass(frozen=True, slots=True)
class ToolDeclaration:
    """A query and all its names.

    Attributes:
        names: the first is described in full, the others refer to it.
        description: the text for planners, with placeholders.
        arguments: the model of the arguments.
        query: answers.
        blocking: whether it may take long.
        writes: whether it changes what is stored.
        shows_example: whether the description ends with a call, since the schema is not enough.
        instead: queries that answer in place of `query`, by the argument that chooses them. Other
            arguments that they do not take are refused, unless they only bound what is shown
            (`SHOWN_ALONE`).
    """

    names: tuple[ToolName, ...]
    description: str
    arguments: type[Arguments]
    query: Query
    blocking: bool = False
    writes: bool = False
    shows_example: bool = False
    instead: Mapping[str, Query] = field(default_factory=dict)

    def tools(self, defaults: Mapping[str, object], *, plain_times: bool = False) -> Iterator[Tool]:
        """Yields a tool for each name.

        Args:
            defaults: values of the description's placeholders.
            plain_times: see `Signature`.
        """
        for tool_name in self.names:
            signature = Signature(self.arguments, tool_name.when, plain_times=plain_times)
            yield Tool(
                tool_name.name,
                tool_name.title,
                partial(self._compose_description, tool_name, signature, defaults),
                self.blocking,
                partial(self._question, signature),
                self.writes,
                tool_name.drawn,
            )

    def _compose_description(
        self, name: ToolName, signature: Signature, defaults: Mapping[str, object]
    ) -> Described:
        """Returns what planners read of a name; in full for the first name."""
        first, when = self.names[0], name.when
        if name is first or when is None:
            text = self.description.format(when=when.text if when else "", **defaults)
        else:
            text = f"As {first.name}, {when.text}."
        if self.blocking:
            text = f"Blocking. {text}"
        if self.shows_example and name is first:
            text = f"{text} Example: {to_json_text(signature.example)}"
        arguments = signature.arguments
        if name is not first:
            for argument in arguments.keys() & Signature(self.arguments).arguments:
                arguments[argument].pop("description", None)
        return Described(text, arguments, signature.required)

    def _question(self, signature: Signature, given: Mapping[str, object]) -> Question:
        """Checks the arguments of a call, and returns its question, which reads the clock once.

        Raises:
            InvalidArgumentsError: they are refused.
        """
        arguments = signature.parse(given).for_query()
        between = cast("tuple[time, time] | None", arguments.pop("between", None))
        query, chosen = self._choose_query(arguments)
        moment = chosen.get("moment")

        def ask(memory: Memory, call: Call) -> Answer:
            memory = replace(memory, clock=StoppedClock(memory.clock.now()))

            def ask_at(fixed: Memory, moment: AtTime) -> MomentAnswer:
                return cast("MomentAnswer", query(fixed, call, **{**chosen, "moment": moment}))

            def ask_in(fixed: Memory, span: TimeRange) -> OneAnswer:
                return cast("OneAnswer", query(fixed, call, **{**chosen, "span": span}))

            if isinstance(moment, AtTime) and moment.each:
                return at_each(memory, moment.each, ask_at)
            if between is not None:
                span = cast("TimeRange", chosen["span"])
                return in_each(memory, call, span, between, ask_in)
            return query(memory, call, **chosen)

        return ask

    def _choose_query(self, arguments: dict[str, object]) -> tuple[Query, dict[str, object]]:
        """Returns the query that answers, and its arguments.

        Raises:
            InvalidArgumentsError: two arguments cannot be combined.
        """
        given = [name for name, value in arguments.items() if value not in (None, False, ())]
        chosen = next((name for name in self.instead if name in given), None)
        query = self.query if chosen is None else self.instead[chosen]
        taken = inspect.signature(query).parameters
        refused = [
            self.arguments.model_fields[name].alias or name
            for name in given
            if name not in {chosen, *taken, *SHOWN_ALONE}
        ]
        if refused and chosen is not None:
            raise InvalidArgumentsError(f"{', '.join(refused)} cannot be combined with {chosen}")
        return query, {name: value for name, value in arguments.items() if name in taken}
