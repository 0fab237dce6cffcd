"""`ros2-memory topics` and `info`: what there is, and how much of it."""

import json
from typing import Final

import typer

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.ask import asked, is_without_answer
from ros2_memory.cli.oddities import counted_as_active, merged
from ros2_memory.cli.opening import opened
from ros2_memory.cli.output import cell, show
from ros2_memory.cli.running import (
    NOT_SO,
    AsJson,
    BagDir,
    Overrides,
    Verbose,
    output,
    reporting,
    say,
)
from ros2_memory.cli.settling import settings_for
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.timebase import NS_PER_S, unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.queries import list_recorded_topics

_WHOLE: Final = "server.max_reply_chars=1000000000"
"""A planner's context is short; a person's screen scrolls."""
_USUAL_NS: Final = 3600 * NS_PER_S


def topics(
    overrides: Overrides = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """Every recorded topic: type, messages, usual rate, when it was first and last heard.

    The rate is that of the topic's newest hour, without the gaps between bags.
    """
    with reporting("topics"):
        settings = settings_for(bag_dir, [*(overrides or ()), _WHOLE])
        memory = opened(settings, verbose=verbose)
        text = asked(build_dispatcher(settings, memory), "list_recorded_topics", {}).text
        reply: JsonValue = json.loads(text)
        snapshot = memory.index.snapshot()
    rows = [each for each in reply if isinstance(each, dict)] if isinstance(reply, list) else []
    remarks = _remarks(memory) if rows else {}
    shown = [
        {
            **row,
            **remarks.get((str(row["topic"]), str(row["type"])), {}),
            "rate_hz": usual_rate(snapshot, str(row["topic"]), memory.limits.latching),
        }
        for row in rows
    ]
    if as_json:
        say(json.dumps(shown) if rows else text)
    elif rows:
        show(output(), [*shown])
    elif is_without_answer(reply):
        show(output(), reply)
    else:
        say(f"nothing is recorded in {settings.recording.bag_dir}")
    if not rows:
        raise typer.Exit(NOT_SO)


def _remarks(memory: Memory) -> dict[tuple[str, str], dict[str, JsonValue]]:
    """By topic and type what is odd of them; planners read it in `data_time_range`."""
    remarks: dict[tuple[str, str], dict[str, JsonValue]] = {}
    for row in list_recorded_topics(memory, Call()):
        of_row = remarks.setdefault((row.topic, row.type), {})
        if row.undecodable is not None:
            of_row["undecodable"] = row.undecodable
        if row.notes:
            of_row["notes"] = [*row.notes]
    return remarks


def usual_rate(snapshot: Snapshot, topic: str, latching: Latching) -> float | None:
    """How often a topic was heard in its newest hour (Hz); None where that says nothing."""
    if latching.is_latched(snapshot, topic):
        return None
    stated = [*snapshot.stated(topic).values()]
    if not stated:
        return None
    last = max(each.last for each in stated)
    messages, spent = 0, 0
    for _, held in snapshot.holding(topic, TimeWindow(last - _USUAL_NS, last + 1)):
        messages += held.count - 1
        spent += held.last - held.first
    return round(messages / unix_from_ns(spent), 2) if messages > 0 and spent > 0 else None


def info(
    overrides: Overrides = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """What the memory covers: range, gaps, damaged files, the budget, and how long it lasts."""
    with reporting("info"):
        settings = settings_for(bag_dir, [*(overrides or ()), _WHOLE, "server.tools=all"])
        memory = opened(settings, verbose=verbose)
        replies: dict[str, JsonValue] = {
            tool: json.loads(asked(build_dispatcher(settings, memory), tool, {}).text)
            for tool in ("memory_status", "data_time_range")
        }
        beside = _beside(memory)
    if as_json:
        say(json.dumps(replies | beside))
    else:
        console = output()
        for reply in replies.values():
            show(console, _in_words(reply))
            console.print()
        for name, rows in beside.items():
            if rows:
                show(console, {name: rows})
    if not memory.index.snapshot().bags:
        raise typer.Exit(NOT_SO)


def _beside(memory: Memory) -> dict[str, JsonValue]:
    """What the tools' replies do not say; mostly there is nothing."""
    snapshot = memory.index.snapshot()
    return {
        "overlapping_recordings": [
            {
                "recording": each.first,
                "and": each.second,
                "from": unix_from_ns(each.start),
                "to": unix_from_ns(each.end),
            }
            for each in merged(snapshot)
        ],
        "counted_as_active": [
            {"file": f"{path.parent.name}/{path.name}", "until": unix_from_ns(until)}
            for path, until in counted_as_active(memory, snapshot)
        ],
    }


def _in_words(reply: JsonValue) -> JsonValue:
    """A status whose budget is a sentence."""
    budget = reply.get("budget") if isinstance(reply, dict) else None
    if not isinstance(reply, dict) or not isinstance(budget, dict):
        return reply
    return {**reply, "budget": budget_in_words(budget)}


def budget_in_words(budget: dict[str, JsonValue]) -> str:
    """What the bags take of the budget, and for how long it lasts."""
    used, most, growth = (budget.get(key) for key in ("used_gb", "max_gb", "growth_gb_per_day"))
    text = f"{cell(used)} GB"
    if most is None:
        text += "; recorder=none: nothing is recorded or deleted here, so no budget and no growth"
    else:
        text += f" of {cell(most)} GB"
    if budget.get("foreign_gb"):
        text += f"; bags that the recorder did not make take {cell(budget['foreign_gb'])} GB more"
    if growth is not None:
        text += f"; grows by {cell(growth)} GB a day"
    if "full_in_days" in budget:
        text += f"; full in {_days(budget['full_in_days'])}"
        text += f", and keeps {_days(budget['keeps_days'])}"
    return text


def _days(value: JsonValue) -> str:
    return f"{cell(value)} {'day' if value == 1 else 'days'}"
