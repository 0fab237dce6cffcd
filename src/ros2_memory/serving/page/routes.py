"""The endpoints of the page: GETs that return JSON.

`/page/span` is the first look, `/page/moment` a time or a tool, `/page/topics` and `/page/labels`
list what a span has of them, and `/page/path` is the path in a part of the map.
They answer from the same queries as the tools, in the queue of the tools that may take long. With
`recording=NAME` they answer from that recording alone, with `poses=TOPIC` the robot is where that
topic has it. `/page/moment` also takes `tool=NAME` and its `arguments` as JSON; a tool that writes
is refused.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from socket import gethostname
from typing import TYPE_CHECKING, Final, TypeAlias

from starlette.responses import Response
from starlette.routing import Route

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.serving.page.drawn_path import Box, path_in_box
from ros2_memory.serving.page.moment import moment_shown, sightings_shown, stretch_shown
from ros2_memory.serving.page.recordings import Recordings
from ros2_memory.serving.page.span import LAST_S, SpanRequest, span_shown
from ros2_memory.serving.page.topics import MOST_SIGNALS, Signal, labels_shown, topics_shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.datastructures import QueryParams
    from starlette.requests import Request

    from ros2_memory.columns.fill import Progress
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.serving.dispatch import Dispatcher

    _Work: TypeAlias = Callable[[QueryParams, Memory, Call], JsonObject]

SPAN_PATH: Final = "/page/span"
MOMENT_PATH: Final = "/page/moment"

_HEADERS: Final = {
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
}
_LEAST_PIXEL_M: Final = 1e-4
"""Positions are stored as finely."""
_LONGEST_LABEL: Final = 200
_LONGEST_NAME: Final = 1000
_LONGEST_ARGUMENTS: Final = 10_000


def page_routes(
    dispatcher: Dispatcher, progress: Callable[[], Progress] | None = None
) -> list[Route]:
    """Returns the routes of the page; `progress`: how far the store of columns is filled."""
    memory = dispatcher.memory
    recordings = Recordings(memory)

    def chosen(given: QueryParams) -> Memory:
        """Returns the part of the memory that is asked, in which its `poses` place the robot."""
        name = _short(given, "recording", _LONGEST_NAME)
        part = recordings.alone(name) if name else memory
        topic = _short(given, "poses", _LONGEST_NAME)
        return replace(part, limits=replace(part.limits, pose_topic=topic)) if topic else part

    def span(given: QueryParams, part: Memory, call: Call) -> JsonObject:
        shown = span_shown(part, call, span_request(given), progress, dispatcher.questions)
        if "status" in shown:
            shown |= recordings.shown(part, call)
            shown |= {"memory": named(memory)} if given.get("named") == "1" else {}
        if shown.get("mixed") and "path" in shown:
            window = TimeWindow.from_unix(float(str(shown["start"])), float(str(shown["end"])))
            shown |= recordings.paths(part, call, window)
        return shown

    def route(path: str, work: _Work) -> Route:
        async def answer(request: Request) -> Response:
            client = request.client.host if request.client else None
            given = request.query_params
            if path != MOMENT_PATH or "tool" not in given:
                reply = await dispatcher.look(lambda call: work(given, chosen(given), call), client)
            else:
                try:
                    arguments = tool_arguments(given)
                except InvalidArgumentsError as error:
                    return Response(f"{error}\n", 400, headers=_HEADERS)
                reply = await dispatcher.answer(
                    given["tool"], arguments, client, for_page=True, part=partial(chosen, given)
                )
            return Response(reply.text, media_type="application/json", headers=_HEADERS)

        return Route(path, answer, methods=["GET"])

    parts: dict[str, _Work] = {
        SPAN_PATH: span,
        MOMENT_PATH: moment_asked,
        "/page/topics": lambda given, part, call: topics_shown(part, call, window_asked(given)),
        "/page/labels": lambda given, part, call: labels_shown(part, call, window_asked(given)),
        "/page/path": lambda given, part, call: path_in_box(
            part, call, window_asked(given), box_asked(given)
        ),
    }
    return [route(path, work) for path, work in parts.items()]


def named(memory: Memory) -> JsonObject:
    """Returns the name of a memory for people, and where its folder is.

    Of a robot that records here it is the machine's name, else the folder's.
    """
    folder = memory.index.bag_dir.resolve()
    is_robot = memory.limits.kept is not None
    return {"name": gethostname() if is_robot else folder.name, "folder": str(folder)}


def span_request(given: QueryParams) -> SpanRequest:
    """Returns what a query string asks of `/page/span`.

    Raises:
        InvalidArgumentsError: a number or a signal is invalid, or there are too many signals.
    """
    signals = given.getlist("signal")
    if len(signals) > MOST_SIGNALS:
        raise InvalidArgumentsError(f"{len(signals)} signals; at most {MOST_SIGNALS} are plotted")
    last_s = _number(given, "last")
    return SpanRequest(
        start_s=_number(given, "start"),
        end_s=_number(given, "end"),
        last_s=LAST_S if last_s is None else last_s,
        since_s=_number(given, "since"),
        version=given.get("version", ""),
        things=given.get("things") != "0",
        status=given.get("status") != "0",
        patient=given.get("patient") == "1",
        first=given.get("first") == "1",
        signals=tuple(map(Signal.parse, signals)),
    )


def moment_asked(given: QueryParams, memory: Memory, call: Call) -> JsonObject:
    """Returns what `/page/moment` shows: of `t`, or of the stretch from `start` to `end`.

    With a `label`, only its sightings in the stretch.

    Raises:
        InvalidArgumentsError: a number is invalid, the label is too long, or no time is given.
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    at_s, start_s, end_s = (_number(given, name) for name in ("t", "start", "end"))
    label = _short(given, "label", _LONGEST_LABEL)
    if at_s is not None:
        return moment_shown(memory, call, at_s)
    if start_s is None or end_s is None:
        raise InvalidArgumentsError("give t, or start and end, in Unix seconds")
    if label:
        return sightings_shown(memory, call, label, start_s, end_s)
    return stretch_shown(memory, call, start_s, end_s)


def window_asked(given: QueryParams) -> TimeWindow:
    """Returns the span that a query string names.

    Raises:
        InvalidArgumentsError: a number is missing or invalid, or the span has no length.
    """
    match _numbers(given, "start", "end"):
        case [start_s, end_s] if start_s < end_s:
            return TimeWindow.from_unix(start_s, end_s)
    raise InvalidArgumentsError("give start, and end after it, in Unix seconds")


def box_asked(given: QueryParams) -> Box:
    """Returns the part of the map that a query string names: `x0`, `y0`, `x1`, `y1` and `pixel`.

    Raises:
        InvalidArgumentsError: a number is missing or invalid, or a pixel has no size.
    """
    match _numbers(given, "x0", "y0", "x1", "y1", "pixel", unit="metres"):
        case [x0, y0, x1, y1, pixel_m] if pixel_m > 0:
            return Box(x0, y0, x1, y1, max(pixel_m, _LEAST_PIXEL_M))
    raise InvalidArgumentsError("give x0, y0, x1, y1 and pixel (above 0), in metres")


def tool_arguments(given: QueryParams) -> JsonObject:
    """Returns the arguments that a query string has for a tool.

    Raises:
        InvalidArgumentsError: they are no JSON object, or too long.
    """
    text = _short(given, "arguments", _LONGEST_ARGUMENTS)
    try:
        arguments: JsonValue = json.loads(text or "{}")
    except (ValueError, RecursionError) as error:
        raise InvalidArgumentsError(f"arguments is no JSON: {error}") from error
    if not isinstance(arguments, dict):
        raise InvalidArgumentsError("arguments must be a JSON object")
    return arguments


def _short(given: QueryParams, name: str, longest: int) -> str:
    text = given.get(name, "")
    if len(text) > longest:
        raise InvalidArgumentsError(f"{name} is longer than {longest} characters")
    return text


def _numbers(given: QueryParams, *names: str, unit: str = "seconds") -> list[float]:
    """Returns those of some numbers that are given."""
    numbers = [_number(given, name, unit) for name in names]
    return [number for number in numbers if number is not None]


def _number(given: QueryParams, name: str, unit: str = "seconds") -> float | None:
    text = given.get(name)
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InvalidArgumentsError(f"{name} must be a number of {unit}, not {text[:40]!r}")
    return number
