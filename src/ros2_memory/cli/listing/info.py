"""`ros2-memory topics` and `info`: what is recorded, and how much of it."""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

import typer

from ros2_memory.bag_dir.layout import bag_kind
from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.bootstrap_fleet import ROBOTS_SETTING, robot_settings
from ros2_memory.cli.ask import call_tools
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    MB,
    AsJson,
    Bags,
    open_memory,
    print_line,
    stdout_console,
)
from ros2_memory.cli.output import format_value, print_reply
from ros2_memory.config import Settings
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.reply import JsonObject, Scope, shown
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.clock_steps import clock_steps
from ros2_memory.history.context import Call, Latching, Memory
from ros2_memory.history.robots import contradicting_frames, mixed_recordings
from ros2_memory.history.view import View
from ros2_memory.index.recordings import recordings_of
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import nothing_here
from ros2_memory.queries import list_recorded_topics
from ros2_memory.recorder.index_manager import SPLITS_OF_PATIENCE
from ros2_memory.results import TopicRow
from ros2_memory.tools.replies import Replies

_WHOLE_REPLY: Final = "server.max_reply_chars=1000000000"
"""A planner's context is short; a person's screen scrolls."""
_TOLD_TWICE: Final = frozenset(
    {"earliest_local", "latest_local", "now_local", "newest_age_s", "silent_topics"}
)
_MOST_ROWS: Final = 5
"""Faults of clocks that are printed one by one; more are summed up."""
_MOST_SILENT: Final = 30
_OWN_LISTS: Final = re.compile(r"data_time_range (?:lists them|says why|has the details)")
_OF_RECORDER: Final = frozenset({"recorder", "recorder_alive"})
_SHORTEST_RATED_NS: Final[Ns] = 10 * NS_PER_MS
_RATE_WINDOW_NS: Final[Ns] = 3600 * NS_PER_S


def topics(
    as_json: AsJson = False,
    *,
    bags: Bags,
) -> None:
    """List every recorded topic: type, messages, usual rate, first and last message.

    The rate is that of the topic's newest hour, from its first to its last message in each bag;
    latched topics and logs have none.
    """
    memory = bags.memory()
    rows: list[JsonObject] = []
    try:
        rows += [_topic_row(memory, each) for each in list_recorded_topics(memory, Call())]
        text = json.dumps(rows)
    except NoDataError as error:
        text = Replies(memory.index.bag_dir, sys.maxsize).error(error).text
    if as_json:
        print_line(text)
    elif rows:
        console = stdout_console()
        listed_topics, notes = _notes_apart(rows)
        print_reply(console, listed_topics)
        if notes:
            print_reply(console, {"notes": notes})
    elif text != "[]":
        print_reply(stdout_console(), json.loads(text))
    else:
        print_line(f"nothing is recorded in {memory.index.bag_dir}")
        snapshot = memory.index.snapshot()
        for each in (*snapshot.damaged, *snapshot.unread):
            print_line(f"  {each.path.name}: {each.reason}")
    if not rows:
        raise typer.Exit(EXIT_NEGATIVE)


def _topic_row(memory: Memory, known: TopicRow) -> JsonObject:
    """Returns a row of the tool's reply, with what planners read in `data_time_range` instead."""
    row = shown(known, Scope())
    if known.undecodable is not None:
        row["undecodable"] = known.undecodable
    if known.notes:
        row["notes"] = [*known.notes]
    row["rate_hz"] = usual_rate(memory.index.snapshot(), known.topic, memory.limits.latching)
    return row


def _notes_apart(rows: Sequence[JsonObject]) -> tuple[list[JsonValue], list[JsonValue]]:
    """Returns the rows without their notes, and the notes, each once with how many topics it is on.

    What is wrong with one bag is noted on each topic in it.
    """
    on: dict[str, list[str]] = {}
    others: list[JsonValue] = []
    for row in rows:
        notes = row.get("notes")
        for note in notes if isinstance(notes, list) else []:
            on.setdefault(str(note), []).append(str(row["topic"]))
        others.append({key: value for key, value in row.items() if key != "notes"})
    return others, [
        f"{topics[0] if len(topics) == 1 else counted(len(topics), 'topic')}: {note}"
        for note, topics in on.items()
    ]


def usual_rate(snapshot: Snapshot, topic: str, latching: Latching) -> float | None:
    """Returns the rate (Hz) of a topic in its newest hour, without the gaps between bags.

    None for a latched topic, for a log, whose lines come when something happens, and if no bag has
    two messages of it, or all came at once.
    """
    if latching.is_latched(snapshot, topic) or snapshot.timeline.is_log(topic):
        return None
    stated = [*snapshot.timeline.totals(topic).values()]
    if not stated:
        return None
    last = max(each.last for each in stated)
    intervals, duration = 0, 0
    window = TimeWindow(last - _RATE_WINDOW_NS, last + 1)
    bags = dict.fromkeys(bag for bag, *_ in snapshot.timeline.extents(topic, window))
    for part in chain.from_iterable(bag.summary.of(topic) for bag in bags):
        intervals += part.count - 1
        duration += part.last - part.first
    if not intervals or duration < _SHORTEST_RATED_NS:
        return None
    return round(intervals / unix_from_ns(duration), 2)


def info(
    as_json: AsJson = False,
    *,
    bags: Bags,
) -> None:
    """Show what is recorded: time range, gaps, damaged files, the budget and how long it lasts."""
    settings = bags.settings(_WHOLE_REPLY, "server.tools=all")
    robots = settings.fleet.robots
    if not robots:
        report = _report(settings, verbose=bags.verbose)
        if as_json:
            print_line(json.dumps(report.as_json()))
        else:
            report.show()
        are_bags = report.are_bags
    else:
        every = {
            name: _report(
                robot_settings(settings, name), verbose=bags.verbose, setting=ROBOTS_SETTING
            )
            for name in robots
        }
        if as_json:
            print_line(json.dumps({name: each.as_json() for name, each in every.items()}))
        else:
            for name, each in every.items():
                stdout_console().rule(name, align="left")
                each.show()
        are_bags = any(each.are_bags for each in every.values())
    if not are_bags:
        raise typer.Exit(EXIT_NEGATIVE)


class _Report(NamedTuple):
    """What is recorded in one bag directory.

    Attributes:
        empty: the sentence where it has no files.
        are_bags: whether some bag answers.
        held: how much is recorded.
        replies: those of the tools, by name.
        lists: what may confuse; each may be empty.
        summed: what is printed in place of long lists of the replies.
    """

    empty: str | None
    are_bags: bool
    held: dict[str, JsonValue]
    replies: dict[str, JsonValue]
    lists: dict[str, list[JsonValue]]
    summed: dict[str, JsonValue]

    def as_json(self) -> dict[str, JsonValue]:
        """Returns all of it."""
        return {**self.replies, "held": self.held, **self.lists}

    def show(self) -> None:
        """Prints it for people."""
        if self.empty is not None:
            print_line(self.empty)
            return
        console = stdout_console()
        parts = map(_for_people, self.replies.values())
        found = {**self.held, **dict(chain.from_iterable(map(dict.items, parts)))}
        silent = found.get("topics_without_messages")
        if isinstance(silent, list):
            found["topics_without_messages"] = listed([*map(str, silent)], at_most=_MOST_SILENT)
        print_reply(console, found | self.summed)
        for name, rows in self.lists.items():
            if rows:
                print_reply(console, {name: rows})


def _report(settings: Settings, *, verbose: bool, setting: str | None = None) -> _Report:
    memory = open_memory(settings, verbose=verbose, setting=setting)
    dispatcher = build_dispatcher(settings, memory)
    tools: dict[str, dict[str, object]] = {"memory_status": {}, "data_time_range": {}}
    replies: list[JsonValue] = [json.loads(answer.text) for answer in call_tools(dispatcher, tools)]
    snapshot = memory.index.snapshot()
    lists: dict[str, list[JsonValue]] = {
        "overlapping_recordings": [
            {
                "recording": pair.names[0],
                "and": pair.names[1],
                "from": unix_from_ns(pair.start),
                "to": unix_from_ns(pair.end),
                "robots_differ_on": topic,
            }
            for pair, topic in mixed_recordings(memory, Call())
        ],
        "contradicting_frames": [
            {"frame": each.frame, "in_recordings": [*each.names], "parents": [*each.parents]}
            for each in contradicting_frames(memory, Call())
        ],
        "counted_as_active": [
            {"file": f"{path.parent.name}/{path.name}", "until": unix_from_ns(until)}
            for path, until in assumed_active(memory, snapshot)
        ],
    }
    empty = None
    if not _has_files(snapshot):
        empty = f"{memory.index.bag_dir}: {snapshot.problem or nothing_here(snapshot)}"
    by_tool = dict(zip(tools, replies, strict=True))
    summed = _summed_faults(memory, snapshot)
    return _Report(empty, bool(snapshot.bags), _held(snapshot), by_tool, lists, summed)


def _summed_faults(memory: Memory, snapshot: Snapshot) -> dict[str, JsonValue]:
    """Returns one row for the steps of a clock, and one for the bags it misdated, if many."""
    summed: dict[str, JsonValue] = {}
    steps = clock_steps(View(memory, Call())) if snapshot.bags else ()
    if len(steps) > _MOST_ROWS:
        largest = max(steps, key=lambda each: abs(each.by))
        summed["clock_steps"] = [
            {
                "steps": len(steps),
                "first": unix_from_ns(steps[0].at),
                "last": unix_from_ns(steps[-1].at),
                "largest_s": round(unix_from_ns(largest.by), 3),
                "largest_at": unix_from_ns(largest.at),
            }
        ]
    faults = snapshot.dating.faults
    if len(faults) > _MOST_ROWS:
        ordered = sorted(faults, key=lambda each: each.bag.start)
        worst = max(faults, key=lambda each: each.by)
        summed["clock_faults"] = [
            {
                "bags": len(faults),
                "first": ordered[0].bag.path.name,
                "last": ordered[-1].bag.path.name,
                "largest": f"{worst.bag.path.name}: {worst.reason}",
            }
        ]
    return summed


def _held(snapshot: Snapshot) -> dict[str, JsonValue]:
    """Returns how much is recorded, as `ros2 bag info` does."""
    bags = snapshot.bags
    kinds = sorted({(bag_kind(bag.path.name) or "")[1:] for bag in bags})
    first, last = snapshot.earliest, snapshot.latest
    span = None if first is None or last is None else last - first
    held: dict[str, JsonValue] = {
        "recordings": len(recordings_of(snapshot)),
        "bags": len(bags),
        "storage": ", ".join(kinds) or None,
        "duration_s": None if span is None else round(unix_from_ns(span), 3),
        "messages": sum(bag.summary.count for bag in bags),
        "topics": len(snapshot.timeline.topics()),
        "size_mb": round(sum(bag.size for bag in bags) / MB, 3),
    }
    if snapshot.empty:
        held["empty_bags"] = len(snapshot.empty)
    if snapshot.silent_topics:
        held["topics_without_messages"] = [*sorted(snapshot.silent_topics)]
    return held


def _has_files(snapshot: Snapshot) -> bool:
    aside = (snapshot.bags, snapshot.active, snapshot.damaged, snapshot.unread)
    return any(aside) or bool(snapshot.empty)


def _for_people(reply: JsonValue) -> dict[str, JsonValue]:
    """Returns a reply without keys that are empty or repeated, or about a missing recorder."""
    row = _with_budget_sentence(reply)
    if not isinstance(row, dict):
        return {}
    has_recorder = row.get("recorder", "") is not None
    left_out = _TOLD_TWICE if has_recorder else _TOLD_TWICE | _OF_RECORDER
    return {
        key: _without_itself(value)
        for key, value in row.items()
        if key not in left_out and (value not in ([], 0) or key == "earliest")
    }


def _without_itself(value: JsonValue) -> JsonValue:
    """Returns what a key holds, with this command's own lists where a sentence names the tool."""
    if isinstance(value, str):
        return _OWN_LISTS.sub("see below", value)
    if isinstance(value, list):
        return [_without_itself(each) if isinstance(each, str) else each for each in value]
    return value


def assumed_active(memory: Memory, snapshot: Snapshot) -> Iterator[tuple[Path, Ns]]:
    """Yields the files without an end that count as active only because they changed lately.

    Each comes with the time (wall clock) from which it counts as left open by a crash. Yields
    nothing while a live recorder reports what it writes.
    """
    heartbeat = memory.index.heartbeat()
    if heartbeat is not None and heartbeat.is_live(memory.clock.now()):
        return
    patience = ns_from_unix(SPLITS_OF_PATIENCE * memory.limits.split_duration_s)
    for each in snapshot.active:
        try:
            yield each.path, each.path.stat().st_mtime_ns + patience
        except OSError:
            continue  # the file was moved or deleted since the scan


def _with_budget_sentence(reply: JsonValue) -> JsonValue:
    """Returns a reply of `memory_status` whose budget is a sentence; any other as it is.

    Bags that are only looked at have no budget, and the line above has their size.
    """
    budget = reply.get("budget") if isinstance(reply, dict) else None
    if not isinstance(reply, dict) or not isinstance(budget, dict):
        return reply
    rest = {key: value for key, value in reply.items() if key != "budget"}
    return rest if budget.get("max_gb") is None else {**reply, "budget": describe_budget(budget)}


def describe_budget(budget: dict[str, JsonValue]) -> str:
    """Returns how much of the budget the bags take, and what is beside them; how long it lasts."""
    growth = budget.get("growth_gb_per_day")
    text = f"{_size_text(budget.get('used_gb'))} of {_size_text(budget.get('max_gb'))}"
    used, state = budget.get("used_gb"), budget.get("state_gb")
    if isinstance(used, float) and isinstance(state, float):
        bags = _size_text(max(used - state, 0.0))
        text += f": bags {bags}, what is stored beside them {_size_text(state)}"
    if budget.get("foreign_gb"):
        foreign = _size_text(budget["foreign_gb"])
        text += f"; bags that the recorder did not make take {foreign} more"
    if growth is not None:
        text += f"; grows by {_size_text(growth)} a day"
    if "full_in_days" in budget:
        text += f"; full in {_days(budget['full_in_days'])} at this rate"
        text += f"; bags older than {_days(budget['keeps_days'])} are deleted"
    return text


def _days(value: JsonValue) -> str:
    days = round(value, 0 if value >= 10 else 1) if isinstance(value, int | float) else value
    return f"{format_value(days)} {'day' if days == 1 else 'days'}"


def _size_text(gigabytes: JsonValue) -> str:
    """Returns a size in GB, or below 0.1 GB in MB."""
    if not isinstance(gigabytes, int | float) or gigabytes >= 0.1 or not gigabytes:
        return f"{format_value(gigabytes)} GB"
    return f"{gigabytes * 1000:.3g} MB"
