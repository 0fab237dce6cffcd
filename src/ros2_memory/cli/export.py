"""`ros2-memory export`: a time window as an MCAP file, or as rows of Parquet."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Annotated

from ros2_memory.bootstrap import require_extra
from ros2_memory.cli.options import AsJson, Bags, Times
from ros2_memory.cli.output import atomic_file, print_json, print_line, print_notes, spinner
from ros2_memory.core.errors import (
    InvalidArgumentsError,
    NoDataError,
    NoDataReason,
    UndecodableError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted, match_topics
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import lost_in, note_unread, unix_text
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.stored_message import StoredMessage
from ros2_memory.history.view import View
from ros2_memory.storage.base import BagReader, Channel, Record
from ros2_memory.storage.mcap.writer import McapWriter


def export(
    *,
    mcap: Annotated[
        Path | None, "FILE", "Write this MCAP file, for Foxglove, ros2 bag and rosbags."
    ] = None,
    parquet: Annotated[
        Path | None,
        "DIR",
        "Write Parquet to this folder, by recording and date, for DuckDB or Spark.",
    ] = None,
    topic: Annotated[
        list[str] | None, "GLOB", "Copy only these topics, such as /vision/*; repeatable."
    ] = None,
    times: Times,
    latched: Annotated[
        bool | None,
        "--latched/--no-latched",
        "Also copy the latched messages valid at the start: maps, static transforms "
        "(default: for --mcap).",
    ] = None,
    robot: Annotated[
        str | None, "NAME", "Partition Parquet by robot, too: one dataset for a fleet."
    ] = None,
    as_json: AsJson = False,
    bags: Bags,
) -> bool:
    """Copy a time window to MCAP or Parquet, each message once.

    MCAP keeps the original messages, definitions, log and publish times. Parquet has one row for
    each message: its fields as JSON, and its pose in columns. Parquet needs ros2-memory[parquet].
    """
    if (mcap is None) == (parquet is None):
        raise InvalidArgumentsError("give one of --mcap FILE and --parquet DIR")
    memory = bags.memory()
    view = View(memory, Call())
    window = times.window(memory)
    topics = _topics(view, topic or ())
    note_unread(view, window)
    with_latched = mcap is not None if latched is None else latched
    earlier = _latched_before(view, topics, window.start) if with_latched else []
    within = view.stream.messages(topics, window)
    first = [*islice(within, 1)]
    if latched is None and not first and not view.timeline.overlapping(window):
        earlier = []  # alone they would look like an answer
    if earlier:
        copied = counted(len(earlier), "latched message is", "latched messages are")
        begins = f"the file begins at {unix_text(earlier[0].time)}"
        none = "" if first else "; no message is in the window"
        view.notes.add(
            f"{copied} copied from before the window, with the original time: {begins}{none}"
        )
    messages, files, lacking = chain(earlier, first, within), 1, ""
    with spinner("exporting"):
        if mcap is not None:
            undefined: list[str] = []
            count = write_mcap(mcap, with_definitions(messages, memory.reader, undefined))
            lacking, where = describe_undefined(undefined), f"in {mcap}"
        elif parquet is not None:
            count, files, lacking = _write_parquet(parquet, messages, memory, robot)
            where = f"in {counted(files, 'file')} below {parquet}"
    if lacking:
        view.notes.add(lacking)
    notes = view.notes.sentences()
    if as_json:
        path = str(mcap or parquet)
        print_json({"path": path, "messages": count, "files": files, "notes": [*notes]})
    else:
        print_line(f"{counted(count, 'message')} {where}")
    print_notes(notes)
    return bool(lacking or not view.notes.complete or lost_in(view.snapshot, window))


def _topics(view: View, globs: Sequence[str]) -> list[str]:
    """Returns the recorded topics that match one of the globs; all without any.

    Raises:
        NoDataError: nothing is recorded, or no topic matches.
    """
    require_bags(view)
    names = view.timeline.topics()
    chosen = {name for glob in globs or ("*",) for name in match_topics(names, glob)}
    if not chosen:
        asked = f"no recorded topic matches {', '.join(globs)}; list_recorded_topics has them"
        raise NoDataError(NoDataReason.TOPIC_NOT_RECORDED, asked)
    return sorted(chosen)


def _static_transforms(
    view: View, topic: str, window: TimeWindow
) -> Iterator[tuple[str, StoredMessage]]:
    """Yields the child frames of a topic of transforms, each with its message, by log time."""
    for stored in view.stream.messages([topic], window):
        with suppress(UndecodableError):
            message = view.memory.reader.decode(stored.record)
            for edge in view.extractor.transforms(message, stored.time, static=True):
                yield edge.child, stored


def _latched_before(view: View, topics: Sequence[str], start: Ns) -> list[StoredMessage]:
    """Returns the latched messages that are valid when a window starts, by log time.

    These are the newest of each topic; of transforms the newest for each child frame, since every
    broadcaster publishes only its own.
    """
    before, snapshot = TimeWindow(MIN_NS, start), view.snapshot
    latching = view.limits.latching
    valid: dict[tuple[str, str], StoredMessage] = {}
    for topic in topics:
        if not latching.may_hold(snapshot, topic):
            continue
        if any(name.endswith("/TFMessage") for name in snapshot.timeline.types_of(topic)):
            if latching.is_latched(snapshot, topic):
                for child, stored in _static_transforms(view, topic, before):
                    valid[topic, child] = stored
        elif (newest := view.stream.newest(topic, before)) and latching.holds(snapshot, newest):
            valid[topic, ""] = newest
    # A message is valid for several frames, and is exported once.
    once = {id(stored): stored for stored in valid.values()}
    return sorted(once.values(), key=lambda stored: stored.time)


def with_definitions(
    messages: Iterator[StoredMessage], reader: BagReader, undefined: list[str]
) -> Iterator[StoredMessage]:
    """Yields the messages with the definitions that their bags lack; collects unknown types."""

    @cache
    def defined(channel: Channel) -> Channel:
        schema = channel.schema
        if channel.encoding != "cdr" or schema.text.strip():
            return channel
        definition = reader.definition(channel)
        if definition is None:
            undefined.extend({schema.name} - {*undefined})
            return channel
        text = definition.text().encode()
        return replace(channel, schema=replace(schema, encoding="ros2msg", text=text))

    for stored in messages:
        record = stored.record
        yield stored._replace(record=record._replace(channel=defined(record.channel)))


def describe_undefined(types: Sequence[str]) -> str:
    """Returns the sentence on types that an MCAP file has no definition of; empty without any."""
    if not types:
        return ""
    return (
        f"{', '.join(types)} {'has' if len(types) == 1 else 'have'} no definition in the bags, in "
        "reader.custom_msg_paths or among the standard types, and none in the file: other programs "
        "cannot read such messages"
    )


def write_mcap(path: Path, messages: Iterator[StoredMessage]) -> int:
    """Writes an MCAP file, which appears when it is complete; returns the number of messages.

    Raises:
        BagError: it cannot be written.
        InvalidArgumentsError: the file exists.
        NoDataError: there are no messages.
    """
    if path.exists():
        raise InvalidArgumentsError(f"{path} exists; name another file, or delete it first")
    if not path.parent.is_dir():
        raise InvalidArgumentsError(f"{path}: there is no folder {path.parent}; make it first")
    first = next(messages, None)
    if first is None:
        raise NoDataError(NoDataReason.OUTSIDE_RANGE, "no message is in the window")
    written = 0

    def records() -> Iterator[Record]:
        nonlocal written
        for stored in chain((first,), messages):
            written += 1
            yield stored.record

    with atomic_file(path) as temporary:
        McapWriter().write(temporary, records())
    return written


def _write_parquet(
    path: Path, messages: Iterator[StoredMessage], memory: Memory, robot: str | None
) -> tuple[int, int, str]:
    """Writes rows of Parquet.

    Returns the numbers of rows and of files, and a sentence on types of which rows have no value.

    Raises:
        ConfigError: the optional dependency is missing.
    """
    require_extra("export --parquet", "parquet", "pyarrow")
    from ros2_memory.cli.parquet import Dataset  # noqa: PLC0415 - an extra that few install

    dataset = Dataset(path, memory.reader, memory.extractor, robot)
    dataset.write(messages)
    types = ", ".join(sorted(dataset.undecoded))
    lacking = f"messages of {types} cannot be decoded: their rows have no value, and "
    return dataset.rows, dataset.files, f"{lacking}`undecodable` says why" if types else ""
