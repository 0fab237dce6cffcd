"""`ros2-memory prove`: what an answer rests on, as a file that gives the same answer."""

import json
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final, TypeAlias, cast

import typer

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.ask import answer_to
from ros2_memory.cli.export import describe_undefined, with_definitions, write_mcap
from ros2_memory.cli.options import LOOKING, AsJson, Bags, is_folder, load_to_look, open_memory
from ros2_memory.cli.output import print_line, print_notes, spinner
from ros2_memory.columns.scanner import Scanner
from ros2_memory.config import Settings
from ros2_memory.core.errors import InvalidArgumentsError, NoDataError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject
from ros2_memory.core.spans import Spans, lies_inside, overlaps_any, united, without
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Span
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.stored_message import StoredMessage
from ros2_memory.history.view import View
from ros2_memory.storage.base import BagReader, Batch, Record

_BESIDE: Final = frozenset(
    {"notes", "bags", "incomplete", "damaged", "unread", "silences", "doubts", "budget"}
)
"""Keys that say how things lie in the files, which other files need not have."""
_NEVER: Final[JsonObject] = {"timestamp": None, "value": None}
"""What a reply of null says where it has notes."""


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
    words, looking = _words(question), (*LOOKING, "server.call_timeout_s=600")  # without a store
    others = [word for word in bags.words or () if not is_folder(word)]
    loaded = bags.settings(*looking)
    memory = open_memory(loaded, verbose=bags.verbose)
    reads = _Reads(memory.reader)
    with spinner("asking"):
        expected = _answer(loaded, replace(memory, reader=cast("BagReader", reads)), words)
    view = View(memory, Call())
    require_bags(view)
    parts = _parts(view)
    read = reads.spans()
    with TemporaryDirectory(dir=output.parent, prefix=".prove-") as folder:
        for nth, spans in enumerate(_more_and_more(view, read, parts)):
            path = Path(folder) / str(nth) / output.name
            path.parent.mkdir()
            undefined: list[str] = []
            count = _write(path, view, spans, parts, undefined)
            settings, _ = load_to_look(None, [str(path), *looking, *others])
            repeated = _answer(settings, open_memory(settings, verbose=bags.verbose), words)
            beside, differing = _differing(expected, repeated)
            if not differing:
                break
        path.replace(output)
    done = {"path": str(output), "messages": count, "same": not differing}
    written = json.dumps({**done, "differing": differing, "beside": beside})
    print_line(written if as_json else f"{counted(count, 'message')} in {output}")
    if beside:
        print_notes([f"only the bags themselves give the same {listed(beside)}"])
    verdict = f"the same answer: ros2-memory ask {shlex.join([*words, str(output)])}"
    if differing:
        verdict = f"over {output} the answer differs in {listed(differing)}"
        if len(parts) > 1 and output.suffix == ".mcap":
            verdict += f"; -o {output.with_suffix('')} keeps recordings apart"
    print(verdict, file=sys.stderr)
    lacking = describe_undefined(undefined)
    print_notes([lacking] if lacking else [])
    rests_on = {name for topic in read for name in view.timeline.types_of(topic)}
    return bool(differing or not rests_on.isdisjoint(undefined))


# What a reader has of one message, or of several.
_Read: TypeAlias = Callable[..., Record | Iterable[Record | Batch] | None]  # type: ignore[explicit-any]


class _Reads:
    """A reader that notes the times of the messages that are read, by topic."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._calls: list[dict[str, Span]] = []

    def __getattr__(self, name: str) -> object:
        read = getattr(self._reader, name)
        return partial(self._noting, read) if name in {"records", "newest", "batches"} else read

    def spans(self) -> dict[str, Spans]:
        """Returns from when to when messages were read, by topic."""
        topics = {topic for call in self._calls for topic in call}
        return {
            topic: united(call[topic] for call in self._calls if topic in call) for topic in topics
        }

    def _noting(self, read: _Read, *given: object, **options: object) -> object:
        """Returns what the reader returns, a message or several, noted when it is their turn."""
        call: dict[str, Span] = {}
        self._calls.append(call)

        def noted(part: Record | Batch) -> Record | Batch:
            times = [part.log_time] if isinstance(part, Record) else part.log_times.tolist()
            if not times:
                return part
            start, stop = call.get(part.channel.topic, (MAX_NS, MIN_NS))
            first, last = min(times), max(times)
            call[part.channel.topic] = min(start, first), max(stop, last + 1)
            return part

        messages = read(*given, **options)
        if messages is None:
            return None
        if isinstance(messages, Record):
            return noted(messages)
        # Mapped: it goes on behind what cannot be read.
        return map(noted, messages)


def _parts(view: View) -> list[tuple[Path, TimeWindow]]:
    """Returns the recordings, each from when to when there is no gap."""
    reach: dict[Path, Span] = {}
    for bag in view.timeline.recorded:
        start, stop = reach.get(bag.recording, (MAX_NS, MIN_NS))
        reach[bag.recording] = min(start, bag.start), max(stop, bag.end + 1)
    gaps = [(before + 1, after) for before, after in view.snapshot.gaps]
    return [
        (recording, TimeWindow(*span))
        for recording, whole in reach.items()
        for span in without([whole], gaps)
    ]


def _more_and_more(
    view: View, read: Mapping[str, Spans], parts: Sequence[tuple[Path, TimeWindow]]
) -> Iterator[dict[str, Spans]]:
    """Yields what an answer may rest on: what was read, then more where that is not all.

    That is the topics that were read as a whole, and everything. The first and the last message of
    all say when "now" is, those of each part what was recorded.
    """
    times = sorted(at for _, window in parts for at in (window.start, window.stop - 1))
    whole, ends = ([(at, at + 1) for at in moments] for moments in ((times[0], times[-1]), times))
    topics = view.timeline.topics()
    yield {topic: united([*read.get(topic, ()), *whole]) for topic in topics}
    ever = [(MIN_NS, MAX_NS)]
    for spans_of in (read, dict.fromkeys(read, ever), dict.fromkeys(topics, ever)):
        yield {topic: united([*spans_of.get(topic, ()), *ends]) for topic in topics}


def _write(
    path: Path,
    view: View,
    spans: Mapping[str, Spans],
    parts: Sequence[tuple[Path, TimeWindow]],
    undefined: list[str],
) -> int:
    """Writes the messages of these times by topic: a file, or one for each part in a folder.

    Returns how many; collects types without a definition.
    """
    count = 0
    whole = [(None, TimeWindow.everything())]
    for nth, (recording, window) in enumerate(whole if path.suffix == ".mcap" else parts):
        file = path
        if recording is not None:
            folder = path / recording.relative_to(view.bag_dir)
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"{recording.name}_{nth}.mcap"
        stored_messages = (
            stored
            for stored in _messages(view, spans, window)
            if recording in (None, stored.bag.recording)
        )
        with suppress(NoDataError):  # all that it has, another recording has too
            defined = with_definitions(stored_messages, view.memory.reader, undefined)
            count += write_mcap(file, defined)
    return count


def _messages(
    view: View, spans: Mapping[str, Spans], within: TimeWindow
) -> Iterator[StoredMessage]:
    """Yields the messages of a window that lie in the spans of their topics."""
    for start, stop in united(span for topic_spans in spans.values() for span in topic_spans):
        window = within.intersect(TimeWindow(start, stop))
        topics = [
            topic
            for topic, topic_spans in spans.items()
            if overlaps_any(topic_spans, window.start, window.stop - 1)
        ]
        for stored in view.stream.messages(topics, window) if topics else ():
            if lies_inside(spans[stored.topic], stored.time):
                yield stored


def _words(question: str) -> list[str]:
    """Returns the tool and its arguments: one JSON object, or `key=value` each."""
    tool, _, rest = question.strip().partition(" ")
    given = [rest] if rest.lstrip().startswith("{") else re.split(r"\s+(?=\w+=)", rest.strip())
    return [tool, *filter(None, given)]


def _answer(settings: Settings, memory: Memory, words: Sequence[str]) -> JsonValue:
    """Returns the reply to a question, from the bags themselves.

    Raises:
        InvalidArgumentsError: the tool refuses the question, or cannot answer it in time.
    """
    memory = replace(memory, scanner=Scanner(None, memory.index.bag_dir))
    tool, *given = words
    reply = answer_to(build_dispatcher(settings, memory), memory, tool, given)
    answer: JsonValue = json.loads(reply.text)
    if reply.is_error and isinstance(answer, dict):
        raise InvalidArgumentsError(str(answer["detail"]))
    return answer


def _differing(one: JsonValue, other: JsonValue) -> tuple[list[str], list[str]]:
    """Returns the keys in which two replies differ: those on files, and the others."""
    one, other = (_NEVER if reply is None else reply for reply in (one, other))
    if not isinstance(one, dict) or not isinstance(other, dict):
        return [], ([] if one == other else ["all"])
    keys = [key for key in dict.fromkeys((*one, *other)) if one.get(key) != other.get(key)]
    return [key for key in keys if key in _BESIDE], [key for key in keys if key not in _BESIDE]
