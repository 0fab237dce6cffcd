"""`ros2-memory export`: a time window as an MCAP file, or as rows of Parquet."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

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
from ros2_memory.core.text import counted, listed, match_topics
from ros2_memory.core.timebase import MIN_NS, Ns
from ros2_memory.history.bag_access import StoredMessage
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import lost_in, note_unread, unix_text
from ros2_memory.history.no_data import require_bags
from ros2_memory.history.robots import note_times_twice
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
        bool,
        "--latched/--no-latched",
        "Also copy to MCAP the latched messages valid at the start: maps, static transforms.",
    ] = True,
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
    if mcap is not None and robot is not None:
        raise InvalidArgumentsError("--robot is for --parquet: MCAP has no column for it")
    memory = bags.memory()
    view = View(memory, Call())
    window = times.window(memory)
    topics = _matching_topics(view, topic or ())
    note_unread(view, window)
    note_times_twice(view, window)
    earlier: list[StoredMessage] = []
    # Where nothing is recorded, they alone would look like an answer.
    if mcap is not None and latched and view.timeline.overlapping(window):
        earlier = _latched_before(view, topics, window.start)
    if earlier:
        copied = counted(len(earlier), "latched message is", "latched messages are")
        begins = f"the file begins at {unix_text(earlier[0].time)}"
        view.notes.add(f"{copied} copied from before the window, with the original time: {begins}")
    messages = chain(earlier, view.stream.messages(topics, window))
    with spinner("exporting"):
        if mcap is not None:
            definitions = Definitions(memory.reader)
            count = write_mcap(mcap, definitions.add_to(messages))
            done = Exported(str(mcap), count, 1, definitions.describe_undefined())
        elif parquet is not None:
            done = _export_to_parquet(parquet, messages, memory, robot)
    if done.fault:
        view.notes.add(done.fault)
    notes = view.notes.sentences()
    if as_json:
        path = str(mcap or parquet)
        print_json(
            {"path": path, "messages": done.messages, "files": done.files, "notes": [*notes]}
        )
    else:
        print_line(f"{counted(done.messages, 'message')} in {done.where}")
    print_notes(notes)
    return bool(done.fault or not view.notes.complete or lost_in(view.snapshot, window))


class Exported(NamedTuple):
    """What an export wrote; `fault` names types that others cannot decode, or is empty."""

    where: str
    messages: int
    files: int
    fault: str


def _matching_topics(view: View, globs: Sequence[str]) -> list[str]:
    """Returns the recorded topics that match one of the globs; all topics if there are no globs.

    A note names globs that match none.

    Raises:
        NoDataError: nothing is recorded, or no topic matches.
    """
    require_bags(view)
    names = view.timeline.topics()
    chosen = {name for glob in globs or ("*",) for name in match_topics(names, glob)}
    missing = [glob for glob in globs if not match_topics(names, glob)]
    not_recorded = f"no recorded topic matches {listed(missing)}; list_recorded_topics has them"
    if not chosen:
        raise NoDataError(NoDataReason.TOPIC_NOT_RECORDED, not_recorded)
    if missing:
        view.notes.add(not_recorded)
    return sorted(chosen)


def _latched_before(view: View, topics: Sequence[str], start: Ns) -> list[StoredMessage]:
    """Returns the latched messages that are valid when a window starts, by log time.

    That is the newest message of each topic. Of transforms it is the newest message for each child
    frame, since every broadcaster publishes only its own frames.
    """
    before, snapshot = TimeWindow(MIN_NS, start), view.snapshot
    latching = view.limits.latching
    valid: list[StoredMessage] = []
    for topic in topics:
        if not latching.may_latch(snapshot, topic):
            continue
        if any(name.endswith("/TFMessage") for name in snapshot.timeline.types_of(topic)):
            if latching.is_latched(snapshot, topic):
                valid += _newest_static_transforms(view, topic, before)
        elif (newest := view.stream.newest(topic, before)) and latching.holds(snapshot, newest):
            valid.append(newest)
    return sorted(valid, key=lambda stored: stored.time)


def _newest_static_transforms(view: View, topic: str, window: TimeWindow) -> list[StoredMessage]:
    """Returns the newest message of a window for each child frame, each message once."""
    newest: dict[str, StoredMessage] = {}
    for stored in view.stream.messages([topic], window):
        with suppress(UndecodableError):
            message = view.memory.reader.decode(stored.record)
            for edge in view.extractor.transforms(message, stored.time, static=True):
                newest[edge.child] = stored
    once = {id(stored): stored for stored in newest.values()}  # a message may have several frames
    return [*once.values()]


class Definitions:
    """Gives messages the definitions that their bags lack.

    Attributes:
        undefined: the types without a definition in the bags, the folders or the standard types.
    """

    def __init__(self, reader: BagReader) -> None:
        self.undefined: list[str] = []
        self._reader = reader
        self._defined = cache(self._with_definition)

    def add_to(self, messages: Iterable[StoredMessage]) -> Iterator[StoredMessage]:
        """Yields the messages, each with the definition of its type if there is one."""
        for stored in messages:
            record = stored.record
            yield stored._replace(record=record._replace(channel=self._defined(record.channel)))

    def _with_definition(self, channel: Channel) -> Channel:
        schema = channel.schema
        if channel.encoding != "cdr" or schema.text.strip():
            return channel
        definition = self._reader.definition(channel)
        if definition is None:
            if schema.name not in self.undefined:
                self.undefined.append(schema.name)
            return channel
        text = definition.text().encode()
        return replace(channel, schema=replace(schema, encoding="ros2msg", text=text))

    def describe_undefined(self) -> str:
        """Returns a sentence on the undefined types; empty if there are none."""
        if not self.undefined:
            return ""
        have = "has" if len(self.undefined) == 1 else "have"
        return (
            f"{', '.join(self.undefined)} {have} no definition in the bags, in "
            "reader.custom_msg_paths or among the standard types, and none in the file: other "
            "programs cannot read such messages"
        )


def write_mcap(path: Path, messages: Iterator[StoredMessage]) -> int:
    """Writes an MCAP file, which appears when it is complete; returns the number of messages.

    Raises:
        BagError: the file cannot be written.
        InvalidArgumentsError: the file exists, or its folder does not.
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


def _export_to_parquet(
    folder: Path, messages: Iterable[StoredMessage], memory: Memory, robot: str | None
) -> Exported:
    """Writes rows of Parquet.

    Raises:
        ConfigError: pyarrow is not installed.
    """
    require_extra("export --parquet", "parquet", "pyarrow")
    from ros2_memory.cli.parquet import Dataset  # noqa: PLC0415 - an extra that few install

    dataset = Dataset(folder, memory.bag_dir, memory.reader, memory.extractor, robot)
    dataset.write(messages)
    fault = ""
    if dataset.undecoded:
        fault = (
            f"messages of {', '.join(sorted(dataset.undecoded))} cannot be decoded: their rows "
            "have no value, and `undecodable` says why"
        )
    where = f"{counted(dataset.files, 'file')} below {folder}"
    return Exported(where, dataset.rows, dataset.files, fault)
