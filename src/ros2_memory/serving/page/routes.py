"""The endpoints of the page: GETs that return JSON.

- `/page/span` is the first look, `/page/moment` a time, `/page/path` the path in a part of the map;
  `/page/topics` and `/page/labels` list the topics and the labels of a span.
- They answer from the same queries as the tools, in the queue of the tools that may take long.
- With `recording=NAME` they answer from that recording alone. With `poses=TOPIC` that topic places
  the robot.
- `/page/moment` also takes `tool=NAME` and its `arguments` as JSON; a tool that writes is refused.
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
from ros2_memory.serving.page.recordings import Recordings
from ros2_memory.serving.page.span import (
    LAST_S,
    SpanRequest,
    moment_shown,
    sightings_shown,
    span_shown,
    stretch_shown,
)
from ros2_memory.serving.page.topics import MOST_SIGNALS, Signal, labels_shown, topics_shown
from ros2_memory.tools.arguments import LATEST_UNIX_S

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
    """Returns the routes of the page; `progress` tells how far the store of columns is filled."""
    page = _PageData(dispatcher, progress)
    return [
        page.route(SPAN_PATH, page.span),
        page.route(MOMENT_PATH, moment_reply),
        page.route("/page/topics", _in_window(topics_shown)),
        page.route("/page/labels", _in_window(labels_shown)),
        page.route("/page/path", _path),
    ]


class _PageData:
    """Answers the requests of the page from a memory, or from one of its recordings."""

    def __init__(self, dispatcher: Dispatcher, progress: Callable[[], Progress] | None) -> None:
        self._dispatcher = dispatcher
        self._progress = progress
        self._memory = dispatcher.memory
        self._recordings = Recordings(dispatcher.memory)

    def route(self, path: str, work: _Work) -> Route:
        """Returns the route of a path whose replies `work` makes."""

        async def answer(request: Request) -> Response:
            given = request.query_params
            client = request.client.host if request.client else None
            if path == MOMENT_PATH and "tool" in given:
                return await self._call_tool(given, client)
            reply = await self._dispatcher.look(
                lambda call: work(given, self._part(given), call), client
            )
            return _json_response(reply.text)

        return Route(path, answer, methods=["GET"])

    async def _call_tool(self, given: QueryParams, client: str | None) -> Response:
        try:
            arguments = tool_arguments(given)
        except InvalidArgumentsError as error:
            return _json_response(self._dispatcher.refusal(error).text)
        part = partial(self._part, given)
        reply = await self._dispatcher.answer(
            given["tool"], arguments, client, for_page=True, part=part
        )
        return _json_response(reply.text)

    def _part(self, given: QueryParams) -> Memory:
        """Returns the memory of the `recording`, or all, in which `poses` place the robot."""
        name = _short(given, "recording", _LONGEST_NAME)
        part = self._recordings.alone(name) if name else self._memory
        topic = _short(given, "poses", _LONGEST_NAME)
        return replace(part, limits=replace(part.limits, pose_topic=topic)) if topic else part

    def span(self, given: QueryParams, part: Memory, call: Call) -> JsonObject:
        """Returns the reply of `/page/span`."""
        questions = self._dispatcher.questions
        shown = span_shown(part, call, span_request(given), self._progress, questions)
        if "status" in shown:
            shown |= self._recordings.shown(part, call)
            if given.get("named") == "1":
                shown["memory"] = memory_name(self._memory)
        return shown


def _in_window(work: Callable[[Memory, Call, TimeWindow], JsonObject]) -> _Work:
    return lambda given, part, call: work(part, call, requested_window(given))


def _path(given: QueryParams, part: Memory, call: Call) -> JsonObject:
    return path_in_box(part, call, requested_window(given), requested_box(given))


def _json_response(text: str) -> Response:
    return Response(text, media_type="application/json", headers=_HEADERS)


def memory_name(memory: Memory) -> JsonObject:
    """Returns the name of a memory for people, and its folder.

    The name is that of the machine if it records here, else that of the folder.
    """
    folder = memory.bag_dir.resolve()
    is_robot = memory.limits.kept is not None
    return {"name": gethostname() if is_robot else folder.name, "folder": str(folder)}


def span_request(given: QueryParams) -> SpanRequest:
    """Returns the request to `/page/span` in a query string.

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


def moment_reply(given: QueryParams, memory: Memory, call: Call) -> JsonObject:
    """Returns the reply of `/page/moment` about `t`, or about the time from `start` to `end`.

    With a `label`, its sightings in that time alone.

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


def requested_window(given: QueryParams) -> TimeWindow:
    """Returns the window from `start` to `end` of a query string.

    Raises:
        InvalidArgumentsError: a number is missing or invalid, or the window has no length.
    """
    start_s, end_s = _number(given, "start"), _number(given, "end")
    if start_s is None or end_s is None or start_s >= end_s:
        raise InvalidArgumentsError("give start, and end after it, in Unix seconds")
    return TimeWindow.from_unix(start_s, end_s)


def requested_box(given: QueryParams) -> Box:
    """Returns the part of the map that a query string names: `x0`, `y0`, `x1`, `y1` and `pixel`.

    Raises:
        InvalidArgumentsError: a number is missing or invalid, or a pixel has no size.
    """
    numbers = [_number(given, name, "metres") for name in ("x0", "y0", "x1", "y1", "pixel")]
    match [number for number in numbers if number is not None]:
        case [x0, y0, x1, y1, pixel_m] if pixel_m > 0:
            return Box(x0, y0, x1, y1, max(pixel_m, _LEAST_PIXEL_M))
    raise InvalidArgumentsError("give x0, y0, x1, y1 and pixel (above 0), in metres")


def tool_arguments(given: QueryParams) -> JsonObject:
    """Returns the `arguments` of a query string, which are those of a tool.

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


def _number(given: QueryParams, name: str, unit: str = "seconds") -> float | None:
    text = given.get(name)
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= LATEST_UNIX_S:  # NaN neither
        raise InvalidArgumentsError(f"{name} must be a number of {unit}, not {text[:40]!r}")
    return number
