"""`ros2-memory topics`, `info` and `config show`: what there is, how much of it, and why so."""

import json
import os
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Final

import typer
import yaml

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.cli.asking import asked, is_without_answer
from ros2_memory.cli.oddities import counted_as_active, merged
from ros2_memory.cli.running import (
    NOT_SO,
    AsJson,
    BagDir,
    Overrides,
    Verbose,
    explained_for,
    opened,
    output,
    reporting,
    say,
    settings_for,
)
from ros2_memory.cli.showing import cell, plain, show
from ros2_memory.memory import Memory
from ros2_memory.model import JsonValue, TimeWindow
from ros2_memory.origins import GROUPS, Sources
from ros2_memory.recorder.snapshot import Snapshot
from ros2_memory.settings import AdapterNode, Settings
from ros2_memory.timebase import NS_PER_S, unix_from_ns

MASK: Final = "********"
_WHOLE: Final = "server.max_reply_chars=1000000000"
"""A planner's context is short; a person's screen scrolls."""
_SECRET: Final = ("token", "password", "secret", "credential")
_USUAL_NS: Final = 3600 * NS_PER_S

config_app = typer.Typer(
    help="The configuration, as the programs see it.", no_args_is_help=True, rich_markup_mode=None
)


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
    shown = [{**row, "rate_hz": usual_rate(snapshot, str(row["topic"]))} for row in rows]
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


def usual_rate(snapshot: Snapshot, topic: str) -> float | None:
    """How often a topic was heard in its newest hour (Hz); None where that says nothing."""
    if snapshot.is_latched(topic):
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
    if all(is_without_answer(reply) for reply in replies.values()):
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
    if growth is not None:
        text += f"; grows by {cell(growth)} GB a day"
    if "full_in_days" in budget:
        text += f"; full in {_days(budget['full_in_days'])}"
        text += f", and keeps {_days(budget['keeps_days'])}"
    return text


def _days(value: JsonValue) -> str:
    return f"{cell(value)} {'day' if value == 1 else 'days'}"


@config_app.command("show")
def config_show(
    overrides: Overrides = None,
    bag_dir: BagDir = None,
    sources: Annotated[bool, typer.Option("--sources", help="Say of each key who set it.")] = False,
) -> None:
    """The configuration as YAML, composed of files, environment and arguments; no secrets.

    Whether there is a token for the server is told in a comment, never what it is.
    """
    with reporting("config show"):
        settings, source = explained_for(bag_dir, overrides)
    if sources:
        for line in sourced(settings, source):
            say(line)
        return
    say(yaml.safe_dump(nested(settings), sort_keys=False, allow_unicode=True).rstrip())
    for name in ("MEMORY_API_TOKEN", "MEMORY_API_TOKEN_FILE"):
        if os.environ.get(name):
            say(f"# {name} is set: {MASK}")


def sourced(settings: Settings, source: Sources) -> Iterator[str]:
    """A line for each group's choice and for each key: its name, who set it, its value.

    A group's own keys that only take over another key's value name that one.
    """
    yield f"# files are those of {source.folder}"
    rows: list[tuple[str, str, str]] = []
    for group in GROUPS:
        option, who = source.choice(group)
        rows.append((group, who, option or "null"))
    for key, value in leaves(settings):
        shown = _shown(key, value)
        rows.append((key, source(key), shown if isinstance(shown, str) else json.dumps(shown)))
    told = [(key, _briefly(who, source.folder), value) for key, who, value in rows]
    first, second = (max(len(row[column]) for row in told) for column in (0, 1))
    for key, who, value in told:
        yield f"{key:<{first}}  {who:<{second}}  {value}"


def _briefly(who: str, folder: Path) -> str:
    file, link, other = who.partition(", as ")
    return f"as {other}" if link else file.replace(f"in {folder}/", "")


def leaves(settings: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Every key with its value."""
    if not is_dataclass(settings):
        return
    for each in fields(settings):
        value: object = getattr(settings, each.name)
        name = "_target_" if isinstance(settings, AdapterNode) and each.name == "target" else ""
        key = f"{prefix}{name or each.name}"
        if is_dataclass(value):
            yield from leaves(value, f"{key}.")
        else:
            yield key, value


def nested(settings: object) -> dict[str, object]:
    """The settings as plain values, as the files have them."""
    whole: dict[str, object] = {}
    for key, value in leaves(settings):
        section, _, name = key.partition(".")
        part = whole.setdefault(section, {})
        if isinstance(part, dict):
            part[name] = _shown(key, value)
    return whole


def _shown(key: str, value: object) -> JsonValue:
    if value and any(word in key.rpartition(".")[2].lower() for word in _SECRET):
        return MASK
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple | list):
        return [_shown("", each) for each in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return plain(str(value))
