"""`ros2-memory topics`, `info` and `recordings`: what is recorded, how much of it, and by whom."""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import cast

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER, bag_kind
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.ask import call_once
from ros2_memory.cli.options import MB, AsJson, Bags, open_robot
from ros2_memory.cli.output import (
    filled_leaves,
    print_json,
    print_line,
    print_notes,
    print_reply,
)
from ros2_memory.config import Settings
from ros2_memory.core.model import BagFile, JsonValue
from ros2_memory.core.reply import JsonObject, shown
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory
from ros2_memory.history.no_data import nothing_here
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import left_open, usual_rate
from ros2_memory.queries import list_recorded_topics
from ros2_memory.results import TopicRow


def topics(as_json: AsJson = False, *, bags: Bags) -> bool:
    """List every recorded topic: type, messages, usual rate, first and last message.

    The rate is that of the topic's newest hour, from its first to its last message in each bag;
    latched topics and logs have none.
    """
    memory = bags.memory()
    topic_rows = list_recorded_topics(memory, Call())
    snapshot, latching = memory.snapshot(), memory.limits.latching
    rows = [_row_with_rate(row, snapshot, latching) for row in topic_rows]
    if as_json:
        print_json(rows)
    elif rows:
        print_reply([{key: row[key] for key in row if key != "notes"} for row in rows])
        topics_by_note = dict[str, list[str]]()  # a note on a bag is on each topic in the bag
        for row in topic_rows:
            for note in row.notes:
                topics_by_note.setdefault(note, []).append(row.topic)
        print_notes(f"{listed(names)}: {note}" for note, names in topics_by_note.items())
    else:
        _print_nothing(memory)
    return not rows


def _print_nothing(memory: Memory) -> None:
    """Prints why there is no bag to show, and the files that cannot be read."""
    snapshot = memory.snapshot()
    print_line(f"{memory.bag_dir}: {snapshot.problem or nothing_here(snapshot)}")
    for aside in (*snapshot.damaged, *snapshot.unread):
        print_line(f"  {aside.path.name}: {aside.reason}")


def _row_with_rate(topic: TopicRow, snapshot: Snapshot, latching: Latching) -> JsonObject:
    """Returns the row that `list_recorded_topics` replies, with the rate and all notes."""
    row = shown(topic)
    if topic.undecodable:
        row["undecodable"] = topic.undecodable
    if topic.notes:
        row["notes"] = [*topic.notes]
    row["rate_hz"] = usual_rate(snapshot, topic.topic, latching)
    return row


def info(as_json: AsJson = False, *, bags: Bags) -> bool:
    """Show what is recorded: time range, gaps, damaged files, the budget and how long it lasts."""
    # A planner's context is short; a person's screen scrolls.
    settings = bags.settings("server.max_reply_chars=1000000000", "server.tools=all")
    robots = settings.fleet.robots
    reports: dict[str, dict[str, JsonObject]] = {}
    has_bags = False
    for name in robots or ("",):
        own, memory = open_robot(settings, name, verbose=bags.verbose)
        reports[name] = report = _report(own, memory)
        has_bags = has_bags or bool(memory.snapshot().bags)
        if not as_json:
            if robots:
                print_line(f"\n{name}")
            _print_report(memory, report)
    if as_json:
        print_json(reports if robots else reports[""])
    return not has_bags


def _report(settings: Settings, memory: Memory) -> dict[str, JsonObject]:
    """Returns the amount of data in a bag directory, and the replies of two tools."""
    report = {"held": _amount_recorded(memory.snapshot())}
    for tool in ("memory_status", "data_time_range"):
        report[tool] = json.loads(call_once(build_dispatcher(settings, memory), tool, {}).text)
    return report


def _print_report(memory: Memory, report: Mapping[str, JsonObject]) -> None:
    """Prints the values of a report that are known, each once, and the notes of both replies."""
    snapshot = memory.snapshot()
    files = (snapshot.bags, snapshot.active, snapshot.damaged, snapshot.unread, snapshot.empty)
    if not any(files):
        _print_nothing(memory)
        return
    values = {key: value for part in report.values() for key, value in filled_leaves(part).items()}
    for key, value in [*values.items()]:
        if value in (None, []) or key.endswith("_local"):
            del values[key]
    lists = (cast("list[JsonValue]", part.get("notes", [])) for part in report.values())
    print_reply(values | {"notes": [*chain.from_iterable(lists)]})


def _amount_recorded(snapshot: Snapshot) -> JsonObject:
    """Returns the counts and sizes of messages and bags, as `ros2 bag info` does."""
    bags, first, last = snapshot.bags, snapshot.earliest, snapshot.latest
    span_s = None if first is None or last is None else round(unix_from_ns(last - first), 3)
    amount: JsonObject = {
        "recordings": len(recordings_of(snapshot)),
        "bags": len(bags),
        "storage": storage_of(bags) or None,
        "duration_s": span_s,
        "messages": sum(bag.summary.count for bag in bags),
        "topics": len(snapshot.timeline.topics()),
        "size_mb": round(sum(bag.size for bag in bags) / MB, 3),
    }
    if snapshot.empty:
        amount["empty_bags"] = len(snapshot.empty)
    if snapshot.silent_topics:
        amount["topics_without_messages"] = [*sorted(snapshot.silent_topics)]
    return amount


def storage_of(bags: Iterable[BagFile]) -> str:
    """Returns the kinds of bags, as `mcap` or `db3, mcap`."""
    kinds = {bag_kind(bag.path.name) or "" for bag in bags}
    return ", ".join(sorted(kind.removeprefix(".") for kind in kinds))


def recordings(as_json: AsJson = False, *, bags: Bags) -> bool:
    """List every recording of a folder: start, length, size, and which program made it.

    To use one of them only, give --recording NAME to the other commands, or data.recording=NAME to
    the server.
    """
    memory = bags.memory()
    snapshot, root = memory.snapshot(), memory.bag_dir
    rows, not_read = [*_recording_rows(snapshot, root)], [*_files_not_read(snapshot, root)]
    is_empty = not (rows or snapshot.damaged or snapshot.unread)
    if as_json:
        print_json([*rows, *not_read])
    elif is_empty:
        _print_nothing(memory)
    else:
        lists = {"recordings": rows, "not_read": not_read}
        print_reply({name: [*some] for name, some in lists.items() if some})
    return is_empty


def _recording_rows(snapshot: Snapshot, root: Path) -> Iterator[JsonObject]:
    """Yields the recordings, the oldest first."""
    own = OwnRecordings(root)
    bags_by_folder = recordings_of(snapshot)
    for path in sorted(bags_by_folder, key=lambda path: bags_by_folder[path][0].start):
        bags = bags_by_folder[path]
        start, end = bags[0].start, max(bag.end for bag in bags)
        whose = None
        if Path(path).is_relative_to(root / MOMENTS_FOLDER):
            whose = "saved moment"
        else:
            with suppress(OSError):  # where the list cannot be read, nobody knows
                is_own = own.owns_bag(bags[0].path)
                whose = "this recorder" if is_own else "another recorder"
        yield {
            "recording": name_of(path, bags, str(root)),
            "start": unix_from_ns(start),
            "end": unix_from_ns(end),
            "length_s": round(unix_from_ns(end - start), 3),
            "size_mb": round(sum(bag.size for bag in bags) / MB, 3),
            "bags": len(bags),
            "messages": sum(bag.summary.count for bag in bags),
            "topics": len({topic for bag in bags for topic in bag.summary.schema.positions}),
            "storage": storage_of(bags),
            "whose": whose,
        }


def _files_not_read(snapshot: Snapshot, root: Path) -> Iterator[JsonObject]:
    """Yields the files of which no message is read, or not all, each with the reason."""
    reasons = dict.fromkeys(snapshot.empty, "no message was recorded")
    for aside in (*snapshot.active, *snapshot.damaged, *snapshot.unread, *left_open(snapshot)):
        reasons[aside.path] = aside.reason
    for path in sorted(reasons):
        yield {"file": str(path).removeprefix(f"{root}/"), "reason": reasons[path]}
