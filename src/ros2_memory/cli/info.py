"""`ros2-memory topics`, `info` and `recordings`: what is recorded, how much of it, and by whom."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from ros2_memory.bag_dir.layout import MOMENTS_FOLDER, bag_kind
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.ask import call_once
from ros2_memory.cli.options import MB, AsJson, Bags, open_robot
from ros2_memory.cli.output import (
    cut_lists,
    format_size,
    format_value,
    print_json,
    print_line,
    print_notes,
    print_reply,
    stdout_console,
)
from ros2_memory.config import Settings
from ros2_memory.core.model import BagFile
from ros2_memory.core.reply import JsonObject, Scope, shown
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory
from ros2_memory.history.no_data import nothing_here
from ros2_memory.index.recordings import name_of, recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import budget_of, usual_rate
from ros2_memory.queries import list_recorded_topics
from ros2_memory.results import Budget, TopicRow

_TOLD_TWICE: Final = frozenset(
    {"earliest_local", "latest_local", "now_local", "newest_age_s", "silent_topics", "budget"}
)
_MOST_SILENT: Final = 30
_OF_RECORDER: Final = frozenset({"recorder", "recorder_alive"})


def topics(as_json: AsJson = False, *, bags: Bags) -> bool:
    """List every recorded topic: type, messages, usual rate, first and last message.

    The rate is that of the topic's newest hour, from its first to its last message in each bag;
    latched topics and logs have none.
    """
    memory = bags.memory()
    topic_rows = list_recorded_topics(memory, Call())
    snapshot, latching = memory.index.snapshot(), memory.limits.latching
    rows = [_row_with_rate(row, snapshot, latching) for row in topic_rows]
    if as_json:
        print_json(rows)
    elif rows:
        print_reply([{key: row[key] for key in row if key != "notes"} for row in rows])
        # What is wrong with one bag is noted on each topic in it.
        notes = {note: row.topic for row in topic_rows for note in row.notes}
        print_notes(f"{topic}: {note}" for note, topic in notes.items())
    else:
        _print_nothing(memory)
    return not rows


def _print_nothing(memory: Memory) -> None:
    """Prints that nothing here is recorded, or can be read, and why."""
    snapshot = memory.index.snapshot()
    print_line(f"{memory.index.bag_dir}: {snapshot.problem or nothing_here(snapshot)}")
    for aside in (*snapshot.damaged, *snapshot.unread):
        print_line(f"  {aside.path.name}: {aside.reason}")


def _row_with_rate(topic: TopicRow, snapshot: Snapshot, latching: Latching) -> JsonObject:
    """Returns a topic's row as the tool has it, with its rate: planners read that elsewhere."""
    row = shown(topic, Scope())
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
    are_bags = False
    for name in robots or ("",):
        own, memory = open_robot(settings, name, verbose=bags.verbose)
        reports[name] = report = _report(own, memory)
        are_bags |= bool(memory.index.snapshot().bags)
        if robots and not as_json:
            stdout_console().rule(name, align="left")
        if not as_json:
            _show(memory, report)
    if as_json:
        print_json(reports if robots else reports[""])
    return not are_bags


def _report(settings: Settings, memory: Memory) -> dict[str, JsonObject]:
    """Returns what is recorded in one bag directory: replies of two tools, and how much it is."""
    report = {"held": _amount_recorded(memory.index.snapshot())}
    for tool in ("memory_status", "data_time_range"):
        report[tool] = json.loads(call_once(build_dispatcher(settings, memory), tool, {}).text)
    return report


def _show(memory: Memory, report: Mapping[str, JsonObject]) -> None:
    """Prints a report for people."""
    snapshot = memory.index.snapshot()
    aside = (snapshot.active, snapshot.damaged, snapshot.unread, snapshot.empty)
    if not any((snapshot.bags, *aside)):
        _print_nothing(memory)
        return
    shown = _for_people({key: value for part in report.values() for key, value in part.items()})
    budget = budget_of(memory, snapshot, memory.index.heartbeat(), memory.clock.now())
    if budget.most is not None:  # bags that are only looked at have none
        shown["budget"] = describe_budget(budget)
    if snapshot.silent_topics:
        topics = sorted(snapshot.silent_topics)
        shown["topics_without_messages"] = listed(topics, at_most=_MOST_SILENT)
    print_reply(cut_lists(shown, shown))


def _amount_recorded(snapshot: Snapshot) -> JsonObject:
    """Returns how much is recorded, as `ros2 bag info` does."""
    bags, first, last = snapshot.bags, snapshot.earliest, snapshot.latest
    span = None if first is None or last is None else round(unix_from_ns(last - first), 3)
    amount: JsonObject = {
        "recordings": len(recordings_of(snapshot)),
        "bags": len(bags),
        "storage": storage_of(bags) or None,
        "duration_s": span,
        "messages": sum(bag.summary.count for bag in bags),
        "topics": len(snapshot.timeline.topics()),
        "size_mb": round(sum(bag.size for bag in bags) / MB, 3),
    }
    if snapshot.empty:
        amount["empty_bags"] = len(snapshot.empty)
    if snapshot.silent_topics:
        amount["topics_without_messages"] = [*sorted(snapshot.silent_topics)]
    return amount


def storage_of(bags: Sequence[BagFile]) -> str:
    """Returns the kinds of bags: `mcap`, or `db3, mcap`."""
    return ", ".join(sorted({(bag_kind(bag.path.name) or "")[1:] for bag in bags}))


def _for_people(reply: JsonObject) -> JsonObject:
    """Returns a reply without keys that are empty or repeated, or about a missing recorder."""
    left_out = _TOLD_TWICE if reply["recorder"] is not None else _TOLD_TWICE | _OF_RECORDER
    return {
        key: value
        for key, value in reply.items()
        if key not in left_out and (value not in ([], 0) or key == "earliest")
    }


def describe_budget(budget: Budget) -> str:
    """Returns how much of the budget the bags take, and what is beside them; how long it lasts."""
    text = (
        f"{format_size(budget.used)} of {format_size(budget.most or 0)}: "
        f"bags {format_size(max(budget.used - budget.state, 0))}, "
        f"what is stored beside them {format_size(budget.state)}"
    )
    if budget.foreign:
        text += (
            f"; bags that the recorder did not make take {format_size(budget.foreign)} more, and "
            "are neither counted nor deleted: `ros2-memory adopt DIR` takes those of a folder"
        )
    if budget.per_day is not None:
        text += f"; grows by {format_size(budget.per_day)} a day"
    if budget.full_in_days is not None and budget.keeps_days is not None:
        text += f"; full in {_days(budget.full_in_days)} at this rate"
        text += f"; bags older than {_days(budget.keeps_days)} are deleted"
    return text


def _days(value: float) -> str:
    days = round(value, 0 if value >= 10 else 1)
    return f"{format_value(days)} {'day' if days == 1 else 'days'}"


def recordings(as_json: AsJson = False, *, bags: Bags) -> bool:
    """List every recording of a folder: start, length, size, and which program made it.

    To use one of them only, give --recording NAME to the other commands, or data.recording=NAME to
    the server.
    """
    memory = bags.memory()
    snapshot, root = memory.index.snapshot(), memory.index.bag_dir
    rows, not_read = [*_rows(snapshot, root)], [*_not_read(snapshot, root)]
    is_empty = not (rows or snapshot.damaged or snapshot.unread)
    if as_json:
        print_json([*rows, *not_read])
    elif is_empty:
        _print_nothing(memory)
    else:
        # For people there is the length.
        short = [{key: row[key] for key in row if key != "end"} for row in rows]
        lists: JsonObject = {"recordings": [*short], "not_read": [*not_read]}
        print_reply({title: rows for title, rows in lists.items() if rows})
    return is_empty


def _rows(snapshot: Snapshot, root: Path) -> Iterator[JsonObject]:
    """Yields the recordings, the oldest first."""
    own = OwnRecordings(root)
    for path, bags in sorted(recordings_of(snapshot).items(), key=lambda pair: pair[1][0].start):
        start, end = min(bag.start for bag in bags), max(bag.end for bag in bags)
        whose = "saved moment" if Path(path).is_relative_to(root / MOMENTS_FOLDER) else None
        with suppress(OSError):  # where the list cannot be read, nobody knows
            whose = whose or ("this recorder" if own.owns_bag(bags[0].path) else "another recorder")
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


def _not_read(snapshot: Snapshot, root: Path) -> Iterator[JsonObject]:
    """Yields the files without any message that is read."""
    reasons = {aside.path: aside.reason for aside in (*snapshot.damaged, *snapshot.unread)}
    for path in sorted({*reasons, *snapshot.empty}):
        reason = reasons.get(path, "no message was recorded")
        yield {"file": str(path).removeprefix(f"{root}/"), "reason": reason}
