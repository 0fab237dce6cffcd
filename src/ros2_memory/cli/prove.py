"""`ros2-memory prove`: what an answer rests on, as a file that gives the same answer."""

import json
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, NamedTuple, TypeVar, cast

import typer

from ros2_memory.bag_dir.layout import is_derived
from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.ask import answer_to
from ros2_memory.cli.export import Definitions, write_mcap
from ros2_memory.cli.options import LOOKING, AsJson, Bags, is_folder, load_to_look, open_memory
from ros2_memory.cli.output import print_json, print_line, print_notes, spinner
from ros2_memory.columns.scanner import Scanner
from ros2_memory.config import Settings
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import MCAP, JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject
from ros2_memory.core.spans import Spans, lies_inside, overlaps_any, united, without
from ros2_memory.core.temporary import hidden_folder
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Span
from ros2_memory.history.bag_access import StoredMessage
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.view import View
from ros2_memory.storage.base import BagReader, Batch, Record

Read = TypeVar("Read", Record, Batch)

_KEYS_ON_FILES: Final = frozenset(
    {"notes", "bags", "incomplete", "damaged", "unread", "silences", "doubts", "budget"}
)
"""Keys on how messages lie in files, which a copy of them need not share."""
_NEVER: Final[JsonObject] = {"timestamp": None, "value": None}
"""The long form of the reply null, which a tool uses if it has notes."""


def prove(
    question: Annotated[
        str,
        typer.Argument(
            metavar="'TOOL key=value ...'", help="The question, in quotes, as `ask` takes it."
        ),
    ],
    *,
    output: Annotated[
        Path,
        "--output",
        "-o",
        "FILE.mcap|DIR",
        "Write this MCAP file, or a folder in which recordings stay apart.",
    ],
    as_json: AsJson = False,
    bags: Bags,
) -> bool:
    """Write the messages that an answer rests on, so that others can look at them.

    The same question is then asked over these alone, and both answers are compared. An answer on
    times between recordings needs a folder: in one file there is nothing between them.
    """
    if output.exists() or not output.parent.is_dir():
        raise InvalidArgumentsError(f"{output} must be new, in a folder that is there")
    words = _split_question(question)
    settings = bags.settings(*LOOKING)
    memory = open_memory(settings, verbose=bags.verbose)
    log = _ReadLog(memory.reader)
    with spinner("asking"):
        expected = _answer(settings, replace(memory, reader=cast("BagReader", log)), words)
    view = View(memory, Call())
    require_bags(view)
    read, parts, definitions = log.spans(), _parts_without_gaps(view), Definitions(memory.reader)
    own_settings = [word for word in bags.words or () if not is_folder(word)]
    with hidden_folder(output.parent) as folder:
        attempts = _spans_to_copy(view, read, parts, in_one_file=output.suffix == MCAP)
        for number, spans in enumerate(attempts):
            path = folder / str(number) / output.name
            path.parent.mkdir()
            count = _write_copy(path, view, spans, parts, definitions)
            copied = load_to_look(None, [str(path), *LOOKING, *own_settings])
            repeated = _answer(copied, open_memory(copied, verbose=bags.verbose), words)
            differing = _differing_keys(expected, repeated)
            if not differing:
                break
        path.replace(output)
    if as_json:
        same = {"same": not differing, "differing": differing}
        print_json({"path": str(output), "messages": count, **same})
    else:
        print_line(f"{counted(count, 'message')} in {output}")
    verdict = f"the same answer: ros2-memory ask {shlex.join([*words, str(output)])}"
    if differing:
        verdict = f"over {output} the answer differs in {listed(differing)}"
        if len(parts) > 1 and output.suffix == MCAP:
            verdict += f"; -o {output.with_suffix('')} keeps recordings apart"
    print(verdict, file=sys.stderr)
    if definitions.undefined:
        print_notes([definitions.describe_undefined()])
    types = {name for topic in read for name in view.timeline.types_of(topic)}
    return bool(differing or not types.isdisjoint(definitions.undefined))


class _ReadLog:
    """A `BagReader` that logs from when to when messages of each topic are read."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._calls: list[dict[str, Span]] = []

    def __getattr__(self, name: str) -> object:
        return getattr(self._reader, name)

    def records(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, newest_first: bool = False
    ) -> Iterator[Record]:
        """Yields and logs what the reader yields."""
        records = self._reader.records(path, topics, window, newest_first=newest_first)
        # `map` goes on after an error of the reader, as the reader does; a generator would end.
        return map(self._logger(), records)

    def batches(
        self, path: Path, topics: Collection[str], window: TimeWindow, *, bare: Collection[str] = ()
    ) -> Iterator[Batch]:
        """Yields and logs what the reader yields."""
        return map(self._logger(), self._reader.batches(path, topics, window, bare=bare))

    def spans(self) -> dict[str, Spans]:
        """Returns the spans that were read of each topic: one for each call, united."""
        spans: dict[str, list[Span]] = {}
        for call in self._calls:
            for topic, span in call.items():
                spans.setdefault(topic, []).append(span)
        return {topic: united(of_topic) for topic, of_topic in spans.items()}

    def _logger(self) -> Callable[[Read], Read]:
        """Returns a function that logs messages of one call, and returns them."""
        call: dict[str, Span] = {}
        self._calls.append(call)

        def log(messages: Read) -> Read:
            if isinstance(messages, Record):
                times = [messages.log_time]
            else:
                times = messages.log_times.tolist()
            if times:
                topic = messages.channel.topic
                start, stop = call.get(topic, (MAX_NS, MIN_NS))
                first, last = min(times), max(times)
                call[topic] = min(start, first), max(stop, last + 1)
            return messages

        return log


class _Part(NamedTuple):
    """A part of a recording without a gap, or a bag with what stays of deleted ones."""

    recording: Path
    window: TimeWindow
    derived: str = ""
    """The name of that bag, by which it is known."""

    def has(self, stored: StoredMessage) -> bool:
        """Whether a message in its window is of it."""
        bag = stored.bag
        derived = bag.path.name if is_derived(bag.path) else ""
        return (bag.recording, derived) == (self.recording, self.derived)


def _parts_without_gaps(view: View) -> list[_Part]:
    """Returns all recordings, each divided at the gaps of the memory, and derived bags."""
    spans: dict[Path, Span] = {}
    derived: list[_Part] = []
    for bag in view.timeline.bags:
        if is_derived(bag.path):
            window = bag.window
            derived.append(_Part(bag.recording, window, bag.path.name))
            continue
        start, stop = spans.get(bag.recording, (MAX_NS, MIN_NS))
        spans[bag.recording] = min(start, bag.start), max(stop, bag.end + 1)
    gaps = [(before + 1, after) for before, after in view.snapshot.gaps]
    recorded = [
        _Part(recording, TimeWindow(start, stop))
        for recording, span in spans.items()
        for start, stop in without([span], gaps)
    ]
    return recorded + derived


def _spans_to_copy(
    view: View, read: Mapping[str, Spans], parts: Sequence[_Part], *, in_one_file: bool
) -> list[dict[str, Spans]]:
    """Returns the times of each topic to copy: those that were read; else all of them.

    All topics are copied at the ends of each part, which say from when to when something was
    recorded.
    """
    topics = view.timeline.topics()
    ends = [at for part in parts for at in (part.window.start, part.window.stop - 1)]
    if in_one_file:  # there is nothing between recordings
        recorded = view.timeline.recorded
        ends = [min(bag.start for bag in recorded), max(bag.end for bag in recorded)]
    moments = [(at, at + 1) for at in ends]
    return [
        {topic: united([*read.get(topic, ()), *moments]) for topic in topics},
        {topic: [(MIN_NS, MAX_NS)] for topic in topics},
    ]


def _write_copy(
    path: Path,
    view: View,
    spans: Mapping[str, Spans],
    parts: Sequence[_Part],
    definitions: Definitions,
) -> int:
    """Copies the messages in the spans of their topics, and returns their number.

    A path that ends in `.mcap` becomes one file, any other one a folder with a file for each part.
    """
    if path.suffix == MCAP:
        messages = _messages_in(view, spans, TimeWindow.everything())
        with suppress(NoDataError):
            return write_mcap(path, definitions.add_to(messages))
        return 0
    count = 0
    for number, part in enumerate(parts):
        folder = path / part.recording.relative_to(view.bag_dir)
        folder.mkdir(parents=True, exist_ok=True)
        messages = filter(part.has, _messages_in(view, spans, part.window))
        with suppress(NoDataError):  # all messages of the part are copies of another recording's
            file = folder / (part.derived or f"{part.recording.name}_{number}{MCAP}")
            count += write_mcap(file, definitions.add_to(messages))
    return count


def _messages_in(
    view: View, spans: Mapping[str, Spans], window: TimeWindow
) -> Iterator[StoredMessage]:
    """Yields the messages of a window that lie in the spans of their topics."""
    for start, stop in united(span for of_topic in spans.values() for span in of_topic):
        part = window.intersect(TimeWindow(start, stop))
        topics = [
            topic
            for topic, of_topic in spans.items()
            if overlaps_any(of_topic, part.start, part.stop - 1)
        ]
        for stored in view.stream.messages(topics, part) if topics else ():
            if lies_inside(spans[stored.topic], stored.time):
                yield stored


def _split_question(question: str) -> list[str]:
    """Returns the tool, and its arguments: one JSON object, or a word for each `key=value`.

    A value may have spaces: it ends where the next `key=` begins.
    """
    tool, _, rest = question.strip().partition(" ")
    rest = rest.strip()
    arguments = [rest] if rest.startswith("{") else re.split(r"\s+(?=\w+=)", rest)
    return [tool, *filter(None, arguments)]


def _answer(settings: Settings, memory: Memory, words: Sequence[str]) -> JsonValue:
    """Returns the reply to a question, read from the bags without stored columns, in any time.

    Raises:
        InvalidArgumentsError: the tool refuses the question.
    """
    memory = replace(memory, scanner=Scanner(None, memory.bag_dir))
    tool, *arguments = words
    reply = answer_to(build_dispatcher(settings, memory, is_patient=True), memory, tool, arguments)
    answer: JsonValue = json.loads(reply.text)
    if reply.is_error and isinstance(answer, dict):
        raise InvalidArgumentsError(str(answer["detail"]))
    return answer


def _differing_keys(expected: JsonValue, repeated: JsonValue) -> list[str]:
    """Returns the keys in which two replies differ, but for keys on how messages lie in files."""
    one = _NEVER if expected is None else expected
    other = _NEVER if repeated is None else repeated
    if not isinstance(one, dict) or not isinstance(other, dict):
        return [] if one == other else ["all"]
    keys = dict.fromkeys((*one, *other))
    return [key for key in keys if key not in _KEYS_ON_FILES and one.get(key) != other.get(key)]
